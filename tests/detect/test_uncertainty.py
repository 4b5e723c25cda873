"""The uncertainty of poses: what a tile's evidence rests on, and how it softens what rays say."""

from dataclasses import replace

import numpy as np
import pytest
from vehicle_scene import GRID_FRAME, SENSOR, ground, look, tiles_of, wall

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.detect.classify import classify
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.parameters import MEASURED_RULES, DetectParameters
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty, TileUncertainties, UncertaintyError, poses_step
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.estimates import PoseEstimate

Tiles = dict[TileId, Tile]


@pytest.fixture(scope="module")
def tiles() -> Tiles:
    return tiles_of(np.concatenate([ground(), wall(9.3)]))


def detector_of(tiles: Tiles, parameters: DetectParameters | None = None) -> ChangeDetector:
    local_map = LocalMap(GRID_FRAME)
    for tile in tiles.values():
        local_map.set_tile(tile)
    return ChangeDetector(local_map, parameters)


def hits(seed: int = 3, shift_m: float = 0.0) -> F64:
    """A scan of the unchanged place with a pose that is `shift_m` off towards the wall."""
    return look([(9.3, -8.0, 8.0, 4.0)], np.random.default_rng(seed)) + np.array([shift_m, 0.0, 0.0])


def tile_of(points_map_m: F64) -> list[int]:
    g = np.floor(GRID_FRAME.grid_of(points_map_m)).astype(np.int64)
    return GRID_FRAME.tile_voxel_of(g)[0].tolist()


def test_of_points_is_the_position_and_the_heading_at_a_lever() -> None:
    assert PoseUncertainty(0.03, 0.002, 20.0).of_points_m == pytest.approx(0.05)
    assert PoseUncertainty(0.03, 0.002).of_points_m == pytest.approx(0.03)


def estimate(covariance: F64 | None = None) -> PoseEstimate:
    return PoseEstimate(0, np.eye(4), 0.02, 0.001, 1.0, "good", covariance=covariance)


def test_the_worst_direction_of_the_pose_counts() -> None:
    assert PoseUncertainty.of(estimate()) == PoseUncertainty(0.02, 0.001)
    tilted = np.diag([1e-6, 0.01**2, 1e-6, 1e-4, 1e-4, 0.3**2])  # pitch known to 0.01 rad, height to 0.3 m
    found = PoseUncertainty.of(estimate(tilted))
    assert (found.sigma_m, found.sigma_rad) == pytest.approx((0.3, 0.01))
    turned = tilted.copy()
    R = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    for block in (slice(0, 3), slice(3, 6)):
        turned[block, block] = R @ tilted[block, block] @ R.T
    again = PoseUncertainty.of(estimate(turned))
    assert (again.sigma_m, again.sigma_rad) == pytest.approx((0.3, 0.01))


@pytest.mark.parametrize("bad", [(-0.01, 0.0, 0.0), (0.0, float("nan"), 0.0), (0.0, 0.0, float("inf"))])
def test_what_is_no_uncertainty_is_refused_with_its_values(bad: tuple[float, float, float]) -> None:
    with pytest.raises(UncertaintyError, match="must be finite and >= 0"):
        PoseUncertainty(*bad)


def test_each_tile_gets_the_mean_variance_of_its_own_points(tiles: Tiles) -> None:
    """A plain account, point by point, over three scans of different quality."""
    poses = [PoseUncertainty(0.02, 0.0005), PoseUncertainty(0.10, 0.003), PoseUncertainty(0.05, 0.001)]
    rng, uncertainties = np.random.default_rng(1), TileUncertainties(GRID_FRAME)
    expected: dict[int, list[tuple[float, float, float]]] = {}
    for k, pose in enumerate(poses):
        points = SENSOR + rng.uniform(-30, 30, (300, 3)) * [1, 1, 0] + [20.0 * k, 0.0, 0.0]
        uncertainties.add_scan(points, len(points), SENSOR, GRID_FRAME.affine(SENSOR), pose)
        for code, p in zip(tile_of(points), points, strict=True):
            row = (pose.sigma_m**2, pose.sigma_rad**2, float(((p - SENSOR) ** 2).sum()))
            expected.setdefault(code, []).append(row)
    assert len(expected) > 3
    for code, rows in expected.items():
        found = uncertainties.pop(TileId(code))
        assert found is not None
        got = (found.sigma_m, found.sigma_rad, found.range_m)
        np.testing.assert_allclose(got, np.sqrt(np.mean(rows, axis=0)), rtol=1e-9)
        assert uncertainties.pop(TileId(code)) is None


def test_large_scans_are_sampled_and_still_count_for_what_they_are() -> None:
    uncertainties = TileUncertainties(GRID_FRAME)
    points = np.broadcast_to(SENSOR + np.array([3.0, 0.0, 0.0]), (50_000, 3))
    for n, sigma_m in ((50_000, 0.0), (12_500, 0.1)):
        some = points[: n : poses_step(n)]
        uncertainties.add_scan(some, n, SENSOR, GRID_FRAME.affine(SENSOR), PoseUncertainty(sigma_m))
    found = uncertainties.mean()
    assert found.sigma_m == pytest.approx(np.sqrt(0.2 * 0.1**2), rel=0.01)
    assert found.range_m == pytest.approx(3.0)


def test_evidence_carries_the_poses_it_rests_on_tile_by_tile(tiles: Tiles) -> None:
    detector, seen = detector_of(tiles), hits()
    codes = np.array(tile_of(seen))
    west = codes == min(codes.tolist())
    detector.add_scan(seen[west], SENSOR, None, PoseUncertainty(0.10, 0.002))
    detector.add_scan(seen[~west], SENSOR, None, PoseUncertainty(0.01, 0.0002))
    found = {e.base.tile_id.morton: e.pose for e in detector.finish(tiles).values()}
    assert found[codes.min()].sigma_m == pytest.approx(0.10)
    assert found[codes.max()].sigma_m == pytest.approx(0.01)
    again = detector_of(tiles)
    again.add_scan(seen, SENSOR)
    assert all(e.pose.sigma_m == 0.0 for e in again.finish(tiles).values())


def counted(tiles: Tiles, pose: PoseUncertainty, parameters: DetectParameters | None = None) -> dict[str, int]:
    """Counters of a place that is as in the map, seen 20 cm off."""
    detector = detector_of(tiles, parameters)
    detector.add_scan(hits(shift_m=0.2), SENSOR, None, pose)
    found = detector.finish(tiles).values()
    return {name: sum(int(getattr(e, name).sum()) for e in found) for name in ("n_bi", "n_bo", "n_pi")}


def test_a_pose_known_poorly_is_not_taken_for_a_change_of_the_wall(tiles: Tiles) -> None:
    sure, unsure = counted(tiles, PoseUncertainty(0.01)), counted(tiles, PoseUncertainty(0.12))
    assert sure["n_bo"] > 100 + 2 * unsure["n_bo"]
    assert sure["n_pi"] > 1.5 * unsure["n_pi"]
    assert unsure["n_bi"] > sure["n_bi"]


def test_a_heading_known_poorly_acts_with_the_range(tiles: Tiles) -> None:
    near, far = counted(tiles, PoseUncertainty(0.0, 0.002)), counted(tiles, PoseUncertainty(0.0, 0.012))
    assert near == counted(tiles, PoseUncertainty())  # 2 cm at 10 m: `included_m` covers it
    assert far["n_bo"] < near["n_bo"]


@pytest.mark.parametrize("sigma_m", [0.0, 0.01, 0.02, 0.04])
def test_good_poses_change_nothing(tiles: Tiles, sigma_m: float) -> None:
    assert counted(tiles, PoseUncertainty(sigma_m)) == counted(tiles, PoseUncertainty())


def changes_called(tiles: Tiles, walls: list[tuple[float, float, float, float]], soft: bool) -> dict[str, int]:
    """Classes that ten scans give whose poses are off by 10 cm along each axis, known to 10 cm and 0.15 degrees."""
    rng, classes = np.random.default_rng(5), np.zeros(6, np.int64)
    detector = detector_of(tiles, DetectParameters(own_rules=replace(MEASURED_RULES, soft=soft)))
    for _ in range(10):
        off = rng.normal(0.0, 0.1, 3) * [1.0, 1.0, 0.5]
        detector.add_scan(look(walls, rng) + off, SENSOR + off, None, PoseUncertainty(0.10, 0.0026))
    for evidence in detector.finish(tiles).values():
        classes += np.bincount(classify(evidence, detector.parameters).change_class, minlength=6)
    return {name.lower(): int(n) for name, n in zip(ChangeClass.__members__, classes, strict=True)}


def test_an_unchanged_place_seen_from_uncertain_poses_is_called_changed_less_often(tiles: Tiles) -> None:
    place = [(9.3, -8.0, 8.0, 4.0)]
    soft, hard = (changes_called(tiles, place, s) for s in (True, False))
    assert hard["modified"] > 20
    assert soft["modified"] < 0.5 * hard["modified"]
    assert soft["deleted"] <= hard["deleted"]
    assert soft["normal"] > hard["normal"]


def test_what_has_gone_and_what_is_new_is_found_all_the_same(tiles: Tiles) -> None:
    place = [(13.4, -8.0, 8.0, 4.0)]  # the wall stands four metres farther back now
    soft, hard = (changes_called(tiles, place, s) for s in (True, False))
    for name in ("deleted", "new"):
        assert hard[name] > 20
        assert soft[name] >= 0.9 * hard[name]


def test_paper_mode_takes_every_pose_for_exact(tiles: Tiles) -> None:
    paper = DetectParameters.paper()
    assert not paper.rules.soft
    assert counted(tiles, PoseUncertainty(0.12), paper) == counted(tiles, PoseUncertainty(), paper)
