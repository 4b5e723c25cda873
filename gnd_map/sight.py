"""The kernel of `visibility`: lines of sight through a window of voxels until something stops them."""

import math

import numba
import numpy as np

from gnd_map.arrays import F64, I32
from gnd_map.jit import kernel

NOTHING = -1
"""A voxel in which nothing stops a line."""
OUTSIDE = -2
"""A voxel of which the map is not at hand; nothing stops a line there, and nothing is counted."""
_MOST_VOXELS = 1024  # that one line crosses


@numba.njit(inline="always", error_model="numpy")
def _stops(mean: F64, whitening: F64, row: int, o: F64, d: F64, t_in: float, t_out: float, r2: float) -> bool:
    """Whether the line passes Gaussian `row` within `r2` at its most likely point between t_in and t_out."""
    mx, my, mz = mean[row, 0] - o[0], mean[row, 1] - o[1], mean[row, 2] - o[2]
    yx = whitening[row, 0, 0] * d[0]
    yy = whitening[row, 1, 0] * d[0] + whitening[row, 1, 1] * d[1]
    yz = whitening[row, 2, 0] * d[0] + whitening[row, 2, 1] * d[1] + whitening[row, 2, 2] * d[2]
    zx = whitening[row, 0, 0] * mx
    zy = whitening[row, 1, 0] * mx + whitening[row, 1, 1] * my
    zz = whitening[row, 2, 0] * mx + whitening[row, 2, 1] * my + whitening[row, 2, 2] * mz
    t = min(max((yx * zx + yy * zy + yz * zz) / (yx * yx + yy * yy + yz * yz), t_in), t_out)
    ex, ey, ez = t * yx - zx, t * yy - zy, t * yz - zz
    return bool(ex * ex + ey * ey + ez * ez <= r2)


@kernel
def cast_lines(  # noqa: C901  (one loop, as in the vehicle's ray kernel)
    places: F64,
    turn: F64,
    weight: F64,
    directions: F64,
    metres: F64,
    state: I32,
    shape: tuple[int, int, int],
    mean: F64,
    whitening: F64,
    r2: float,
    range_m: float,
    reach_m: float,
    level: float,
    hits: F64,
    passes: F64,
) -> None:
    """Follow every direction from every place; counts into `hits` and `passes`.

    Args:
        places: (P, 3) float64 window coordinates.
        turn: (P, 2) float64 cosine and sine of the angle by which the directions are turned about the vertical.
        weight: (P,) float64 rays that each line stands for.
        directions: (R, 3) float64 unit vectors, metric.
        metres: (3,) float64 metres a voxel.
        state: (nx * ny * nz,) int32: row of what stops lines, NOTHING or OUTSIDE.
        shape: (nx, ny, nz).
        mean: (M, 3) float64 metres from the window's corner.
        whitening: (M, 3, 3) float64 lower triangles.
        r2: squared Mahalanobis distance within which a Gaussian stops a line.
        range_m: voxels that a line enters beyond are not counted.
        reach_m: lines end there.
        level: a line that nothing stopped counts if the sine of its elevation, up or down, is smaller.
        hits: (M,) float64, changed: lines that each Gaussian stopped within the range.
        passes: (nx * ny * nz,) float64, changed: lines that crossed each voxel and met something behind.
    """
    nx, ny, nz = shape
    crossed = np.empty(_MOST_VOXELS, np.int64)
    o, d, g = np.empty(3), np.empty(3), np.empty(3)
    for p in range(places.shape[0]):
        for axis in range(3):
            o[axis] = places[p, axis] * metres[axis]
        if not (0.0 <= places[p, 0] < nx and 0.0 <= places[p, 1] < ny and 0.0 <= places[p, 2] < nz):
            continue
        for r in range(directions.shape[0]):
            d[0] = turn[p, 0] * directions[r, 0] - turn[p, 1] * directions[r, 1]
            d[1] = turn[p, 1] * directions[r, 0] + turn[p, 0] * directions[r, 1]
            d[2] = directions[r, 2]
            for axis in range(3):
                g[axis] = d[axis] / metres[axis]
            i, j, k = math.floor(places[p, 0]), math.floor(places[p, 1]), math.floor(places[p, 2])
            step_x, step_y, step_z = (1 if g[0] > 0 else -1), (1 if g[1] > 0 else -1), (1 if g[2] > 0 else -1)
            dt_x = 1.0 / abs(g[0]) if g[0] != 0.0 else np.inf
            dt_y = 1.0 / abs(g[1]) if g[1] != 0.0 else np.inf
            dt_z = 1.0 / abs(g[2]) if g[2] != 0.0 else np.inf
            t_x = ((i + 1 - places[p, 0]) if step_x > 0 else (places[p, 0] - i)) * dt_x if g[0] != 0.0 else np.inf
            t_y = ((j + 1 - places[p, 1]) if step_y > 0 else (places[p, 1] - j)) * dt_y if g[1] != 0.0 else np.inf
            t_z = ((k + 1 - places[p, 2]) if step_z > 0 else (places[p, 2] - k)) * dt_z if g[2] != 0.0 else np.inf
            t_in, n, met = 0.0, 0, abs(d[2]) < level
            while t_in < reach_m and n < _MOST_VOXELS:
                at = (i * ny + j) * nz + k
                row = state[at]
                t_out = min(t_x, t_y, t_z)
                if row >= 0 and _stops(mean, whitening, row, o, d, t_in, min(t_out, reach_m), r2):
                    met = True
                    if t_in <= range_m:
                        hits[row] += weight[p]
                    break
                if t_in <= range_m:
                    crossed[n] = at
                    n += 1
                t_in = t_out
                if t_x <= t_y and t_x <= t_z:
                    i += step_x
                    t_x += dt_x
                    if i < 0 or i >= nx:
                        break
                elif t_y <= t_z:
                    j += step_y
                    t_y += dt_y
                    if j < 0 or j >= ny:
                        break
                else:
                    k += step_z
                    t_z += dt_z
                    if k < 0 or k >= nz:
                        break
            if met:
                for c in range(n):
                    passes[crossed[c]] += weight[p]
