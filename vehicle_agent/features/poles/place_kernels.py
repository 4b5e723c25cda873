"""The compiled part of the pole detector that deals with places: ground, and what stands around a candidate.

Every kernel has a plain twin in the tests. Coordinates are float64, z up, of the frame that the points are given in.
"""

import math
from typing import NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.jit import bare, kernel


class GroundCells(NamedTuple):
    """Squares of the ground, corner at (x0, y0), `n` by `n`."""

    x0: float
    y0: float
    cell_m: float
    n: int


@kernel
def lowest_heights(points: F64, ground: GroundCells, plane_z: float, slope: float, pit_m: float) -> F64:
    """(n, n) height of the second lowest point of each cell (the lowest is sometimes an echo), inf without two.

    Points (N, 3) lower than `pit_m` and `slope` times the distance under the height of the middle count as echoes.
    """
    lowest, second = np.full((ground.n, ground.n), np.inf), np.full((ground.n, ground.n), np.inf)
    half = 0.5 * ground.n * ground.cell_m
    for k in range(points.shape[0]):
        x, y, z = points[k, 0] - ground.x0, points[k, 1] - ground.y0, points[k, 2]
        i, j = math.floor(x / ground.cell_m), math.floor(y / ground.cell_m)
        if not (0 <= i < ground.n and 0 <= j < ground.n):
            continue
        if z < plane_z - pit_m - slope * math.sqrt((x - half) ** 2 + (y - half) ** 2):
            continue
        if z < lowest[i, j]:
            second[i, j], lowest[i, j] = lowest[i, j], z
        elif z < second[i, j]:
            second[i, j] = z
    return second


@kernel
def cone_heights(low: F64, rise: float) -> F64:
    """(n, m): the highest surface under `low` that rises by no more than `rise` from cell to cell.

    Two passes over a frame of cells that are inf, each from four of the eight neighbours: a chamfer distance.
    """
    n, m = low.shape[0], low.shape[1]
    z, corner = np.full((n + 2, m + 2), np.inf), math.sqrt(2.0) * rise
    z[1 : n + 1, 1 : m + 1] = low
    for i in range(1, n + 1):
        for j in range(1, m + 1):
            side, diagonal = min(z[i - 1, j], z[i, j - 1]), min(z[i - 1, j - 1], z[i - 1, j + 1])
            z[i, j] = min(z[i, j], side + rise, diagonal + corner)
    for i in range(n, 0, -1):
        for j in range(m, 0, -1):
            side, diagonal = min(z[i + 1, j], z[i, j + 1]), min(z[i + 1, j + 1], z[i + 1, j - 1])
            z[i, j] = min(z[i, j], side + rise, diagonal + corner)
    return z[1 : n + 1, 1 : m + 1].copy()


@kernel
def heights_over(points: F64, z: F64, ground: GroundCells) -> F64:
    """(N,) height of the points (N, 3) over the ground's cells `z` (n, n); inf outside."""
    out = np.full(points.shape[0], np.inf)
    for k in range(points.shape[0]):
        i = math.floor((points[k, 0] - ground.x0) / ground.cell_m)
        j = math.floor((points[k, 1] - ground.y0) / ground.cell_m)
        if 0 <= i < ground.n and 0 <= j < ground.n:
            out[k] = points[k, 2] - z[i, j]
    return out


@kernel
def by_cell(points: F64, ground: GroundCells) -> tuple[I64, I64]:
    """Order, int64 (M,), of the points (N, 3) that lie in a cell of the ground, and its start (n * n + 1,) in it."""
    cell, begin = np.full(points.shape[0], -1, np.int64), np.zeros(ground.n * ground.n + 1, np.int64)
    for k in range(points.shape[0]):
        i = math.floor((points[k, 0] - ground.x0) / ground.cell_m)
        j = math.floor((points[k, 1] - ground.y0) / ground.cell_m)
        if 0 <= i < ground.n and 0 <= j < ground.n:
            cell[k] = i * ground.n + j
            begin[cell[k] + 1] += 1
    for c in range(ground.n * ground.n):
        begin[c + 1] += begin[c]
    order, put = np.empty(begin[ground.n * ground.n], np.int64), begin.copy()
    for k in range(points.shape[0]):
        if cell[k] >= 0:
            order[put[cell[k]]] = k
            put[cell[k]] += 1
    return order, begin


@kernel
def around(
    points: F64,
    height: F64,
    order: I64,
    start: I64,
    ground: GroundCells,
    axes: F64,
    belts: F64,
    bin_m: float,
    bins: int,
) -> tuple[I64, F64]:
    """What stands around candidates, by height over the ground.

    Args:
        points: (N, 3) everything above the ground.
        height: (N,) over the ground.
        order: of the points, by cell, as `by_cell` gives it.
        start: of each cell in it.
        ground: the cells.
        axes: (C, 8) x, y and height over the ground of a point of the axis; its lean in x and y [m a m]; radius; unit
            vector from the sensor.
        belts: (5,) distances beyond the radius where the core ends, the ring begins and ends, a plate ends, all ends.
        bin_m: height of a bin.
        bins: B, number of bins from the ground.

    Returns:
        int64 (C, B, 4): points in core, ring, within the plate's reach, beyond it but not behind; float64 (C, B, 5):
        sums of x, y, xx, xy, yy about the axis of what lies within the plate's reach.
    """
    count, sums = np.zeros((axes.shape[0], bins, 4), np.int64), np.zeros((axes.shape[0], bins, 5))
    for c in range(axes.shape[0]):
        far = axes[c, 5] + belts[4]
        i0, i1 = _cells(axes[c, 0] - ground.x0, far, ground)
        j0, j1 = _cells(axes[c, 1] - ground.y0, far, ground)
        for i in range(i0, i1):
            for a in range(start[i * ground.n + j0], start[i * ground.n + j1]):
                k = order[a]
                b = math.floor(height[k] / bin_m)
                if not 0 <= b < bins:
                    continue
                up = height[k] - axes[c, 2]
                x, y = points[k, 0] - axes[c, 0] - axes[c, 3] * up, points[k, 1] - axes[c, 1] - axes[c, 4] * up
                out = math.sqrt(x * x + y * y) - axes[c, 5]
                if out > belts[4]:
                    continue
                count[c, b, 0] += out <= belts[0]
                count[c, b, 1] += belts[1] < out <= belts[2]
                if out <= belts[3]:
                    count[c, b, 2] += 1
                    sums[c, b, 0] += x
                    sums[c, b, 1] += y
                    sums[c, b, 2] += x * x
                    sums[c, b, 3] += x * y
                    sums[c, b, 4] += y * y
                elif x * axes[c, 6] + y * axes[c, 7] <= axes[c, 5] + belts[3]:
                    count[c, b, 3] += 1
    return count, sums


@bare
def _cells(middle_m: float, far_m: float, ground: GroundCells) -> tuple[int, int]:
    """First cell, and the one after the last, along an axis of the grid, within `far_m` of its coordinate."""
    first = min(max(math.floor((middle_m - far_m) / ground.cell_m), 0), ground.n)
    return first, max(first, min(math.floor((middle_m + far_m) / ground.cell_m) + 1, ground.n))


@kernel
def rays_below(points: F64, origins: F64, places: F64, half_m: float) -> I64:
    """Rays that pass under the lowest visible part of candidates, or end before them.

    Args:
        points: (N, 3) ends of all rays, ground too.
        origins: (N or 1, 3) their starts.
        places: (C, 4) x, y, height of the ground and of the lowest part [m, frame of the points].
        half_m: rays that pass so near to the axis count.

    Returns:
        int64 (C, 2): rays that end before the candidate where they would have met it, and that go beyond it there.
    """
    found, single = np.zeros((places.shape[0], 2), np.int64), origins.shape[0] == 1
    for n in range(points.shape[0] if places.shape[0] else 0):
        m = 0 if single else n
        x, y = points[n, 0] - origins[m, 0], points[n, 1] - origins[m, 1]
        length = math.sqrt(x * x + y * y)
        if not 0.0 < length < np.inf:
            continue
        climb = (points[n, 2] - origins[m, 2]) / length
        for c in range(places.shape[0]):
            px, py = places[c, 0] - origins[m, 0], places[c, 1] - origins[m, 1]
            along = (x * px + y * py) / length
            if along <= 0.0 or abs(x * py - y * px) > half_m * length:
                continue
            there = origins[m, 2] + climb * along
            if places[c, 2] + 0.1 < there < places[c, 3] - 0.05:
                found[c, 0] += length < along - 0.3
                found[c, 1] += length > along + 0.3
    return found
