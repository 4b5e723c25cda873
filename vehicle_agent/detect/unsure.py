"""Where a drive met something in an empty voxel, too little for a decision of its own: what it tells the cloud of it.

At the speed of a motorway a LiDAR meets too few sub-cells of a new thing. Each vehicle that calls such a voxel empty
outvotes those that saw it; so who met something abstains there, and tells how much it met. The cloud adds that up over
vehicles (`gnd.cloud_merger.together`).

The number that travels is the one that decides whether a voxel is new: how many sub-cells half as many points would
have met (`extension.cells_at_half`). It is small where a voxel was hit by chance or at its edge, and it adds. Two
values do, those that the lattice of reports has.

It is told only of tiles in which the vehicle cannot decide upon most of what it met. Where it can, as on a street, what
is left is hardly more than edges and noise: there it gained nothing and cost a fifth more bytes.
"""

from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import I32, I64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.vehicle_agent.detect.evidence import TileEvidence
from gnd.vehicle_agent.detect.extension import cells_at_half, extends_neighbour

MET_SHARE: Final = 0.05
"""Who met points with more of its rays in an empty voxel does not call it empty."""
UNSURE_CELLS: Final = 8
"""Sub-cells with points that make it worth telling."""
_BESIDE_CELLS: Final = 5
"""A neighbour with so many counts as something met, too, ..."""
_BESIDE: Final = 2
"""... and so many of the 26 must be: things are larger than a voxel, noise is not."""

_LEAST: Final = 12
"""Voxels of a tile that are told; fewer are not, nor are fewer than those that the drive calls new itself."""

SOME: Final = 5
MUCH: Final = 10
MUCH_CELLS: Final = 6
"""It met much where half of the points would have met so many sub-cells. Two that met much decide together, or three
that met some (`cloud_merger.together.TOGETHER_CELLS`)."""

_AROUND: Final = tuple(step for step in product((-1, 0, 1), repeat=3) if any(step))


def has_met(e: TileEvidence) -> NDArray[np.bool_]:
    """(K,) voxels without a Gaussian in the map in which more than a chance share of the rays ended."""
    return np.asarray(~e.in_map & (e.n_be > MET_SHARE * (e.n_be + e.n_pe)))


def is_unsure(e: TileEvidence, new: NDArray[np.bool_], silent: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(K,) which voxels the cloud is told about.

    Args:
        e: K voxels of a tile.
        new: which of them the drive calls new.
        silent: upon which it does not decide.
    """
    met = has_met(e) & silent
    rows = np.flatnonzero(met & (e.measured.cells >= _BESIDE_CELLS))
    beside = new.copy()
    beside[rows] = ~extends_neighbour(e.base, e.measured.take(rows))
    rows = rows[e.measured.cells[rows] >= UNSURE_CELLS]
    found = np.zeros(len(e), np.bool_)
    found[rows] = _neighbours(e, rows, beside) >= _BESIDE
    return found if found.sum() >= max(_LEAST, new.sum()) else np.zeros(len(e), np.bool_)


def _neighbours(e: TileEvidence, rows: I64, marked: NDArray[np.bool_]) -> I64:
    """(len(rows),) how many of the 26 voxels around each row, in this tile, are marked (K,)."""
    grid, ids = VoxelGrid.of(e.base.tile_id), e.voxel_id[marked]
    here = np.stack(grid.unravel(e.voxel_id[rows]), axis=1)
    n = np.zeros(len(rows), np.int64)
    for step in _AROUND:
        x, y, floor = (here + step).T
        inside = (x >= 0) & (x < grid.nx) & (y >= 0) & (y < grid.ny)
        n[inside] += np.isin(grid.voxel_id(x[inside], y[inside], floor[inside]), ids)
    return n


def told(measured: Gaussians) -> Gaussians:
    """What was measured there as it travels: `count` and `cells` are about how many sub-cells half as many points would
    have met, `MUCH` or `SOME`.
    """
    half = cells_at_half(measured.cells, measured.count)
    cells: I32 = np.where(half >= MUCH_CELLS, MUCH, SOME).astype(np.int32)
    return Gaussians(measured.voxel_id, cells, cells.copy(), measured.mean_m, measured.cov_m2)
