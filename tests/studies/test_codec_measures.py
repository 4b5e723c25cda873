"""What codecs are measured by: divergence, pose shift, the plain message beside."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.errors import ShapeError
from gnd.gnd_map.gaussian import Gaussians, full_matrices
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId, covering_circle
from studies.codec_scenes import FLOOR_M, _tile_class, kl_median, kl_nats, plain_protobuf, pose_shift_cm

TILE = TileId(497353963154)


def gaussians(seed: int, n: int) -> Gaussians:
    rng = np.random.default_rng(seed)
    A = rng.normal(0, 0.1, (n, 3, 3)) + 0.2 * np.eye(3)
    cov = (A @ A.transpose(0, 2, 1))[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32)
    mean = rng.uniform(-0.5, 0.5, (n, 3)).astype(np.float32)
    ids = np.arange(0, 3 * n, 3, dtype=np.int32)
    return Gaussians(ids, np.full(n, 90, np.int32), np.full(n, 50, np.int32), mean, cov)


def moved(g: Gaussians, by_m: tuple[float, float, float]) -> Gaussians:
    return Gaussians(g.voxel_id, g.count, g.cells, (g.mean_m + np.float32(by_m)).astype(np.float32), g.cov_m2)


def test_divergence_is_what_samples_of_the_original_say() -> None:
    a, b = gaussians(1, 4), moved(gaussians(2, 4), (0.0, 0.1, 0.0))
    found = kl_nats(a, b)
    for i in range(4):
        p, q = (
            multivariate_normal(g.mean_m[i], full_matrices(g.cov_m2[i]) + FLOOR_M**2 * np.eye(3), seed=3)
            for g in (a, b)
        )
        x = p.rvs(200_000)
        assert found[i] == pytest.approx(np.mean(p.logpdf(x) - q.logpdf(x)), rel=0.03)


def test_divergence_from_itself_is_nothing_also_of_a_point() -> None:
    g = gaussians(4, 3)
    point = Gaussians(g.voxel_id, g.count, g.cells, g.mean_m, np.zeros_like(g.cov_m2))
    for same in (g, point):
        assert np.allclose(kl_nats(same, same), 0.0, atol=1e-9)
    assert kl_median({TILE: g}, {TILE: moved(g, (0.1, 0.0, 0.0))}) > 0.01


def test_divergence_of_other_voxels_is_refused() -> None:
    with pytest.raises(ShapeError, match="3 voxels and 2 voxels"):
        kl_nats(gaussians(1, 3), gaussians(1, 2))


@pytest.fixture(scope="module")
def room() -> tuple[GridFrame, dict[TileId, Gaussians], np.ndarray]:
    """A hall of 16 m x 12 m, its map, and its points (N, 3) in the map frame."""
    frame = LocalFrame.of_tile(TILE)
    rng = np.random.default_rng(5)
    u, v = rng.uniform(-1, 1, (2, 60_000))
    side, sign = rng.integers(0, 3, 60_000), rng.choice([-1.0, 1.0], 60_000)
    x = np.where(side == 1, 8 * sign, 8 * u)
    y = np.where(side == 2, 6 * sign, 6 * np.where(side == 1, u, v))
    z = np.where(side == 0, 0.0, 1.5 + 1.5 * v)
    points = np.stack([x, y, z], axis=1) + rng.normal(0, 0.01, (60_000, 3)) + [0.3, 0.2, 30.4]
    grid_frame = GridFrame.around(frame, covering_circle(*TILE.centre_rad, 60.0))
    accumulator = VoxelAccumulator(grid_frame)
    accumulator.add(points)
    return grid_frame, {t: g for t, g in accumulator.finish().items() if len(g)}, points


def test_poses_move_as_the_map_does(room: tuple[GridFrame, dict[TileId, Gaussians], np.ndarray]) -> None:
    grid_frame, tiles, points = room
    T = np.eye(4)
    T[:3, 3] = [0.3, 0.2, 30.4]
    scans = [(points[i::7] - T[:3, 3], T) for i in range(7)]
    assert pose_shift_cm(grid_frame, tiles, tiles, scans) == pytest.approx(np.zeros(7), abs=1e-9)
    off = {tile_id: moved(g, (0.01, -0.02, 0.0)) for tile_id, g in tiles.items()}
    assert np.median(pose_shift_cm(grid_frame, tiles, off, scans)) == pytest.approx(np.sqrt(5.0), rel=0.1)
    snapped = {tile_id: snap(g, LATTICES["archive"]) for tile_id, g in tiles.items()}
    assert np.median(pose_shift_cm(grid_frame, tiles, snapped, scans)) < 0.5


def test_scans_that_match_nothing_are_left_out(room: tuple[GridFrame, dict[TileId, Gaussians], np.ndarray]) -> None:
    grid_frame, tiles, points = room
    far = np.eye(4)
    far[:3, 3] = [30.0, 0.0, 60.0]
    assert len(pose_shift_cm(grid_frame, tiles, tiles, [(points[::9] - [0.3, 0.2, 30.4], far)])) == 0


@pytest.mark.parametrize(("number", "least", "most"), [("double", 80, 92), ("float", 44, 54)])
def test_the_papers_way_to_write_a_tile(number: str, least: int, most: int) -> None:
    g = gaussians(6, 200)
    body = plain_protobuf(TILE, g, number)  # type: ignore[arg-type]
    assert least < len(body) / 200 < most
    tile = _tile_class(number).FromString(body)  # type: ignore[arg-type]
    assert tile.id == TILE.morton
    assert [voxel.id for voxel in tile.voxels] == g.voxel_id.tolist()
    assert np.array_equal([voxel.mean for voxel in tile.voxels], g.mean_m)
    assert np.array_equal([voxel.covariance for voxel in tile.voxels], g.cov_m2)
