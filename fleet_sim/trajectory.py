"""How a simulated vehicle moves along its lane: smooth, in closed form, at any time.

The vehicle frame has its origin on the road under the middle of the rear axle, x forward, y left, z up from the road.
The rear axle runs along the path, so wheel speed and yaw rate describe the motion without slip; body roll, pitch and
heave come on top.
"""

from dataclasses import dataclass
from math import exp, radians, tau
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.world import World
from gnd.gnd_map.se3 import T_inverse, exp_so3, log_so3

FloatArray = NDArray[np.float64]

Direction = Literal[1, -1]

_STEP_S: Final = 0.5e-3
_SWAY_RAD: Final = radians(0.12)
_HEAVE_M: Final = 0.006
_SWAY_RADPS: Final = (2.6, 5.1, 8.3)
_END_MARGIN_M: Final = 2.0


@dataclass(frozen=True, slots=True)
class DrivingStyle:
    """How fast and how straight somebody drives.

    Attributes:
        cruise_mps: speed once under way.
        start_share: speed at the start as a share of the cruising speed.
        settle_s: time constant of getting under way.
        wave_mps, wave_radps, wave_rad: a slow swing of the speed.
        wander_m, wander_length_m, wander_rad: a slow swing across the lane.
        sway_rad: phases of roll, pitch and heave, float64 (9,).
    """

    cruise_mps: float
    start_share: float
    settle_s: float
    wave_mps: float
    wave_radps: float
    wave_rad: float
    wander_m: float
    wander_length_m: float
    wander_rad: float
    sway_rad: tuple[float, ...]

    def __post_init__(self) -> None:
        slowest = self.cruise_mps * self.start_share - abs(self.wave_mps)
        if slowest <= 0.5:
            raise DriveSimError(f"the vehicle would slow down to {slowest:.2f} m/s; keep it above 0.5 m/s")

    @staticmethod
    def drawn(rng: np.random.Generator, cruise_mps: float) -> "DrivingStyle":
        """Draw a style around a cruising speed."""
        return DrivingStyle(
            cruise_mps=cruise_mps + float(rng.uniform(-0.5, 0.5)),
            start_share=float(rng.uniform(0.45, 1.0)),
            settle_s=float(rng.uniform(2.0, 3.5)),
            wave_mps=float(rng.uniform(0.1, 0.14)) * cruise_mps,
            wave_radps=float(rng.uniform(0.4, 0.7)),
            wave_rad=float(rng.uniform(0.0, tau)),
            wander_m=float(rng.uniform(0.05, 0.2)),
            wander_length_m=float(rng.uniform(45.0, 75.0)),
            wander_rad=float(rng.uniform(0.0, tau)),
            sway_rad=tuple(rng.uniform(0.0, tau, 9).tolist()),
        )


@dataclass(frozen=True, slots=True)
class Motion:
    """The true motion of one drive through a world.

    Attributes:
        world: where.
        style: how.
        direction: +1 along the street's x, -1 against it; both keep to the right lane.
        start_m: street x at time 0.
    """

    world: World
    style: DrivingStyle
    direction: Direction
    start_m: float

    def travelled_m(self, t_s: FloatArray) -> FloatArray:
        """Return the way along the street since time 0, float64 (K,) [m]."""
        s = self.style
        lost = (1.0 - s.start_share) * s.settle_s
        swing = s.wave_mps / s.wave_radps * (np.sin(s.wave_radps * t_s + s.wave_rad) - np.sin(s.wave_rad))
        return np.asarray(s.cruise_mps * (t_s - lost * (1.0 - np.exp(-t_s / s.settle_s))) + swing)

    def duration_s(self, way_m: float) -> float:
        """Return the time until `way_m` has been travelled [s]."""
        slowest = self.style.cruise_mps * self.style.start_share - abs(self.style.wave_mps)
        t_s = np.arange(0.0, way_m / slowest + 1.0, 0.01)
        return float(np.interp(way_m, self.travelled_m(t_s), t_s))

    def on_path(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return street x, street y [m] and the path's slope dy/dx at times (K,) [s]."""
        s = self.style
        x = self.start_m + self.direction * self.travelled_m(t_s)
        phase = tau * x / s.wander_length_m + s.wander_rad
        offset, widening = self.world.lane_m(x)
        y = -self.direction * offset + s.wander_m * np.sin(phase)
        return x, y, s.wander_m * tau / s.wander_length_m * np.cos(phase) - self.direction * widening

    def T_map_vehicle(self, t_s: FloatArray) -> FloatArray:
        """Return the true poses, float64 (K, 4, 4), at times (K,) [s] after the start."""
        t_s = np.asarray(t_s, dtype=np.float64)
        x, y, slope = self.on_path(t_s)
        side_rise, grade = -self.world.crown * np.sign(y), self.world.grade(x)
        zero, one = np.zeros_like(x), np.ones_like(x)
        forward = self.world.map_of_street(self.direction * np.stack([one, slope, grade + slope * side_rise], axis=1))
        along, across = np.stack([one, zero, grade], axis=1), np.stack([zero, one, side_rise], axis=1)
        up = _unit(np.cross(self.world.map_of_street(along), self.world.map_of_street(across)))
        ahead = _unit(forward)
        T = np.tile(np.eye(4), (len(x), 1, 1))
        roll, pitch, heave = swaying(t_s, self.style.sway_rad)
        R_map_road = np.stack([ahead, np.cross(up, ahead), up], axis=2)
        T[:, :3, :3] = R_map_road @ exp_so3(np.stack([roll, pitch, zero], axis=1))
        ground = self.world.map_of_street(np.stack([x, y, self.world.road_height_m(y, x)], axis=1))
        T[:, :3, 3] = ground + heave[:, None] * up
        return T

    def speed_and_yaw_rate(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return true speed along the vehicle's x [m/s] and rate about its z [rad/s] at times (K,) [s]."""
        step = T_inverse(self.T_map_vehicle(t_s - _STEP_S)) @ self.T_map_vehicle(t_s + _STEP_S)
        return step[:, 0, 3] / (2 * _STEP_S), log_so3(step[:, :3, :3])[:, 2] / (2 * _STEP_S)


def swaying(t_s: FloatArray, phases_rad: tuple[float, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Roll, pitch [rad] and heave [m], (K,) each, at times (K,) [s]: three sines each, weaker the faster.

    `phases_rad` are nine phases.
    """
    phases = np.array(phases_rad).reshape(3, 3)
    waves = np.sin(t_s[:, None, None] * np.array(_SWAY_RADPS) + phases) / np.array([1.0, 1.5, 3.0])
    roll, pitch, heave = waves.sum(axis=2).T
    return _SWAY_RAD * roll, _SWAY_RAD * pitch, _HEAVE_M * heave


def lane_motion(world: World, style: DrivingStyle, direction: Direction) -> tuple[Motion, float]:
    """Return the motion from one end of the world's street to the other, and how long it takes [s]."""
    reach = world.half_length_m - _END_MARGIN_M
    motion = Motion(world, style, direction, -direction * reach)
    return motion, motion.duration_s(2 * reach)


def gauss_markov(
    rng: np.random.Generator, count: int, step_s: float, sigma: float, time_constant_s: float
) -> FloatArray:
    """Return a first-order Gauss-Markov process, float64 (count,), stationary with `sigma` from its first value on."""
    keep = exp(-step_s / time_constant_s)
    values = sigma * rng.standard_normal(count)
    for i in range(1, count):
        values[i] = keep * values[i - 1] + (1.0 - keep * keep) ** 0.5 * values[i]
    return values


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
