"""A point-cloud map and its parameters."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.dense_rays import ScanPlan
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.world import State, World
from gnd.gnd_map.accumulate import CELLS_A_SIDE, N_MIN_CELLS, VoxelAccumulator
from gnd.gnd_map.arrays import F32, F64, I64, points_3d
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.evidence import MassParameters
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.near_grid import grid_near
from gnd.gnd_map.tile_id import TileId


class PcdError(GndError):
    """Base of the point-cloud baseline's errors; also a parameter, cloud or report that cannot be used."""


MASSES: Final = MassParameters(lambda_c_pass=0.05)
"""Evidence of a map point: hits near it (BI) and rays that passed it (PI), Eq. (5) and (7)."""
NEW_MASSES: Final = MassParameters(lambda_s_block=0.05, lambda_c_block=0.0, lambda_c_pass=0.1)
"""Evidence of a cell without map points: hits are its "passes" (C, Eq. 9), rays through it its "hits" (S)."""
NEAR_M: Final = 0.15
"""A hit this close to a map point (across its surface, where it has one) is explained by it."""
PLANAR_RATIO: Final = 10.0
"""λ2 / λ1 of the points around a map point from which it lies on a surface (as Eq. 16)."""
BEYOND_M: Final = 0.15
"""A ray has passed a point on a surface when it ends so far behind the surface."""
BESIDE_M: Final = 0.05
"""A ray has passed a point without surface when it went by this close ..."""
AHEAD_M: Final = 0.5
"""... and so far before its own end."""
SUPPORT_CELLS: Final = 3
"""Evidence of a map point is that of all map points within so many leaf cells."""
NEW_SUPPORT_CELLS: Final = 1
"""The same for new points."""
MIN_PASSES: Final = 3
"""Rays through an empty block before it counts as observed."""
MIN_PASS_POINTS: Final = 2
"""Passing rays in the support that a deletion needs."""
RANGE_M: Final = (2.0, 50.0)
"""Nearer points are the vehicle itself; farther hits are not used, but their rays pass what lies within the range."""
XI: Final = 0.5
"""More than this share of a block's observers must agree (the analogue of ξ_update, GND 5.3)."""
REACH_CELLS: Final = 1
"""New points of several vehicles this many leaf cells apart speak of the same surface."""
SIMILAR: Final = 0.8
"""Score: a voxel whose Gaussians before and after are at least this similar counts as not modified."""

_HALF_SPAN = 1 << 20  # cells around the frame's origin that a key can name
_MASK = (1 << 21) - 1
_PLACES_AT_ONCE = 24
_AT_ONCE = 50_000


@dataclass(frozen=True, slots=True, eq=False)
class PcdMap:
    """A point cloud in the map frame."""

    points_m: F32
    """(M, 3) float32 metres, map frame."""
    frame: LocalFrame
    """The map frame (ENU)."""

    def __post_init__(self) -> None:
        p = self.points_m
        if p.dtype != np.float32 or p.ndim != 2 or p.shape[1] != 3 or not np.isfinite(p).all():
            raise PcdError(f"points must be finite float32 (M, 3), got {p.dtype} {p.shape}")

    def __len__(self) -> int:
        return len(self.points_m)

    @property
    def sha(self) -> bytes:
        """32 bytes: SHA-256 of the points."""
        return hashlib.sha256(self.points_m.tobytes()).digest()

    @property
    def grid_frame(self) -> GridFrame:
        """The GND grid around the map frame's origin."""
        return GridFrame.around(self.frame, [TileId.from_geodetic(self.frame.lat_rad, self.frame.lon_rad)])


def base_pcd(
    world: World, plan: ScanPlan | None = None, *, state: State = "before", leaves: int = CELLS_A_SIDE
) -> PcdMap:
    """The point cloud of a world's state from the dense noise-free scan that the truth is made of.

    Args:
        world: the street.
        plan: where the scan looks from; that of the truth by default.
        state: "before" is the base map.
        leaves: leaf cells along each side of a voxel.
    """
    grid_frame = PcdMap(np.empty((0, 3), np.float32), world.frame).grid_frame
    return PcdMap(downsample(_dense_points(world, plan or ScanPlan(), state), grid_frame, leaves), world.frame)


def _dense_points(world: World, plan: ScanPlan, state: State) -> Iterable[F64]:
    """Hits (N, 3), map frame, a few scanner places at a time."""
    scene = Scene.build(world.shapes(state), world.A_street_map)
    waiting: list[F64] = []
    for place, origin in enumerate(world.map_of_street(plan.origins_street(world))):
        directions = world.map_of_street(plan.directions_street(place))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        ranges, _ = scene.cast(origin, directions, plan.range_m)
        hit = np.isfinite(ranges)
        waiting.append(origin + ranges[hit, None] * directions[hit])
        if len(waiting) == _PLACES_AT_ONCE:
            yield np.concatenate(waiting)
            waiting = []
    if waiting:
        yield np.concatenate(waiting)


def downsample(clouds: Iterable[F64], grid_frame: GridFrame, leaves: int = CELLS_A_SIDE) -> F32:
    """(K, 3) float32 centroids of the points of each leaf cell, sorted by cell."""
    keys, count, sums = np.empty(0, np.int64), np.empty(0, np.float64), np.empty((0, 3))
    for cloud in clouds:
        key = cell_keys(cells_of(points_3d("points", cloud), grid_frame, leaves), grid_frame, leaves)
        parts = np.concatenate([keys, key]), np.concatenate([count, np.ones(len(key))]), np.concatenate([sums, cloud])
        keys, inverse = np.unique(parts[0], return_inverse=True)
        count = np.bincount(inverse, weights=parts[1]).astype(np.float64)
        sums = np.stack([np.bincount(inverse, weights=parts[2][:, a]) for a in range(3)], axis=1)
    return (sums / count[:, None]).astype(np.float32)


def cells_of(points_map_m: F64, grid_frame: GridFrame, leaves: int = CELLS_A_SIDE) -> I64:
    """(N, 3) int64 leaf cells of points (N, 3): floor(grid coordinates x leaves)."""
    parts = [np.floor(grid_near(grid_frame, part) * leaves) for part in _parts(points_map_m)]
    return np.concatenate(parts).astype(np.int64)


def _parts(points: F64) -> list[F64]:
    """The points in pieces: `grid_near` is fast where a piece, of sorted points, is no longer than some 100 m."""
    return np.array_split(points, max(1, len(points) // _AT_ONCE))


def cell_keys(cells: I64, grid_frame: GridFrame, leaves: int = CELLS_A_SIDE) -> I64:
    """(N,) int64 one number a cell, ordered by x, y, z.

    Raises:
        PcdError: a cell lies farther than about 100 km from the frame's origin.
    """
    away = cells - _key_origin(grid_frame, leaves)
    if len(away) and not ((away >= 0) & (away <= _MASK)).all():
        raise PcdError(f"cells up to {np.abs(away - _HALF_SPAN).max()} from the frame's origin; {_HALF_SPAN} have keys")
    return np.asarray((away[:, 0] << 42) | (away[:, 1] << 21) | away[:, 2])


def key_cells(keys: I64, grid_frame: GridFrame, leaves: int = CELLS_A_SIDE) -> I64:
    """(N, 3) the cells of `cell_keys`."""
    away = np.stack([keys >> 42, (keys >> 21) & _MASK, keys & _MASK], axis=-1)
    return np.asarray(away + _key_origin(grid_frame, leaves))


def _key_origin(grid_frame: GridFrame, leaves: int) -> I64:
    return np.asarray(np.floor(grid_frame.grid_of(np.zeros((1, 3)))[0]).astype(np.int64) * leaves - _HALF_SPAN)


def gnd_of(pcd: PcdMap, grid_frame: GridFrame, n_min_cells: int = N_MIN_CELLS) -> dict[TileId, Gaussians]:
    """The Gaussians of a point cloud: the one existence rule, moments of its points, by tile."""
    accumulator = VoxelAccumulator(grid_frame)
    for part in _parts(pcd.points_m.astype(np.float64)):
        accumulator.add(part)
    return accumulator.finish(n_min_cells)


def without(pcd: PcdMap, deleted: NDArray[np.bool_], added_m: F32) -> PcdMap:
    """The cloud without the points `deleted` (M,) and with points `added_m` (K, 3) behind them."""
    return PcdMap(np.concatenate([pcd.points_m[~deleted], added_m.astype(np.float32)]), pcd.frame)
