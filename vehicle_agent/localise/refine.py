"""Refined poses: hierarchical GraphSLAM with submaps, stretch by stretch (GND, 3 (ii), 6.2 and 7.2).

The scans of the last 30 m are matched with the map together (`stretch.py`); every few metres they are solved anew, and
scans that lie far enough behind are final. What leaves the stretch is remembered as a belief about its first scan.
Only these poses are evidence of change.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, log_so3
from gnd.vehicle_agent.localise.calibration import (
    BIAS_PRIOR_RADPS,
    COURSE_PRIOR,
    ODOMETRY_BIAS_DRIFT_RADPS,
    ODOMETRY_SCALE_DRIFT,
    SCALE_PRIOR,
    MotionTeacher,
)
from gnd.vehicle_agent.localise.graph import MapMatch, SmoothedPose
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.odometry import SLIP_LASTS_NS, MotionBuffer
from gnd.vehicle_agent.localise.parameters import RefineParameters, RegistrationParameters
from gnd.vehicle_agent.localise.scan_odometry import ScanStep
from gnd.vehicle_agent.localise.step_noise import StepNoise
from gnd.vehicle_agent.localise.stretch import (
    N_SHARED,
    SolvedStretch,
    StretchBelief,
    StretchStep,
    log_se3,
    marginalised,
    solve_stretch,
)
from gnd.vehicle_agent.localise.stretch_scans import StretchScan, StretchScans

_EVERY_S: Final = 1.0
"""The stretch is solved at the latest after this time."""
UNLEARNT_S: Final = 8.0
"""Until the gyro's bias is known scans may wait so long to be final."""
_LENGTH_S: Final = 15.0
"""Of the stretch; what is older is remembered as a belief about its first scan."""
_SCALES: Final = (2.0, 1.5)
"""Geman-McClure scales of the match."""
_FIRST_SCALES: Final = (4.0, 2.0, 1.5)
"""When the prediction is off by more than `near_m`."""
_NEAR_M: Final = 0.04
REFINE_LEARNT_DEGPS: Final = 0.06
"""Sigma of the gyro's bias below which it is known; until then scans may wait so long."""
_FIT_M: Final = 20.0
"""The newest part of the stretch, by which its fit is judged."""
_FIRM_FIT: Final = 0.35
"""Fit of a stretch that is beyond doubt."""
_LEAST_FIT: Final = 0.15
"""Below, it is no information."""
_MOST_MISFIT: Final = 4.0
"""Of a firm one."""
_CERTAIN_M: Final = 0.1
"""One sigma of a pose that no rival can question."""
_FLOOR_M: Final = 0.002
_FLOOR_DEG: Final = 0.004
"""The least sigma of a final pose: errors of map and mount that no match shows."""
_CORRECT_M: Final = 0.06
_CORRECT_DEG: Final = 0.12
"""An online pose farther off than this from the solution of the stretch begins anew from there."""

SUPPORTED: Final = 3
"""Solutions before one corrects the online pose."""
FIRM: Final = 4
"""Solutions that fit well, before anything is certain."""
FIRST_SIGMA_M, FIRST_SIGMA_RAD = 0.5, 0.02  # of the online pose that the first scan starts from
FIRM_AFTER_SLIP: Final = 2
"""As if so many had fitted well so far: rivals of single scans count for some metres."""
SEEN_SIGMA_M: Final = 0.025
"""Of a step forward that scans have seen: less than that of one that is only taken to go on as before."""
HELD_INFORMATION: Final = np.diag([3e-3**-2, 3e-3**-2, 6e-4**-2, 0.0, 0.01**-2, 0.01**-2])
"""Of a step's turns and of its motion left and up, from gyro, tyres and road."""
AGREES_CHI2: Final = 16.3
"""Of heading and place, three degrees of freedom: 99.9 %."""
MAP_VARIANCE: Final = np.array([np.radians(0.05), 0.01, 0.01]) ** 2  # of heading and place between two knots


class Refiner:
    """Takes scans with online poses in time order; returns poses that are final, oldest first."""

    def __init__(
        self,
        parameters: RefineParameters,
        registration: RegistrationParameters,
        match_map: MatchMapCache,
        motion: MotionBuffer,
        teacher: MotionTeacher,
    ) -> None:
        self.parameters = parameters
        self.registration = registration
        self._map, self._motion, self._teacher = match_map, motion, teacher
        self.unique = True
        """No other place looks the same: else a good fit proves nothing."""
        self._scans = StretchScans(motion, teacher)
        self._final = 0  # how many of them are final
        self._belief: StretchBelief | None = None
        self._solved: SolvedStretch | None = None
        self._solved_way_m, self._solved_ns = 0.0, 0
        self._news = self._waited = False
        self._solutions = 0
        self._noise = StepNoise()
        self._firm = 0  # solutions in a row that fitted well

    def push(
        self,
        number: int,
        t_ns: int,
        points_m: F64,
        T_map_vehicle: F64,
        T_before_now: F64 | None = None,
        seen: ScanStep | None = None,
        *,
        busy: bool = False,
    ) -> list[SmoothedPose]:
        """Take a scan; give the poses that became final with it.

        Args:
            number: of its pose, one more than that of the scan before.
            t_ns: its time.
            points_m: (K, 3) sampled points, vehicle frame, sweep motion removed.
            T_map_vehicle: (4, 4) its online pose.
            T_before_now: (4, 4) motion since the scan before as all odometry tells it; None: wheels and gyro alone.
            seen: that motion as the scans tell it.
            busy: something else that takes long was done with this scan: what is due is solved with the next one.
        """
        self._news, waits = False, busy and not self._waited
        newest, par = self._scans.take(number, t_ns, points_m, T_map_vehicle, T_before_now, seen), self.parameters
        if self._belief is None:
            self._belief = self._first_belief(T_map_vehicle)
            self._solved_way_m, self._solved_ns = newest.way_m, t_ns
        due = newest.way_m - self._solved_way_m >= par.every_m or t_ns - self._solved_ns >= _EVERY_S * 1e9
        if newest.knot is None or not due:
            return []
        self._waited = waits
        if waits:
            return []
        self._solve()
        return self._leaving(newest)

    def flush(self) -> list[SmoothedPose]:
        """All poses that are not final yet, as they stand."""
        if self._final < len(self._scans):
            self._solve()
        return self._finalise(len(self._scans))

    @property
    def solved(self) -> bool:
        """True when the stretch was solved with the newest scan."""
        return self._news

    @property
    def supported(self) -> bool:
        """True just after the stretch was solved, not for the first time, when it is whole and its newest scans fit."""
        whole = self._solved is not None and not self._solved.torn
        return self._news and whole and self._solutions > SUPPORTED and self._fit() >= _LEAST_FIT

    @property
    def certain(self) -> bool:
        """True when the stretch has fitted well for some way, and leaves little doubt about its newest scan."""
        return self._solved is not None and self._is_certain(self._covariance(-1))

    def correction(self, T_map_vehicle: F64) -> MapMatch | None:
        """Where the newest scan is, when its online pose (4, 4) is farther from there than either is uncertain."""
        if not self.supported:
            return None
        newest = self._scans[-1]
        assert newest.knot is not None  # only then is there news
        T, covariance = newest.knot.T_map_vehicle, self._covariance(-1)
        off, sigma = T_inverse(T) @ T_map_vehicle, np.sqrt(np.diag(covariance))
        far = np.hypot(off[0, 3], off[1, 3]) > _CORRECT_M + 3.0 * sigma[3:5].max()
        turned = abs(off[1, 0]) > np.radians(_CORRECT_DEG) + 3.0 * sigma[2]
        return MapMatch(T, covariance) if far or turned else None

    # --- the stretch -----------------------------------------------------------------------------------------------

    def _first_belief(self, T_map_vehicle: F64) -> StretchBelief:
        sigmas = np.array([FIRST_SIGMA_RAD] * 3 + [FIRST_SIGMA_M] * 3)
        shared = np.array([BIAS_PRIOR_RADPS, SCALE_PRIOR, COURSE_PRIOR, COURSE_PRIOR])
        information = np.diag(1.0 / np.concatenate([sigmas, shared]) ** 2)
        return StretchBelief(T_map_vehicle.copy(), self._motion.shared(), information, np.zeros(6 + N_SHARED))

    def _solve(self) -> None:
        """Place all scans of the stretch anew, let wheels and gyro learn from it, and let go of its old scans."""
        scans = self._scans.knots()
        knots = [scan.knot for scan in scans if scan.knot is not None]
        assert self._belief is not None
        current = self._motion.shared()
        known = self._solved is not None and np.sqrt(np.diag(self._covariance(-1))[3:5]).max() < _NEAR_M
        belief = _recentred(self._belief, current)
        match_map = self._map.near(knots[len(knots) // 2].T_map_vehicle[:3, 3])
        steps = self._scans.steps(self._noise)
        self._solved = solve_stretch(
            knots, steps, belief, match_map, self.registration, _SCALES if known else _FIRST_SCALES
        )
        self._noise.learn(self._solved, steps, self._solved.shared - belief.shared)
        self._news, self._solutions = True, self._solutions + 1
        newest = self._scans[-1]
        before_ns = self._solved_ns
        dt_s = (newest.t_ns - before_ns) * 1e-9
        self._solved_way_m, self._solved_ns = newest.way_m, newest.t_ns
        fits_well = self._fit() >= _FIRM_FIT and self._solved.misfit < _MOST_MISFIT
        if self._solved.torn or self._fit() < _LEAST_FIT:
            self._firm = 0
        elif self._motion.slipped(before_ns, newest.t_ns) and not self._scans_hold(scans, steps, before_ns):
            self._firm = min(self._firm, FIRM_AFTER_SLIP)
        self._firm += fits_well and not self._solved.torn
        self._belief = self._shortened(scans, steps, belief, dt_s)
        self._teach()

    def _scans_hold(self, scans: Sequence[StretchScan], steps: Sequence[Sequence[StretchStep]], since_ns: int) -> bool:
        """Whether the scans alone measure the whole way since a time, well enough to see a slip, and agree with the map
        on its ends: then nothing rests on the wheels.
        """
        since_ns -= SLIP_LASTS_NS
        for (before, now), measured in zip(pairwise(scans), steps, strict=True):
            if now.t_ns <= since_ns:
                continue
            assert before.knot is not None
            assert now.knot is not None
            relative = T_inverse(before.knot.T_map_vehicle) @ now.knot.T_map_vehicle
            if len(measured) < 2 or not _agrees(measured[-1], relative):
                return False
        seen = self._scans.seen_since(since_ns)
        return all(step is not None and _forward_sigma_m(step) < SEEN_SIGMA_M for step in seen)

    def _shortened(
        self, scans: list[StretchScan], steps: list[list[StretchStep]], belief: StretchBelief, dt_s: float
    ) -> StretchBelief:
        """Let go of the knots that are far behind; the belief about the first that stays."""
        newest, solved = self._scans[-1], self._solved
        assert solved is not None
        first = 0
        while first < len(scans) - 2 and self._is_done_with(scans[first + 1], newest):
            first += 1
        if not first:
            return belief
        knots = [scan.knot for scan in scans[: first + 1] if scan.knot is not None]
        kept = marginalised(knots, steps[:first], belief, solved.shared, self.registration)
        self._solved = replace(
            solved,
            covariance=solved.covariance[first:],
            axle_variance=solved.axle_variance[first:],
            fit=solved.fit[first:],
            known=solved.known[first:],
        )
        self._final -= self._scans.drop_before(scans[first])
        drift = np.array([ODOMETRY_BIAS_DRIFT_RADPS, ODOMETRY_SCALE_DRIFT, ODOMETRY_SCALE_DRIFT, ODOMETRY_SCALE_DRIFT])
        return _loosened(kept, drift**2 * dt_s)

    def _is_done_with(self, scan: StretchScan, newest: StretchScan) -> bool:
        par = self.parameters
        old = newest.way_m - scan.way_m > par.length_m or newest.t_ns - scan.t_ns > _LENGTH_S * 1e9
        return old and self._scans.index(scan) <= self._final

    def _teach(self) -> None:
        """Wheels and gyro learn from the stretch: single scans of a sparse sensor seldom fit well enough to teach."""
        assert self._solved is not None
        if self._fit() < _LEAST_FIT:
            return
        more, variance = self._solved.shared - self._motion.shared(), np.diag(self._solved.shared_covariance)
        sigma = np.sqrt(variance * max(1.0, self._solved.misfit))
        self._teacher.correct(more, sigma)

    def _fit(self) -> float:
        """How well the newest `fit_m` of the stretch fit the map, 0 ... 1; points in unknown voxels count as off."""
        if self._solved is None:
            return 0.0
        knots = self._scans.knots()[-len(self._solved.fit) :]
        near = np.array([self._scans[-1].way_m - scan.way_m <= _FIT_M for scan in knots])
        return float((self._solved.fit * self._solved.known)[: len(near)][near].mean()) if near.any() else 0.0

    # --- scans -----------------------------------------------------------------------------------------------------

    def _leaving(self, newest: StretchScan) -> list[SmoothedPose]:
        """The poses of scans that lie `lag_m` behind the newest knot, or are too old to wait."""
        par = self.parameters
        learnt = self._teacher.uncertainty[1] < np.radians(REFINE_LEARNT_DEGPS)
        longest_s, n = (par.longest_s if learnt else UNLEARNT_S), self._final
        while n < len(self._scans):
            scan = self._scans[n]
            overdue = newest.t_ns - scan.t_ns > longest_s * 1e9
            if not overdue and (not learnt or newest.way_m - scan.way_m < par.lag_m):
                break
            n += 1
        return self._finalise(n)

    def _finalise(self, end: int) -> list[SmoothedPose]:
        """The poses of the scans up to `end` that are not final yet."""
        first, self._final = self._final, end
        if end == first or self._solved is None:
            return []
        at = [self._scans.index(scan) for scan in self._scans.knots()]
        return [self._pose(i, at) for i in range(first, end)]

    def _pose(self, i: int, at: list[int]) -> SmoothedPose:
        """From the knots before and after, each by how near it is; beyond the last, from that one alone."""
        scan = self._scans[i]
        after = min(int(np.searchsorted(at, i)), len(at) - 1)
        low = after if at[after] <= i else after - 1
        by_low, by_high = self._scans.from_knot(at[low], i), self._scans.from_knot(at[after], i)
        share = self._scans.share(i, at[low], at[after])
        covariance = (1.0 - share) * self._covariance(low) + share * self._covariance(after)
        T = between(by_low, by_high, share)
        axle = (1.0 - share) * self._axle_variance(low) + share * self._axle_variance(after)
        certain = self.unique and self._is_certain(covariance)
        return SmoothedPose(scan.number, scan.t_ns, T, covariance, certain, axle)

    def _covariance(self, knot: int) -> F64:
        """(6, 6) of a knot's pose: what the stretch leaves open, more where it disagrees with itself, and the least."""
        assert self._solved is not None
        floor = np.diag([np.radians(_FLOOR_DEG) ** 2] * 3 + [_FLOOR_M**2] * 3)
        grown = np.sqrt(self._grown)
        return np.asarray(grown[:, None] * self._solved.covariance[knot] * grown + floor)

    @property
    def _grown(self) -> F64:
        """(6,) by what a pose's variances differ from those that are assumed: what residuals show of the errors of map
        and odometry, and more where scans disagree with each other.
        """
        assert self._solved is not None
        grown, matched = np.full(6, max(1.0, self._solved.misfit)), self._solved.matched
        odometry = self._noise.against_claimed()
        odometry[3:5] = 1.0  # along a tunnel the steps agree with each other and drift together
        grown[2:5] *= self._solved.seen * matched + odometry[2:5] * (1.0 - matched)
        return grown

    def _axle_variance(self, knot: int) -> float:
        assert self._solved is not None
        floor = np.radians(_FLOOR_DEG) ** 2
        return float(self._solved.axle_variance[knot] * self._grown[2] + floor)

    def as_seen(self, covariance: F64) -> F64:
        """The covariance (6, 6) of an online pose with errors of the map as the stretch's residuals show them."""
        if self._solved is None:
            return covariance
        grown = np.ones(6)
        grown[2:5] = np.sqrt(np.maximum(self._solved.seen, 1.0))  # the stretch leaves out what draws single scans
        return np.asarray(grown[:, None] * covariance * grown)

    def _is_certain(self, covariance: F64) -> bool:
        sigma_m = float(np.sqrt(np.diag(covariance)[3:5]).max())
        return self._firm >= FIRM and sigma_m < _CERTAIN_M


def _forward_sigma_m(step: ScanStep) -> float:
    """One sigma of how far forward a step went, the rest held by gyro and road too: a car that slips still rolls on."""
    return float(np.sqrt(np.linalg.inv(np.linalg.inv(step.covariance) + HELD_INFORMATION)[3, 3]))


def _agrees(step: StretchStep, T_before_now: F64) -> bool:
    """True when a motion (4, 4) is one that the step allows."""
    off = log_se3(T_inverse(step.T_before_now) @ T_before_now)[2:5]
    return float(off @ np.linalg.solve(step.covariance[2:5, 2:5] + np.diag(MAP_VARIANCE), off)) < AGREES_CHI2


def _recentred(belief: StretchBelief, shared: F64) -> StretchBelief:
    """The same belief about other values of the shared parameters: those that the steps are made with now."""
    moved = np.concatenate([np.zeros(6), shared - belief.shared])
    return belief._replace(shared=shared, gradient=belief.gradient + belief.information @ moved)


def _loosened(belief: StretchBelief, variance: F64) -> StretchBelief:
    """The belief when the shared parameters may have changed since, by so much (N_SHARED,), its mean unchanged."""
    covariance = np.linalg.inv(belief.information)
    mean = -covariance @ belief.gradient
    covariance[-N_SHARED:, -N_SHARED:] += np.diag(variance)
    information = np.linalg.inv(covariance)
    return belief._replace(information=information, gradient=-information @ mean)


def between(T_first: F64, T_last: F64, share: float) -> F64:
    """(4, 4) the pose `share` (0 ... 1) of the way from one pose to another that is near it."""
    off = T_inverse(T_first) @ T_last
    return np.asarray(T_first @ T_from_R_t(exp_so3(share * log_so3(off[:3, :3])), share * off[:3, 3]))
