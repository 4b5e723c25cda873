"""What the vehicle saw a moment ago as a map: a pose that jumps away from it has jumped, whatever else has changed.

Where nearly all that stands was rebuilt, the base map can be fitted by chance, half a metre off. What was seen half a
second before has not been rebuilt since, so it tells such a chance from a pose that went wrong.
"""

from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F32, F64, I32, I64
from gnd.gnd_map.jit import bare, bare_inlined
from gnd.vehicle_agent.localise.match_map import MatchMap

_LEAST_POINTS: Final = 6
_MARGIN: Final = 2  # voxels around, so that points beside what was seen are inside the window
_EMPTY: Final = -1


def recent_map(
    points_m: F32 | F64, noise_m: float, centre_m: F64 | None = None, about_m: F64 | None = None, reach_m: float = 0.0
) -> MatchMap | None:
    """A Gaussian for each 1 m cube of the map frame in which enough points lie; the others are empty.

    Args:
        points_m: (N, 3), C-contiguous, about a centre.
        noise_m: one sigma of a point.
        centre_m: (3,), map frame; None: its origin.
        about_m: (3,), map frame: points that are farther from there are left out; None: none is.
        reach_m: how far.

    Returns:
        The map; None where no point is left.
    """
    points, centre = points_m, np.zeros(3) if centre_m is None else centre_m
    about, reach = (np.zeros(3), np.inf) if about_m is None else (np.ascontiguousarray(about_m), reach_m)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    if not extent_of(points, centre, about, reach, low, high):
        return None
    origin, shape = low - _MARGIN, high - low + 1 + 2 * _MARGIN
    index = np.zeros(tuple(shape.tolist()), np.int32)
    n = number_cubes(points, centre, about, reach, origin, _LEAST_POINTS, index)
    count, mean, cov = np.zeros(n, np.int64), np.zeros((n, 3)), np.zeros((n, 6))
    moments_of_cubes(points, centre, about, reach, origin, index, count, mean, cov)
    return MatchMap.of(index, np.eye(3), -origin.astype(np.float64), mean, cov, noise_m)


@bare_inlined
def _is_near(x: float, y: float, z: float, about: F64, reach_m: float) -> bool:
    dx, dy, dz = x - about[0], y - about[1], z - about[2]
    return bool(np.sqrt(dx * dx + dy * dy + dz * dz) < reach_m)


@bare
def extent_of(points: F32 | F64, centre: F64, about: F64, reach_m: float, low: I64, high: I64) -> int:
    """Fill `low` and `high` (3,) with the lowest and the highest cube that points within reach lie in; how many do."""
    n = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] + centre[0], points[i, 1] + centre[1], points[i, 2] + centre[2]
        if not _is_near(x, y, z, about, reach_m):
            continue
        at = np.int64(np.floor(x)), np.int64(np.floor(y)), np.int64(np.floor(z))
        for axis in range(3):
            low[axis] = min(low[axis], at[axis]) if n else at[axis]
            high[axis] = max(high[axis], at[axis]) if n else at[axis]
        n += 1
    return n


@bare
def number_cubes(
    points: F32 | F64, centre: F64, about: F64, reach_m: float, origin: I64, least: int, index: I32
) -> int:
    """Turn `index` (nx, ny, nz), all zeros, into row numbers of the cubes that hold enough points, and `_EMPTY`; how
    many they are.
    """
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] + centre[0], points[i, 1] + centre[1], points[i, 2] + centre[2]
        if _is_near(x, y, z, about, reach_m):
            gx, gy, gz = int(np.floor(x)) - origin[0], int(np.floor(y)) - origin[1], int(np.floor(z)) - origin[2]
            index[gx, gy, gz] += 1
    flat, rows = index.reshape(-1), 0
    for cell in range(flat.shape[0]):
        if flat[cell] >= least:
            flat[cell] = rows
            rows += 1
        else:
            flat[cell] = _EMPTY
    return rows


@bare
def moments_of_cubes(
    points: F32 | F64, centre: F64, about: F64, reach_m: float, origin: I64, index: I32, count: I64, mean: F64,
    cov: F64,
) -> None:  # fmt: skip
    """Fill points, mean and covariance (xx, xy, xz, yy, yz, zz) of the numbered cubes (M,), all zeros: first the means,
    then what lies about them, so that nothing cancels.
    """
    for about_mean in range(2):
        for i in range(points.shape[0]):
            x, y, z = points[i, 0] + centre[0], points[i, 1] + centre[1], points[i, 2] + centre[2]
            if not _is_near(x, y, z, about, reach_m):
                continue
            gx, gy, gz = int(np.floor(x)) - origin[0], int(np.floor(y)) - origin[1], int(np.floor(z)) - origin[2]
            row = index[gx, gy, gz]
            if row < 0:
                continue
            if about_mean == 0:
                count[row] += 1
                mean[row, 0] += x
                mean[row, 1] += y
                mean[row, 2] += z
                continue
            dx, dy, dz = x - mean[row, 0], y - mean[row, 1], z - mean[row, 2]
            cov[row, 0] += dx * dx
            cov[row, 1] += dx * dy
            cov[row, 2] += dx * dz
            cov[row, 3] += dy * dy
            cov[row, 4] += dy * dz
            cov[row, 5] += dz * dz
        for row in range(count.shape[0]):
            if about_mean == 0:
                for axis in range(3):
                    mean[row, axis] /= count[row]
            else:
                for k in range(6):
                    cov[row, k] /= max(count[row] - 1, 1)
