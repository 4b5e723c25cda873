"""The compiled kernel that makes returns of what the shots of a sweep have met.

It stands in a file of its own, because numba's cache on disk notices changes of a kernel's own file only.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.jit import bare


class ReturnRules(NamedTuple):
    """What a sensor gives back of what its shots have met.

    Attributes:
        sigma_m: of the range.
        nearest_m, farthest_m: what it measures at all.
        dark_m: how far it sees a surface of reflectivity 0.1 that faces it.
        kept: share of the returns that are not lost by chance.
        step_m: ranges are rounded to this; 0: they are not.
        point_step_m: coordinates are rounded to this.
    """

    sigma_m: float
    nearest_m: float
    farthest_m: float
    dark_m: float
    kept: float
    step_m: float
    point_step_m: float


@bare
def fill_returns(
    hits: tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]],
    drawn: tuple[NDArray[np.float64], NDArray[np.float64]],
    reflectivity: NDArray[np.float64],
    table: tuple[NDArray[np.float64], NDArray[np.uint32], NDArray[np.uint8]],
    rules: ReturnRules,
    points: NDArray[np.float32],
    t_offset_ns: NDArray[np.uint32],
    ring: NDArray[np.uint8],
    primitive: NDArray[np.int32],
) -> int:
    """Fill points (N, 3), times, rings and primitives (N,) with the returns in the order of firing; how many there are.

    The echo falls with reflectivity x cos(incidence) / range² (Lambert); it fades over ±10 % of the limit.

    Args:
        hits: range, primitive (-1: nothing was met) and cosine of incidence, (columns, beams) each.
        drawn: numbers of the normal distribution, and of the even one between 0 and 1, (columns, beams) each.
        reflectivity: of each primitive.
        table: directions (columns, beams, 3), times after the start of the sweep and rings (columns, beams).
        rules: of the sensor.
        points: float32 (shots, 3), to be filled as far as there are returns, like the next three.
        t_offset_ns: (shots,).
        ring: (shots,).
        primitive: (shots,).
    """
    (range_m, met, incidence), (normal, even), (directions, times, rings) = hits, drawn, table
    n = 0
    for i in range(met.shape[0]):
        for j in range(met.shape[1]):
            if met[i, j] < 0:
                continue
            noisy = range_m[i, j] + rules.sigma_m * normal[i, j]
            limit = rules.dark_m * sqrt(reflectivity[met[i, j]] * incidence[i, j] / 0.1)
            chance = min(max((1.1 * limit - range_m[i, j]) / (0.2 * limit + 1e-9), 0.0), 1.0) * rules.kept
            if not (even[i, j] < chance and rules.nearest_m <= noisy <= rules.farthest_m):
                continue
            given = np.rint(noisy / rules.step_m) * rules.step_m if rules.step_m > 0.0 else noisy
            for axis in range(3):
                step = rules.point_step_m
                points[n, axis] = np.float32(np.rint(directions[i, j, axis] * given / step) * step)
            t_offset_ns[n], ring[n], primitive[n] = times[i, j], rings[i, j], met[i, j]
            n += 1
    return n
