"""The kernels of `lattice`: integers to floats and back, one Gaussian after the other.

They do word for word what the numpy of `lattice` does; a test holds them to it, bit for bit.
"""

import math
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F32, F64, I32, I64
from gnd.gnd_map.jit import bare

PLANE_STEP: Final = 0
SLOPE_BITS: Final = 1
SHEAR_BITS: Final = 2
THIN_BITS: Final = 3
PLANE_BITS: Final = 4
LENGTH_BITS: Final = 5
MEAN_BITS: Final = 6
CELLS_AT: Final = 7
LONGEST: Final = 8
NUMBERS: Final = 9
"""What a kernel needs to know of a lattice, int64."""

_TINY: Final = 1e-12
_MAX_SLOPE, _MAX_STEP = 4095.0, 8191.0
_AXES: Final = np.array([[1, 2, 0], [0, 2, 1], [0, 1, 2]])
_SIX: Final = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@bare
def to_floats(
    axis: I32,
    level: I32,
    slope: I32,
    step: I32,
    along: I64,
    across: I64,
    n: I64,
    row: int,
    mean: F32,
    cov: F32,
    at: int,
) -> bool:
    """Mean (3,) and covariance (6,) of a row of integers into row `at`; False where an entry of L is too long."""
    a, b, c = along[level[row, 0]], along[level[row, 1]], across[level[row, 2]]
    ba = slope[row, 0] * b >> n[SHEAR_BITS]
    ca, cb = slope[row, 1] * c >> n[SLOPE_BITS], slope[row, 2] * c >> n[SLOPE_BITS]
    longest = n[LONGEST]
    if a > longest or b > longest or c > longest or abs(ba) > longest or abs(ca) > longest or abs(cb) > longest:
        return False
    bits = n[MEAN_BITS] - n[LENGTH_BITS]
    ya, yb = np.int64(step[row, 0]) << (bits - n[PLANE_BITS]), np.int64(step[row, 1]) << (bits - n[PLANE_BITS])
    yc = np.int64(step[row, 2]) << (bits - n[THIN_BITS])
    unit, square = 2.0 ** -float(n[MEAN_BITS]), 2.0 ** (-2.0 * float(n[LENGTH_BITS]))
    i, j, k = _AXES[axis[row], 0], _AXES[axis[row], 1], _AXES[axis[row], 2]
    mean[at, i] = np.float32((a * ya) * unit)
    mean[at, j] = np.float32((ba * ya + b * yb) * unit)
    mean[at, k] = np.float32((ca * ya + cb * yb + c * yc) * unit)
    cov[at, _SIX[i, i]] = np.float32((a * a) * square)
    cov[at, _SIX[j, i]] = np.float32((ba * a) * square)
    cov[at, _SIX[j, j]] = np.float32((ba * ba + b * b) * square)
    cov[at, _SIX[k, i]] = np.float32((ca * a) * square)
    cov[at, _SIX[k, j]] = np.float32((ca * ba + cb * b) * square)
    cov[at, _SIX[k, k]] = np.float32((ca * ca + cb * cb + c * c) * square)
    return True


@bare
def floats_of(
    axis: I32, level: I32, slope: I32, step: I32, along: I64, across: I64, n: I64, mean: F32, cov: F32
) -> int:
    """Means (N, 3) and covariances (N, 6) of rows of integers; how many of them are too long, and left out."""
    long = 0
    for row in range(len(axis)):
        long += 0 if to_floats(axis, level, slope, step, along, across, n, row, mean, cov, row) else 1
    return long


@bare
def _level(bounds: F64, sd_m: float) -> int:
    """Number of bounds below, as `np.searchsorted`."""
    low, high = 0, len(bounds)
    while low < high:
        middle = (low + high) // 2
        if bounds[middle] < sd_m:
            low = middle + 1
        else:
            high = middle
    return low


@bare
def _rounded(value: float, limit: float) -> float:
    nearest: float = np.rint(value)
    return min(max(nearest, -limit), limit)


@bare
def find_integers(
    count: I32, cells: I32, mean: F32, cov: F32, counts: I64, between: F64, along_m: F64, across_m: F64, along: I64,
    across: I64, n: I64, axis: I32, level: I32, slope: I32, step: I32, number: I32, on: I64,
    made_mean: F32, made_cov: F32,
) -> None:  # fmt: skip
    """Integers of each Gaussian, and whether they give it back to the bit: the likely thin axis first, then the others;
    where none does, those of the likely one stay.

    Args:
        count: (N,) int32.
        cells: (N,) int32.
        mean: (N, 3) float32.
        cov: (N, 6) float32.
        counts: (K,) int64 numbers of points of the lattice.
        between: (K - 1,) float64 where they change.
        along_m: float64 between which standard deviations levels change, m, along the surface.
        across_m: the same across it.
        along: int64 lengths of the levels along the surface.
        across: the same across it.
        n: (NUMBERS,) int64.
        axis: (N,) int32, filled.
        level: (N, 3) int32, filled.
        slope: (N, 3) int32, filled.
        step: (N, 3) int32, filled.
        number: (N,) int32, filled: of points.
        on: (N,) int64, filled.
        made_mean: (1, 3) float32, room to work in.
        made_cov: (1, 6) float32, as well.
    """
    half = 2.0 ** -float(n[LENGTH_BITS])
    for row in range(len(count)):
        number[row] = _level(between, float(count[row]))
        points = counts[number[row]]
        is_count = points == count[row] and min(points, n[CELLS_AT]) == cells[row]
        likely = _thin_axis(cov, row)
        on[row] = 0
        for turn in range(4):
            # The fourth time writes the first again: none gave it back.
            axis[row] = (likely + turn % 3) % 3
            i, j, k = _AXES[axis[row], 0], _AXES[axis[row], 1], _AXES[axis[row], 2]
            level[row, 0] = _level(along_m, math.sqrt(max(np.float64(cov[row, _SIX[i, i]]), _TINY)))
            d1 = along[level[row, 0]] * half
            l21 = np.float64(cov[row, _SIX[j, i]]) / d1
            level[row, 1] = _level(along_m, math.sqrt(max(np.float64(cov[row, _SIX[j, j]]) - l21 * l21, _TINY)))
            d2 = along[level[row, 1]] * half
            shear, tilt = 2.0 ** float(n[SHEAR_BITS]), 2.0 ** float(n[SLOPE_BITS])
            s_ba = _rounded(l21 / d2 * shear, _MAX_SLOPE)
            l21 = s_ba * d2 / shear
            l31 = np.float64(cov[row, _SIX[k, i]]) / d1
            l32 = (np.float64(cov[row, _SIX[k, j]]) - l31 * l21) / d2
            rest = np.float64(cov[row, _SIX[k, k]]) - l31 * l31 - l32 * l32
            level[row, 2] = _level(across_m, math.sqrt(max(rest, _TINY)))
            d3 = across[level[row, 2]] * half
            slope[row, 0] = s_ba
            slope[row, 1] = _rounded(l31 / d3 * tilt, _MAX_SLOPE)
            slope[row, 2] = _rounded(l32 / d3 * tilt, _MAX_SLOPE)
            _whiten(mean, axis, level, slope, step, along, across, n, row)
            if turn == 3 or not is_count:
                break
            fits = to_floats(axis, level, slope, step, along, across, n, row, made_mean, made_cov, 0)
            if fits and _is_same(mean, cov, row, made_mean, made_cov):
                on[row] = 1
                break


@bare
def _thin_axis(cov: F32, row: int) -> int:
    """Axis of the largest diagonal entry of Sigma^-1."""
    best, found = 0, -np.inf
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        off = np.float64(cov[row, _SIX[j, k]])
        cofactor = np.float64(cov[row, _SIX[j, j]]) * np.float64(cov[row, _SIX[k, k]]) - off * off
        if cofactor > found:
            best, found = i, cofactor
    return best


@bare
def _whiten(mean: F32, axis: I32, level: I32, slope: I32, step: I32, along: I64, across: I64, n: I64, row: int) -> None:
    """The mean's steps, one whitened component after the other."""
    half = 2.0 ** -float(n[LENGTH_BITS])
    b, c = along[level[row, 1]], across[level[row, 2]]
    aa, bb, cc = along[level[row, 0]] * half, b * half, c * half
    ba = (slope[row, 0] * b >> n[SHEAR_BITS]) * half
    ca, cb = (slope[row, 1] * c >> n[SLOPE_BITS]) * half, (slope[row, 2] * c >> n[SLOPE_BITS]) * half
    i, j, k = _AXES[axis[row], 0], _AXES[axis[row], 1], _AXES[axis[row], 2]
    plane, thin = 2.0 ** -float(n[PLANE_BITS]), 2.0 ** -float(n[THIN_BITS])
    m_a = _rounded(np.float64(mean[row, i]) / aa / plane, _MAX_STEP)
    m_b = _rounded((np.float64(mean[row, j]) - ba * m_a * plane) / bb / plane, _MAX_STEP)
    m_c = _rounded((np.float64(mean[row, k]) - (ca * m_a + cb * m_b) * plane) / cc / thin, _MAX_STEP)
    step[row, 0], step[row, 1], step[row, 2] = m_a, m_b, m_c


@bare
def _is_same(mean: F32, cov: F32, row: int, made_mean: F32, made_cov: F32) -> bool:
    for i in range(3):
        if mean[row, i] != made_mean[0, i]:
            return False
    same = True
    for i in range(6):
        same = same and cov[row, i] == made_cov[0, i]
    return same
