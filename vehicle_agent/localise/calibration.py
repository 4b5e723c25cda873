"""What the map teaches about the vehicle's own motion sensors, and how far to trust them until it has."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd_map.se3 import T_inverse, log_so3
from vehicle_agent.localise.drift import Drift
from vehicle_agent.localise.odometry import MotionBuffer
from vehicle_agent.localise.parameters import OdometryParameters

F64 = NDArray[np.float64]

STEP_S, STRETCH_S = 0.5, 1.0
MAX_TRIM_RAD, KNOWN_COURSE_RAD = 1.05e-3, 6e-4
KEEPS = 2.0  # a stretch that is less sure than what was learnt, by more than this in variance, is not listened to


class Stamped(NamedTuple):
    """A pose (4, 4) at a time."""

    t_ns: int
    T_map_vehicle: F64


class MotionTeacher:
    """Learns wheel scale, gyro bias and course of a `MotionBuffer` from map matches: scalar Kalman filters."""

    def __init__(self, motion: MotionBuffer, parameters: OdometryParameters) -> None:
        self.parameters = parameters
        self._motion = motion
        self._scale_var = parameters.scale_prior**2
        self._bias_var = parameters.bias_prior_radps**2
        self._course_var = parameters.course_prior**2
        self._excess_var = np.zeros(6)
        self._anchor: Stamped | None = None
        self._last: Stamped | None = None

    def sigmas(self, odometry: F64, dt_s: float) -> F64:
        """(6,) one sigma of a motion (4, 4) that took `dt_s`: roll, pitch, yaw [rad], forward, left, up [m]."""
        par, way_m = self.parameters, float(np.linalg.norm(odometry[:3, 3]))
        yaw = np.hypot(par.yaw_rad, np.sqrt(self._bias_var) * dt_s)
        forward = np.hypot(par.longitudinal_m + par.distance_share * way_m, np.sqrt(self._scale_var) * way_m)
        across = np.array([par.lateral_m, par.vertical_m]) + par.distance_share * way_m
        left, up = np.hypot(across, np.sqrt(self._course_var) * way_m)
        known = np.array([par.roll_pitch_rad, par.roll_pitch_rad, yaw, forward, left, up])
        return np.asarray(np.hypot(known, np.sqrt(np.maximum(self._excess_var, 0.0))))

    @property
    def uncertainty(self) -> tuple[float, float]:
        """One sigma of the wheel scale, and of the gyro's bias [rad/s], as learnt so far."""
        return float(np.sqrt(self._scale_var)), float(np.sqrt(self._bias_var))

    @property
    def course(self) -> tuple[float, float]:
        """Where the vehicle drives in its own frame, as learnt so far: angle to its x axis and its sigma, rad."""
        return float(self._motion.course[0]), float(np.sqrt(self._course_var))

    @property
    def trim_rad(self) -> float:
        """What the heading is turned by so that the rear axle runs along it, once that is known; 0 when it is not, or
        when it is so much that the recording's vehicle frame means something else than the axle.
        """
        course_rad, sigma_rad = float(self._motion.course[0]), float(np.sqrt(self._course_var))
        return course_rad if abs(course_rad) < MAX_TRIM_RAD and sigma_rad < KNOWN_COURSE_RAD else 0.0

    def forget(self) -> None:
        """The poses to come do not continue those before."""
        self._anchor = self._last = None

    def learn(self, t_ns: int, T_map_vehicle: F64, covariance: F64) -> None:
        """Take a trusted match and its covariance (6, 6): each step tells how good the odometry is, each stretch of
        `STRETCH_S` what it is wrong by.
        """
        now = Stamped(t_ns, T_map_vehicle)
        if self._last is not None and t_ns - self._last.t_ns < STEP_S * 1e9:
            self._judge(self._last, now, np.diag(covariance))
        self._last = now
        if self._anchor is None or t_ns - self._anchor.t_ns > 3e9 * STRETCH_S:
            self._anchor = now
        elif t_ns - self._anchor.t_ns >= STRETCH_S * 1e9:
            self._compare(self._anchor, now)
            self._anchor = now

    def _judge(self, first: Stamped, last: Stamped, match_var: F64) -> None:
        """What a step is off by, beyond what the two matches may be off by, averaged over the last steps."""
        driven = self._motion.delta(first.t_ns, last.t_ns)
        off = T_inverse(driven) @ T_inverse(first.T_map_vehicle) @ last.T_map_vehicle
        square = np.concatenate([log_so3(off[:3, :3]), off[:3, 3]]) ** 2
        self._excess_var += self.parameters.excess_gain * (square - 2.0 * match_var - self._excess_var)

    def correct(self, drift: Drift, overlap: float) -> None:
        """Take off what a whole stretch says, where it knows better than what was learnt so far.

        `overlap`: in how many of the stretch's matches each scan takes part, so that they are not independent.
        """
        par, grown = self.parameters, float(np.sqrt(overlap))
        bias = max(drift.yaw_radps.sigma * grown, par.least_bias_radps)
        if bias**2 < KEEPS * self._bias_var:
            self._motion.yaw_bias_radps += drift.yaw_radps.value
            self._bias_var = bias**2
        scale = max(drift.forward.sigma * grown, par.least_scale)
        if scale**2 < KEEPS * self._scale_var:
            self._motion.speed_scale *= 1.0 - drift.forward.value
            self._scale_var = scale**2
        course = max(max(drift.left.sigma, drift.up.sigma) * grown, par.least_scale)
        if course**2 < KEEPS * self._course_var:
            self._motion.course -= [drift.left.value, drift.up.value]
            self._course_var = course**2

    def _compare(self, first: Stamped, last: Stamped) -> None:
        par, dt_s = self.parameters, (last.t_ns - first.t_ns) * 1e-9
        self._scale_var += par.scale_drift**2 * dt_s
        self._bias_var += par.bias_drift_radps**2 * dt_s
        seen = T_inverse(first.T_map_vehicle) @ last.T_map_vehicle
        driven = self._motion.delta(first.t_ns, last.t_ns)
        self._learn_course(driven, seen, par.stretch_m)
        self._learn_scale(driven[0, 3] / self._motion.speed_scale, seen[0, 3], par.stretch_m)
        self._learn_bias(_yaw(driven) + self._motion.yaw_bias_radps * dt_s, _yaw(seen), dt_s, par.stretch_rad)

    def _learn_scale(self, wheel_m: float, map_m: float, sigma_m: float) -> None:
        gain = self._scale_var * wheel_m / (wheel_m**2 * self._scale_var + sigma_m**2)
        self._motion.speed_scale += gain * (map_m - self._motion.speed_scale * wheel_m)
        self._scale_var *= 1.0 - gain * wheel_m

    def _learn_course(self, driven: F64, seen: F64, sigma_m: float) -> None:
        forward_m = driven[0, 3]
        gain = self._course_var * forward_m / (forward_m**2 * self._course_var + sigma_m**2)
        self._motion.course += gain * (seen[1:3, 3] - driven[1:3, 3])
        self._course_var *= 1.0 - gain * forward_m

    def _learn_bias(self, gyro_rad: float, map_rad: float, dt_s: float, sigma_rad: float) -> None:
        gain = self._bias_var * dt_s / (dt_s**2 * self._bias_var + sigma_rad**2)
        self._motion.yaw_bias_radps += gain * (gyro_rad - map_rad - self._motion.yaw_bias_radps * dt_s)
        self._bias_var *= 1.0 - gain * dt_s


def _yaw(T: F64) -> float:
    return float(np.arctan2(T[1, 0], T[0, 0]))
