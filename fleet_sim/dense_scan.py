"""A dense, noise-free scan of both states of a world from its lanes: what there is to be known about it.

Every metre of both lanes, an ideal scanner with the joint field of view of the fleet's LiDARs casts the same rays
through `before` and `after`: some 1,500 hits a voxel, five times what a VLP-16 brings home from a drive, and evenly
spread. Kept are, for each voxel of the GND grid: which of its 10 cm sub-cells (those of `gnd_map.accumulate`) were hit
on what kind of surface, and how many rays passed through in either state.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.dense_rays import (
    AFTER_COME,
    AFTER_KEPT,
    BEFORE_GONE,
    BEFORE_KEPT,
    LEAF_AFTER,
    LEAF_BEFORE,
    ScanPlan,
    Shots,
    shots,
)
from gnd.fleet_sim.errors import TruthError
from gnd.fleet_sim.world import World
from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.grid import GridFrame, zones
from gnd.gnd_map.jit import kernel
from gnd.gnd_map.near_grid import grid_near
from gnd.gnd_map.tile_id import covering_corridor

__all__ = [
    "AFTER_COME",
    "AFTER_KEPT",
    "BEFORE_GONE",
    "BEFORE_KEPT",
    "LEAF_AFTER",
    "LEAF_BEFORE",
    "SEASONAL",
    "DenseScan",
    "DenseWindow",
    "ScanPlan",
    "dense_scans",
]

FloatArray = NDArray[np.float64]

KNOWN_BEFORE: Final = BEFORE_KEPT | BEFORE_GONE
STANDS_AFTER: Final = BEFORE_KEPT | AFTER_KEPT | AFTER_COME
"""What an ideal map holds after: all that was ever seen and still stands."""

SEASONAL: Final = LEAF_BEFORE | LEAF_AFTER
"""Leaves and snow of either state."""

CELLS: Final = 10
"""Sub-cells of a voxel along each axis."""
_FIRST_VOXELS: Final = 1 << 16
_MAX_VOXELS: Final = 1 << 20
_MARGIN_M: Final = 3.0
_HEIGHT_M: Final = 24.0


class DenseWindow(NamedTuple):
    """A box of voxels in grid coordinates: lowest voxel and size."""

    gx: int
    gy: int
    gz: int
    nx: int
    ny: int
    nz: int


@dataclass(frozen=True, slots=True)
class DenseScan:
    """What the dense scan has seen, for the V voxels that a ray touched.

    Attributes:
        grid_frame: the grid of the world.
        g: int32 (V, 3), grid coordinates, sorted by gx, gy, gz.
        cells: uint8 (M, 1000), flags of the sub-cells of the M voxels with hits; sub-cell (cz * 10 + cy) * 10 + cx.
        row: int32 (V,), row in `cells`, -1 for a voxel without hits.
        passes: int32 (V, 2), followed rays that passed through in the states before and after.
        unexplained: int32 (V, 3), sub-cells gone, come and revealed that have no neighbour (of 26) in the other state.
        shell: int32 (V, 2), hit sub-cells that touch the voxel from outside, in the states before and after.
        before: accumulator of all points of the state before.
        after: accumulator of what stands after: its own points, and those of before on what was kept.
    """

    grid_frame: GridFrame
    g: NDArray[np.int32]
    cells: NDArray[np.uint8]
    row: NDArray[np.int32]
    passes: NDArray[np.int32]
    unexplained: NDArray[np.int32]
    shell: NDArray[np.int32]
    before: VoxelAccumulator
    after: VoxelAccumulator

    def count(self, flags: int) -> NDArray[np.int32]:
        """Return how many sub-cells of each voxel carry any of the flags, int32 (V,)."""
        return np.append(_counted(self.cells, flags), np.int32(0))[self.row]


def world_grids(world: World, half_width_m: float = 60.0) -> tuple[GridFrame, ...]:
    """Return the voxel grids of a world's street and its surroundings: one, or two where a zone of latitude ends."""
    x = np.array([-world.half_length_m - half_width_m, world.half_length_m + half_width_m])
    ends = world.map_of_street(np.stack([x, np.zeros(2), np.zeros(2)], axis=1))
    lat, lon, _ = world.frame.geodetic_from_enu(ends)
    tiles = covering_corridor(lat, lon, half_width_m)
    return tuple(GridFrame.around(world.frame, group) for group in zones(tiles).values())


def world_grid(world: World) -> GridFrame:
    """Return the voxel grid of a world that lies in one zone of latitude.

    Raises:
        TruthError: it lies in several; see `world_grids`.
    """
    grids = world_grids(world)
    if len(grids) > 1:
        raise TruthError(f"the world lies in {len(grids)} zones of latitude, each with a grid of its own")
    return grids[0]


def dense_scans(world: World, plan: ScanPlan) -> list[DenseScan]:
    """Scan both states of a world, into one result for each zone of latitude that it lies in.

    Nothing is compared across the border of two zones: there, a voxel has no neighbour.

    Raises:
        TruthError: more voxels with hits than there is room for.
    """
    windows = [(grid, _window(world, plan, grid)) for grid in world_grids(world)]
    tallies = [_Tally(grid, window) for grid, window in windows if window.ny > 0]
    for each in shots(world, plan):
        for tally in tallies:
            tally.take(each, plan.pass_stride)
    return [tally.result() for tally in tallies]


def dense_scan(world: World, plan: ScanPlan) -> DenseScan:
    """Scan both states of a world that lies in one zone of latitude.

    Raises:
        TruthError: it lies in several, or has more voxels with hits than there is room for.
    """
    found = dense_scans(world, plan)
    if len(found) > 1:
        raise TruthError(f"the world lies in {len(found)} zones of latitude, use dense_scans")
    return found[0]


class _Tally:
    """What shots leave in the voxels of one grid."""

    def __init__(self, grid: GridFrame, window: DenseWindow) -> None:
        size = window.nx * window.ny * window.nz
        self._grid, self._window = grid, window
        self._index = np.full(size, -1, dtype=np.int32)
        self._passes = np.zeros((2, size), dtype=np.int32)
        self._cells = np.zeros((_FIRST_VOXELS, CELLS**3), dtype=np.uint8)
        self._used = 0
        self._before, self._after = VoxelAccumulator(grid), VoxelAccumulator(grid)

    def take(self, shots: Shots, pass_stride: int) -> None:
        """Count rays."""
        g_origin, g_ends = grid_near(self._grid, shots.origin[None, :])[0], grid_near(self._grid, shots.ends)
        _pass(g_origin, g_ends[::pass_stride], self._window, self._passes[shots.state])
        self._mark(g_ends, shots.flags)
        self._before.add_grid(g_ends[(shots.flags & KNOWN_BEFORE) != 0])
        self._after.add_grid(g_ends[((shots.flags & STANDS_AFTER) != 0) & shots.fresh])

    def _mark(self, g_ends: FloatArray, flags: NDArray[np.uint8]) -> None:
        """Set the flags of sub-cells; marking twice does no harm, so a table that was full is made larger first."""
        while (used := _mark(g_ends, flags, self._window, self._index, self._cells, self._used)) < 0:
            self._used = len(self._cells)
            if self._used >= _MAX_VOXELS:
                raise TruthError(f"more than {_MAX_VOXELS} voxels were hit: use a shorter street")
            self._cells = np.concatenate([self._cells, np.zeros_like(self._cells)])
        self._used = used

    def result(self) -> DenseScan:
        """Return what was counted."""
        window, index, passes, seen = self._window, self._index, self._passes, self._cells[: self._used]
        touched = np.flatnonzero((index >= 0) | (passes[0] > 0) | (passes[1] > 0))
        row = index[touched]
        changes = np.append(_unexplained(window, index, seen, self._used), np.zeros((1, 3), np.int32), axis=0)[row]
        shell = _shell(window, index, seen, touched)
        g = (np.stack(np.unravel_index(touched, window[3:]), axis=1) + np.array(window[:3])).astype(np.int32)
        seen_passes = passes[:, touched].T.copy()
        return DenseScan(self._grid, g, seen, row, seen_passes, changes, shell, self._before, self._after)


def _window(world: World, plan: ScanPlan, grid: GridFrame) -> DenseWindow:
    """The voxels around the street that lie in the grid's zone."""
    reach = world.half_length_m + plan.range_m + _MARGIN_M
    corners = np.array([(x, y, z) for x in (-reach, reach) for y in (-reach, reach) for z in (-1, 1)], dtype=np.float64)
    corners *= np.array([1.0, (plan.range_m + world.kerb_m) / reach, _HEIGHT_M])
    g = np.floor(grid.grid_of(world.map_of_street(corners))).astype(int)
    low, high = g.min(axis=0), g.max(axis=0) + 1
    first, last = grid.lat_index_range
    low[1], high[1] = max(low[1], first * grid.ny), min(high[1], (last + 1) * grid.ny)
    return DenseWindow(*low.tolist(), *(high - low).tolist())


@kernel
def _counted(cells: NDArray[np.uint8], flags: int) -> NDArray[np.int32]:
    """Number of sub-cells of each row that carry any of the flags, (M,)."""
    found = np.zeros(len(cells), np.int32)
    for row in range(len(cells)):
        for cell in range(CELLS**3):
            found[row] += (cells[row, cell] & flags) != 0
    return found


@kernel
def _slot(window: DenseWindow, x: int, y: int, z: int) -> int:
    """Place of a voxel in the window's flat arrays, -1 outside."""
    i, j, k = x - window.gx, y - window.gy, z - window.gz
    if i < 0 or j < 0 or k < 0 or i >= window.nx or j >= window.ny or k >= window.nz:
        return -1
    return (i * window.ny + j) * window.nz + k


@kernel
def _mark(
    g: FloatArray,
    flags: NDArray[np.uint8],
    window: DenseWindow,
    index: NDArray[np.int32],
    cells: NDArray[np.uint8],
    used: int,
) -> int:
    """Set the flags of the sub-cells that points g (N, 3) fall into; rows used so far, -1 if there are too few."""
    for n in range(len(g)):
        x, y, z = int(np.floor(g[n, 0])), int(np.floor(g[n, 1])), int(np.floor(g[n, 2]))
        slot = _slot(window, x, y, z)
        if flags[n] == 0 or slot < 0:
            continue
        if index[slot] < 0:
            if used == len(cells):
                return -1
            index[slot] = used
            used += 1
        cx, cy, cz = int((g[n, 0] - x) * CELLS), int((g[n, 1] - y) * CELLS), int((g[n, 2] - z) * CELLS)
        cells[index[slot], (cz * CELLS + cy) * CELLS + cx] |= flags[n]
    return used


@kernel
def _pass(origin: FloatArray, ends: FloatArray, window: DenseWindow, passes: NDArray[np.int32]) -> None:
    """Count rays from origin (3,) to ends (N, 3), grid coordinates, in every voxel but that of the end."""
    voxel, step, last = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    at, delta = np.empty(3), np.empty(3)
    for n in range(len(ends)):
        left = 0
        for a in range(3):
            d = ends[n, a] - origin[a]
            voxel[a], last[a], step[a] = np.floor(origin[a]), np.floor(ends[n, a]), 1 if d > 0.0 else -1
            delta[a] = abs(1.0 / d) if d != 0.0 else np.inf
            at[a] = (voxel[a] + (d > 0.0) - origin[a]) / d if d != 0.0 else np.inf
            left += abs(last[a] - voxel[a])
        for _ in range(left):
            slot = _slot(window, voxel[0], voxel[1], voxel[2])
            if slot >= 0:
                passes[slot] += 1
            a = 0 if at[0] < at[1] and at[0] < at[2] else (1 if at[1] < at[2] else 2)
            at[a] += delta[a]
            voxel[a] += step[a]


@kernel
def _near(
    window: DenseWindow, index: NDArray[np.int32], cells: NDArray[np.uint8], x: int, y: int, z: int, wanted: int
) -> bool:
    """Whether sub-cell (x, y, z), counted from the window's corner, or a neighbour (of 26) carries a wanted flag."""
    for i in range(x - 1, x + 2):
        for j in range(y - 1, y + 2):
            for k in range(z - 1, z + 2):
                vx, vy, vz = i // CELLS, j // CELLS, k // CELLS
                slot = _slot(window, vx + window.gx, vy + window.gy, vz + window.gz)
                if slot >= 0 and index[slot] >= 0:
                    cell = ((k - vz * CELLS) * CELLS + j - vy * CELLS) * CELLS + i - vx * CELLS
                    if cells[index[slot], cell] & wanted:
                        return True
    return False


@kernel
def _unexplained(
    window: DenseWindow, index: NDArray[np.int32], cells: NDArray[np.uint8], used: int
) -> NDArray[np.int32]:
    """Sub-cells of each row that are gone, come or revealed: none of the other state's within one sub-cell, (M, 3)."""
    found = np.zeros((used, 3), np.int32)
    for slot in range(len(index)):
        row = index[slot]
        if row < 0:
            continue
        x, y = slot // (window.ny * window.nz) * CELLS, slot // window.nz % window.ny * CELLS
        z = slot % window.nz * CELLS
        for cell in range(CELLS**3):
            flags = cells[row, cell]
            if flags == 0 or (flags & KNOWN_BEFORE and flags & STANDS_AFTER):
                continue
            i, j, k = x + cell % CELLS, y + cell // CELLS % CELLS, z + cell // CELLS**2
            if flags & BEFORE_GONE:
                found[row, 0] += not _near(window, index, cells, i, j, k, STANDS_AFTER)
            elif not _near(window, index, cells, i, j, k, KNOWN_BEFORE):
                found[row, 1 if flags & AFTER_COME else 2] += 1
    return found


@kernel
def _shell(
    window: DenseWindow, index: NDArray[np.int32], cells: NDArray[np.uint8], touched: NDArray[np.int64]
) -> NDArray[np.int32]:
    """Sub-cells (V, 2) known before and standing after in the six layers, one sub-cell thick, around each voxel."""
    found = np.zeros((len(touched), 2), np.int32)
    for n in range(len(touched)):
        i, j = touched[n] // (window.ny * window.nz), touched[n] // window.nz % window.ny
        k = touched[n] % window.nz
        for face in range(6):
            axis, side = face // 2, face % 2 * 2 - 1
            x, y, z = i + (axis == 0) * side, j + (axis == 1) * side, k + (axis == 2) * side
            slot = _slot(window, x + window.gx, y + window.gy, z + window.gz)
            if slot < 0 or index[slot] < 0:
                continue
            layer = 0 if side > 0 else CELLS - 1
            for a in range(CELLS):
                for b in range(CELLS):
                    cx = layer if axis == 0 else a
                    cy = layer if axis == 1 else (a if axis == 0 else b)
                    cz = layer if axis == 2 else b
                    flags = cells[index[slot], (cz * CELLS + cy) * CELLS + cx]
                    found[n, 0] += (flags & KNOWN_BEFORE) != 0
                    found[n, 1] += (flags & STANDS_AFTER) != 0
    return found
