"""The compiled kernels of the ray caster: exact intersection of rays with the primitives of a street and of movers.

A ray is cast in the street frame, an affine image of the map frame (turn and shear), so that the parameter t along the
ray is the same in both: with a unit direction in the map frame, t is the range in metres.

All kernels stand in this one file, because numba's cache on disk notices changes of a kernel's own file only.
"""

from math import cos, log, sin, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.shapes import BALL, BLOCK, BOX, COLUMNS, POST
from gnd.gnd_map.jit import bare

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]

_PARALLEL: Final = 1e-12
_SKIN_M: Final = 1e-6
BLOCK_COLUMNS: Final = 16
"""Movers are looked for in so many columns of shots at once."""
_SLACK_M: Final = 0.2
"""Neither sensor nor mover goes farther within a block (about 1 ms)."""


class Ray(NamedTuple):
    """A ray in the street frame: origin, and the image of a unit direction of the map frame."""

    ox: float
    oy: float
    oz: float
    dx: float
    dy: float
    dz: float


class RayGrid(NamedTuple):
    """The grid of a scene: corner, numbers of cells, edge of a cell (street frame, metres)."""

    x0: float
    y0: float
    nx: int
    ny: int
    cell: float


@bare
def _meet_box(ray: Ray, inverse: tuple[float, float, float], p: FloatArray, k: int) -> float:
    """Range at which the ray enters the box from outside, inf if it does not (slabs, with 1/direction given)."""
    rx, ry = p[k + 1] - ray.ox, p[k + 2] - ray.oy
    x0, x1 = (rx - p[k + 3]) * inverse[0], (rx + p[k + 3]) * inverse[0]
    y0, y1 = (ry - p[k + 4]) * inverse[1], (ry + p[k + 4]) * inverse[1]
    z0, z1 = (p[k + 5] - ray.oz) * inverse[2], (p[k + 6] - ray.oz) * inverse[2]
    entry = max(min(x0, x1), min(y0, y1), min(z0, z1))
    leave = min(max(x0, x1), max(y0, y1), max(z0, z1))
    return entry if 0.0 < entry <= leave else np.inf


@bare
def _clip(distance: float, speed: float, entry: float, leave: float) -> tuple[float, float]:
    """Clip [entry, leave] to the half-space where distance + t * speed <= 0."""
    if abs(speed) < _PARALLEL:
        return (entry, leave) if distance <= 0.0 else (np.inf, leave)
    t = -distance / speed
    return (max(entry, t), leave) if speed < 0.0 else (entry, min(leave, t))


@bare
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


@bare
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


@bare
def _meet_ball(ray: Ray, p: FloatArray, k: int) -> float:
    """Range at which the ray enters the sphere from outside, inf if it does not."""
    rx, ry, rz = ray.ox - p[k + 1], ray.oy - p[k + 2], ray.oz - p[k + 3]
    a, b = ray.dx * ray.dx + ray.dy * ray.dy + ray.dz * ray.dz, rx * ray.dx + ry * ray.dy + rz * ray.dz
    root = b * b - a * (rx * rx + ry * ry + rz * rz - p[k + 4] * p[k + 4])
    if root < 0.0:
        return np.inf
    entry = (-b - sqrt(root)) / a
    return entry if entry > 0.0 else np.inf


@bare
def _inverse(d: float) -> float:
    """1/d, huge instead of infinite where the ray runs along a face (0 * inf is no number)."""
    return 1.0 / d if abs(d) > _PARALLEL else 1.0 / _PARALLEL


@bare
def cast_ray(
    ray: Ray, range_m: float, p: FloatArray, starts: IntArray, items: IntArray, tops: FloatArray, grid: RayGrid
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


@bare
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


@bare
def cast_rays(
    origins: FloatArray,
    directions: FloatArray,
    range_m: float,
    p: FloatArray,
    starts: IntArray,
    items: IntArray,
    tops: FloatArray,
    grid: RayGrid,
    ranges: FloatArray,
    index: IntArray,
) -> None:
    """Cast N rays from origins (N, 3) along directions (N, 3), both in the street frame: fills ranges and primitives
    (N,).
    """
    for i in range(len(directions)):
        o, d = origins[i], directions[i]
        ray = Ray(o[0], o[1], o[2], d[0], d[1], d[2])
        ranges[i], index[i] = cast_ray(ray, range_m, p, starts, items, tops, grid)


@bare
def cast_fan(
    origin: FloatArray,
    directions: FloatArray,
    reach_m: FloatArray,
    p: FloatArray,
    starts: IntArray,
    items: IntArray,
    tops: FloatArray,
    grid: RayGrid,
    ranges: FloatArray,
    index: IntArray,
) -> None:
    """Cast rays from one origin (3,) along directions (N, 3), each with its own reach (N,): fills ranges and
    primitives (N,).
    """
    for i in range(len(directions)):
        d = directions[i]
        ray = Ray(origin[0], origin[1], origin[2], d[0], d[1], d[2])
        ranges[i], index[i] = cast_ray(ray, reach_m[i], p, starts, items, tops, grid)


@bare
def shot(pose: FloatArray, following: FloatArray, share: float, d: FloatArray) -> Ray:
    """The ray of a shot along d (3,), lidar frame, that leaves at a share of the way between two poses (3, 4).

    The affine pose is interpolated entry by entry, which over 55 µs is exact to far below a micrometre.
    """
    a, b = pose, following
    ox = a[0, 3] + share * (b[0, 3] - a[0, 3])
    oy = a[1, 3] + share * (b[1, 3] - a[1, 3])
    oz = a[2, 3] + share * (b[2, 3] - a[2, 3])
    dx, dy, dz = 0.0, 0.0, 0.0
    for k in range(3):
        dx += (a[0, k] + share * (b[0, k] - a[0, k])) * d[k]
        dy += (a[1, k] + share * (b[1, k] - a[1, k])) * d[k]
        dz += (a[2, k] + share * (b[2, k] - a[2, k])) * d[k]
    return Ray(ox, oy, oz, dx, dy, dz)


@bare
def cast_sweep(
    poses: FloatArray,
    directions: FloatArray,
    shares: FloatArray,
    range_m: float,
    p: FloatArray,
    starts: IntArray,
    items: IntArray,
    tops: FloatArray,
    grid: RayGrid,
    ranges: FloatArray,
    found: IntArray,
    incidence: FloatArray,
) -> None:
    """Cast directions (columns, beams, 3) from poses (columns + 1, 3, 4), both towards the street frame, and fill
    ranges, primitives and cosines of incidence (columns, beams).

    Beam j leaves at the fraction shares[j] of its cycle.
    """
    columns, beams = directions.shape[0], directions.shape[1]
    for i in range(columns):
        for j in range(beams):
            ray = shot(poses[i], poses[i + 1], shares[j], directions[i, j])
            ranges[i, j], found[i, j] = cast_ray(ray, range_m, p, starts, items, tops, grid)
            met = found[i, j] >= 0
            incidence[i, j] = incidence_of(ray, ranges[i, j], p, found[i, j]) if met else 1.0


class Crowd(NamedTuple):
    """Movers as the kernels take them; their shapes are packed in frames of their own (x ahead, z up from the ground).

    Attributes:
        tracks: float64 (M, S, 5): x, y, z [m], yaw [rad] in the street frame, stride [m], straight between samples.
        t0_s, step_s: time of the first sample of every track, time from sample to sample.
        packed: float64 (P * 13,), primitives as `shapes.pack` lays them out, flat.
        swing: float64 (P,), a primitive is shifted ahead by this much of the stride (legs and arms).
        first: int32 (M + 1,), where the primitives of each mover start.
        centre_m: float64 (M,), height of the middle of the ball around a mover.
        radius_m: float64 (M,), radius of that ball.
        reach_m: movers farther than this from the street's middle, along the street, are not there.
    """

    tracks: FloatArray
    t0_s: float
    step_s: float
    packed: FloatArray
    swing: FloatArray
    first: IntArray
    centre_m: FloatArray
    radius_m: FloatArray
    reach_m: float


@bare
def state_at(crowd: Crowd, mover: int, t_s: float) -> tuple[float, float, float, float, float]:
    """Where a mover is at an instant: x, y, z, yaw, stride; before and after its track it stands at the end of it."""
    last = crowd.tracks.shape[1] - 1
    u = min(max((t_s - crowd.t0_s) / crowd.step_s, 0.0), float(last))
    k = min(int(u), last - 1)
    f, a, b = u - k, crowd.tracks[mover, k], crowd.tracks[mover, k + 1]
    return (
        a[0] + f * (b[0] - a[0]),
        a[1] + f * (b[1] - a[1]),
        a[2] + f * (b[2] - a[2]),
        a[3] + f * (b[3] - a[3]),
        a[4] + f * (b[4] - a[4]),
    )


@bare
def _meet_primitive(ray: Ray, inverse: tuple[float, float, float], p: FloatArray, k: int) -> float:
    """Range at which the ray enters the primitive packed at p[k:] from outside, inf if it does not.

    `cast_ray` has the same written out: a call there costs a third of its speed.
    """
    if p[k] == BOX:
        return _meet_box(ray, inverse, p, k)
    if p[k] == BALL:
        return _meet_ball(ray, p, k)
    if p[k] == BLOCK:
        return _meet_block(ray, p, k)
    return _meet_post(ray, p, k)


@bare
def _near_ball(ray: Ray, range_m: float, x: float, y: float, z: float, reach: float) -> bool:
    """Whether a ray comes into a ball within range."""
    rx, ry, rz = x - ray.ox, y - ray.oy, z - ray.oz
    dd = ray.dx * ray.dx + ray.dy * ray.dy + ray.dz * ray.dz
    along, away = rx * ray.dx + ry * ray.dy + rz * ray.dz, rx * rx + ry * ry + rz * rz - reach * reach
    if away <= 0.0:
        return True
    before = along - range_m * dd
    return along > 0.0 and away * dd <= along * along and (before <= 0.0 or before * before <= reach * reach * dd)


@bare
def meet_mover(ray: Ray, range_m: float, crowd: Crowd, mover: int, t_s: float) -> tuple[float, int, float]:
    """Range, primitive and cosine of incidence where a ray shot at an instant first meets a mover, (inf, -1, 1) if not.

    The ray is taken into the mover's own frame at that instant.
    """
    x, y, z, yaw, stride = state_at(crowd, mover, t_s)
    rx, ry, rz = ray.ox - x, ray.oy - y, ray.oz - z
    best, found, incidence = range_m, -1, 1.0
    c, s = cos(yaw), sin(yaw)
    x, y, dx, dy = c * rx + s * ry, c * ry - s * rx, c * ray.dx + s * ray.dy, c * ray.dy - s * ray.dx
    inverse = (_inverse(dx), _inverse(dy), _inverse(ray.dz))
    for item in range(crowd.first[mover], crowd.first[mover + 1]):
        own = Ray(x - crowd.swing[item] * stride, y, rz, dx, dy, ray.dz)
        t = _meet_primitive(own, inverse, crowd.packed, item * COLUMNS)
        if t < best:
            best, found, incidence = t, item, incidence_of(own, t, crowd.packed, item)
    return (best, found, incidence) if found >= 0 else (np.inf, -1, 1.0)


@bare
def _faces(pose: FloatArray, direction: FloatArray, x: float, y: float, reach: float, spread: float) -> bool:
    """Whether shots may touch a ball seen from above; `spread` is the sine of how far they fan out from `direction`."""
    rx, ry = x - pose[0, 3], y - pose[1, 3]
    away = sqrt(rx * rx + ry * ry)
    dx = pose[0, 0] * direction[0] + pose[0, 1] * direction[1] + pose[0, 2] * direction[2]
    dy = pose[1, 0] * direction[0] + pose[1, 1] * direction[1] + pose[1, 2] * direction[2]
    flat = sqrt(dx * dx + dy * dy)
    wide = reach + spread * away
    return away <= wide or (rx * dx + ry * dy > 0.0 and abs(rx * dy - ry * dx) <= wide * flat)


@bare
def cast_crowd(
    poses: FloatArray,
    directions: FloatArray,
    shares: FloatArray,
    range_m: float,
    crowd: Crowd,
    timing: tuple[float, float],
    spreads: tuple[float, float],
    base: int,
    ranges: FloatArray,
    found: IntArray,
    incidence: FloatArray,
) -> None:
    """Let the shots of a sweep, given as to `cast_sweep`, meet movers, each where it is at the time of the shot.

    `timing` is the time of the first cycle and the time of a cycle [s]; `spreads` are the sines of the angles that the
    shots of a block of BLOCK_COLUMNS columns and of one column fan out: those that look elsewhere are left out.
    `ranges`, `found` and `incidence` are what `cast_sweep` gave; they change where a mover stands nearer, whose
    primitives count from `base`.
    """
    (t_start, cycle_s), (wide, narrow) = timing, spreads
    columns, beams = directions.shape[0], directions.shape[1]
    for mover in range(len(crowd.first) - 1):
        reach = crowd.radius_m[mover] + _SLACK_M
        for i in range(columns):
            block = i % BLOCK_COLUMNS == 0
            if block:
                x, y, z, _, _ = state_at(crowd, mover, t_start + i * cycle_s)
                seen = abs(x) <= crowd.reach_m and _faces(poses[i], directions[i, 0], x, y, reach, wide)
            if not seen or not _faces(poses[i], directions[i, 0], x, y, reach, narrow):
                continue
            for j in range(beams):
                ray, limit = shot(poses[i], poses[i + 1], shares[j], directions[i, j]), min(range_m, ranges[i, j])
                if _near_ball(ray, limit, x, y, z + crowd.centre_m[mover], reach):
                    t, item, cosine = meet_mover(ray, limit, crowd, mover, t_start + (i + shares[j]) * cycle_s)
                    if item >= 0:
                        ranges[i, j], found[i, j], incidence[i, j] = t, base + item, cosine


@bare
def _mixed(value: np.uint64) -> np.uint64:
    """Scramble the bits of a counter (splitmix64, Steele et al. 2014): neighbours give independent numbers."""
    value = value + np.uint64(0x9E3779B97F4A7C15)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@bare
def _within_crown(ray: Ray, v: FloatArray) -> tuple[float, float]:
    """Ranges at which the ray enters and leaves the ellipsoid v (x, y, z, half axes); leave < entry if it misses."""
    rx, ry, rz = (ray.ox - v[0]) / v[3], (ray.oy - v[1]) / v[4], (ray.oz - v[2]) / v[5]
    dx, dy, dz = ray.dx / v[3], ray.dy / v[4], ray.dz / v[5]
    a, b, c = dx * dx + dy * dy + dz * dz, rx * dx + ry * dy + rz * dz, rx * rx + ry * ry + rz * rz - 1.0
    root = b * b - a * c
    if root <= 0.0:
        return 1.0, 0.0
    return (-b - sqrt(root)) / a, (-b + sqrt(root)) / a


@bare
def _within_hedge(ray: Ray, v: FloatArray) -> tuple[float, float]:
    """Ranges at which the ray enters and leaves the upright box v (x, y, z, half edges); leave < entry if it misses."""
    entry, leave = _clip(ray.ox - v[0] - v[3], ray.dx, -np.inf, np.inf)
    entry, leave = _clip(v[0] - v[3] - ray.ox, -ray.dx, entry, leave)
    entry, leave = _clip(ray.oy - v[1] - v[4], ray.dy, entry, leave)
    entry, leave = _clip(v[1] - v[4] - ray.oy, -ray.dy, entry, leave)
    entry, leave = _clip(ray.oz - v[2] - v[5], ray.dz, entry, leave)
    return _clip(v[2] - v[5] - ray.oz, -ray.dz, entry, leave)


@bare
def cast_leaves(
    poses: FloatArray,
    directions: FloatArray,
    shares: FloatArray,
    range_m: float,
    volumes: FloatArray,
    spreads: tuple[float, float],
    base: int,
    seed: np.uint64,
    ranges: FloatArray,
    found: IntArray,
    incidence: FloatArray,
) -> None:
    """Let the shots of a sweep, given as to `cast_sweep`, meet leaves somewhere inside porous volumes, or pass through.

    A volume (V, 8) is x, y, z of its middle, three half axes, leaves met a metre, and 1 for a box, 0 for an ellipsoid.
    The way to the first leaf is exponential (a Poisson process along the ray), drawn for each shot and volume by a hash
    of `seed`; the nearest leaf of all volumes counts, which is the same as one process over all of them.
    `spreads`, `base`, `ranges`, `found` and `incidence` are as with `cast_crowd`.
    """
    columns, beams = directions.shape[0], directions.shape[1]
    for item in range(len(volumes)):
        v = volumes[item]
        reach = sqrt(v[3] * v[3] + v[4] * v[4] + v[5] * v[5]) + _SLACK_M
        seen = False
        for i in range(columns):
            if i % BLOCK_COLUMNS == 0:
                seen = _faces(poses[i], directions[i, 0], v[0], v[1], reach, spreads[0])
            if not seen or not _faces(poses[i], directions[i, 0], v[0], v[1], reach, spreads[1]):
                continue
            for j in range(beams):
                ray, limit = shot(poses[i], poses[i + 1], shares[j], directions[i, j]), min(range_m, ranges[i, j])
                entry, leave = _within_hedge(ray, v) if v[7] > 0.0 else _within_crown(ray, v)
                entry = max(entry, 0.0)
                if leave <= entry or entry >= limit:
                    continue
                drawn = _mixed(seed + np.uint64((item * columns + i) * beams + j))
                chance = (float(drawn >> np.uint64(11)) + 0.5) / 9007199254740992.0
                t = entry - log(chance) / v[6]
                if t < min(leave, limit):
                    tilt = float(_mixed(drawn) >> np.uint64(11)) / 9007199254740992.0
                    ranges[i, j], found[i, j], incidence[i, j] = t, base + item, 0.3 + 0.7 * tilt
