"""The compiled kernels of the ray caster: exact intersection of rays with the primitives of a street and of movers.

A ray is cast in the street frame, an affine image of the map frame (turn and shear), so that the parameter t along the
ray is the same in both: with a unit direction in the map frame, t is the range in metres.

All kernels stand in this one file, because numba's cache on disk notices changes of a kernel's own file only.
"""

from math import sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_sim.shapes import BALL, BLOCK, BOX, COLUMNS, POST
from gnd_map.jit import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]

_PARALLEL: Final = 1e-12
_SKIN_M: Final = 1e-6


class Ray(NamedTuple):
    """A ray in the street frame: origin, and the image of a unit direction of the map frame."""

    ox: float
    oy: float
    oz: float
    dx: float
    dy: float
    dz: float


class Grid(NamedTuple):
    """The grid of a scene: corner, numbers of cells, edge of a cell (street frame, metres)."""

    x0: float
    y0: float
    nx: int
    ny: int
    cell: float


@kernel
def _meet_box(ray: Ray, inverse: tuple[float, float, float], p: FloatArray, k: int) -> float:
    """Range at which the ray enters the box from outside, inf if it does not (slabs, with 1/direction given)."""
    rx, ry = p[k + 1] - ray.ox, p[k + 2] - ray.oy
    x0, x1 = (rx - p[k + 3]) * inverse[0], (rx + p[k + 3]) * inverse[0]
    y0, y1 = (ry - p[k + 4]) * inverse[1], (ry + p[k + 4]) * inverse[1]
    z0, z1 = (p[k + 5] - ray.oz) * inverse[2], (p[k + 6] - ray.oz) * inverse[2]
    entry = max(min(x0, x1), min(y0, y1), min(z0, z1))
    leave = min(max(x0, x1), max(y0, y1), max(z0, z1))
    return entry if 0.0 < entry <= leave else np.inf


@kernel
def _clip(distance: float, speed: float, entry: float, leave: float) -> tuple[float, float]:
    """Clip [entry, leave] to the half-space where distance + t * speed <= 0."""
    if abs(speed) < _PARALLEL:
        return (entry, leave) if distance <= 0.0 else (np.inf, leave)
    t = -distance / speed
    return (max(entry, t), leave) if speed < 0.0 else (entry, min(leave, t))


@kernel
def _meet_block(ray: Ray, p: FloatArray, k: int) -> float:
    """Range at which the ray enters the turned block with a sloping top from outside, inf if it does not."""
    c, s = p[k + 7], p[k + 8]
    rx, ry = ray.ox - p[k + 1], ray.oy - p[k + 2]
    u, v = c * rx + s * ry, c * ry - s * rx
    du, dv = c * ray.dx + s * ray.dy, c * ray.dy - s * ray.dx
    entry, leave = _clip(u - p[k + 3], du, -np.inf, np.inf)
    entry, leave = _clip(-u - p[k + 3], -du, entry, leave)
    entry, leave = _clip(v - p[k + 4], dv, entry, leave)
    entry, leave = _clip(-v - p[k + 4], -dv, entry, leave)
    if entry > leave:
        return np.inf
    above = ray.oz - p[k + 9] * u - p[k + 10] * v - p[k + 6]
    entry, leave = _clip(above, ray.dz - p[k + 9] * du - p[k + 10] * dv, entry, leave)
    entry, leave = _clip(p[k + 5] - ray.oz, -ray.dz, entry, leave)
    return entry if 0.0 < entry <= leave else np.inf


@kernel
def _meet_post(ray: Ray, p: FloatArray, k: int) -> float:
    """Range at which the ray enters the vertical cylinder from outside, inf if it does not."""
    rx, ry = ray.ox - p[k + 1], ray.oy - p[k + 2]
    a, b = ray.dx * ray.dx + ray.dy * ray.dy, rx * ray.dx + ry * ray.dy
    c = rx * rx + ry * ry - p[k + 3] * p[k + 3]
    entry, leave = -np.inf, np.inf
    if a > _PARALLEL:
        root = b * b - a * c
        if root < 0.0:
            return np.inf
        entry, leave = (-b - sqrt(root)) / a, (-b + sqrt(root)) / a
    elif c > 0.0:
        return np.inf
    entry, leave = _clip(ray.oz - p[k + 6], ray.dz, entry, leave)
    entry, leave = _clip(p[k + 5] - ray.oz, -ray.dz, entry, leave)
    return entry if 0.0 < entry <= leave else np.inf


@kernel
def _meet_ball(ray: Ray, p: FloatArray, k: int) -> float:
    """Range at which the ray enters the sphere from outside, inf if it does not."""
    rx, ry, rz = ray.ox - p[k + 1], ray.oy - p[k + 2], ray.oz - p[k + 3]
    a, b = ray.dx * ray.dx + ray.dy * ray.dy + ray.dz * ray.dz, rx * ray.dx + ry * ray.dy + rz * ray.dz
    root = b * b - a * (rx * rx + ry * ry + rz * rz - p[k + 4] * p[k + 4])
    if root < 0.0:
        return np.inf
    entry = (-b - sqrt(root)) / a
    return entry if entry > 0.0 else np.inf


@kernel
def _inverse(d: float) -> float:
    """1/d, huge instead of infinite where the ray runs along a face (0 * inf is no number)."""
    return 1.0 / d if abs(d) > _PARALLEL else 1.0 / _PARALLEL


@kernel
def cast_ray(
    ray: Ray, range_m: float, p: FloatArray, starts: IntArray, items: IntArray, tops: FloatArray, grid: Grid
) -> tuple[float, int]:
    """Walk one ray over the grid: range and index of the first primitive, (inf, -1) for a miss.

    A cell or a primitive whose highest point lies below the ray's whole stretch in the cell is left without a test
    (roads are mostly air). The origin must lie inside the grid.
    """
    cell, nx, ny = grid.cell, grid.nx, grid.ny
    ix, iy = int((ray.ox - grid.x0) / cell), int((ray.oy - grid.y0) / cell)
    step_x, step_y = (1 if ray.dx > 0.0 else -1), (1 if ray.dy > 0.0 else -1)
    inverse = (_inverse(ray.dx), _inverse(ray.dy), _inverse(ray.dz))
    delta_x, delta_y = cell * abs(inverse[0]), cell * abs(inverse[1])
    next_x = (grid.x0 + (ix + (ray.dx > 0.0)) * cell - ray.ox) * inverse[0] if abs(ray.dx) > _PARALLEL else np.inf
    next_y = (grid.y0 + (iy + (ray.dy > 0.0)) * cell - ray.oy) * inverse[1] if abs(ray.dy) > _PARALLEL else np.inf
    best, found, entry = range_m, -1, 0.0
    while 0 <= ix < nx and 0 <= iy < ny and entry < best:
        leave = min(next_x, next_y, range_m)
        lowest = ray.oz + (leave if ray.dz < 0.0 else entry) * ray.dz
        if lowest <= tops[ix * ny + iy]:
            for j in range(starts[ix * ny + iy], starts[ix * ny + iy + 1]):
                k = items[j] * COLUMNS
                if lowest > p[k + 11]:
                    continue
                if p[k] == BOX:
                    t = _meet_box(ray, inverse, p, k)
                elif p[k] == BALL:
                    t = _meet_ball(ray, p, k)
                elif p[k] == BLOCK:
                    t = _meet_block(ray, p, k)
                else:
                    t = _meet_post(ray, p, k)
                if t < best:
                    best, found = t, items[j]
        if next_x < next_y:
            next_x += delta_x
            ix += step_x
        else:
            next_y += delta_y
            iy += step_y
        entry = leave
    return (best, found) if found >= 0 else (np.inf, -1)


@kernel
def incidence_of(ray: Ray, t: float, p: FloatArray, item: int) -> float:
    """Cosine of the angle between a ray and the normal of the surface of primitive `item` that it met at range t."""
    k = item * COLUMNS
    dx, dy, dz = ray.dx, ray.dy, ray.dz
    x, y, z = ray.ox + t * dx - p[k + 1], ray.oy + t * dy - p[k + 2], ray.oz + t * dz
    length = sqrt(dx * dx + dy * dy + dz * dz)
    if p[k] == BALL:
        return float(abs(x * dx + y * dy + (z - p[k + 3]) * dz) / (p[k + 4] * length))
    if p[k] == POST:
        flat = z > p[k + 6] - _SKIN_M or z < p[k + 5] + _SKIN_M
        return float(abs(dz) / length if flat else abs(x * dx + y * dy) / (p[k + 3] * length))
    c, s = p[k + 7], p[k + 8]
    if abs(c * x + s * y) > p[k + 3] - _SKIN_M:
        return float(abs(c * dx + s * dy) / length)
    if abs(c * y - s * x) > p[k + 4] - _SKIN_M:
        return float(abs(c * dy - s * dx) / length)
    if z < p[k + 5] + _SKIN_M:
        return float(abs(dz) / length)
    rise_x, rise_y = p[k + 9], p[k + 10]
    down = dz - rise_x * (c * dx + s * dy) - rise_y * (c * dy - s * dx)
    return float(abs(down) / (length * sqrt(1.0 + rise_x * rise_x + rise_y * rise_y)))


@kernel
def cast_rays(
    origins: FloatArray,
    directions: FloatArray,
    range_m: float,
    p: FloatArray,
    starts: IntArray,
    items: IntArray,
    tops: FloatArray,
    grid: Grid,
) -> tuple[FloatArray, IntArray]:
    """Cast N rays from origins (N, 3) along directions (N, 3), both in the street frame: ranges and primitives (N,)."""
    ranges, index = np.empty(len(directions)), np.empty(len(directions), np.int32)
    for i in range(len(directions)):
        o, d = origins[i], directions[i]
        ray = Ray(o[0], o[1], o[2], d[0], d[1], d[2])
        ranges[i], index[i] = cast_ray(ray, range_m, p, starts, items, tops, grid)
    return ranges, index


@kernel
def cast_sweep(
    poses: FloatArray,
    directions: FloatArray,
    shares: FloatArray,
    range_m: float,
    p: FloatArray,
    starts: IntArray,
    items: IntArray,
    tops: FloatArray,
    grid: Grid,
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Cast directions (columns, beams, 3) from poses (columns + 1, 3, 4), both towards the street frame.

    Beam j leaves at the fraction shares[j] of its cycle; the affine pose between two cycles is interpolated entry by
    entry, which over 55 µs is exact to far below a micrometre.
    """
    columns, beams = directions.shape[0], directions.shape[1]
    ranges, found = np.empty((columns, beams)), np.empty((columns, beams), np.int32)
    incidence, T = np.empty((columns, beams)), np.empty((3, 4))
    for i in range(columns):
        for j in range(beams):
            for k in range(12):
                here, there = poses[i, k // 4, k % 4], poses[i + 1, k // 4, k % 4]
                T[k // 4, k % 4] = here + shares[j] * (there - here)
            d = directions[i, j]
            dx = T[0, 0] * d[0] + T[0, 1] * d[1] + T[0, 2] * d[2]
            dy = T[1, 0] * d[0] + T[1, 1] * d[1] + T[1, 2] * d[2]
            dz = T[2, 0] * d[0] + T[2, 1] * d[1] + T[2, 2] * d[2]
            ray = Ray(T[0, 3], T[1, 3], T[2, 3], dx, dy, dz)
            ranges[i, j], found[i, j] = cast_ray(ray, range_m, p, starts, items, tops, grid)
            met = found[i, j] >= 0
            incidence[i, j] = incidence_of(ray, ranges[i, j], p, found[i, j]) if met else 1.0
    return ranges, found, incidence
