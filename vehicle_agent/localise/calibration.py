"""Calibration of the vehicle's own motion sensors by the map, and their uncertainty until then."""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.vehicle_agent.importers.mounting import angles_of
from gnd.vehicle_agent.localise.clock import ClockDoubt, ClockEstimator
from gnd.vehicle_agent.localise.estimates import Cause, Health
from gnd.vehicle_agent.localise.first_course import FirstCourse
from gnd.vehicle_agent.localise.mount import DOUBTFUL_RAD, SIGMAS, MountDoubt, MountResidual
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.remount import Mounting, left_over, left_sigma
from gnd.vehicle_agent.localise.scan_odometry import ScanStep
from gnd.vehicle_agent.localise.stretch import BIAS, LEFT, SCALE, UP

SCALE_PRIOR: Final = 0.02
BIAS_PRIOR_RADPS: Final = 0.005
COURSE_PRIOR: Final = 0.02
"""One sigma before anything is learnt: of the wheel scale (a share), of the gyro's bias, and of the motion sideways and
upwards per metre forward (the LiDAR's mount is not aligned with the wheels)."""
_LONGITUDINAL_M: Final = 0.003
_LATERAL_M: Final = 0.003
_VERTICAL_M: Final = 0.01
_DISTANCE_SHARE: Final = 0.007
_ROLL_PITCH_RAD: Final = 0.003
_YAW_RAD: Final = 0.0006
"""Of a step between two scans, the share being of its length, once scale, bias and course are learnt."""
ODOMETRY_SCALE_DRIFT: Final = 0.0001
ODOMETRY_BIAS_DRIFT_RADPS: Final = 1e-05
"""Their change in a root second."""
_STRETCH_M: Final = 0.03
_STRETCH_RAD: Final = 0.002
"""Of the motion over a second by two map matches."""
_LEAST_SCALE: Final = 0.0005
_LEAST_BIAS_RADPS: Final = 7e-05
"""The least sigma of scale and bias as a stretch of submaps estimates them."""
_EXCESS_GAIN: Final = 0.2
"""Weight of the newest step in the running judgement of how much worse than all this the odometry is."""

STEP_S, STRETCH_S = 0.5, 1.0
IN_DOUBT = 2.5
"""Sigmas from which on a course beyond what is allowed makes the heading doubtful."""
MAX_TRIM_RAD, KNOWN_COURSE_RAD = 1.05e-3, 6e-4
WRONG_HEADING_RAD = float(np.radians(0.5))
"""Until the mount's yaw is known to be off by less, by two sigmas, no pose is called good."""
OBSERVED_RAD, DISPUTABLE_RAD = float(np.radians(0.2)), float(np.radians(0.6))
"""Once the course was observed so well, one sigma and the larger limit will do: recordings have mounts, or axes,
that are turned by half a degree (KITTI 00: 0.5°, KITTI raw 0027: 0.2°)."""
PATIENT_M = 5.0
"""Where no course is seen on so much of way, as in an open field, one sigma will do."""
CRAB_M = 0.03
"""How far a way driven straight leads aside: by steering, camber, an origin that is not at the axle."""
CLOCK_LASTS = 2.0  # a clock's error goes on as long as the vehicle brakes or turns: for more than the step asked about
KEEPS = 2.0  # a stretch that is less sure than what was learnt, by more than this in variance, is not listened to


class Stamped(NamedTuple):
    """A pose (4, 4) at a time."""

    t_ns: int
    T_map_vehicle: F64


@dataclass(frozen=True, slots=True)
class MotionCalibration:
    """Calibration of a vehicle's sensors, each value with one sigma.

    Attributes:
        time_offset_s: stamps of wheels and gyro are so much later than those of the LiDAR, growing by
            `time_offset_rate`.
        clock_doubt: why that is not to be relied on.
        wheel_scale: factor of the wheel speed.
        gyro_bias_radps: bias of the yaw rate.
        course_rad: direction of driving straight, left of the vehicle's x axis as the header's mount puts it.
        mount: height, roll and pitch against the header, from the ground.
        mount_header: (4, 4) the header's T_vehicle_lidar.
        mount_used: (4, 4) the one in use: the header's where that is not certainly wrong.
    """

    time_offset_s: float
    time_offset_sigma_s: float
    time_offset_rate: float
    clock_doubt: ClockDoubt
    wheel_scale: float
    wheel_scale_sigma: float
    gyro_bias_radps: float
    gyro_bias_sigma_radps: float
    course_rad: float
    course_sigma_rad: float
    mount: MountResidual
    mount_header: F64 | None = None
    mount_used: F64 | None = None

    def __post_init__(self) -> None:
        sigmas = (self.time_offset_sigma_s, self.wheel_scale_sigma, self.gyro_bias_sigma_radps, self.course_sigma_rad)
        if min(sigmas) < 0.0 or self.wheel_scale <= 0.0:
            raise ValueError(f"sigmas must not be negative and the scale positive, got {self}")

    @property
    def mount_yaw_rad(self) -> float:
        """Yaw of the mount against the header, from driving straight; its sigma is that of the course."""
        return -self.course_rad

    @property
    def mount_doubtful(self) -> tuple[MountDoubt, ...]:
        """Axes in which the header's mount is certainly wrong: by more than 10 cm or 0.3°."""
        turned = abs(self.course_rad) - SIGMAS * self.course_sigma_rad > DOUBTFUL_RAD
        return (*self.mount.doubtful, "yaw") if turned else self.mount.doubtful

    def as_json(self) -> dict[str, Any]:
        """Plain values, angles in degrees; None where nothing is known."""
        mount = self.mount
        return {
            "time_offset_s": _with_sigma(self.time_offset_s, self.time_offset_sigma_s),
            "time_offset_rate": round(self.time_offset_rate, 7),
            "clock_doubt": self.clock_doubt,
            "wheel_scale": _with_sigma(self.wheel_scale, self.wheel_scale_sigma),
            "yaw_bias_degps": _with_sigma(np.degrees(self.gyro_bias_radps), np.degrees(self.gyro_bias_sigma_radps)),
            "mount_height_m": _with_sigma(mount.height_m, mount.height_sigma_m),
            "mount_roll_deg": _with_sigma(np.degrees(mount.roll_rad), np.degrees(mount.roll_sigma_rad)),
            "mount_pitch_deg": _with_sigma(np.degrees(mount.pitch_rad), np.degrees(mount.pitch_sigma_rad)),
            "mount_yaw_deg": _with_sigma(np.degrees(self.mount_yaw_rad), np.degrees(self.course_sigma_rad)),
            "mount_doubtful": list(self.mount_doubtful),
            "mount_told": _mount_json(self.mount_header),
            "mount_used": _mount_json(self.mount_used),
        }


class MotionTeacher:
    """Learns wheel scale, gyro bias and course of a `MotionBuffer` from map matches: scalar Kalman filters."""

    def __init__(self, motion: MotionBuffer, mount: Mounting | None = None) -> None:
        self.mount = mount or Mounting(np.eye(4))
        self.first_course = FirstCourse()
        self.clock = ClockEstimator(motion)
        self._motion = motion
        self._scale_var = SCALE_PRIOR**2
        self._bias_var = BIAS_PRIOR_RADPS**2
        self._course_var = COURSE_PRIOR**2
        self._way_m = 0.0
        self._excess_var = np.zeros(6)
        self._anchor: Stamped | None = None
        self._last: Stamped | None = None

    def sigmas(self, odometry: F64, dt_s: float) -> F64:
        """(6,) one sigma of a motion (4, 4) that took `dt_s`: roll, pitch, yaw [rad], forward, left, up [m]."""
        way_m = float(np.linalg.norm(odometry[:3, 3]))
        yaw = np.hypot(_YAW_RAD, np.sqrt(self._bias_var) * dt_s)
        forward = np.hypot(_LONGITUDINAL_M + _DISTANCE_SHARE * way_m, np.sqrt(self._scale_var) * way_m)
        across = np.array([_LATERAL_M, _VERTICAL_M]) + _DISTANCE_SHARE * way_m
        left, up = np.hypot(across, np.sqrt(self._course_var) * way_m)
        known = np.array([_ROLL_PITCH_RAD, _ROLL_PITCH_RAD, yaw, forward, left, up])
        return np.asarray(np.hypot(known, np.sqrt(np.maximum(self._excess_var, 0.0))))

    def sigmas_between(self, first_ns: int, last_ns: int, odometry: F64) -> F64:
        """(6,) as `sigmas`, of the motion (4, 4) between two times, with what the clock's uncertainty adds to it."""
        sigmas = self.sigmas(odometry, (last_ns - first_ns) * 1e-9)
        yaw_rad, forward_m = self.clock_sigmas(first_ns, last_ns)
        sigmas[2], sigmas[3] = np.hypot(sigmas[2], yaw_rad), np.hypot(sigmas[3], forward_m)
        sigmas[3] = np.hypot(sigmas[3], self.slip_sigma_m(first_ns, last_ns, odometry))
        return sigmas

    def slip_sigma_m(self, first_ns: int, last_ns: int, odometry: F64) -> float:
        """One sigma of the way of a motion (4, 4) by wheels that slip: all of it; 0 where they do not."""
        return float(np.linalg.norm(odometry[:3, 3])) if self._motion.slipped(first_ns, last_ns) else 0.0

    def clock_sigmas(self, first_ns: int, last_ns: int) -> tuple[float, float]:
        """One sigma of the turn [rad] and of the way [m] between two times that an uncertain clock makes: that of the
        offset times what yaw rate and speed changed by.
        """
        speed, yaw_rate = self._motion.changes(first_ns, last_ns)
        sigma_s = CLOCK_LASTS * self.clock.estimate.offset_sigma_s
        return abs(yaw_rate) * sigma_s, abs(speed) * sigma_s

    @property
    def uncertainty(self) -> tuple[float, float]:
        """One sigma of the wheel scale, and of the gyro's bias [rad/s], as learnt so far."""
        return float(np.sqrt(self._scale_var)), float(np.sqrt(self._bias_var))

    @property
    def cause(self) -> Cause:
        """Which of the sensors whose errors are learnt is wrong, if any."""
        return "mount" if self.mount_in_doubt else self.clock_cause

    @property
    def clock_cause(self) -> Cause:
        """What is wrong with the clock, if anything."""
        return "none" if self.clock.estimate.doubt == "none" else "clock"

    @property
    def mount_in_doubt(self) -> bool:
        """True while the mount is, or may well be, off by so much that poses are wrong, and was not yet put right."""
        return self.mount.unsettled or self.mount.torn or self.yaw_in_doubt

    def doubted(self, health: Health, cause: Cause, *, trimmed: bool) -> tuple[Health, Cause]:
        """Health and cause (of all but the mount) with what is known of the mount by now.

        `trimmed`: the heading is turned by `trim_rad`; else by `header_trim_rad`.
        """
        if health != "good":
            return health, cause
        turned_rad = self.trim_rad if trimmed else self.header_trim_rad
        course_rad, course_sigma_rad = self._course_seen(turned_rad)
        off_rad, sigma_rad = left_over(course_rad, course_sigma_rad, turned_rad, self.mount.sigma.yaw_rad)
        known = abs(off_rad) + 2.0 * sigma_rad < WRONG_HEADING_RAD
        if not turned_rad and (course_sigma_rad < OBSERVED_RAD or self._way_m > PATIENT_M):
            known |= abs(off_rad) + sigma_rad < DISPUTABLE_RAD
        return (health, cause) if known and not self.mount_in_doubt else ("degraded", "mount")

    @property
    def calibration(self) -> MotionCalibration:
        """All that is known so far."""
        clock, motion = self.clock.estimate, self._motion
        scale_sigma, bias_sigma = self.uncertainty
        return MotionCalibration(
            time_offset_s=clock.offset_s,
            time_offset_sigma_s=clock.offset_sigma_s,
            time_offset_rate=clock.rate,
            clock_doubt=clock.doubt,
            wheel_scale=float(motion.speed_scale),
            wheel_scale_sigma=scale_sigma,
            gyro_bias_radps=float(motion.yaw_bias_radps),
            gyro_bias_sigma_radps=bias_sigma,
            course_rad=float(motion.course[0]),
            course_sigma_rad=self._course[1],
            mount=self.mount.residual,
            mount_header=self.mount.T_header,
            mount_used=self.mount.T_vehicle_lidar(-self.header_trim_rad),
        )

    @property
    def _course(self) -> tuple[float, float]:
        """Direction of driving straight [rad], as the matches teach it, and one sigma."""
        return float(self._motion.course[0]), float(np.hypot(np.sqrt(self._course_var), CRAB_M / max(self._way_m, 1.0)))

    @property
    def header_trim_rad(self) -> float:
        """What the heading is turned by where the header is certainly wrong; 0 where it is not."""
        course_rad, sigma_rad = self._course
        return course_rad if abs(course_rad) - SIGMAS * sigma_rad > DOUBTFUL_RAD else 0.0

    @property
    def trim_rad(self) -> float:
        """What the heading is turned by so that the rear axle runs along it, once that is known; 0 when it is not. Also
        0 between what a mount may be off by unknowingly and what is certainly a wrong header: there the recording's
        vehicle frame may mean something else than the axle.
        """
        course_rad = self._course[0]
        slight = abs(course_rad) < MAX_TRIM_RAD and self._course_known
        return course_rad if slight else self.header_trim_rad

    @property
    def _course_known(self) -> bool:
        """True when the matches of a whole stretch have estimated it."""
        return bool(self._course_var < KNOWN_COURSE_RAD**2)

    def yaw_sigma_rad(self, trim_rad: float, least_rad: float) -> float:
        """One sigma of what the heading is off by for the mount's sake when it was turned by `trim_rad`: at least
        `least_rad`, and no more once the course is known.
        """
        if trim_rad and self._course_known:
            return least_rad
        left_rad = left_sigma(*self._course_seen(trim_rad), trim_rad, self.mount.sigma.yaw_rad)
        return float(np.hypot(least_rad, left_rad))

    def _course_seen(self, trim_rad: float) -> tuple[float, float]:
        """The course [rad] and one sigma, by what knows better: matches, or the first steps between scans; by matches
        alone where the heading was turned after them.
        """
        matched, first = self._course, self.first_course
        return matched if trim_rad or matched[1] <= first.sigma_rad else (first.course_rad, first.sigma_rad)

    @property
    def yaw_in_doubt(self) -> bool:
        """True while the course shows that the mount's yaw is likely wrong, but not yet by how much."""
        course_rad, sigma_rad = abs(self._course[0]), self._course[1]
        likely = course_rad > max(2.0 * DOUBTFUL_RAD, IN_DOUBT * sigma_rad)  # where the heading would be called wrong
        return likely and course_rad - SIGMAS * sigma_rad <= DOUBTFUL_RAD

    def remounted(self, T_now_before: F64) -> None:
        """The vehicle's axes are others from now on: (4, 4), those before in those now."""
        forward = T_now_before[:3, :3] @ np.array([1.0, *self._motion.course])
        self._motion.course = forward[1:] / forward[0]
        self.forget()

    def forget(self) -> None:
        """The poses to come do not continue those before."""
        self._anchor = self._last = None

    def see_step(
        self, first_ns: int, last_ns: int, T_driven: F64, seen: ScanStep | None, *, slipped: bool = False
    ) -> None:
        """Take the motion between two scans: (4, 4) by wheels and gyro, and by the scans, if known. Wheels that
        slip, or that the scans contradict (`slipped`), are no observation of the clock.
        """
        self._way_m += float(np.linalg.norm(T_driven[:3, 3]))
        slipped |= self._motion.slipped(first_ns, last_ns)
        if slipped:
            self.clock.see_slip(last_ns)
        self.clock.see(first_ns, last_ns, None if slipped else seen)
        self.first_course.see(seen)

    def learn(self, t_ns: int, T_map_vehicle: F64, covariance: F64) -> None:
        """Take a trusted match and its covariance (6, 6): each step shows how good the odometry is, each stretch of
        `STRETCH_S` what its errors are.
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
        self._excess_var += _EXCESS_GAIN * (square - 2.0 * match_var - self._excess_var)

    def correct(self, change: F64, sigmas: F64) -> None:
        """Take over what a whole stretch found, where it knows better than what was learnt so far.

        Args:
            change: (N_SHARED,) of the stretch's shared parameters.
            sigmas: (N_SHARED,) one sigma each.
        """
        least = [_LEAST_BIAS_RADPS, _LEAST_SCALE, _LEAST_SCALE]
        bias, scale, course = np.maximum(sigmas[[BIAS, SCALE, LEFT]], least).tolist()
        if bias**2 < KEEPS * self._bias_var:
            self._motion.yaw_bias_radps += float(change[BIAS])
            self._bias_var = bias**2
        if scale**2 < KEEPS * self._scale_var:
            self._motion.speed_scale *= 1.0 + float(change[SCALE])
            self._scale_var = scale**2
        if course**2 < KEEPS * self._course_var:
            self._motion.course += change[[LEFT, UP]]
            self._course_var = course**2

    def _compare(self, first: Stamped, last: Stamped) -> None:
        dt_s = (last.t_ns - first.t_ns) * 1e-9
        self._scale_var += ODOMETRY_SCALE_DRIFT**2 * dt_s
        self._bias_var += ODOMETRY_BIAS_DRIFT_RADPS**2 * dt_s
        seen = T_inverse(first.T_map_vehicle) @ last.T_map_vehicle
        driven = self._motion.delta(first.t_ns, last.t_ns)
        self._learn_course(driven, seen, _STRETCH_M)
        self._learn_scale(driven[0, 3] / self._motion.speed_scale, seen[0, 3], _STRETCH_M)
        self._learn_bias(_yaw(driven) + self._motion.yaw_bias_radps * dt_s, _yaw(seen), dt_s, _STRETCH_RAD)

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


def _with_sigma(value: float, sigma: float) -> dict[str, float] | None:
    return {"value": round(float(value), 6), "sigma": round(float(sigma), 6)} if np.isfinite(sigma) else None


def _mount_json(T_vehicle_lidar: F64 | None) -> dict[str, float] | None:
    """Height, and angles about the vehicle's axes in degrees."""
    if T_vehicle_lidar is None:
        return None
    roll, pitch, yaw = (round(float(angle), 3) for angle in np.degrees(angles_of(T_vehicle_lidar[:3, :3])))
    height_m = round(float(T_vehicle_lidar[2, 3]), 4)
    return {"height_m": height_m, "roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw}


def _yaw(T: F64) -> float:
    return float(np.arctan2(T[1, 0], T[0, 0]))
