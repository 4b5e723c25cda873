"""Submaps: what was seen along some metres of way in a frame of its own, as Gaussians of cells of half a metre.

The cells are the voxels of GND tiles at half size, laid around the submap's origin, so that accumulator and codec are
those of the map. They are smaller than the map's voxels because they are cut again once the submap's place on the map
is known: what is cut twice is blurred by part of a cell.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from math import radians
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.codec import CODEC_STANDARD, codec_of, snap
from gnd.gnd_map.codec.lattice import LATTICES
from gnd.gnd_map.errors import TileError
from gnd.gnd_map.gaussian import Gaussians, full_matrices
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame, VoxelGrid
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.tile_id import TileId

CELL_M: Final = 0.5
_SCALE: Final = 1.0 / CELL_M
REACH_TILES: Final = 7
"""A submap reaches so many tiles of its grid to each side: some 130 m."""
_LAT_RAD, _LON_RAD = radians(45.0), radians(10.0)
"""Where on the Earth the grid is borrowed from; part of the wire format."""
_CODEC: Final = CODEC_STANDARD
MIN_CELLS: Final = 10
"""A cell holds a Gaussian from so many occupied sub-cells of 5 cm on."""

Column = tuple[int, int]
"""Tiles east and north of that at the submap's origin."""


@dataclass(frozen=True, slots=True, eq=False)
class SubmapGaussians:
    """N Gaussians in the frame of their submap: mean_m (N, 3), cov_m2 (N, 3, 3), number of points (N,)."""

    mean_m: F64
    cov_m2: F64
    count: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.mean_m)

    def take(self, rows: npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> "SubmapGaussians":
        """The Gaussians at positions, or of a mask (N,)."""
        return SubmapGaussians(self.mean_m[rows], self.cov_m2[rows], self.count[rows])


class SubmapPoints:
    """Collects the points of one submap."""

    def __init__(self) -> None:
        self._points = VoxelAccumulator(_grid())

    def add(self, points_submap_m: npt.ArrayLike) -> None:
        """Take points (N, 3) in the frame of the submap; those beyond its reach are left out."""
        points = np.asarray(points_submap_m, np.float64).reshape(-1, 3)
        inside = np.abs(points[:, :2]).max(axis=1, initial=0.0) < _reach_m()
        self._points.add(_SCALE * points[inside])

    def encoded(self) -> dict[Column, bytes]:
        """The Gaussians as they travel, by tile of the submap's grid, ascending."""
        here, lattice = _origin(), LATTICES["standard"]
        found = {_column_of(tile, here): (tile, g) for tile, g in self._points.finish(MIN_CELLS).items() if len(g)}
        return {at: codec_of(_CODEC).encode(tile, snap(g, lattice)) for at, (tile, g) in sorted(found.items())}


def decode_submap(bodies: Mapping[Column, bytes]) -> SubmapGaussians:
    """The Gaussians of a submap.

    Raises:
        CodecError: bytes that are no Gaussians.
        TileError: a tile beyond the reach of submaps.
    """
    here, parts = _origin(), list[tuple[F64, F64, npt.NDArray[np.int64]]]()
    for column, body in bodies.items():
        if max(abs(column[0]), abs(column[1])) > REACH_TILES:
            raise TileError(f"tile {column} of a submap, it reaches {REACH_TILES} tiles to each side")
        tile = TileId.from_indices(here.lon_index + column[0], here.lat_index + column[1])
        parts.append(_placed(tile, codec_of(_CODEC).decode(tile, body)))
    if not parts:
        return SubmapGaussians(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0, np.int64))
    return SubmapGaussians(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def spread_points(gaussians: SubmapGaussians, step_m: float) -> F64:
    """(P, 3) points that stand for the Gaussians: a grid with about `step_m` between them that fills, along the axes of
    each, the box with its variances. The flat piece of a wall becomes that piece again, with its thickness.
    """
    variances, axes = np.linalg.eigh(gaussians.cov_m2)
    half_m = np.sqrt(3.0 * np.maximum(variances, 0.0))  # a uniform distribution's half width
    n = np.clip(np.ceil(2.0 * half_m / step_m), 2, np.ceil(CELL_M / step_m) + 1).astype(np.int64)
    parts = []
    for shape in np.unique(n, axis=0):
        rows = np.flatnonzero((n == shape).all(axis=1))
        # points in the middle of equal parts have 1 - 1/n² of the variance of the box
        grow = 1.0 / np.sqrt(1.0 - 1.0 / shape**2)
        ticks = [grow[k] * ((2 * np.arange(shape[k]) + 1) / shape[k] - 1.0) for k in range(3)]
        unit = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        off = np.einsum("nij,nj,pj->npi", axes[rows], half_m[rows], unit, optimize=True)
        parts.append((gaussians.mean_m[rows, None, :] + off).reshape(-1, 3))
    return np.concatenate(parts) if parts else np.empty((0, 3))


def _placed(tile: TileId, g: Gaussians) -> tuple[F64, F64, npt.NDArray[np.int64]]:
    T = LocalFrame.of_tile(_origin()).T_self_other(LocalFrame.of_tile(tile))
    mean_m = transform(T, VoxelGrid.of(tile).centre_m(g.voxel_id) + g.mean_m) / _SCALE
    cov_m2 = T[:3, :3] @ full_matrices(g.cov_m2) @ T[:3, :3].T / _SCALE**2
    return mean_m, cov_m2, g.count.astype(np.int64)


def _column_of(tile: TileId, here: TileId) -> Column:
    return tile.lon_index - here.lon_index, tile.lat_index - here.lat_index


@lru_cache(maxsize=1)
def _origin() -> TileId:
    return TileId.from_geodetic(_LAT_RAD, _LON_RAD)


@lru_cache(maxsize=1)
def _grid() -> GridFrame:
    here, steps = _origin(), range(-REACH_TILES, REACH_TILES + 1)
    tiles = [TileId.from_indices(here.lon_index + i, here.lat_index + j) for i, j in product(steps, steps)]
    return GridFrame.around(LocalFrame.of_tile(here), tiles)


@lru_cache(maxsize=1)
def _reach_m() -> float:
    """Nearer than the border of the outermost tiles, from the middle of the one at the origin."""
    grid = VoxelGrid.of(_origin())
    return (REACH_TILES + 0.4) * min(grid.nx * grid.dx_m, grid.ny * grid.dy_m) / _SCALE
