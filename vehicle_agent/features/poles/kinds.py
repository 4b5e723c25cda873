"""What stands around a column by height: whether it is free, how high it reaches, and what kind of thing it is."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.poles.columns import PoleColumns
from gnd.vehicle_agent.features.poles.place_kernels import around, by_cell
from gnd.vehicle_agent.features.poles.slices import GroundHeights

_RING_SHARE_MAX: Final = 0.5
"""Share of the heights of a pole's thin part at which something stands in the ring around it …"""
_FREE_M: Final = 0.75
"""… and length of a part of it at which nothing does."""
_STREETLIGHT_M: Final = 5.0
"""Lower posts are no streetlights."""

Mask = NDArray[np.bool_]

BIN_M: Final = 0.25
BINS: Final = 48
CORE_M, RING_M, RING_END_M, PLATE_M, REACH_M = 0.15, 0.2, 0.65, 0.9, 2.4
"""Distances beyond the radius: of the core, where the ring begins and ends, how far a plate and an arm reach."""
CORE, RING, NEAR, FAR = range(4)
"""Columns of the counts."""

PLATE_THICK_M: Final = 0.1
PLATE_WIDE_M: Final = 0.12
"""Standard deviations of a plate's points across and along it: one of 0.4 m has 0.12 m along."""
PLATE_HIGH_M: Final = 1.8
PLATE_POINTS: Final = 4
LOWEST_PLATE_M: Final = 1.0
WIDER: Final = 1.5
"""Plates, crowns and heads begin where so many times more points lie beside the core than in it."""
HEAD_M: Final = 1.0
"""Of a streetlight's height at most so much has anything beside the mast: arm and head."""
BESIDE_M: Final = 0.3
"""A crown whose middle lies so far off, aside or behind, is not the mast's own."""
MAST_SHARE: Final = 0.8
"""Of the least height of a streetlight: up to here at least its mast is thin."""
CROWN_POINTS: Final = 8
LOWEST_CROWN_M: Final = 1.75
CROWN_HIGH_M: Final = 2.0
CROWN_THICK_M: Final = 0.2


class PoleSurroundings(NamedTuple):
    """C candidates by height over the ground, B bins of `BIN_M`.

    Attributes:
        counts: (C, B, 4) points in core, ring, plate's reach, and beyond, but for those behind.
        sums: (C, B, 5) of the plate's reach about the axis: x, y, xx, xy, yy.
    """

    counts: I64
    sums: F64


def look_around(columns: PoleColumns, points_m: F64, height_m: F64, ground: GroundHeights) -> PoleSurroundings:
    """Count what stands around columns, of the points (N, 3) above the ground and their heights (N,)."""
    axes = np.column_stack([columns.xy_m, columns.height_m, columns.lean, 0.5 * columns.diameter_m, columns.toward])
    belts = np.array([CORE_M, RING_M, RING_END_M, PLATE_M, REACH_M])
    cells = by_cell(points_m, ground.cells)
    return PoleSurroundings(*around(points_m, height_m, *cells, ground.cells, axes, belts, BIN_M, BINS))


def is_free(columns: PoleColumns, seen: PoleSurroundings) -> Mask:
    """(C,) whether nothing stands in the ring around the thin part at most of its heights, and over one length."""
    core = _within(columns.bottom_m, columns.top_m) & (seen.counts[:, :, CORE] > 0)
    ring = core & (seen.counts[:, :, RING] > 0)
    run, longest, first = np.zeros(len(core)), np.zeros(len(core)), np.zeros(len(core))
    for b in range(BINS):
        free = core[:, b] & ~ring[:, b]
        first = np.where(free & (run == 0.0), b, first)
        run = np.where(ring[:, b], 0.0, np.where(free, b + 1.0 - first, run))
        longest = np.maximum(longest, run)
    share = ring.sum(axis=1) / np.maximum(core.sum(axis=1), 1)
    return np.asarray((share <= _RING_SHARE_MAX) & (longest * BIN_M >= _FREE_M))


def _within(low_m: F64, high_m: F64) -> Mask:
    """(C, B) whether a bin lies between two heights (C,), those of its own ends included."""
    bins = np.arange(BINS)
    first, last = np.floor(low_m / BIN_M)[:, None], np.floor(high_m / BIN_M)[:, None]
    return np.asarray((bins >= first) & (bins <= last))


def tops(columns: PoleColumns, seen: PoleSurroundings, gap_m: F64) -> F64:
    """(C,) height over the ground up to which the core goes on without a gap of more than gap_m (C,)."""
    top = columns.top_m.copy()
    for b in range(BINS):
        middle = (b + 0.5) * BIN_M
        reached = (seen.counts[:, b, CORE] > 0) & (middle > top) & (middle - top <= gap_m)
        top = np.where(reached, (b + 1.0) * BIN_M, top)
    return top


def bottoms(columns: PoleColumns, seen: PoleSurroundings, gap_m: F64) -> F64:
    """(C,) height over the ground down to which the core goes on without a gap of more than gap_m (C,).

    Where more lies in the ring than in the core it is a wall or a hedge that goes on, not the pole.
    """
    own = (seen.counts[:, :, CORE] > 0) & (seen.counts[:, :, RING] <= seen.counts[:, :, CORE])
    bottom = columns.bottom_m.copy()
    for b in range(BINS - 1, -1, -1):
        middle = (b + 0.5) * BIN_M
        reached = own[:, b] & (middle < bottom) & (bottom - middle <= gap_m)
        bottom = np.where(reached, b * BIN_M, bottom)
    return bottom


def kinds_of(columns: PoleColumns, seen: PoleSurroundings, top_m: F64) -> tuple[str, ...]:
    """The kind of each column: "trunk", "traffic_sign", "streetlight" or "pole".

    Args:
        columns: C columns.
        seen: what stands around them.
        top_m: (C,) how high each reaches.
    """
    more = seen.counts[:, :, NEAR] > WIDER * seen.counts[:, :, CORE]
    wide = more & _within(np.maximum(columns.top_m - BIN_M, LOWEST_PLATE_M), top_m - 0.5 * BIN_M)
    full = more & _within(np.full(len(top_m), LOWEST_CROWN_M), top_m)
    points, across, along = _spread(seen, wide)
    high = wide.sum(axis=1) * BIN_M
    crown = (points >= CROWN_POINTS) & (across >= CROWN_THICK_M)
    plate = (points >= PLATE_POINTS) & (across <= PLATE_THICK_M) & (along >= PLATE_WIDE_M) & (high <= PLATE_HIGH_M)
    over = _within(np.maximum(columns.top_m, LOWEST_CROWN_M), columns.top_m + CROWN_HIGH_M)
    leaves = (seen.counts[:, :, FAR] * over).sum(axis=1) >= CROWN_POINTS
    tall = (top_m >= _STREETLIGHT_M) & (columns.top_m >= MAST_SHARE * _STREETLIGHT_M)
    mast = tall & (_beside_it(columns, seen, full) | (~crown & (full.sum(axis=1) * BIN_M <= HEAD_M)))
    kinds = ["streetlight", "trunk", "traffic_sign", "trunk"]
    return tuple(np.select([mast, crown | tall, plate, leaves], kinds, "pole").tolist())


def _beside_it(columns: PoleColumns, seen: PoleSurroundings, bins: Mask) -> Mask:
    """(C,) whether what lies in the plate's reach, in some bins (C, B), lies on one side or behind: another's crown."""
    n = np.maximum((seen.counts[:, :, NEAR] * bins).sum(axis=1), 1)
    off = (seen.sums[:, :, :2] * bins[:, :, None]).sum(axis=1) / n[:, None]
    behind = (off * columns.toward).sum(axis=1)
    aside = off[:, 1] * columns.toward[:, 0] - off[:, 0] * columns.toward[:, 1]
    return np.asarray((behind > BESIDE_M) | (np.abs(aside) > BESIDE_M))


def _spread(seen: PoleSurroundings, bins: Mask) -> tuple[I64, F64, F64]:
    """Points in the plate's reach in the bins (C, B), and their standard deviations across and along."""
    n = (seen.counts[:, :, NEAR] * bins).sum(axis=1)
    total = (seen.sums * bins[:, :, None]).sum(axis=1) / np.maximum(n, 1)[:, None]
    xx, xy, yy = (total[:, k] for k in (2, 3, 4))
    xx, xy, yy = xx - total[:, 0] ** 2, xy - total[:, 0] * total[:, 1], yy - total[:, 1] ** 2
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    return n, np.sqrt(np.maximum(middle - half, 0.0)), np.sqrt(np.maximum(middle + half, 0.0))
