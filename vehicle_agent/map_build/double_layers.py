"""Doubled surfaces: two thin parallel layers where there is one wall or one road, as passes with different poses leave.

Found in the occupied 10 cm sub-cells of the voxels, along each axis of the grid: a column of 2 m through a voxel and
the next one along the axis. A surface that is seen across the axis leaves one thin run of occupied cells in every
column; a doubled one leaves two, in most columns the same distance apart. Leaves, wires and fences leave runs too, but
not at one distance. What stands that close in truth (a sign before a wall, a fence before a hedge, a window's pane
before what is behind it) is counted as well; it is rare, and the same in every map of a place. Layers nearer than 20 cm
are not told apart here: the thickness of planes shows them.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import I32, I64
from gnd.gnd_map.jit import kernel

CELL_M: Final = 0.1
THICK: Final = 3
"""Cells that a thin layer fills at most: noise of some centimetres, and a slant of the surface."""
LEAST_APART, MOST_APART = 2, 10
"""Cells between the middles of two layers."""
COLUMNS: Final = 16
"""Of the hundred columns of a voxel that must hold something."""
SINGLE_SHARE, DOUBLE_SHARE = 0.6, 0.5
"""Share of the columns that show one thin layer, or two at one distance, or either."""

NOTHING, TORN, ONE = -2, -1, 0
"""What a column shows; a positive number is the distance of two layers in cells."""


@dataclass(frozen=True, slots=True, eq=False)
class DoubleLayers:
    """What was found along one kind of axis: surfaces in all, and those that are doubled.

    g: (D, 3) int32 voxels of doubled ones, grid coordinates. apart_m: (D,) distance of their layers.
    """

    surfaces: int
    g: I32
    apart_m: npt.NDArray[np.float64]

    @property
    def doubled(self) -> int:
        """Surfaces with two layers."""
        return len(self.g)

    @property
    def per_thousand(self) -> float:
        """Of the surfaces."""
        return 1e3 * self.doubled / max(self.surfaces, 1)


def find_double_layers(g: I32, bits: npt.NDArray[np.uint64], axes: tuple[int, ...]) -> DoubleLayers:
    """Look for doubled surfaces across the given axes (0 east, 1 north, 2 up) of the grid.

    Args:
        g: (M, 3) voxels, each once, of `VoxelAccumulator.occupied`.
        bits: (M, 16) their sub-cells.
        axes: e.g. (0, 1) for walls, (2,) for the road.
    """
    if not len(g):
        return DoubleLayers(0, g, np.empty(0))
    corner = g.min(axis=0) - 1
    key = _keys(g - corner)
    order = np.argsort(key)
    key, bits, g = key[order], np.ascontiguousarray(bits[order]), g[order]
    surfaces = np.zeros(len(g), np.bool_)
    apart = np.zeros(len(g), np.int64)
    for axis in axes:
        step = np.zeros(3, np.int32)
        step[axis] = 1
        beyond = np.searchsorted(key, _keys(g - corner + step))
        known = beyond < len(key)
        known[known] = key[beyond[known]] == _keys(g - corner + step)[known]
        found = layers(bits, np.where(known, beyond, -1), axis)
        surfaces |= found > 0
        apart = np.maximum(apart, np.where(found > 1, found - 1, 0))
    doubled = apart > 0
    return DoubleLayers(int(surfaces.sum()), g[doubled], apart[doubled].astype(np.float64) * CELL_M)


def _keys(g: npt.NDArray[np.integer]) -> I64:
    """One number of each row (M, 3) of coordinates from 0 to 2 million."""
    wide = g.astype(np.int64)
    return (wide[:, 0] << 42) | (wide[:, 1] << 21) | wide[:, 2]


@kernel
def layers(bits: npt.NDArray[np.uint64], beyond: I64, axis: int) -> I64:
    """(M,) what each voxel shows across an axis: 0 nothing even, 1 one layer, 1 + cells between two of them.

    `bits` (M, 16) sub-cells; `beyond` (M,) row of the next voxel along the axis, -1 without one. A layer belongs to
    the voxel in which its first cell lies.
    """
    stride, side, other = (1, 10, 100)[axis], (10, 1, 1)[axis], (100, 100, 10)[axis]
    result, states = np.zeros(len(bits), np.int64), np.zeros(100, np.int64)
    begins, ends = np.zeros(20, np.int64), np.zeros(20, np.int64)
    for m in range(len(bits)):
        for column in range(100):
            base = (column % 10) * side + (column // 10) * other
            n = _runs(bits, m, beyond[m], base, stride, begins, ends)
            states[column] = _state(n, begins, ends)
        columns, single = (states != NOTHING).sum(), (states == ONE).sum()
        if columns < COLUMNS:
            continue
        gap, agreeing = _commonest(states)
        if agreeing >= DOUBLE_SHARE * columns:
            result[m] = 1 + gap
        elif single + agreeing >= SINGLE_SHARE * columns:
            result[m] = 1
    return result


@kernel
def _runs(bits: npt.NDArray[np.uint64], row: int, beyond: int, base: int, stride: int, begins: I64, ends: I64) -> int:
    """Runs of occupied cells in a column of two voxels: how many; `begins` and `ends` (20,) are filled."""
    runs, within = 0, False
    for k in range(20):
        r, at = row if k < 10 else beyond, base + (k % 10) * stride
        filled = r >= 0 and (bits[r, at >> 6] >> np.uint64(at & 63)) & np.uint64(1) != 0
        if filled and not within:
            begins[runs] = k
            runs += 1
        if filled:
            ends[runs - 1] = k
        within = filled
    return runs


@kernel
def _state(runs: int, begins: I64, ends: I64) -> int:
    """What a column shows: NOTHING, TORN or thick, ONE thin layer, or the cells between the middles of two."""
    if runs == 0 or begins[0] >= 10:
        return NOTHING
    near = 0
    for n in range(runs):
        if begins[n] + ends[n] - begins[0] - ends[0] <= 2 * MOST_APART:
            near += 1
            if ends[n] - begins[n] >= THICK:
                return TORN
    if near == 1:
        return ONE
    gap = (begins[1] + ends[1] - begins[0] - ends[0] + 1) // 2
    return gap if near == 2 and gap >= LEAST_APART else TORN


@kernel
def _commonest(states: I64) -> tuple[int, int]:
    """The distance, give or take a cell, that most columns have between two layers, and how many do."""
    best, most = LEAST_APART, 0
    for gap in range(LEAST_APART, MOST_APART + 1):
        agreeing = ((states >= max(gap - 1, LEAST_APART)) & (states <= gap + 1)).sum()
        if agreeing > most:
            best, most = gap, agreeing
    return best, most
