"""Whether what was measured in an empty voxel is more than the edge of a surface that the map holds next door.

Map and vehicle sample such an edge differently, and the least number of sub-cells decides by a hair: on real scans
more than four in five false new voxels lay there, and most of their sub-cells held a single point.
"""

from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I32
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.vehicle_agent.detect.records import planar_normals

DETECT_EDGE_M: Final = 0.15
"""So near to the plane of a planar Gaussian next door a voxel lies at the edge of a known surface."""
_X: Final = np.linspace(1e-6, 60.0, 6001)
_POINTS_PER_CELL: Final = _X / -np.expm1(-_X)

_AROUND: Final = tuple(step for step in product((-1, 0, 1), repeat=3) if any(step))


def cells_at_half(cells: I32, count: I32) -> F64:
    """(K,) how many sub-cells half as many points would have filled.

    A number of sub-cells depends on how often a place was hit. Points that fall on K sub-cells at random fill
    K (1 - exp(-n / K)) of them; n and the filled ones give K, and that the number at n / 2. Where each sub-cell holds
    many points it is all of them, where each holds one it is half.

    Args:
        cells: (K,) sub-cells with points.
        count: (K,) points.
    """
    ratio = np.maximum(count, cells) / np.maximum(cells, 1)
    x = np.interp(ratio, _POINTS_PER_CELL, _X)  # n / K
    return np.asarray(cells / (1.0 + np.exp(-0.5 * x)), np.float64)


def extends_neighbour(base: Tile, measured: Gaussians) -> NDArray[np.bool_]:
    """Return which measured Gaussians (K,) continue a planar one of the map in one of the 26 voxels around.

    Neighbours in other tiles are not looked at.

    Args:
        base: the tile's map.
        measured: K voxels of the same tile.
    """
    found = np.zeros(len(measured), np.bool_)
    if not len(measured) or not len(base.gaussians):
        return found
    grid = VoxelGrid.of(base.tile_id)
    here = np.stack(grid.unravel(measured.voxel_id), axis=1)
    p_tile_m = grid.centre_m(measured.voxel_id) + measured.mean_m
    normal = planar_normals(base.gaussians.full_cov())  # zeros where not planar
    q_tile_m = grid.centre_m(base.gaussians.voxel_id) + base.gaussians.mean_m
    for step in _AROUND:
        row = _rows(grid, base.gaussians.voxel_id, here + step)
        off_m = np.abs(np.einsum("ni,ni->n", normal[row], p_tile_m - q_tile_m[row]))
        found |= (row >= 0) & normal[row].any(axis=1) & (off_m <= DETECT_EDGE_M)
    return found


def _rows(grid: VoxelGrid, ids: I32, at: NDArray[np.int64]) -> NDArray[np.int64]:
    """Row in the sorted `ids` of each voxel (K, 3) of the grid, -1 where there is none."""
    inside = (at[:, 0] >= 0) & (at[:, 0] < grid.nx) & (at[:, 1] >= 0) & (at[:, 1] < grid.ny)
    wanted = grid.voxel_id(*np.where(inside[:, None], at, 0).T)
    row = np.minimum(np.searchsorted(ids, wanted), len(ids) - 1)
    return np.where(inside & (ids[row] == wanted), row, -1)
