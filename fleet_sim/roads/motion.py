"""How a vehicle drives along a route: speed and place across the road in closed form or interpolated, at any time."""

from dataclasses import dataclass
from math import tau
from typing import Final

import numpy as np

from gnd.fleet_sim.roads.curve import FloatArray
from gnd.fleet_sim.roads.route import IntArray, Route

STEP_S: Final = 0.05
_HALF_S: Final = 0.01
"""Speeds and turns are differences over twice this: over the period of 50 Hz, so that they add up to the motion."""
_SLIP_S: Final = 0.1
"""Sideways speed is a difference over twice this: places across the road are samples, straight in between."""
CHANGE_S: Final = 5.0
"""A change of lane takes about so long."""


@dataclass(frozen=True, slots=True)
class Cruise:
    """How somebody drives: a mean speed with slow waves, and a slow wander within the lane."""

    cruise_mps: float
    wave_mps: tuple[float, float]
    wave_radps: tuple[float, float]
    wave_rad: tuple[float, float]
    wander_m: tuple[float, float]
    wander_per_m: tuple[float, float]
    wander_rad: tuple[float, float]

    @staticmethod
    def drawn(rng: np.random.Generator, slowest_mps: float, fastest_mps: float) -> "Cruise":
        """Draw a driver whose mean speed is within the middle of the range, so that waves stay within it."""
        fifth = 0.2 * (fastest_mps - slowest_mps)
        mean = float(rng.uniform(slowest_mps + fifth, fastest_mps - fifth))
        low, high = np.array([0.05, 0.15]), np.array([0.12, 0.3])
        return Cruise(
            mean,
            _two(rng, 0.3 * fifth, 0.5 * fifth),
            (float(rng.uniform(low[0], high[0])), float(rng.uniform(low[1], high[1]))),
            _two(rng, 0.0, tau),
            _two(rng, 0.03, 0.12),
            (tau / float(rng.uniform(200, 400)), tau / float(rng.uniform(70, 150))),
            _two(rng, 0.0, tau),
        )

    def way_m(self, t_s: FloatArray) -> FloatArray:
        """Return the way since time 0, float64 (K,) [m]."""
        way = self.cruise_mps * t_s
        for swing, omega, phase in zip(self.wave_mps, self.wave_radps, self.wave_rad, strict=True):
            way = way + swing / omega * (np.sin(omega * t_s + phase) - np.sin(phase))
        return way

    def across_m(self, way_m: FloatArray) -> FloatArray:
        """Return the wander to the left of the lane's middle, float64 (K,) [m]."""
        waves = zip(self.wander_m, self.wander_per_m, self.wander_rad, strict=True)
        return np.asarray(sum(swing * np.sin(per_m * way_m + phase) for swing, per_m, phase in waves))


def _two(rng: np.random.Generator, low: float, high: float) -> tuple[float, float]:
    first, second = rng.uniform(low, high, 2).tolist()
    return first, second


class RoadMotion:
    """The true motion of one drive along a route; times in seconds since its start.

    Attributes:
        duration_s: how long it takes.
    """

    def __init__(self, route: Route, cruise: Cruise, start_m: float, length_m: float) -> None:
        self._route, self._cruise, self._start_m = route, cruise, start_m
        coarse = np.arange(0.0, length_m / (0.5 * cruise.cruise_mps), STEP_S)
        self.duration_s = float(np.interp(length_m, cruise.way_m(coarse), coarse))
        self._times = np.arange(-2.0, self.duration_s + 2.0 + STEP_S, STEP_S)
        self._left_m = np.full(len(self._times), route.lane_left_m[0])

    @property
    def lane_times_s(self) -> FloatArray:
        """Times at which the lane is given, float64 (S,), every STEP_S."""
        return self._times

    def keep_to(self, lane: IntArray) -> None:
        """Drive in lanes int64 (S,) of the route at those times; changes are smoothed over CHANGE_S."""
        wanted = np.array(self._route.lane_left_m)[lane]
        count = round(CHANGE_S / STEP_S) | 1
        kernel = np.hanning(count + 2)[1:-1]
        padded = np.pad(wanted, count // 2, mode="edge")
        self._left_m = np.convolve(padded, kernel / kernel.sum(), mode="valid")

    def way_m(self, t_s: FloatArray) -> FloatArray:
        """Return the way along the route's line at times (K,), float64 (K,)."""
        return self._start_m + self._cruise.way_m(np.asarray(t_s, dtype=np.float64))

    def left_m(self, t_s: FloatArray) -> FloatArray:
        """Return how far left of the route's line the vehicle is at times (K,), float64 (K,)."""
        return np.asarray(np.interp(t_s, self._times, self._left_m)) + self._cruise.across_m(self.way_m(t_s))

    def positions(self, t_s: FloatArray) -> FloatArray:
        """Return true places, float64 (K, 2), at times (K,)."""
        t = np.asarray(t_s, dtype=np.float64)
        return self._route.line.offset(self.way_m(t), self.left_m(t))

    def poses(self, t_s: FloatArray) -> FloatArray:
        """Return true poses x, y [m], heading [rad, not wrapped], float64 (K, 3), at times (K,)."""
        t = np.asarray(t_s, dtype=np.float64)
        way = self.way_m(t)
        xy, heading = self._route.line.at(way)
        left = self.left_m(t)
        xy = xy + left[:, None] * np.stack([-np.sin(heading), np.cos(heading)], axis=1)
        lateral = (self.left_m(t + _SLIP_S) - self.left_m(t - _SLIP_S)) / (2 * _SLIP_S)
        along = (self.way_m(t + _HALF_S) - self.way_m(t - _HALF_S)) / (2 * _HALF_S)
        slip = np.arctan2(lateral, along * (1.0 - self._route.line.curvature(way) * left))
        return np.column_stack([xy, heading + slip])

    def speed_and_yaw_rate(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return true speed [m/s] and yaw rate [rad/s], float64 (K,) each, as means over 20 ms around times (K,)."""
        t = np.asarray(t_s, dtype=np.float64)
        before, after = self.poses(t - _HALF_S), self.poses(t + _HALF_S)
        step = np.linalg.norm(after[:, :2] - before[:, :2], axis=1)
        return step / (2 * _HALF_S), (after[:, 2] - before[:, 2]) / (2 * _HALF_S)
