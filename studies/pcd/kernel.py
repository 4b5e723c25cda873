"""Rays against map points: blocks of 5 x 5 x 5 leaf cells, walked as one step where they hold nothing.

A leaf cell is a sub-cell of the GND grid; "cell coordinates" are grid coordinates times ten, counted from the window's
corner. Cells and blocks are unit cubes there; distances stay in metres.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, F64, I32
from gnd.gnd_map.jit import kernel

SIDE = 5
"""Leaf cells along each side of a block (half a voxel)."""
CELLS = SIDE**3
EMPTY = -1

T = TypeVar("T", bound=Callable[..., Any])


def inlined(function: T) -> T:
    """Compile a part of a kernel into its caller."""
    return cast("T", numba.njit(inline="always", error_model="numpy")(function))


class Base(NamedTuple):
    """The map as the kernels read it.

    `slot` (R, 125) uint8: 1 + rank of the map's cell within the block, 0 where it has none; `start` (R,) int32: cell
    number of rank 0; `point_m` (U, 3) float32: centroid of each cell's points relative to the window's anchor;
    `normal` (U, 3) float32: unit normal, zeros where the points around lie on no surface; `shape` blocks along
    x, y, z.
    """

    slot: NDArray[np.uint8]
    start: I32
    point_m: F32
    normal: F32
    shape: tuple[int, int, int]


class PcdCounts(NamedTuple):
    """What a drive counts.

    `state` (blocks,) int32: row of a map block (0 ... R - 1), R + row of a block that only has new points, or
    -1 - passes. `map_hits`, `map_passes` (U,) int32. `new_of` (R,) int32: row in the new blocks, -1 without.
    `new_hits`, `new_passes` (Q, 125) int32; `new_sum` (Q, 125, 3) float32, sums of the points' cell coordinates from
    the cell's corner; `new_block` (Q,) int32: number of the block. Passes of new cells are counted from the block's
    first new hit on.
    """

    state: I32
    map_hits: I32
    map_passes: I32
    new_of: I32
    new_hits: I32
    new_passes: I32
    new_sum: F32
    new_block: I32


class Rules(NamedTuple):
    """The rules of `studies.pcd.points` as the kernels read them."""

    near_m: float
    beyond_m: float
    beside_m: float
    ahead_m: float
    range_min_m: float
    range_max_m: float


@inlined
def _map_cell(base: Base, state: I32, x: int, y: int, z: int) -> int:
    """Number of the map's cell at (x, y, z), -1 where the map has none or outside the window."""
    nx, ny, nz = base.shape
    if x < 0 or y < 0 or z < 0:
        return -1
    i, j, k = x // SIDE, y // SIDE, z // SIDE
    if i >= nx or j >= ny or k >= nz:
        return -1
    row = state[(i * ny + j) * nz + k]
    if row < 0 or row >= len(base.start):
        return -1
    slot = base.slot[row, ((x - i * SIDE) * SIDE + y - j * SIDE) * SIDE + z - k * SIDE]
    return base.start[row] + slot - 1 if slot > 0 else -1


@inlined
def _clip(g: float, d: float, n: int, t0: float, t1: float) -> tuple[float, float]:
    """The part of [t0, t1] where g + t d lies inside [0, n]; empty when t0 > t1."""
    if d == 0.0:
        return (t0, t1) if 0.0 <= g < n else (np.inf, -np.inf)
    a, b = -g / d, (n - g) / d
    return max(t0, min(a, b)), min(t1, max(a, b))


@inlined
def _index(g: float, n: int) -> int:
    """floor(g), kept inside 0 ... n - 1 against rounding at the faces."""
    return min(max(math.floor(g), 0), n - 1)


@inlined
def _first(g: float, d: float, i: int) -> tuple[float, float]:
    """Ray parameter of the first face along one axis, and the step between faces."""
    if d == 0.0:
        return np.inf, np.inf
    face = i + 1.0 if d > 0.0 else float(i)
    return (face - g) / d, 1.0 / abs(d)


@inlined
def _has_passed(
    base: Base, u: int, o: tuple[float, float, float], v: tuple[float, float, float], length: float,
    t_in: float, t_out: float, rules: Rules,
) -> bool:  # fmt: skip
    """Whether the ray o + t v has passed the map point u while it crossed its cell (t_in ... t_out)."""
    nx, ny, nz = base.normal[u, 0], base.normal[u, 1], base.normal[u, 2]
    wx, wy, wz = base.point_m[u, 0] - o[0], base.point_m[u, 1] - o[1], base.point_m[u, 2] - o[2]
    along = nx * v[0] + ny * v[1] + nz * v[2]
    if along != 0.0:
        t = (nx * wx + ny * wy + nz * wz) / along
        return bool(t_in <= t <= t_out and (1.0 - t) * abs(along) > rules.beyond_m)
    if nx != 0.0 or ny != 0.0 or nz != 0.0:
        return False
    t = (wx * v[0] + wy * v[1] + wz * v[2]) / (length * length)
    if (1.0 - t) * length <= rules.ahead_m:
        return False
    dx, dy, dz = wx - t * v[0], wy - t * v[1], wz - t * v[2]
    return bool(dx * dx + dy * dy + dz * dz <= rules.beside_m * rules.beside_m)


@inlined
def _cross_block(
    base: Base, counts: PcdCounts, row: int, new: int, corner: tuple[int, int, int],
    g: tuple[float, float, float], d: tuple[float, float, float],
    o: tuple[float, float, float], v: tuple[float, float, float], length: float,
    t_in: float, t_end: float, rules: Rules,
) -> None:  # fmt: skip
    """Walk the leaf cells of one block from t_in to t_end: passes of map points and of new cells."""
    hx, hy, hz = g[0] - corner[0], g[1] - corner[1], g[2] - corner[2]
    i = _index(hx + t_in * d[0], SIDE)
    j = _index(hy + t_in * d[1], SIDE)
    k = _index(hz + t_in * d[2], SIDE)
    t_x, dt_x = _first(hx, d[0], i)
    t_y, dt_y = _first(hy, d[1], j)
    t_z, dt_z = _first(hz, d[2], k)
    is_map = 0 <= row < len(base.start)
    while True:
        t_out = min(t_x, t_y, t_z, t_end)
        cell = (i * SIDE + j) * SIDE + k
        if is_map and base.slot[row, cell] > 0:
            u = base.start[row] + base.slot[row, cell] - 1
            if _has_passed(base, u, o, v, length, t_in, t_out, rules):
                counts.map_passes[u] += 1
        elif new >= 0 and (1.0 - t_out) * length > rules.ahead_m:
            counts.new_passes[new, cell] += 1
        if t_out >= t_end:
            return
        t_in = t_out
        if t_x <= t_y and t_x <= t_z:
            i += 1 if d[0] > 0.0 else -1
            t_x += dt_x
        elif t_y <= t_z:
            j += 1 if d[1] > 0.0 else -1
            t_y += dt_y
        else:
            k += 1 if d[2] > 0.0 else -1
            t_z += dt_z
        if i < 0 or j < 0 or k < 0 or i >= SIDE or j >= SIDE or k >= SIDE:
            return


@inlined
def _explains(base: Base, u: int, p: tuple[float, float, float], near_m: float) -> float:
    """Squared distance of the hit p from map point u where its point or surface is within near_m, else infinite."""
    dx, dy, dz = p[0] - base.point_m[u, 0], p[1] - base.point_m[u, 1], p[2] - base.point_m[u, 2]
    nx, ny, nz = base.normal[u, 0], base.normal[u, 1], base.normal[u, 2]
    d2 = dx * dx + dy * dy + dz * dz
    away = dx * nx + dy * ny + dz * nz
    if nx == 0.0 and ny == 0.0 and nz == 0.0:
        return d2 if d2 <= near_m * near_m else np.inf
    return d2 if abs(away) <= near_m else np.inf


@inlined
def _explained_by(  # noqa: C901  (a call a block would cost more than the block)
    base: Base, state: I32, x: int, y: int, z: int, p: tuple[float, float, float], near_m: float
) -> int:
    """A map cell whose point or surface is within near_m of the hit p, or -1.

    The hit's own cell, else the nearest of the 27 around, else of the 125.
    """
    u = _map_cell(base, state, x, y, z)
    if u >= 0 and _explains(base, u, p, near_m) < np.inf:
        return u
    best, least, reach = -1, np.inf, 1
    while best < 0 and reach <= 2:
        for i in range(max(x - reach, 0) // SIDE, min((x + reach) // SIDE + 1, base.shape[0])):
            for j in range(max(y - reach, 0) // SIDE, min((y + reach) // SIDE + 1, base.shape[1])):
                for k in range(max(z - reach, 0) // SIDE, min((z + reach) // SIDE + 1, base.shape[2])):
                    row = state[(i * base.shape[1] + j) * base.shape[2] + k]
                    if row < 0 or row >= len(base.start):
                        continue
                    for a in range(max(x - reach - i * SIDE, 0), min(x + reach - i * SIDE, SIDE - 1) + 1):
                        for b in range(max(y - reach - j * SIDE, 0), min(y + reach - j * SIDE, SIDE - 1) + 1):
                            for c in range(max(z - reach - k * SIDE, 0), min(z + reach - k * SIDE, SIDE - 1) + 1):
                                slot = base.slot[row, (a * SIDE + b) * SIDE + c]
                                if slot == 0:
                                    continue
                                u = base.start[row] + slot - 1
                                d2 = _explains(base, u, p, near_m)
                                if d2 < least:
                                    best, least = u, d2
        reach += 1
    return best


@kernel
def cast_rays(  # noqa: C901  (one loop: a call a block would cost more than the block)
    points: F64, origins: F64, A: F64, b: F64, base: Base, counts: PcdCounts, used: int, rules: Rules,
    moving: NDArray[np.bool_], start: int,
) -> tuple[int, int]:  # fmt: skip
    """Cast rays `start` and following of one scan.

    Args:
        points: (N, 3) hits in metres relative to the window's anchor.
        origins: (N, 3) or (1, 3) the sensor at each hit.
        A: (3, 3) window cell coordinates are A @ p + b.
        b: (3,)
        base: the map.
        counts: what is counted, changed.
        used: rows of the new blocks in use.
        rules: parameters.
        moving: (N,) bool, points on moving objects: their rays pass, their ends say nothing.
        start: first ray.

    Returns:
        The next ray (N when all are done; less when there is no row left for new blocks), and the rows in use.
    """
    nx, ny, nz = base.shape
    n_rows = len(base.start)
    for r in range(start, len(points)):
        at_o = 0 if len(origins) == 1 else r
        o = (origins[at_o, 0], origins[at_o, 1], origins[at_o, 2])
        v = (points[r, 0] - o[0], points[r, 1] - o[1], points[r, 2] - o[2])
        length = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        if not (length > rules.range_min_m):
            continue
        if used >= len(counts.new_block):
            return r, used
        g = (
            A[0, 0] * o[0] + A[0, 1] * o[1] + A[0, 2] * o[2] + b[0],
            A[1, 0] * o[0] + A[1, 1] * o[1] + A[1, 2] * o[2] + b[1],
            A[2, 0] * o[0] + A[2, 1] * o[1] + A[2, 2] * o[2] + b[2],
        )
        d = (
            A[0, 0] * v[0] + A[0, 1] * v[1] + A[0, 2] * v[2],
            A[1, 0] * v[0] + A[1, 1] * v[1] + A[1, 2] * v[2],
            A[2, 0] * v[0] + A[2, 1] * v[1] + A[2, 2] * v[2],
        )
        t_in, t_end = _clip(g[0], d[0], nx * SIDE, 0.0, min(1.0, rules.range_max_m / length))
        t_in, t_end = _clip(g[1], d[1], ny * SIDE, t_in, t_end)
        t_in, t_end = _clip(g[2], d[2], nz * SIDE, t_in, t_end)
        if t_in >= t_end:
            continue
        hx, hy, hz, ex, ey, ez = g[0] / SIDE, g[1] / SIDE, g[2] / SIDE, d[0] / SIDE, d[1] / SIDE, d[2] / SIDE
        i, j, k = _index(hx + t_in * ex, nx), _index(hy + t_in * ey, ny), _index(hz + t_in * ez, nz)
        i1, j1, k1 = _index(hx + t_end * ex, nx), _index(hy + t_end * ey, ny), _index(hz + t_end * ez, nz)
        n_x, n_y, n_z = abs(i1 - i), abs(j1 - j), abs(k1 - k)
        s_x, s_y, s_z = 1 if i1 > i else -1, 1 if j1 > j else -1, 1 if k1 > k else -1
        t_x, dt_x = _first(hx, ex, i) if n_x > 0 else (np.inf, np.inf)
        t_y, dt_y = _first(hy, ey, j) if n_y > 0 else (np.inf, np.inf)
        t_z, dt_z = _first(hz, ez, k) if n_z > 0 else (np.inf, np.inf)
        left = n_x + n_y + n_z
        while True:
            at = (i * ny + j) * nz + k
            row = counts.state[at]
            t_out = min(t_x, t_y, t_z, t_end)
            if row < 0:
                if left > 0:
                    counts.state[at] = row - 1
            else:
                new = row - n_rows if row >= n_rows else counts.new_of[row]
                _cross_block(
                    base, counts, row, new, (i * SIDE, j * SIDE, k * SIDE), g, d, o, v, length, t_in, t_out, rules
                )
            if left == 0:
                break
            left -= 1
            t_in = t_out
            if t_x <= t_y and t_x <= t_z:
                i, n_x = i + s_x, n_x - 1
                t_x = t_x + dt_x if n_x > 0 else np.inf
            elif t_y <= t_z:
                j, n_y = j + s_y, n_y - 1
                t_y = t_y + dt_y if n_y > 0 else np.inf
            else:
                k, n_z = k + s_z, n_z - 1
                t_z = t_z + dt_z if n_z > 0 else np.inf
        if t_end < 1.0 or moving[r]:
            continue
        cx, cy, cz = g[0] + d[0], g[1] + d[1], g[2] + d[2]
        x, y, z = _index(cx, nx * SIDE), _index(cy, ny * SIDE), _index(cz, nz * SIDE)
        u = _explained_by(base, counts.state, x, y, z, (points[r, 0], points[r, 1], points[r, 2]), rules.near_m)
        if u >= 0:
            counts.map_hits[u] += 1
            continue
        at = ((x // SIDE) * ny + y // SIDE) * nz + z // SIDE
        row = counts.state[at]
        new = row - n_rows if row >= n_rows else (counts.new_of[row] if row >= 0 else -1)
        if new < 0:
            new = used
            used += 1
            counts.new_block[new] = at
            if row < 0:
                counts.state[at] = n_rows + new
            else:
                counts.new_of[row] = new
        cell = ((x % SIDE) * SIDE + y % SIDE) * SIDE + z % SIDE
        counts.new_hits[new, cell] += 1
        counts.new_sum[new, cell, 0] += cx - x
        counts.new_sum[new, cell, 1] += cy - y
        counts.new_sum[new, cell, 2] += cz - z
    return len(points), used


@inlined
def _sum_around(base: Base, state: I32, cells: I32, values: I32, u: int, reach: int) -> int:
    """Sum of `values` (U,) over the map cells within `reach` cells of map cell u."""
    total = 0
    for i in range(cells[u, 0] - reach, cells[u, 0] + reach + 1):
        for j in range(cells[u, 1] - reach, cells[u, 1] + reach + 1):
            for k in range(cells[u, 2] - reach, cells[u, 2] + reach + 1):
                w = _map_cell(base, state, i, j, k)
                if w >= 0:
                    total += values[w]
    return total


@inlined
def _add_around(base: Base, state: I32, cells: I32, u: int, value: int, reach: int, sums: I32) -> None:
    """Add `value` to `sums` (U,) at the map cells within `reach` cells of map cell u."""
    for i in range(cells[u, 0] - reach, cells[u, 0] + reach + 1):
        for j in range(cells[u, 1] - reach, cells[u, 1] + reach + 1):
            for k in range(cells[u, 2] - reach, cells[u, 2] + reach + 1):
                w = _map_cell(base, state, i, j, k)
                if w >= 0:
                    sums[w] += value


@kernel
def support_sums(base: Base, state: I32, cells: I32, hits: I32, passes: I32, reach: int, least: int) -> tuple[I32, I32]:
    """Sums of hits and of passes (U,) over the map cells within `reach` cells of each.

    Rays have passed few cells: hits are summed only where the sum of passes is `least` or more, else they are 0.
    `cells` (U, 3): cell coordinates of the map's cells.
    """
    hit_sums, pass_sums = np.zeros(len(cells), np.int32), np.zeros(len(cells), np.int32)
    for u in range(len(cells)):
        if passes[u] > 0:
            _add_around(base, state, cells, u, passes[u], reach, pass_sums)
    for u in range(len(cells)):
        if pass_sums[u] >= max(least, 1):
            hit_sums[u] = _sum_around(base, state, cells, hits, u, reach)
    return hit_sums, pass_sums


@kernel
def surface_normals(base: Base, state: I32, cells: I32, ratio: float) -> F32:
    """(U, 3) normals of the map's cells by the 3 x 3 x 3 cells around; zeros where λ2 < ratio λ1 or too few."""
    found = np.zeros((len(cells), 3), np.float32)
    for u in range(len(cells)):
        n, s = 0, np.zeros(9)
        for i in range(cells[u, 0] - 1, cells[u, 0] + 2):
            for j in range(cells[u, 1] - 1, cells[u, 1] + 2):
                for k in range(cells[u, 2] - 1, cells[u, 2] + 2):
                    w = _map_cell(base, state, i, j, k)
                    if w < 0:
                        continue
                    x = base.point_m[w, 0] - base.point_m[u, 0]
                    y = base.point_m[w, 1] - base.point_m[u, 1]
                    z = base.point_m[w, 2] - base.point_m[u, 2]
                    n += 1
                    s[0] += x
                    s[1] += y
                    s[2] += z
                    s[3] += x * x
                    s[4] += x * y
                    s[5] += x * z
                    s[6] += y * y
                    s[7] += y * z
                    s[8] += z * z
        if n < 4:
            continue
        a, e, f = s[3] / n - s[0] * s[0] / n / n, s[6] / n - s[1] * s[1] / n / n, s[8] / n - s[2] * s[2] / n / n
        p, q, r = s[4] / n - s[0] * s[1] / n / n, s[5] / n - s[0] * s[2] / n / n, s[7] / n - s[1] * s[2] / n / n
        _normal(a + 1e-6, p, q, e + 1e-6, r, f + 1e-6, ratio, found[u])
    return found


@kernel
def _normal(a: float, p: float, q: float, e: float, r: float, f: float, ratio: float, out: F32) -> None:
    """Write the unit eigenvector of the smallest eigenvalue of [[a, p, q], [p, e, r], [q, r, f]] if λ2 >= ratio λ1."""
    mean = (a + e + f) / 3.0
    spread = math.sqrt(((a - mean) ** 2 + (e - mean) ** 2 + (f - mean) ** 2 + 2.0 * (p * p + q * q + r * r)) / 6.0)
    if spread <= 1e-12:
        return
    aa, ee, ff = (a - mean) / spread, (e - mean) / spread, (f - mean) / spread
    pp, qq, rr = p / spread, q / spread, r / spread
    half = 0.5 * (aa * (ee * ff - rr * rr) - pp * (pp * ff - rr * qq) + qq * (pp * rr - ee * qq))
    angle = math.acos(min(max(half, -1.0), 1.0)) / 3.0
    largest = mean + 2.0 * spread * math.cos(angle)
    smallest = mean + 2.0 * spread * math.cos(angle + 2.0943951023931953)
    if 3.0 * mean - largest - smallest < ratio * smallest:
        return
    a, e, f = a - smallest, e - smallest, f - smallest
    best, x, y, z = 0.0, 0.0, 0.0, 0.0
    for turn in range(3):  # the longest cross product of two rows of M - λ1 I
        if turn == 0:
            cx, cy, cz = p * r - q * e, q * p - a * r, a * e - p * p
        elif turn == 1:
            cx, cy, cz = p * f - q * r, q * q - a * f, a * r - p * q
        else:
            cx, cy, cz = e * f - r * r, r * q - p * f, p * r - e * q
        size = cx * cx + cy * cy + cz * cz
        if size > best:
            best, x, y, z = size, cx, cy, cz
    if best > 0.0:
        length = math.sqrt(best)
        out[0], out[1], out[2] = x / length, y / length, z / length
