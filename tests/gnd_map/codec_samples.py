"""Gaussians for tests of codecs: those of streets, and everything at the limits of what a voxel may hold."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gnd.gnd_map.gaussian import Gaussians, concat, six_entries
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId

EQUATOR = TileId.from_geodetic(np.radians(0.0001), np.radians(10.0))
KARLSRUHE = TileId.from_geodetic(np.radians(49.0), np.radians(8.4))
ARCTIC = TileId.from_geodetic(np.radians(89.99), np.radians(-120.0))
ANTARCTIC = TileId.from_geodetic(np.radians(-89.9999), np.radians(179.9999))
SEOUL = TileId(497353963154)
TILES = (EQUATOR, KARLSRUHE, ARCTIC, ANTARCTIC, SEOUL)


def ids_in(tile_id: TileId, rng: np.random.Generator, n: int, floors: tuple[int, int] = (-3, 12)) -> np.ndarray:
    """(<= n,) voxel ids of a tile between two floors, ascending."""
    grid = VoxelGrid.of(tile_id)
    ix, iy = rng.integers(0, grid.nx, n), rng.integers(0, grid.ny, n)
    return np.unique(grid.voxel_id(ix, iy, rng.integers(*floors, n))).astype(np.int32)


def street(tile_id: TileId, rng: np.random.Generator, n: int) -> Gaussians:
    """About n voxels of a tile: a road with a slope, a wall, and things that stand about."""
    grid = VoxelGrid.of(tile_id)
    ix, iy = rng.integers(0, grid.nx, n), rng.integers(0, grid.ny, n)
    kind = rng.choice(3, n, p=[0.55, 0.3, 0.15])
    ix = np.where(kind == 1, grid.nx // 3, ix)
    floor = np.where(kind == 0, ix // 16, rng.integers(0, 8, n))
    ids, first = np.unique(grid.voxel_id(ix, iy, floor).astype(np.int32), return_index=True)
    kind, ix = kind[first], ix[first]
    sd = np.stack([_sd(rng, kind, thin) for thin in (1, 2, 0)], axis=1)
    turn = _turns(rng, len(ids), 0.05)
    cov = turn * sd[:, None, :] ** 2 @ turn.transpose(0, 2, 1)
    mean = rng.normal(0, 0.05, (len(ids), 3))
    mean[:, 2] += np.where(kind == 0, (ix % 16) / 16.0 - 0.5, 0.0)
    return gaussians_of(ids, rng.integers(20, 3000, len(ids)), mean, cov)


def _sd(rng: np.random.Generator, kind: np.ndarray, thin: int) -> np.ndarray:
    wide = rng.uniform(0.2, 0.3, len(kind))
    return np.where(kind == (thin + 1) % 3, rng.uniform(0.005, 0.03, len(kind)), wide)


def _turns(rng: np.random.Generator, n: int, rad: float) -> np.ndarray:
    """(n, 3, 3) small turns, not quite orthogonal at large angles: any matrix will do."""
    x, y, z = rng.normal(0, rad, (3, n))
    zero = np.zeros(n)
    skew = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    return np.eye(3) + skew + 0.5 * skew @ skew


def gaussians_of(ids: np.ndarray, count: np.ndarray, mean: np.ndarray, cov: np.ndarray) -> Gaussians:
    """Gaussians of float64 arrays; occupied cells as many as the count allows, at most 700."""
    six = six_entries(cov).astype(np.float32)
    six[:, [0, 3, 5]] = np.abs(six[:, [0, 3, 5]])
    count = np.asarray(count).astype(np.int32)
    return Gaussians(ids, count, np.minimum(count, 700).astype(np.int32), np.clip(mean, -2, 2).astype(np.float32), six)


def changed(base: Gaussians, tile_id: TileId, rng: np.random.Generator, share: float) -> Gaussians:
    """Another state of a tile: some voxels gone, some other, some new."""
    fate = rng.random(len(base))
    other = street(tile_id, rng, max(4, int(share * len(base))))
    fresh = other.take(~np.isin(other.voxel_id, base.voxel_id))
    kept = base.take(fate > share / 2)
    mean = kept.mean_m.copy()
    moved = rng.random(len(kept)) < share
    mean[moved] += rng.normal(0, 0.1, (int(moved.sum()), 3)).astype(np.float32)
    mean = np.clip(mean, -2, 2)
    again = Gaussians(kept.voxel_id, kept.count, kept.cells, mean, kept.cov_m2)
    return concat([again, fresh])


# --- everything that a voxel may hold ---------------------------------------------------------------------------------

_SD = st.sampled_from([0.0, 1e-6, 1e-3, 0.004, 0.01, 0.1, 0.29, 1.0, 4.0])
_MEAN = st.sampled_from([-2.0, -1.999, -0.5, -1e-6, 0.0, 1e-20, 0.3, 0.5, 1.9999, 2.0]) | st.floats(-2.0, 2.0, width=32)
_COUNT = st.sampled_from([1, 2, 19, 20, 21, 28, 29, 1000, 2**30, 2**31 - 1]) | st.integers(1, 2**31 - 1)
_WILD = st.sampled_from([0.0, 1e-38, -1e-9, 1e-4, -0.05, 0.08, 1.0, -8.0, 3e38]) | st.floats(-8.0, 8.0, width=32)


@st.composite
def extreme_gaussians(draw: st.DrawFn, tile_id: TileId, most: int = 12) -> Gaussians:
    """Points, lines, planes, balls any way round, matrices that are no covariances, means and counts at the limits."""
    seed = draw(st.integers(0, 2**32 - 1))
    ids = ids_in(tile_id, np.random.default_rng(seed), draw(st.integers(0, most)))
    n = len(ids)
    sd = np.array([[draw(_SD) for _ in range(3)] for _ in range(n)]).reshape(n, 3)
    turn = _turns(np.random.default_rng(seed + 1), n, draw(st.sampled_from([0.0, 0.01, 0.5])))
    g = gaussians_of(
        ids,
        np.array([draw(_COUNT) for _ in range(n)], np.int64),
        np.array([[draw(_MEAN) for _ in range(3)] for _ in range(n)]).reshape(n, 3),
        turn * sd[:, None, :] ** 2 @ turn.transpose(0, 2, 1),
    )
    if draw(st.booleans()):
        cov = draw(hnp.arrays(np.float32, (n, 6), elements=_WILD.map(np.float32)))
        cov[:, [0, 3, 5]] = np.abs(cov[:, [0, 3, 5]])
        g = Gaussians(g.voxel_id, g.count, g.cells, g.mean_m, cov)
    return g
