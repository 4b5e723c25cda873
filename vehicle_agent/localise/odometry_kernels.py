"""Numba kernels of the motion by wheels and gyro: samples at the times that are asked for, and their integral.

The plain twins are in `tests/localise/test_odometry_kernels.py`.
"""

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.jit import bare, kernel


@kernel
def resampled(known_ns: I64, speed: F64, yaw_rate: F64, first_ns: int, last_ns: int) -> tuple[I64, F64, F64]:
    """Times (N,) of the samples `known_ns` (K,) strictly within a span, both ends added, and the samples there: linear
    between samples, the nearest beyond them, 0 without any.
    """
    k, n = known_ns.shape[0], 1
    t = np.empty(k + 2, np.int64)
    t[0] = first_ns
    for i in range(k):
        if first_ns < known_ns[i] < last_ns:
            t[n] = known_ns[i]
            n += 1
    if last_ns > first_ns:
        t[n] = last_ns
        n += 1
    speed_at, yaw_rate_at = np.zeros(n), np.zeros(n)
    after = 0
    for i in range(n if k else 0):
        while after < k and known_ns[after] < t[i]:
            after += 1
        low, high = max(after - 1, 0), min(after, k - 1)
        span = known_ns[high] - known_ns[low]
        part = (t[i] - known_ns[low]) / span if span > 0 else 0.0
        speed_at[i] = speed[low] + part * (speed[high] - speed[low])
        yaw_rate_at[i] = yaw_rate[low] + part * (yaw_rate[high] - yaw_rate[low])
    return t[:n], speed_at, yaw_rate_at


@bare
def integrate(t_ns: I64, speed: F64, yaw_rate: F64, course: F64, T: F64) -> None:
    """Fill T (N, 4, 4) with the poses at times (N,) in the frame of the first, of a car that drives along its x axis
    and turns about z, step by step along the chord of an arc; course (2,): motion left and up per metre forward.
    """
    yaw = x = y = z = 0.0
    for i in range(t_ns.shape[0]):
        if i:
            dt = (t_ns[i] - t_ns[i - 1]) * 1e-9
            half, way = 0.25 * (yaw_rate[i] + yaw_rate[i - 1]) * dt, 0.5 * (speed[i] + speed[i - 1]) * dt
            chord = way * np.sin(half) / half if half != 0.0 else way
            cos, sin = np.cos(yaw + half), np.sin(yaw + half)
            x += chord * (cos - course[0] * sin)
            y += chord * (sin + course[0] * cos)
            z += way * course[1]
            yaw += 2.0 * half
        T[i] = 0.0
        T[i, 0, 0] = T[i, 1, 1] = np.cos(yaw)
        T[i, 1, 0] = np.sin(yaw)
        T[i, 0, 1] = -T[i, 1, 0]
        T[i, 2, 2] = T[i, 3, 3] = 1.0
        T[i, 0, 3], T[i, 1, 3], T[i, 2, 3] = x, y, z
