"""How far along its path a vehicle has come at any time: cruising, creeping in a jam, stopping and starting."""

from math import tau
from typing import Final

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import gaussian_filter1d

from fleet_sim.errors import DriveSimError
from gnd_map.arrays import F64

_STEP_S: Final = 0.02
_LEAD_S: Final = 2.0
"""A ride is known so long before its first scan and after its last."""
_EASE_S: Final = 0.6
"""Speeds change no quicker than over about this time."""


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
        t_s = _STEP_S * np.arange(len(speed_mps)) - _LEAD_S
        if speed_mps.min() < 0.0 or t_s[-1] < duration_s + _LEAD_S / 2:
            raise DriveSimError(f"speeds from {speed_mps.min():.2f} m/s until {t_s[-1]:.1f} s make no ride")
        way = np.concatenate([[0.0], np.cumsum(0.5 * (speed_mps[1:] + speed_mps[:-1]) * _STEP_S)])
        self.duration_s = duration_s
        self._way = CubicHermiteSpline(t_s, way - np.interp(0.0, t_s, way), speed_mps)

    def way_m(self, t_s: F64) -> F64:
        """Return the way (K,) [m] at times (K,) [s]."""
        return np.asarray(self._way(t_s))


def cruise(rng: np.random.Generator, speed_mps: float, way_m: float, longest_s: float = np.inf) -> Ride:
    """Return a ride of about a speed that swings slowly, until a way or a time is over."""
    wave, rate, phase = rng.uniform(0.08, 0.14), rng.uniform(0.4, 0.7), rng.uniform(0.0, tau)
    t_s = np.arange(-_LEAD_S, 2.0 * way_m / speed_mps + 2 * _LEAD_S, _STEP_S)
    speed = speed_mps * (1.0 + rng.uniform(-0.05, 0.05)) * (1.0 + wave * np.sin(rate * t_s + phase))
    way = np.cumsum(speed * _STEP_S)
    over_s = float(np.interp(way_m, way - np.interp(0.0, t_s, way), t_s))
    return Ride(speed, min(over_s, longest_s))


def halting(rng: np.random.Generator, top_mps: float, duration_s: float, share_standing: float) -> Ride:
    """Return a ride that starts and stops again and again: `share_standing` of the time it stands.

    It rolls for the first two seconds, so that a heading can be found.
    """
    count = round((duration_s + 2 * _LEAD_S) / _STEP_S) + 1
    t_s, speed, until = _STEP_S * np.arange(count) - _LEAD_S, np.zeros(count), 3.0
    speed[t_s < until] = top_mps
    while until < duration_s:
        stands, rolls = share_standing * rng.uniform(4.0, 8.0), (1.0 - share_standing) * rng.uniform(4.0, 8.0)
        until += stands
        speed[(t_s >= until) & (t_s < until + rolls)] = top_mps * rng.uniform(0.6, 1.0)
        until += rolls
    return Ride(np.maximum(gaussian_filter1d(speed, _EASE_S / _STEP_S), 0.0), duration_s)
