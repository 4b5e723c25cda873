"""A point-cloud map turned into what the ray kernel reads: a dense window of blocks, leaf cells, points and normals."""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.accumulate import CELLS_A_SIDE
from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.grid import GridFrame
from studies.pcd.kernel import CELLS, EMPTY, SIDE, Base, surface_normals
from studies.pcd.points import PcdError, PcdMap, cell_keys, cells_of, key_cells

MAX_BLOCKS = 200_000_000
_REMEMBERED = 2
_MARGIN_BLOCKS = np.array([4, 4, 2]), np.array([4, 4, 8])
"""Room for what is new around, below and above the map."""


@dataclass(frozen=True, slots=True, eq=False)
class PcdIndex:
    """The map's occupied leaf cells U in a window of blocks.

    Attributes:
        grid_frame: the GND grid.
        origin_c: (3,) int64 cell coordinates of the window's corner, in leaf cells of the grid.
        anchor_m: (3,) float64 origin of the kernel's metres, map frame.
        state: (blocks,) int32 row of each block that holds points, -1 elsewhere.
        cells: (U, 3) int32 cell coordinates from the window's corner, by block.
        cell_of_point: (M,) int32 the cell of each point of the map.
        base: the arrays of the kernel.
    """

    grid_frame: GridFrame
    origin_c: I64
    anchor_m: F64
    state: I32
    cells: I32
    cell_of_point: I32
    base: Base

    def window_affine(self, at_m: F64) -> tuple[F64, F64]:
        """A (3, 3) and b (3,): window cell coordinates of metres relative to the anchor, near `at_m` (3,) (map)."""
        A, b = self.grid_frame.affine(at_m)
        A, b = A * CELLS_A_SIDE, b * CELLS_A_SIDE
        return np.ascontiguousarray(A), A @ self.anchor_m + (b - self.origin_c)

    def blocks_of(self, cells: I64) -> I64:
        """(N,) block numbers of window cell coordinates (N, 3), -1 outside the window."""
        at = cells // SIDE
        shape = np.array(self.base.shape)
        inside = ((at >= 0) & (at < shape)).all(axis=1)
        return np.where(inside, (at[:, 0] * shape[1] + at[:, 1]) * shape[2] + at[:, 2], -1)

    def corners_of(self, blocks: NDArray[np.integer]) -> I64:
        """(N, 3) window cell coordinates of the lowest cell of blocks (N,)."""
        return np.stack(np.unravel_index(blocks, self.base.shape), axis=1).astype(np.int64) * SIDE

    def points_at(self, cells: F64) -> F64:
        """(N, 3) map frame, metres, of continuous window cell coordinates (N, 3)."""
        return self.grid_frame.map_of_grid((cells + self.origin_c) / CELLS_A_SIDE)


_remembered: "OrderedDict[tuple[bytes, float], PcdIndex]" = OrderedDict()


def index_of(pcd: PcdMap, planar_ratio: float) -> PcdIndex:
    """Index a point cloud (some seconds for a street; those of the last two clouds, by content, are remembered).

    Raises:
        PcdError: no points, or they span more blocks than there is room for.
    """
    key = pcd.sha, planar_ratio
    if key not in _remembered:
        _remembered[key] = _made_index(pcd, planar_ratio)
        while len(_remembered) > _REMEMBERED:
            _remembered.popitem(last=False)
    return _remembered[key]


def _made_index(pcd: PcdMap, planar_ratio: float) -> PcdIndex:
    if len(pcd) == 0:
        raise PcdError("a point-cloud map without points cannot be compared with anything")
    grid_frame = pcd.grid_frame
    points = pcd.points_m.astype(np.float64)
    keys, inverse, count = np.unique(
        cell_keys(cells_of(points, grid_frame), grid_frame), return_inverse=True, return_counts=True
    )
    cells = key_cells(keys, grid_frame)
    origin, shape = _window(cells)
    cells -= origin
    block, in_block = _block_and_cell(cells, shape)
    order = np.lexsort((in_block, block))
    anchor = points.mean(axis=0)
    sums = np.stack([np.bincount(inverse, weights=points[:, a] - anchor[a]) for a in range(3)], axis=1)
    centroid = np.ascontiguousarray((sums / count[:, None])[order], np.float32)
    state, slot, start = _tables(block[order], in_block[order], shape)
    ordered = np.ascontiguousarray(cells[order], np.int32)
    base = Base(slot, start, centroid, np.zeros_like(centroid), shape)
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    normal = surface_normals(base, state, ordered, planar_ratio)
    return PcdIndex(grid_frame, origin, anchor, state, ordered, rank[inverse], base._replace(normal=normal))


def _window(cells: I64) -> tuple[I64, tuple[int, int, int]]:
    """Corner (3,) in leaf cells, on a voxel's corner, and shape in blocks."""
    below, above = _MARGIN_BLOCKS
    low = (cells.min(axis=0) // CELLS_A_SIDE) * CELLS_A_SIDE - below * SIDE
    shape = (cells.max(axis=0) - low) // SIDE + 1 + above
    if int(np.prod(shape)) > MAX_BLOCKS:
        raise PcdError(f"the points span {shape.tolist()} blocks of half a voxel; there is room for {MAX_BLOCKS}")
    return low, (int(shape[0]), int(shape[1]), int(shape[2]))


def _block_and_cell(cells: I64, shape: tuple[int, int, int]) -> tuple[I64, I64]:
    b, c = np.divmod(cells, SIDE)
    return (b[:, 0] * shape[1] + b[:, 1]) * shape[2] + b[:, 2], (c[:, 0] * SIDE + c[:, 1]) * SIDE + c[:, 2]


def _tables(block: I64, in_block: I64, shape: tuple[int, int, int]) -> tuple[I32, NDArray[np.uint8], I32]:
    """State of the window, slots and starts, of cells sorted by block."""
    rows, start, row_of = np.unique(block, return_index=True, return_inverse=True)
    state = np.full(int(np.prod(shape)), EMPTY, np.int32)
    state[rows] = np.arange(len(rows), dtype=np.int32)
    slot = np.zeros((len(rows), CELLS), np.uint8)
    slot[row_of, in_block] = np.arange(len(block)) - start[row_of] + 1
    return state, slot, start.astype(np.int32)
