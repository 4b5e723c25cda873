"""One layer along one drive with given poses: a sign that stands, one that is gone, one that is new."""

from math import atan2, hypot

import numpy as np
import pytest

from gnd.gnd_map.features import VACUOUS, Feature, FeatureTile, feature_id_of, hit, miss, prior
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import exp_so3
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import Detections
from gnd.schemas.errors import LayerError
from gnd.schemas.feature_layer import LAYERS, LayerParameters
from gnd.schemas.features import FeatureChange
from gnd.vehicle_agent.features.feature_map import place_in_tile
from gnd.vehicle_agent.features.layer import FeatureLayer, PlacedLook, of_counts
from gnd.vehicle_agent.features.layer_parameters import FeatureParameters
from gnd.vehicle_agent.features.layers import placed
from gnd.vehicle_agent.features.look import Look
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.packed_rays import PlacedRays

START = TileId.from_path("13033/03021/23031/22102")
FRAME = LocalFrame.of_tile(START)
STANDS, GONE, NEW = (40.0, 5.0), (60.0, -5.0), (80.0, 6.0)
POSE_COV = np.diag([1e-4, 1e-4, 1e-8])


def mapped(*places: tuple[float, float]) -> list[FeatureTile]:
    """Tiles of a map that holds signs at these places of the map frame, height 2 m."""
    tiles: dict[TileId, list[Feature]] = {}
    for place in places:
        tile, point, cov = place_in_tile(FRAME, np.array([*place, 2.0]), np.diag([0.01, 0.01, 0.04]))
        tiles.setdefault(tile, []).append(
            Feature(feature_id_of(*map(str, place)), "traffic_sign", point, cov, prior(0.95))
        )
    return [FeatureTile.of(tile, 3, found) for tile, found in tiles.items()]


def look_from(x: float, rng: np.random.Generator, t_ns: int) -> PlacedLook:
    """What the camera detects at (x, 0), heading east: signs that are there, nine times in ten."""
    there = [p for p in (STANDS, NEW) if p[0] - x > 0 and hypot(p[0] - x, p[1]) < 78.0]
    there = [p for p in there if abs(atan2(p[1], p[0] - x)) < np.radians(19.0) and rng.random() < 0.9]
    range_m = np.array([hypot(p[0] - x, p[1]) + rng.normal(0.0, 0.5) for p in there])
    bearing = np.array([atan2(p[1], p[0] - x) + rng.normal(0.0, 0.01) for p in there])
    n = len(there)
    look = Look(t_ns, range_m, bearing, np.full(n, 0.5), np.full(n, 0.01), ("traffic_sign",) * n, np.full(n, 2.0))
    return PlacedLook(look, np.array([x, 0.0, 0.0]), POSE_COV, 0.0)


@pytest.fixture(scope="module")
def changes() -> dict[TileId, FeatureChange]:
    layer = FeatureLayer(LAYERS["signs"], FRAME)
    for tile in mapped(STANDS, GONE):
        assert layer.hold(tile)
    rng = np.random.default_rng(3)
    for step in range(160):
        layer.see(look_from(-20.0 + 0.6 * step, rng, step * 66_000_000), None)
    return {change.tile: change for change in layer.leave_all()}


def seen(changes: dict[TileId, FeatureChange], place: tuple[float, float]):  # type: ignore[no-untyped-def]
    number = feature_id_of(*map(str, place))
    (found,) = [one for change in changes.values() for one in change.seen if one.feature_id == number]
    return found


def test_a_sign_that_stands_is_confirmed_and_measured(changes: dict[TileId, FeatureChange]) -> None:
    one = seen(changes, STANDS)
    assert one.existence.state == "exist"
    assert one.hits > 20
    tile, point, _ = place_in_tile(FRAME, np.array([*STANDS, 2.0]), np.eye(3))
    assert np.hypot(*(one.position_m - point[0])[:2]) < 0.4
    assert tile in changes


def test_a_sign_that_is_gone_is_denied(changes: dict[TileId, FeatureChange]) -> None:
    one = seen(changes, GONE)
    assert one.existence.state == "absent"
    assert one.position_m is None


def test_a_new_sign_is_found_where_it_stands(changes: dict[TileId, FeatureChange]) -> None:
    found = [(tile, one) for tile, change in changes.items() for one in change.found]
    tile, point, _ = place_in_tile(FRAME, np.array([*NEW, 2.0]), np.eye(3))
    assert [(where, one.kind) for where, one in found] == [(tile, "traffic_sign")]
    assert np.hypot(*(found[0][1].points_m[0] - point[0])[:2]) < 0.3
    assert found[0][1].points_m[0, 2] == pytest.approx(point[0, 2], abs=0.5)
    assert found[0][1].existence.state == "exist"


def test_heights_are_those_of_the_map_on_a_slope() -> None:
    """The vehicle climbs by 2 % and looks along its own x axis; the sign's foot is where the map has it."""
    slope, sign = 0.02, np.array([80.0, 4.0, 80.0 * 0.02 + 2.0])
    T = np.eye(4)
    T[:3, :3] = exp_so3(np.array([0.0, -np.arctan(slope), 0.0]))
    layer = FeatureLayer(LAYERS["signs"], FRAME)
    for x in np.arange(10.0, 60.0, 0.5):
        T[:3, 3] = x, 0.0, slope * x
        ahead, left, height = (np.float32(v) for v in T[:3, :3].T @ (sign - T[:3, 3]))
        columns = [
            np.array([v], np.float32) for v in (np.hypot(ahead, left), np.arctan2(left, ahead), height, 0.5, 0.01)
        ]
        look = Detections(int(x * 1e8), "camera", "signs", ("traffic_sign",), *columns)
        estimate = PoseEstimate(look.t_ns, T.copy(), 0.01, 1e-3, 0.9, "good")
        layer.see(
            placed(look, T, RefinedScan(look.t_ns, PlacedRays(np.zeros((0, 3)), np.zeros((0, 3))), estimate)), None
        )
    (found,) = [(change.tile, one) for change in layer.leave_all() for one in change.found]
    tile, point, _ = place_in_tile(FRAME, sign, np.eye(3))
    assert found[0] == tile
    assert found[1].points_m[0] == pytest.approx(point[0], abs=0.1)


def test_the_report_says_where_the_drive_has_looked_and_what_it_compared_with(
    changes: dict[TileId, FeatureChange],
) -> None:
    assert sum(change.viewed.bit_count() for change in changes.values()) > 100
    judged = [change for change in changes.values() if change.seen]
    assert all(change.base_version == 3 and len(change.base_sha) == 32 for change in judged)
    assert {change.base_version for change in changes.values() if not change.seen} <= {0, 3}


def test_a_newer_version_waits_while_there_is_evidence_against_the_old_one() -> None:
    layer = FeatureLayer(LAYERS["signs"], FRAME)
    (old,), (new,) = mapped(STANDS), mapped((STANDS[0] + 0.1, STANDS[1]))
    assert layer.hold(old)
    assert layer.hold(new)
    layer.see(look_from(20.0, np.random.default_rng(0), 0), None)
    assert not layer.hold(old)
    assert layer.holds(new.tile_id) == new


def test_what_was_left_is_forgotten() -> None:
    layer = FeatureLayer(LAYERS["signs"], FRAME)
    for tile in mapped(STANDS):
        layer.hold(tile)
    layer.see(look_from(20.0, np.random.default_rng(0), 0), None)
    assert layer.leave(np.array([20.0, 0.0, 0.0]), 90.0) == []
    assert layer.leave(np.array([400.0, 0.0, 0.0]), 90.0)
    assert layer.tiles == []


@pytest.mark.parametrize(("hits", "misses"), [(0, 0), (4, 2), (0, 5), (3, 3), (7, 1)])
def test_masses_of_counts_are_those_of_looks_one_by_one(hits: int, misses: int) -> None:
    state = VACUOUS
    for evidence in [hit(0.7)] * hits + [miss(0.7)] * misses:
        state = state.combined(evidence)
    one = of_counts(hits, misses, 0.7)
    expected = pytest.approx((state.exist, state.absent, state.unknown, state.conflict), abs=2e-4)
    assert (one.exist, one.absent, one.unknown, one.conflict) == expected


def test_masses_of_very_many_looks_do_not_underflow() -> None:
    assert of_counts(4000, 400, 0.9).state == "exist"
    even = of_counts(3000, 3000, 0.9)
    assert even.exist == pytest.approx(even.absent)


def test_layers_that_cannot_be_are_refused_by_name() -> None:
    with pytest.raises(LayerError, match="trees"):
        FeatureParameters.of("signs", "trees")
    with pytest.raises(LayerError, match="ndt2"):
        LayerParameters("ndt2", "camera", ("traffic_sign",))
    with pytest.raises(LayerError, match="twice"):
        FeatureParameters((LAYERS["signs"], LAYERS["signs"]))
