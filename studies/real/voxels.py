"""Voxels of one grid frame by a single integer, and how many sub-cells points occupy in them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.grid import GridFrame

I64 = NDArray[np.int64]
_BITS, _HALF = 21, 1 << 20


def origin_of(grid_frame: GridFrame) -> I64:
    """(3,) integer grid coordinates at the frame's origin: keys count from here."""
    return np.asarray(np.floor(grid_frame.grid_of(np.zeros((1, 3)))[0]), np.int64)


def keys_of(grid_frame: GridFrame, g: ArrayLike) -> I64:
    """(N,) one integer a voxel for integer grid coordinates (N, 3), within a million voxels of the origin."""
    offset = np.asarray(g, np.int64) - origin_of(grid_frame) + _HALF
    return np.asarray((offset[..., 0] << 2 * _BITS) | (offset[..., 1] << _BITS) | offset[..., 2])


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Voxels with points: keys (M,) int64 increasing, occupied sub-cells (M,) and points (M,)."""

    keys: I64
    cells: I64
    count: I64

    @classmethod
    def of(cls, accumulator: VoxelAccumulator) -> "Cells":
        """What an accumulator has taken."""
        g, moments = accumulator.moments()
        keys = keys_of(accumulator.grid_frame, g)
        order = np.argsort(keys)
        return cls(keys[order], moments.cells[order].astype(np.int64), moments.count[order])

    def cells_at(self, keys: I64) -> I64:
        """(K,) occupied sub-cells of voxels, 0 where there is no point."""
        return self._at(keys, self.cells)

    def count_at(self, keys: I64) -> I64:
        """(K,) points in voxels."""
        return self._at(keys, self.count)

    def dense(self, n_min_cells: int) -> I64:
        """Keys of the voxels with at least so many sub-cells."""
        return self.keys[self.cells >= n_min_cells]

    def _at(self, keys: I64, values: I64) -> I64:
        if not len(self.keys):
            return np.zeros(len(keys), np.int64)
        row = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[row] == keys, values[row], 0)
