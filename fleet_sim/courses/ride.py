"""How far along its path a vehicle has come at any time: cruising, creeping in a jam, stopping and starting."""

from math import tau
from typing import Final

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import gaussian_filter1d

from gnd.fleet_sim.errors import DriveSimError
from gnd.gnd_map.arrays import F64

RIDE_STEP_S: Final = 0.02
_LEAD_S: Final = 2.0
"""A ride is known so long before its first scan and after its last."""
_EASE_S: Final = 0.6
"""Lively speeds change over about this time."""
_BRAKE_MPS2: Final = 3.0
_JERK_S: Final = 0.15


class Ride:
    """The way along a path over time; time 0 is the first scan.

    Attributes:
        duration_s: until the ride ends.
    """

    def __init__(self, speed_mps: F64, duration_s: float) -> None:
        """Take speeds (S,) every 20 ms from 2 s before the first scan; the way at time 0 is 0.

        Raises:
            DriveSimError: a vehicle that drives backwards, or speeds that do not reach the end.
        """
        t_s = RIDE_STEP_S * np.arange(len(speed_mps)) - _LEAD_S
        if speed_mps.min() < 0.0 or t_s[-1] < duration_s + _LEAD_S / 2:
            raise DriveSimError(f"speeds from {speed_mps.min():.2f} m/s until {t_s[-1]:.1f} s make no ride")
        way = np.concatenate([[0.0], np.cumsum(0.5 * (speed_mps[1:] + speed_mps[:-1]) * RIDE_STEP_S)])
        self.duration_s = duration_s
        self._way = CubicHermiteSpline(t_s, way - np.interp(0.0, t_s, way), speed_mps)

    def way_m(self, t_s: F64) -> F64:
        """Return the way (K,) [m] at times (K,) [s]."""
        return np.asarray(self._way(t_s))


def cruise(rng: np.random.Generator, speed_mps: float, way_m: float, longest_s: float = np.inf) -> Ride:
    """Return a ride of about a speed that swings slowly, until a way or a time is over."""
    wave, rate, phase = rng.uniform(0.08, 0.14), rng.uniform(0.4, 0.7), rng.uniform(0.0, tau)
    t_s = np.arange(-_LEAD_S, 2.0 * way_m / speed_mps + 2 * _LEAD_S, RIDE_STEP_S)
    speed = speed_mps * (1.0 + rng.uniform(-0.05, 0.05)) * (1.0 + wave * np.sin(rate * t_s + phase))
    way = np.cumsum(speed * RIDE_STEP_S)
    over_s = float(np.interp(way_m, way - np.interp(0.0, t_s, way), t_s))
    return Ride(speed, min(over_s, longest_s))


def halting(
    rng: np.random.Generator,
    top_mps: float,
    duration_s: float,
    stands_s: tuple[float, float],
    rolls_s: tuple[float, float],
) -> Ride:
    """Return a ride that starts and stops again and again, with up to some 3 m/s².

    It rolls for the first three seconds, so that a heading can be found.
    """
    count = round((duration_s + 2 * _LEAD_S) / RIDE_STEP_S) + 1
    t_s, speed, until = RIDE_STEP_S * np.arange(count) - _LEAD_S, np.zeros(count), 3.0
    speed[t_s < until] = top_mps
    while until < duration_s:
        until += float(rng.uniform(*stands_s))
        rolls = float(rng.uniform(*rolls_s))
        speed[(t_s >= until) & (t_s < until + rolls)] = top_mps * rng.uniform(0.6, 1.0)
        until += rolls
    for k in range(1, count):
        change = np.clip(speed[k] - speed[k - 1], -_BRAKE_MPS2 * RIDE_STEP_S, _BRAKE_MPS2 * RIDE_STEP_S)
        speed[k] = speed[k - 1] + change
    return Ride(np.maximum(gaussian_filter1d(speed, _JERK_S / RIDE_STEP_S), 0.0), duration_s)


def lively(rng: np.random.Generator, top_mps: float, way_m: float) -> Ride:
    """Return a ride that brakes to less than half of its speed and speeds up again, every few seconds."""
    t_s = np.arange(-_LEAD_S, 2.5 * way_m / top_mps + 2 * _LEAD_S, RIDE_STEP_S)
    times, speeds = [-_LEAD_S], [top_mps]
    while times[-1] < t_s[-1]:
        times.append(times[-1] + float(rng.uniform(2.0, 3.5)))
        speeds.append(top_mps * float(rng.uniform(0.4, 0.55) if len(times) % 2 == 0 else rng.uniform(0.9, 1.1)))
    speed = np.maximum(gaussian_filter1d(np.interp(t_s, times, speeds), _EASE_S / RIDE_STEP_S), 0.5)
    way = np.cumsum(speed * RIDE_STEP_S)
    return Ride(speed, float(np.interp(way_m, way - np.interp(0.0, t_s, way), t_s)))
