"""Lanes seen against lanes of the map: generalised ICP, what it says along which direction, and which lane is which."""

import sys

import numpy as np
import pytest
from plane_scene import Noise, Scene, drive, sensors

from gnd.extras import MissingExtra
from gnd.gnd_map.errors import ShapeError
from gnd.vehicle_agent.errors import NewLayerError
from gnd.vehicle_agent.features.mapping.dead_reckoning import composed, relative
from gnd.vehicle_agent.features.mapping.drive_nodes import DriveNodes
from gnd.vehicle_agent.features.mapping.lane_looks import Polylines, choices, offsets
from gnd.vehicle_agent.features.mapping.lane_map import LaneMap, gicp
from gnd.vehicle_agent.features.mapping.lanes import LaneMatcher, logarithm, moved, solved

SHARP = Noise(lane_m=0.05, lane_rad=0.002)


def straight(yaw=0.7, lefts=(-5.25, -1.75, 1.75)):
    way = np.linspace(-30.0, 110.0, 141)
    flat = [np.column_stack([way, np.full(141, left), np.zeros(141)]) for left in lefts]
    return [composed(np.tile([2.0, 3.0, yaw], (141, 1)), line)[:, :2] for line in flat]


def arc(radius=80.0, lefts=(-3.5, 0.0, 3.5)):
    angle = np.linspace(-0.3, 1.2, 400)
    return [(radius - left) * np.column_stack([np.sin(angle), -np.cos(angle)]) + [0.0, radius] for left in lefts]


def seen_from(lanes, pose, reach=40.0):
    source = LaneMap.of(lanes).xy_m
    flat = np.column_stack([source, np.zeros(len(source))])
    xy = relative(np.broadcast_to(pose, flat.shape), flat)[:, :2]
    return xy[(xy[:, 0] > 5.0) & (xy[:, 0] < reach)]


def test_gicp_finds_a_shift_across_and_leaves_the_one_along():
    lanes, true = straight(), np.array([2.0, 3.0, 0.7])
    along, across, turn = 0.8, 0.6, 0.02
    start = moved(true, np.array([along, across, turn]))
    found = gicp(LaneMap.of(lanes).xy_m, seen_from(lanes, true), start, 1.5)
    off = logarithm(true, found)
    assert abs(off[1] - 0.0) < 0.02
    assert abs(off[2]) < 1e-3
    assert off[0] == pytest.approx(along, abs=0.1)


@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.57, 2.5])
def test_gicp_works_in_the_plane_whatever_the_heading(yaw):
    lanes, true = straight(yaw), np.array([2.0, 3.0, yaw])
    found = gicp(LaneMap.of(lanes).xy_m, seen_from(lanes, true), moved(true, np.array([0.0, -0.9, 0.03])), 1.5)
    assert np.abs(logarithm(true, found)[1:]).max() < 0.02


def test_gicp_says_nothing_where_there_is_no_lane():
    assert (
        gicp(LaneMap.of(straight()).xy_m, np.random.default_rng(0).uniform(200.0, 240.0, (400, 2)), np.zeros(3), 1.5)
        is None
    )


def matches(bend, noise=SHARP, start=(0.0, 0.0, 0.0), search=False, polish=False, seed=1):
    truth = Scene(bend=bend).truth()
    nodes = DriveNodes.of(drive(truth, noise, seed), sensors(noise))
    matcher = LaneMatcher(LaneMap.of(truth.lanes), nodes.drive.lanes, nodes)
    matcher._searched = not search
    true = truth.at(nodes.t_ns)
    pose = composed(true, np.broadcast_to(np.array(start), true.shape))
    found = matcher.matched(nodes, pose, polish=polish)
    return found, np.array([logarithm(true[k], moved(p_, o)) for k, p_, o in zip(*found[:3], strict=True)])


@pytest.mark.parametrize("polish", [False, True])
def test_straight_lanes_know_nothing_along_and_all_across(polish):
    found, off = matches(0.0, start=(0.7, 0.4, 0.01), polish=polish)
    assert len(found.key) >= 6
    along = np.array([np.cos(0.01), -np.sin(0.01), 0.0])
    np.testing.assert_allclose(found.information @ along, 0.0, atol=1e-5 * found.information[0, 1, 1])
    assert found.information[:, 1, 1].min() > 1.0 / 0.03**2
    np.testing.assert_allclose(off[:, 0], 0.7, atol=0.05)
    assert np.abs(off[:, 1]).max() < 0.1
    assert np.abs(off[:, 2]).max() < 0.005


def test_a_circle_lets_slide_along_it():
    radius, lines = 80.0, arc()
    A = np.zeros((1, 3, 3))
    polylines = np.stack([line[130:290:20][:8] for line in lines])
    o = offsets(Polylines(np.zeros(3, np.int64), polylines, np.tile([1.0, 0.04], (3, 1))), LaneMap.of(lines),
                np.zeros((1, 3)), np.zeros((1, 3)))  # fmt: skip
    for n in range(3):
        J = o.by_pose[n, np.argmin(o.cost[n])]
        A[0] += J.T @ np.diag([1.0, 625.0]) @ J
    values, vectors = np.linalg.eigh(A[0])
    slide = np.array([1.0, 0.0, 1.0 / radius])
    assert values[0] < 1e-4 * values[1]
    assert abs(vectors[:, 0] @ slide) / np.linalg.norm(slide) == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(solved(A, np.zeros((1, 3)))[1][0] @ slide, 0.0, atol=1e-4 * values[2])


def test_matches_are_as_certain_as_they_say():
    noise = Noise(lane_m=1.0, lane_rad=np.radians(2.5), miss=0.1)
    squares, n = 0.0, 0
    for seed in range(6):
        found, off = matches(0.02, noise, seed=seed)
        squares += sum(o @ i @ o for o, i in zip(off, found.information, strict=True))
        n += sum(np.linalg.matrix_rank(i, tol=1e-6 * np.trace(i)) for i in found.information)
    assert 0.6 < squares / n < 1.5


def test_a_start_one_lane_off_is_found_out():
    """Three lanes are seen side by side: a vehicle 2.6 m off would take each for the next, one by one."""
    noise = Noise(lane_m=0.6, lane_rad=np.radians(1.5), miss=0.1)
    _, off = matches(0.01, noise, start=(0.0, 2.6, 0.0), search=True)
    assert np.abs(off[:, 1]).max() < 1.5
    assert np.median(np.abs(off[:, 1])) < 0.3


def test_polylines_of_a_look_keep_their_order():
    lanes = LaneMap.of(straight(0.0))
    x = np.linspace(5.0, 40.0, 8)
    # Two of three, at -5.0 and +1.6: the first and the last, though 1.6 m would be nearer to the middle one if moved.
    lines = Polylines(np.zeros(2, np.int64), np.stack([np.column_stack([x, np.full(8, y)]) for y in (1.6, -5.0)]),
                      np.tile([1.0, 0.04], (2, 1)))  # fmt: skip
    at = np.array([[2.0, 3.0, 0.0]])
    o = offsets(lines, lanes, at, at)
    column, cost = choices(lines, o, np.zeros(1))
    assert column[:, 0].tolist() == [2, 0]
    assert cost[0, 0] == pytest.approx((0.15**2 + 0.25**2) / (1.0 + 0.3**2), rel=0.01)
    np.testing.assert_allclose(o.residual[[0, 1], column[:, 0]], [[-0.15, 0.0], [0.25, 0.0]], atol=1e-6)


def test_more_polylines_than_lanes_leaves_one_over():
    lanes = LaneMap.of(straight(0.0, (-1.75, 1.75)))
    x = np.linspace(5.0, 40.0, 8)
    lines = Polylines(np.zeros(3, np.int64), np.stack([np.column_stack([x, np.full(8, y)]) for y in (-1.7, 1.8, 5.0)]),
                      np.tile([0.5, 0.04], (3, 1)))  # fmt: skip
    at = np.array([[2.0, 3.0, 0.0]])
    column, _ = choices(lines, offsets(lines, lanes, at, at), np.zeros(1))
    assert column[:, 0].tolist() == [0, 1, -1]


def test_feet_are_the_nearest_places_of_a_bent_lane():
    lane = arc()[1]
    lanes, rng = LaneMap.of([lane]), np.random.default_rng(2)
    angle, off = rng.uniform(0.0, 0.9, 50), rng.uniform(-3.0, 3.0, 50)
    xy = (80.0 - off)[:, None] * np.column_stack([np.sin(angle), -np.cos(angle)]) + [0.0, 80.0]
    feet = lanes.feet(np.zeros(50, np.int64), angle * 800.0 + 240.0 + rng.uniform(-40.0, 40.0, 50), xy)
    assert feet.valid.all()
    np.testing.assert_allclose(feet.off_m, off, atol=2e-3)


def test_a_closed_lane_goes_on_past_its_seam():
    angle = np.linspace(0.0, 2.0 * np.pi, 800)
    lanes = LaneMap.of([60.0 * np.column_stack([np.cos(angle), np.sin(angle)])])
    assert lanes.closed.tolist() == [True]
    xy = 61.0 * np.column_stack([np.cos([-0.05, 0.05]), np.sin([-0.05, 0.05])])
    feet = lanes.feet(np.zeros(2, np.int64), np.array([40.0, -40.0]), xy)
    assert feet.valid.all()
    np.testing.assert_allclose(feet.off_m, -1.0, atol=5e-3)


def test_bad_lanes_are_refused():
    with pytest.raises(NewLayerError, match="lane 0 of the HD map"):
        LaneMap.of([np.array([[0.0, 0.0], [0.1, 0.0]])])
    with pytest.raises(NewLayerError, match="without lanes"):
        LaneMap.of([])
    with pytest.raises(ShapeError, match="lane 0"):
        LaneMap.of([np.zeros((4, 3))])
    with pytest.raises(ShapeError, match="not finite"):
        LaneMap.of([np.array([[0.0, np.nan], [5.0, 0.0]])])


def test_without_its_extra_it_says_which(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    lane = np.stack([np.arange(0.0, 20.0, 0.1), np.zeros(200)], axis=1)
    with pytest.raises(MissingExtra, match=r"small_gicp is not installed; .*pip install 'gnd-fleet\[lanes\]'"):
        gicp(lane, lane, np.zeros(3), 1.0)
