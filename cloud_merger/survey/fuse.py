"""Placed submaps become voxels of tiles: drive by drive, so that drives can be compared, and together.

Only where the published map has no road: what it covers is the affair of change detection.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnd.cloud_merger.survey.solve import SolvedPiece, cov_sigma_m
from gnd.gnd_map.accumulate import N_MIN_CELLS, VoxelAccumulator
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame, VoxelGrid, zones
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.submap import spread_points
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId, covering_corridor

STEP_M: Final = 0.09
"""Between the points that stand for a Gaussian: nearer than the sub-cells that say whether a voxel is filled."""
ROAD_M: Final = 3.0
"""The map has a road where it has a Gaussian so near to the way, horizontally."""
WAY_STEP_M: Final = 2.0
WIDE_M: Final = 25.0
"""A new tile holds what lies so near to the new way."""
CLEAR_M: Final = 1.5
"""... and so far from what the map holds, horizontally."""
THICK_M: Final = 0.12
"""Where two drives see a voxel, only directions in which both are thinner tell whether they agree."""
SAME_M: Final = 0.12
"""Drives agree on a voxel when their means lie so near to each other along such a direction."""


@dataclass(frozen=True, slots=True, eq=False)
class FusedTile:
    """One tile as the drives see it.

    Attributes:
        tile: which.
        gaussians: all voxels, of all drives together that are believed; where none is, of all.
        agreed: (N,) of them, whether two vehicles or more saw the voxel and agree.
        drives: numbers of the drives in the piece that have voxels here.
        vehicles: of them, by name, each once.
        apart_m: 90 % quantile of how far vehicles lie apart in shared voxels; None without enough of them.
        shared: voxels that two vehicles or more saw.
        sigma_m: largest position sigma of the submaps that it is made of.
        first_ns, last_ns: of the submaps.
    """

    tile: TileId
    gaussians: Gaussians
    agreed: NDArray[np.bool_]
    drives: tuple[int, ...]
    vehicles: tuple[str, ...]
    apart_m: float | None
    shared: int
    sigma_m: float
    first_ns: int
    last_ns: int


LEAST_SHARED: Final = 30
"""Voxels that must be shared before drives can be said to agree or not."""


def fuse_piece(piece: SolvedPiece, published: Mapping[TileId, Tile]) -> list[FusedTile]:
    """The tiles of the new roads of a piece, sorted."""
    covered = _covered(published, piece.frame)
    way_m = bare_way(piece, covered)
    if not len(way_m):
        return []
    lat, lon, _ = piece.frame.geodetic_from_enu(way_m)
    tiles = covering_corridor(lat, lon, WIDE_M + 1.0)
    found = []
    for group in zones(tiles).values():
        found += _fuse_zone(piece, GridFrame.around(piece.frame, group), covered, cKDTree(way_m[:, :2]))
    return sorted(found, key=lambda one: one.tile)


def _covered(published: Mapping[TileId, Tile], frame: LocalFrame) -> cKDTree | None:
    """Where the published map has Gaussians, from above."""
    means = [
        transform(frame.T_self_other(LocalFrame.of_tile(t)), VoxelGrid.of(t).centre_m(one.gaussians.voxel_id)
                  + one.gaussians.mean_m)[:, :2]
        for t, one in published.items()
        if len(one.gaussians)
    ]  # fmt: skip
    return cKDTree(np.concatenate(means)) if means else None


def bare_way(piece: SolvedPiece, covered: cKDTree | None) -> F64:
    """(K, 3) places along the ways of the drives at which the map has no road, working frame."""
    ways = [np.empty((0, 3))]
    for k in range(len(piece.drives)):
        p = piece.placed.T[piece.graph.drive_of == k, :3, 3]
        way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
        at = np.arange(0.0, way_m[-1] + WAY_STEP_M, WAY_STEP_M)
        ways.append(np.column_stack([np.interp(at, way_m, p[:, axis]) for axis in range(3)]))
    way = np.concatenate(ways)
    return way if covered is None or not len(way) else way[covered.query(way[:, :2])[0] > ROAD_M]


def _fuse_zone(piece: SolvedPiece, grid: GridFrame, covered: cKDTree | None, way: cKDTree) -> list[FusedTile]:
    nodes = [node for drive in piece.drives for node in drive.nodes]
    by_drive = dict[int, VoxelAccumulator]()
    believed, doubted = VoxelAccumulator(grid), VoxelAccumulator(grid)
    for n, node in enumerate(nodes):
        k = int(piece.graph.drive_of[n])
        wanted = _wanted(transform(piece.placed.T[n], node.gaussians.mean_m), covered, way)
        points = transform(piece.placed.T[n], spread_points(node.gaussians.take(wanted), STEP_M))
        by_drive.setdefault(k, VoxelAccumulator(grid)).add(points)
        (doubted if k in piece.doubts else believed).add(points)
    whole = doubted.finish(N_MIN_CELLS) | believed.finish(N_MIN_CELLS)
    own = {k: accumulator.finish(N_MIN_CELLS // 2) for k, accumulator in by_drive.items()}
    centres = {t: piece.frame.enu_from_geodetic(*t.centre_rad, 0.0)[:2] for t in whole}
    origins = cKDTree(piece.placed.T[:, :2, 3])
    found = []
    for tile, gaussians in whole.items():
        near = origins.query_ball_point(centres[tile], 30.0 + WIDE_M)
        found.append(_fused(piece, tile, gaussians, {k: o[tile] for k, o in own.items() if tile in o}, near))
    return found


def _wanted(mean_m: F64, covered: cKDTree | None, way: cKDTree) -> NDArray[np.bool_]:
    """(N,) Gaussians near to the new way and off the map; looked up once for each square of half a metre."""
    squares, row = np.unique(np.floor(mean_m[:, :2] * 2.0).astype(np.int64), axis=0, return_inverse=True)
    centres = (squares + 0.5) / 2.0
    good = way.query(centres)[0] < WIDE_M
    if covered is not None:
        good &= covered.query(centres)[0] > CLEAR_M
    return np.asarray(good[row.ravel()])


def _fused(
    piece: SolvedPiece, tile: TileId, gaussians: Gaussians, own: Mapping[int, Gaussians], near: Sequence[int]
) -> FusedTile:
    believed = {k: g for k, g in own.items() if k not in piece.doubts and len(g)}
    by_vehicle: dict[str, list[Gaussians]] = {}
    for k, g in believed.items():
        by_vehicle.setdefault(piece.drives[k].vehicle, []).append(g)
    agreed, apart = agreement(gaussians, by_vehicle)
    of_these = [n for n in near if int(piece.graph.drive_of[n]) in (believed or own)]
    nodes = [node for drive in piece.drives for node in drive.nodes]
    times = [nodes[n].t_ns for n in of_these]
    return FusedTile(
        tile=tile,
        gaussians=gaussians,
        agreed=agreed,
        drives=tuple(sorted(believed or own)),
        vehicles=tuple(sorted(by_vehicle)),
        apart_m=float(np.quantile(apart, 0.9)) if len(apart) >= LEAST_SHARED else None,
        shared=len(apart),
        sigma_m=max((cov_sigma_m(piece.placed.covariance[n]) for n in of_these), default=np.inf),
        first_ns=min(times, default=0),
        last_ns=max(times, default=0),
    )


def agreement(gaussians: Gaussians, by_vehicle: Mapping[str, Sequence[Gaussians]]) -> tuple[NDArray[np.bool_], F64]:
    """(N,) which voxels two vehicles or more saw alike, and how far apart they lie in those that are shared.

    The distance of two means counts along the direction in which the voxel is thinnest; of a thick one, such as a
    hedge, half of the distance that there is.
    """
    n = len(gaussians)
    seen, apart_m = np.zeros(n, np.int64), np.zeros(n)
    values, axes = np.linalg.eigh(gaussians.full_cov())
    thin = values[:, 0] < THICK_M**2
    for parts in by_vehicle.values():
        has, off_m = np.zeros(n, np.bool_), np.full(n, np.inf)
        for own in parts:
            at = np.searchsorted(gaussians.voxel_id, own.voxel_id)
            inside = at < n
            at, kept = at[inside], np.flatnonzero(inside)
            same = gaussians.voxel_id[at] == own.voxel_id[kept]
            at, kept = at[same], kept[same]
            off = own.mean_m[kept].astype(np.float64) - gaussians.mean_m[at]
            along = np.abs(np.einsum("ni,ni->n", off, axes[at, :, 0]))
            has[at] = True
            off_m[at] = np.minimum(off_m[at], np.where(thin[at], along, np.linalg.norm(off, axis=1) / 2))
        seen += has
        apart_m = np.where(has, np.maximum(apart_m, off_m), apart_m)
    shared = seen >= 2
    return shared & (2.0 * apart_m <= SAME_M), 2.0 * apart_m[shared]
