"""The compiled part of the pole detector that deals with rays: rows of them, and the slices of thin things.

Every kernel has a plain twin in the tests.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.jit import bare, kernel

U8 = NDArray[np.uint8]

CLEAR, HIDDEN, JOINED = 0, 1, 2
"""What lies beside a slice in its own row: nothing or something farther; something nearer; something at its range."""
STEP_BINS = 4000
STEP_RAD = math.radians(1.0) / STEP_BINS
FEW_STEPS = 200
SMALL = 32
"""Cells with more points are sorted by numpy."""


class Rows(NamedTuple):
    """Rows of equal tangent of elevation from `tan_low`, and columns that a turn is divided into for sorting."""

    tan_low: float
    tan_step: float
    rows: int
    columns: int


class Beside(NamedTuple):
    """What a slice is and what must be beside it."""

    link_m: float
    """Neighbours in a row whose ranges differ by less are one thing."""
    width_m: float
    """Slices are no wider, but for the distance of two rays."""
    clear_m: float
    """So far to either side nothing is at the range of the slice, or nearer …"""
    jump_m: float
    """… by this much behind it."""


@kernel
def polar_of(points: F64, origins: F64, near_m: float, far_m: float) -> tuple[I64, F64]:
    """Which of the points (N, 3) lie at horizontal distances near … far from their origins (N or 1, 3), and there.

    Returns:
        int64 (K,), and float64 (K, 3): azimuth -pi … pi, horizontal distance, tangent of the elevation. Points that
        are not finite are left out.
    """
    kept, polar = np.empty(points.shape[0], np.int64), np.empty((points.shape[0], 3))
    count, single = 0, origins.shape[0] == 1
    for n in range(points.shape[0]):
        m = 0 if single else n
        x, y, z = points[n, 0] - origins[m, 0], points[n, 1] - origins[m, 1], points[n, 2] - origins[m, 2]
        distance = math.sqrt(x * x + y * y)
        if near_m <= distance <= far_m and abs(z) < far_m:
            kept[count] = n
            polar[count, 0], polar[count, 1], polar[count, 2] = math.atan2(y, x), distance, z / distance
            count += 1
    return kept[:count].copy(), polar[:count].copy()


@kernel
def layer_gaps(polar: F64, rows: Rows) -> I64:
    """How often the next return above one in the same column lies so many rows higher, int64 (rows + 1,)."""
    seen, turn = np.zeros((rows.columns, rows.rows), np.uint8), 2.0 * math.pi
    for k in range(polar.shape[0]):
        row = math.floor((polar[k, 2] - rows.tan_low) / rows.tan_step)
        if 0 <= row < rows.rows:
            seen[min(max(math.floor((polar[k, 0] + math.pi) / turn * rows.columns), 0), rows.columns - 1), row] = 1
    gaps = np.zeros(rows.rows + 1, np.int64)
    for column in range(rows.columns):
        before = -1
        for row in range(rows.rows):
            if seen[column, row]:
                if before >= 0:
                    gaps[row - before] += 1
                before = row
    return gaps


@kernel
def row_order(polar: F64, rows: Rows) -> tuple[I64, I64]:
    """Sort rays (K, 3) by row, and by azimuth within a row.

    Returns:
        order, int64 (M,) of the rays that lie in a row; start, int64 (rows + 1,), of each row in it.
    """
    cells, turn = rows.rows * rows.columns, 2.0 * math.pi
    cell, begin = np.full(polar.shape[0], -1, np.int32), np.zeros(cells + 1, np.int32)
    for k in range(polar.shape[0]):
        row = math.floor((polar[k, 2] - rows.tan_low) / rows.tan_step)
        if 0 <= row < rows.rows:
            column = min(max(math.floor((polar[k, 0] + math.pi) / turn * rows.columns), 0), rows.columns - 1)
            cell[k] = row * rows.columns + column
            begin[cell[k] + 1] += 1
    for c in range(cells):
        begin[c + 1] += begin[c]
    order, put = np.empty(begin[cells], np.int64), begin.copy()
    for k in range(polar.shape[0]):
        if cell[k] >= 0:
            order[put[cell[k]]] = k
            put[cell[k]] += 1
    for c in range(cells):
        if begin[c + 1] > begin[c] + 1:
            _sort_by_azimuth(order[begin[c] : begin[c + 1]], polar)
    return order, begin[:: rows.columns].astype(np.int64)


@kernel
def _sort_by_azimuth(part: I64, polar: F64) -> None:
    if part.shape[0] > SMALL:
        part[:] = part[np.argsort(polar[part, 0], kind="mergesort")]
        return
    for a in range(1, part.shape[0]):
        k, b = part[a], a
        while b > 0 and polar[part[b - 1], 0] > polar[k, 0]:
            part[b] = part[b - 1]
            b -= 1
        part[b] = k


@kernel
def azimuth_step(polar: F64, order: I64, start: I64, link_m: float) -> float:
    """Usual angle between neighbouring rays of a row that meet the same thing (median) [rad].

    0 where fewer than FEW_STEPS tell.
    """
    count = np.zeros(STEP_BINS, np.int64)
    for row in range(start.shape[0] - 1):
        for a in range(start[row] + 1, start[row + 1]):
            k, before = order[a], order[a - 1]
            step = polar[k, 0] - polar[before, 0]
            if abs(polar[k, 1] - polar[before, 1]) < link_m and step < STEP_BINS * STEP_RAD:
                count[int(step / STEP_RAD)] += 1
    half, so_far = 0.5 * count.sum(), 0
    for b in range(STEP_BINS if 2.0 * half >= FEW_STEPS else 0):
        so_far += count[b]
        if so_far > half:
            return (b + 0.5) * STEP_RAD
    return 0.0


@kernel
def thin_slices(polar: F64, order: I64, start: I64, step: float, beside: Beside) -> tuple[I64, I64, U8]:
    """Find the slices of thin things: neighbours of a row at one range, with free space on both sides.

    Args:
        polar: (K, 3) rays that met something above the ground.
        order: their order, by row and azimuth.
        start: (rows + 1,) of each row in it.
        step: angle between neighbouring rays [rad].
        beside: what a slice is.

    Returns:
        members, int64 (M,), rays of the slices one slice after the other; start, int64 (S + 1,), of each; sides, uint8
        (S, 2): CLEAR or HIDDEN, to the right and to the left. A slice that is hidden on both sides is none.
    """
    members, begin = np.empty(order.shape[0], np.int64), np.empty(order.shape[0] + 1, np.int64)
    sides, slices, filled = np.empty((order.shape[0], 2), np.uint8), 0, 0
    begin[0] = 0
    for row in range(start.shape[0] - 1):
        rays = order[start[row] : start[row + 1]]
        n = rays.shape[0]
        if n == 0:
            continue
        seam = _widest_gap(rays, polar)
        a = 0
        while a < n:
            b = a + 1
            while b < n and _linked(rays[(seam + b - 1) % n], rays[(seam + b) % n], polar, step, beside):
                b += 1
            if _is_thin(rays, seam + a, seam + b, polar, step, beside.width_m):
                right = _beside(rays, seam + a, -1, polar, step, beside)
                left = _beside(rays, seam + b - 1, 1, polar, step, beside)
                if right != JOINED and left != JOINED and right + left < 2 * HIDDEN:
                    for c in range(a, b):
                        members[filled] = rays[(seam + c) % n]
                        filled += 1
                    sides[slices, 0], sides[slices, 1] = right, left
                    slices += 1
                    begin[slices] = filled
            a = b
    return members[:filled].copy(), begin[: slices + 1].copy(), sides[:slices].copy()


@bare
def _widest_gap(rays: I64, polar: F64) -> int:
    """Where to begin a row, so that nothing lies across its ends: after its widest gap."""
    n, widest, at = rays.shape[0], -1.0, 0
    for a in range(n):
        gap = _turn(polar[rays[a], 0] - polar[rays[a - 1 if a else n - 1], 0])
        if gap > widest:
            widest, at = gap, a
    return at


@bare
def _turn(angle: float) -> float:
    """A difference of azimuths as 0 … 2 pi."""
    return angle if angle >= 0.0 else angle + 2.0 * math.pi


@bare
def _linked(before: int, after: int, polar: F64, step: float, beside: Beside) -> bool:
    gap = _turn(polar[after, 0] - polar[before, 0])
    near = min(polar[before, 1], polar[after, 1])
    apart = abs(polar[after, 1] - polar[before, 1])
    return bool(apart < beside.link_m and gap * near < max(beside.link_m, 2.5 * step * near))


@bare
def _is_thin(rays: I64, a: int, b: int, polar: F64, step: float, width_m: float) -> bool:
    """Whether the rays a … b - 1 of a row span no more than a pole does, across and along."""
    n = rays.shape[0]
    across = _turn(polar[rays[(b - 1) % n], 0] - polar[rays[a % n], 0]) * polar[rays[a % n], 1]
    if across > width_m + step * polar[rays[a % n], 1]:
        return False
    low, high = np.inf, -np.inf
    for c in range(a, b):
        low, high = min(low, polar[rays[c % n], 1]), max(high, polar[rays[c % n], 1])
    return bool(high - low < width_m)


@bare
def _beside(rays: I64, edge: int, way: int, polar: F64, step: float, beside: Beside) -> int:
    """What lies within `clear_m` beside the ray at `edge`, to the right (way -1) or left (1)."""
    n = rays.shape[0]
    here = rays[edge % n]
    found, reach = CLEAR, max(beside.clear_m, 1.5 * step * polar[here, 1])
    for c in range(1, n):
        there = rays[(edge + way * c) % n]
        gap = _turn(way * (polar[there, 0] - polar[here, 0]))
        if gap * polar[here, 1] > reach or gap > math.pi:
            break
        if abs(polar[there, 1] - polar[here, 1]) <= beside.jump_m:
            return JOINED
        if polar[there, 1] < polar[here, 1]:
            found = HIDDEN
    return JOINED if _on_a_line(rays, edge, way, polar, step) else found


@bare
def _on_a_line(rays: I64, edge: int, way: int, polar: F64, step: float) -> bool:
    """Whether the ray and the next two lie on a straight line in plan: the near end of a wall seen from along it.

    On a line 1 / distance is A cos(azimuth - a), which is straight over a few rays.
    """
    n = rays.shape[0]
    if n < 4:
        return False
    p, q, r = rays[edge % n], rays[(edge + way) % n], rays[(edge + 2 * way) % n]
    first, second = _turn(way * (polar[q, 0] - polar[p, 0])), _turn(way * (polar[r, 0] - polar[q, 0]))
    if first > 2.5 * step or second > 2.5 * step or first <= 0.0 or second <= 0.0:
        return False
    inverse = 1.0 / polar[q, 1] + (1.0 / polar[q, 1] - 1.0 / polar[p, 1]) * second / first
    if inverse <= 0.0:
        return False
    return bool(abs(1.0 / inverse - polar[r, 1]) < 0.15 + 0.15 * abs(polar[r, 1] - polar[q, 1]))
