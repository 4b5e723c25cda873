"""Scan-to-scan odometry: each scan is matched with what the last ones saw, with no map needed and no wheel.

The scans before are kept as Gaussians in a rolling map (some 20 m of way). A step that lies far from the prediction,
or that rests on too few points, is not given. Experience with odometry of recordings (`importers.lidar_odometry`) holds
here too: voxels that hold one or two rings of a scan show where the rings are, not where the ground is.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, log_so3, transform
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.parameters import NOISE_M, ON_MAP, RegistrationParameters
from gnd.vehicle_agent.localise.registration import register
from gnd.vehicle_agent.localise.rolling_map import RollingMap
from gnd.vehicle_agent.localise.scan_pool import standing_points

_N_POINTS: Final = 1250
"""So many of a scan's sampled points are matched."""
_BETWEEN_SCANS: Final = replace(
    ON_MAP, scales=(4.0, 2.0), correlation=3.0, floor_m=0.005, floor_rad=0.0001, degenerate_m=0.05
)
_MIN_STANDING_SHARE: Final = 0.25
"""So many of a scan's points must stand above the ground. Rings on open ground keep their place relative to the
vehicle: they fit best where it stood before, and it seems to be slower than it is."""
_STEP_SHARE: Final = 0.2
"""A step's variance in that of a match: the matches of a stretch of road share most of their errors."""
_STEADY_M: Final = 0.03
_STEADY_RAD: Final = 0.002
"""Sigmas of going on as in the step before, which is tried where wheels and gyro lead nowhere."""
_COAST_S: Final = 0.5
"""For so long a vehicle with slipping wheels is taken to go on over scans that match nowhere."""
_MIN_FIT: Final = 0.4
_MIN_STEADY_FIT: Final = 0.6
"""The same when going on as before."""
_MIN_MATCHING_RATIO: Final = 0.5
"""A match that fits worse is not given."""
_GATE_M: Final = 0.08
_GATE_DEG: Final = 0.1
"""How far a step may lie from the prediction, beyond three of its sigmas."""
_ADD_M: Final = 1.5
_ADD_DEG: Final = 5.0
"""A scan joins the map when the vehicle has moved so far since the last that did; the first `first_scans` join in any
case."""
_FIRST_SCANS: Final = 3
_MAX_GAP_S: Final = 1.0
"""After a longer time without a scan the map begins anew."""

CONTRADICTED, STILL_CONTRADICTED = 3.0, 1.5  # sigmas at which wheels begin to slip, and above which they still do
OFF_GROUND_M, OFF_GROUND_SLOPE = 0.3, 0.02  # what stands higher, and so much for each metre of distance, is no ground


class SteadyMotion(NamedTuple):
    """A motion (4, 4) that took `dt_ns`, and goes on."""

    T_before_now: F64
    dt_ns: int

    def after(self, dt_ns: int) -> F64:
        """(4, 4) the motion in another time."""
        return _exp(_log(self.T_before_now) * (dt_ns / self.dt_ns))

    def trajectory(self, first_ns: int, last_ns: int) -> Trajectory:
        """The way of the vehicle between two times, in its frame at the first."""
        last_ns = max(last_ns, first_ns + 1)
        return Trajectory(np.array([first_ns, last_ns]), np.stack([np.eye(4), self.after(last_ns - first_ns)]))


class ScanStep(NamedTuple):
    """The motion between two scans by the scans.

    Attributes:
        T_before_now: (4, 4).
        covariance: (6, 6) of a small motion of the vehicle at its later end, rotation [rad] first, then position [m],
            along its own axes (as GTSAM's BetweenFactorPose3 takes it); directions that the scans do not constrain have
            a sigma of metres, and T_before_now follows the prediction there.
        slipping: the wheels slipped in the step before, so that less is needed to contradict them in this one.
    """

    T_before_now: F64
    covariance: F64
    slipping: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class JointStep:
    """The motion by wheels, gyro and scans together.

    Attributes:
        T_before_now: (4, 4), each weighted by its covariance.
        driven_sigmas: (6,) sigmas of wheels and gyro, grown where the scans contradict them.
        slipped: whether they do.
    """

    T_before_now: F64
    driven_sigmas: F64
    slipped: bool


def joint_step(T_driven: F64, sigmas: F64, step: ScanStep | None) -> JointStep:
    """Put together the motion (4, 4) with `sigmas` (6,) by wheels and gyro, and that by scans, if known."""
    if step is None:
        return JointStep(T_driven, sigmas, False)
    off = _log(T_inverse(T_driven) @ step.T_before_now)
    level = STILL_CONTRADICTED if step.slipping else CONTRADICTED
    contradicted = off**2 > level**2 * (sigmas**2 + np.diag(step.covariance))
    grown = np.where(contradicted, np.hypot(sigmas, CONTRADICTED * off), sigmas)
    gain = _gain(np.diag(grown**2), step.covariance)
    return JointStep(T_driven @ _exp(gain @ off), grown, bool(contradicted.any()))


class _Prediction(NamedTuple):
    """Motion since the scan before (4, 4), its sigmas (6,), and the scan's points (N, 3) with such a motion removed."""

    T_before_now: F64
    sigmas: F64
    points_m: F64


class _ScanMatch(NamedTuple):
    """Where a scan lies on the rolling map: (4, 4), covariance (6, 6), fit; and the prediction that it is near to."""

    T_odom_vehicle: F64
    covariance: F64
    fit: float
    prediction: _Prediction


class ScanOdometry:
    """Feeds on deskewed scans in time order.

    The pose on the rolling map is filtered, prediction and match each by its covariance, so that the map does not bend
    with every match. A step is what two filtered poses differ by.
    """

    def __init__(self, noise_m: float = NOISE_M, min_standing_share: float = _MIN_STANDING_SHARE) -> None:
        self._registration = RegistrationParameters(noise_m, _BETWEEN_SCANS)
        self._min_standing_share = min_standing_share
        self._map = RollingMap(noise_m)
        self._before_ns: int | None = None
        self._T_odom_before = np.eye(4)
        self._covariance = np.zeros((6, 6))
        self._steady: SteadyMotion | None = None
        self._slipping = False
        self._coasted_ns = 0
        self._T_odom_added = np.eye(4)

    def begin(self, t_ns: int, points_m: F64) -> None:
        """Start with this scan: it does not continue those before."""
        self._before_ns = t_ns
        self._T_odom_before = self._T_odom_added = np.eye(4)
        self._covariance, self._steady, self._slipping = np.zeros((6, 6)), None, False
        self._map.clear(np.zeros(3))
        self._map.add(points_m, np.zeros(3))

    @property
    def steady(self) -> SteadyMotion | None:
        """The motion of the newest step, if there was one."""
        return self._steady

    def step(
        self,
        t_ns: int,
        points_vehicle_m: F64,
        T_before_now_predicted: F64,
        sigmas: F64,
        points_going_on: Callable[[], F64] | None = None,
    ) -> ScanStep | None:
        """The motion since the scan before; None when there is none, or it is not to be trusted.

        Args:
            t_ns: time of the scan; after a gap of more than `max_gap_s` everything begins anew.
            points_vehicle_m: (N, 3) float64 sampled points, sweep motion removed.
            T_before_now_predicted: (4, 4) motion since the scan before by wheel speed and yaw rate.
            sigmas: (6,) its sigmas, rotation [rad] first, then position [m].
            points_going_on: gives the points with the motion `steady` removed; called when the wheels slip.
        """
        if self._before_ns is None or not 0 < t_ns - self._before_ns <= _MAX_GAP_S * 1e9:
            self.begin(t_ns, points_vehicle_m)
            return None
        dt_ns, self._before_ns = t_ns - self._before_ns, t_ns
        driven = _Prediction(T_before_now_predicted, sigmas, points_vehicle_m)
        standing = len(standing_points(points_vehicle_m, OFF_GROUND_M, OFF_GROUND_SLOPE))
        sees = standing >= self._min_standing_share * len(points_vehicle_m)
        match = self._matched(driven, self._going_on(dt_ns, points_going_on)) if sees else None
        if sees and match is None and self._slipping and self._steady is not None:
            coasted = self._coast(self._steady, dt_ns, points_vehicle_m)
            if coasted is not None:
                return coasted
        used = driven if match is None else match.prediction
        T_before_now = self._advance(used, match)
        self._add(used.points_m)
        slipped, self._steady, self._slipping, self._coasted_ns = self._slipping, None, False, 0
        if match is None:
            return None
        self._steady = SteadyMotion(T_before_now, dt_ns)
        step = ScanStep(T_before_now, _STEP_SHARE * match.covariance, slipped)
        self._slipping = joint_step(T_before_now_predicted, sigmas, step).slipped
        return step

    def _coast(self, steady: SteadyMotion, dt_ns: int, points_m: F64) -> ScanStep | None:
        """Go on as before over a scan that matches nowhere while the wheels slip, for a short time."""
        self._coasted_ns += dt_ns
        if self._coasted_ns > _COAST_S * 1e9:
            return None
        going_on = _Prediction(steady.after(dt_ns), self._steady_sigmas(), points_m)
        return ScanStep(self._advance(going_on, None), np.diag(going_on.sigmas**2), slipping=True)

    def _steady_sigmas(self) -> F64:
        return np.array([_STEADY_RAD] * 3 + [_STEADY_M] * 3)

    def _matched(self, driven: _Prediction, going_on: Callable[[], _Prediction] | None) -> _ScanMatch | None:
        """The match near the motion by wheels and gyro, or near that of going on as before: that comes first while the
        wheels slip.
        """
        if going_on is None:
            return self._match_near(driven, _MIN_FIT)
        if self._slipping:
            return self._match_near(going_on(), _MIN_STEADY_FIT) or self._match_near(driven, _MIN_FIT)
        return self._match_near(driven, _MIN_FIT) or self._match_near(going_on(), _MIN_STEADY_FIT)

    def _going_on(self, dt_ns: int, points_going_on: Callable[[], F64] | None) -> Callable[[], _Prediction] | None:
        """The motion of the step before, for as long as this one took."""
        steady = self._steady
        if steady is None or points_going_on is None:
            return None
        return lambda: _Prediction(steady.after(dt_ns), self._steady_sigmas(), points_going_on())

    def _match_near(self, prediction: _Prediction, min_fit: float) -> _ScanMatch | None:
        """The match, if it fits well enough and lies near enough to the prediction."""
        T_predicted = self._T_odom_before @ prediction.T_before_now
        chosen = prediction.points_m[:: max(1, len(prediction.points_m) // _N_POINTS)]
        try:
            result = register(chosen, T_predicted, self._map.match_map(), self._registration, "near")
        except RegistrationError:
            return None
        if not result.converged or result.fit < min_fit or result.matching_ratio < _MIN_MATCHING_RATIO:
            return None
        if not self._near(_log(T_inverse(T_predicted) @ result.T_map_vehicle), prediction.sigmas):
            return None
        return _ScanMatch(result.T_map_vehicle, result.covariance, result.fit, prediction)

    def _near(self, off: F64, sigmas: F64) -> bool:
        limit_m = _GATE_M + 3.0 * float(np.linalg.norm(sigmas[3:]))
        limit_rad = np.radians(_GATE_DEG) + 3.0 * float(np.linalg.norm(sigmas[:3]))
        return bool(np.linalg.norm(off[3:]) <= limit_m and np.linalg.norm(off[:3]) <= limit_rad)

    def _advance(self, prediction: _Prediction, match: _ScanMatch | None) -> F64:
        """Go on to the filtered pose of this scan and give the step (4, 4); a step is too short for its turn to matter
        to the covariance.
        """
        T_before_now, self._covariance = prediction.T_before_now, self._covariance + np.diag(prediction.sigmas**2)
        if match is not None:
            gain = _gain(self._covariance, match.covariance)
            off = _log(T_inverse(self._T_odom_before @ T_before_now) @ match.T_odom_vehicle)
            T_before_now = T_before_now @ _exp(gain @ off)
            self._covariance = (np.eye(6) - gain) @ self._covariance
        self._T_odom_before = self._T_odom_before @ T_before_now
        return T_before_now

    def _add(self, points_m: F64) -> None:
        """The scan joins the map when the vehicle has moved on since the last that did."""
        T = self._T_odom_before
        moved = _log(T_inverse(self._T_odom_added) @ T)
        far = np.linalg.norm(moved[3:]) >= _ADD_M or np.linalg.norm(moved[:3]) >= np.radians(_ADD_DEG)
        if far or self._map.scans < _FIRST_SCANS:
            self._T_odom_added = T
            self._map.add(transform(T, points_m), T[:3, 3])


def _gain(prior: F64, measured: F64) -> F64:
    """(6, 6) how much of the way from the prior to the measurement to go, each believed by its covariance (6, 6)."""
    return np.asarray(np.linalg.solve(prior + measured, prior).T)


def _log(T: F64) -> F64:
    """(6,) rotation vector and position of a small motion (4, 4)."""
    return np.concatenate([log_so3(T[:3, :3]), T[:3, 3]])


def _exp(small: F64) -> F64:
    return T_from_R_t(exp_so3(small[:3]), small[3:])
