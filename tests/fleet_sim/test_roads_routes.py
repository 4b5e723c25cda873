"""Roads: lines in the plane, motorways with signs, the test track, the motorway with lights."""

import numpy as np
import pytest

from gnd.fleet_sim.errors import RoadError
from gnd.fleet_sim.roads.alignment import Bends, drawn_bends
from gnd.fleet_sim.roads.curve import STEP_M, Centreline, of_curvature, of_figure
from gnd.fleet_sim.roads.motorway import LANE_M, motorway
from gnd.fleet_sim.roads.route import Features, Route
from gnd.fleet_sim.roads.routes import route_named
from gnd.fleet_sim.roads.streetlights import streetlight_motorway
from gnd.fleet_sim.roads.test_track import SHARPEST_M, test_track


@pytest.fixture(scope="module")
def road() -> Route:
    return motorway(11)


def test_an_arc_ends_where_the_circle_does() -> None:
    line = of_curvature([(0.25, 1 / 300.0), (471.0, 1 / 300.0)], 0.4)
    xy, heading = line.at(np.array([471.25]))
    assert heading[0] == pytest.approx(0.4 + 471.125 / 300.0, abs=1e-6)
    chord = 2 * 300.0 * np.sin(0.5 * 471.125 / 300.0)
    assert np.linalg.norm(xy[0]) == pytest.approx(chord, abs=0.15)
    assert line.curvature(np.array([200.0]))[0] == pytest.approx(1 / 300.0, rel=1e-6)


def test_an_open_line_goes_on_straight_beyond_its_ends() -> None:
    line = of_curvature([(100.0, 0.0)], 0.0)
    xy, heading = line.at(np.array([-5.0, 107.0]))
    assert xy == pytest.approx(np.array([[-5.0, 0.0], [107.0, 0.0]]))
    assert line.offset(np.array([50.0]), 2.0) == pytest.approx(np.array([[50.0, 2.0]]))
    assert heading == pytest.approx([0.0, 0.0])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_closed_line_goes_round_and_round(side: float) -> None:
    angle = side * np.linspace(0.0, 2 * np.pi, 5000, endpoint=False)
    line = of_figure(100.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    assert line.length_m == pytest.approx(2 * np.pi * 100.0, abs=STEP_M)
    way = np.linspace(-700.0, 2000.0, 9001)
    xy, heading = line.at(way)
    assert np.linalg.norm(xy, axis=1) == pytest.approx(np.full(9001, 100.0), abs=0.05)
    assert np.abs(np.diff(heading) - side * 0.3 / 100.0).max() < 1e-3, "no jump where a lap ends"
    assert np.linalg.norm(np.diff(xy, axis=0), axis=1) == pytest.approx(np.full(9000, 0.3), abs=1e-3)


def test_lines_that_cannot_be_are_refused() -> None:
    with pytest.raises(RoadError, match=r"\(1, 2\)"):
        Centreline(np.zeros((1, 2)), np.zeros(1))
    with pytest.raises(RoadError, match="finite"):
        Centreline(np.full((3, 2), np.nan), np.zeros(3))


def test_roads_never_turn_back() -> None:
    bends = Bends((900.0, 5000.0), (100.0, 1200.0), (300.0, 1300.0), (120.0, 250.0))
    for seed in range(30):
        line = of_curvature(drawn_bends(bends, 20_000.0, np.random.default_rng(seed)), 0.0)
        assert np.abs(line.heading_rad).max() < np.pi / 2
        assert line.length_m == pytest.approx(20_000.0, abs=STEP_M)


def test_a_motorway_has_the_papers_signs(road: Route) -> None:
    features = road.features
    assert [len(features.rows(state)) for state in ("normal", "deleted", "new")] == [55, 9, 39]
    assert (len(features.standing), len(features.mapped)) == (94, 64)
    assert road.length_m == pytest.approx(20_000.0, abs=STEP_M)
    assert np.isnan(features.mapped_xy_m).any(axis=1).nonzero()[0].tolist() == features.rows("new").tolist()
    error = features.mapped.mapped_xy_m - features.mapped.xy_m
    assert error.std() == pytest.approx(0.1, rel=0.3)


def test_signs_stand_beside_and_over_the_road_on_both_sides(road: Route) -> None:
    way = np.arange(0.0, road.length_m, 1.0)
    line, heading = road.line.at(way)
    nearest = np.linalg.norm(road.features.xy_m[:, None] - line[None], axis=2).argmin(axis=1)
    step = road.features.xy_m - line[nearest]
    left = -np.sin(heading[nearest]) * step[:, 0] + np.cos(heading[nearest]) * step[:, 1]
    over = road.features.height_m > 5.0
    assert (left < -2 * LANE_M).sum() > 40
    assert (left > LANE_M).sum() > 5
    assert (np.abs(left[over]) < 2 * LANE_M).all()
    assert ((left > LANE_M + 1.0) | (left < -2 * LANE_M - 3.0))[~over].all()
    gaps = np.linalg.norm(road.features.xy_m[:, None] - road.features.xy_m[None], axis=2) + 1e9 * np.eye(103)
    assert 2.0 < gaps.min() < 2 * LANE_M, "panels a lane apart, none on top of another"


def test_some_of_the_gone_signs_were_moved(road: Route) -> None:
    features = road.features
    old, new = features.take(features.rows("deleted")), features.take(features.rows("new"))
    way_m = np.linalg.norm(old.xy_m[:, None] - new.xy_m[None], axis=2)
    same = np.array([[a == b for b in new.kinds] for a in old.kinds])
    assert ((way_m < 21.0) & same).any(axis=1).sum() >= 3


@pytest.mark.parametrize("kind", ["motorway", "test-track", "streetlights", "streetlights-straight"])
def test_the_same_seed_gives_the_same_route(kind: str) -> None:
    one, again, other = route_named(kind, 12), route_named(kind, 12), route_named(kind, 13)
    assert np.array_equal(one.features.xy_m, again.features.xy_m)
    assert np.array_equal(one.line.xy_m, again.line.xy_m)
    assert not np.array_equal(one.line.xy_m[:100], other.line.xy_m[:100])
    assert one.features.states == again.features.states


def test_a_shorter_motorway_has_fewer_signs() -> None:
    features = motorway(11, length_m=5000.0).features
    assert [len(features.rows(state)) for state in ("normal", "deleted", "new")] == [14, 2, 10]


def test_the_test_track_is_closed_and_has_beacons() -> None:
    for seed in (11, 12, 13):
        track = test_track(seed)
        assert track.line.closed
        assert track.length_m == pytest.approx(2000.0, abs=2.0)
        assert len(track.features) == 80
        way = np.arange(0.0, track.length_m, 1.0)
        assert np.abs(track.line.curvature(way)).max() < 1.2 / SHARPEST_M
        lanes = track.lanes()
        assert len(lanes) == 3
        assert np.linalg.norm(lanes[0][0] - lanes[0][-1]) < 0.01
        distance = np.linalg.norm(track.features.xy_m[:, None] - track.line.xy_m[None, ::4], axis=2).min(axis=1)
        assert (distance > 4.3).all(), "off the road"


def test_a_straight_motorway_is_straight_and_lit() -> None:
    straight, bent = streetlight_motorway(11, straight=True), streetlight_motorway(11)
    assert np.ptp(straight.line.heading_rad) == 0.0
    assert np.ptp(bent.line.heading_rad) > 0.05
    assert len(straight.features) == len(bent.features) in (125, 250)
    assert np.abs(bent.line.curvature(np.arange(1.0, 4999.0, 5.0))).max() < 1.01 / 1000.0
    assert set(bent.features.kinds) == {"streetlight"}


def test_lanes_lie_beside_the_line(road: Route) -> None:
    lanes = road.lanes(step_m=100.0)
    assert [len(lane) for lane in lanes] == [201] * 4
    apart = np.linalg.norm(lanes[1] - lanes[0], axis=1)
    assert apart == pytest.approx(np.full(201, LANE_M), abs=0.01)


def test_impossible_routes_are_refused(road: Route) -> None:
    for kind in ("motorway", "test-track", "streetlights"):
        with pytest.raises(RoadError, match="-1"):
            route_named(kind, -1)
    with pytest.raises(RoadError, match="4000"):
        motorway(1, length_m=4000.0)
    with pytest.raises(RoadError, match="100"):
        streetlight_motorway(1, length_m=100.0)
    with pytest.raises(RoadError, match="lane"):
        route_named("lane", 1)
    f = road.features
    with pytest.raises(RoadError, match="unique"):
        Features(np.ones(2, np.int64), f.kinds[:2], f.xy_m[:2], f.height_m[:2], f.states[:2], f.mapped_xy_m[:2])
    with pytest.raises(RoadError, match="2 features"):
        Features(f.feature_id[:2], f.kinds[:3], f.xy_m[:2], f.height_m[:2], f.states[:2], f.mapped_xy_m[:2])
