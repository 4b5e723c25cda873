"""Refined poses: hierarchical GraphSLAM with submaps, stretch by stretch (GND, 3 (ii), 6.2 and 7.2).

Every few metres a scan becomes an anchor. When the vehicle is some way past it, the scans around it are put together
as a submap, the submap is matched with the map, and a graph over the anchors of the last 100 m says which matches
hold. The poses of the scans follow from their anchors. Only these poses are evidence of change.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, log_so3
from vehicle_agent.errors import RegistrationError
from vehicle_agent.localise.anchor_graph import AnchorStep, Solution, solve
from vehicle_agent.localise.calibration import MotionTeacher
from vehicle_agent.localise.drift import drift_of
from vehicle_agent.localise.graph import MapMatch, SmoothedPose
from vehicle_agent.localise.level import settled
from vehicle_agent.localise.match_map import MatchMapCache
from vehicle_agent.localise.odometry import MotionBuffer
from vehicle_agent.localise.parameters import RegistrationParameters
from vehicle_agent.localise.refine_parameters import RefineParameters
from vehicle_agent.localise.registration import register
from vehicle_agent.localise.submap import Submap, SubmapScan, ToldByScans, local_poses, make_submap

F64 = NDArray[np.float64]

RECENT, SUPPORTED = 6, 3  # of so many anchors so many must have a match that takes part
FIRM = 4  # anchors whose submaps fit well, before anything is certain
NO_POINTS = np.zeros((0, 3), np.float32)
FIRST_SIGMA_M, FIRST_SIGMA_RAD = 0.5, 0.02  # of the online pose that the first anchor starts from


@dataclass(slots=True, eq=False)
class _Anchor:
    """A scan with a submap around it, and what the map says about it; it may be asked again."""

    scan: SubmapScan
    submap: Submap
    match: MapMatch | None
    fit: float


class Refiner:
    """Feeds on scans with online poses in time order; gives poses that are final, oldest first."""

    def __init__(
        self,
        parameters: RefineParameters,
        registration: RegistrationParameters,
        match_map: MatchMapCache,
        motion: MotionBuffer,
        teacher: MotionTeacher,
    ) -> None:
        self.parameters = parameters
        self.registration = replace(registration, wheel_sigma_m=parameters.wheel_sigma_m)
        self._map, self._motion, self._teacher = match_map, motion, teacher
        self._scans: list[SubmapScan] = []  # since the first anchor of the window
        self._final = 0  # how many of them are final
        self._next: SubmapScan | None = None  # the anchor to come
        self._anchors: list[_Anchor] = []
        self._news = False
        self._made_with_radps = 0.0  # gyro bias that the submaps were made with
        self._firm = 0  # anchors so far whose submaps fitted well
        self._start: MapMatch | None = None  # of the first anchor of the window, from the time before
        self.solution: Solution | None = None
        """Of the anchors in the window, as of the newest one."""

    def push(
        self, number: int, t_ns: int, points_m: F64, T_map_vehicle: F64, told: ToldByScans | None = None
    ) -> list[SmoothedPose]:
        """Take a scan; give the poses that became final with it.

        Args:
            number: of its pose, one more than that of the scan before.
            t_ns: its time.
            points_m: (K, 3) sampled points, vehicle frame, sweep motion removed.
            T_map_vehicle: (4, 4) its online pose.
            told: what scans tell better than wheels and gyro of the motion since the scan before.
        """
        way_m = 0.0
        if self._scans:
            last = self._scans[-1]
            way_m = last.way_m + float(np.linalg.norm(self._motion.delta(last.t_ns, t_ns)[:3, 3]))
        scan = SubmapScan(number, t_ns, way_m, points_m.astype(np.float32), T_map_vehicle, told)
        self._news = False
        self._scans.append(scan)
        if self._next is None:
            self._next = scan
        if self._passed(self._next, scan):
            self._add_anchor(self._next)
            self._news = True
            self._next = self._anchor_after(self._next)
        return self._leaving(scan) if self._anchors else []

    def flush(self) -> list[SmoothedPose]:
        """All poses that are not final yet, as they stand; submaps at the end are shorter."""
        par = self.parameters
        while self._next is not None:
            last = self._next
            self._add_anchor(last)
            following = self._anchor_after(last)
            self._next = following if following.way_m - last.way_m >= par.every_m else None
        return self._finalise(len(self._scans))

    @property
    def supported(self) -> bool:
        """True just after a new anchor, when the matches of enough of the last ones take part."""
        return self._news and sum(self._agreeing()[-RECENT:]) >= SUPPORTED

    def _agreeing(self) -> list[bool]:
        """Which anchors have a match, of more than their wheels, that takes part."""
        if self.solution is None:
            return []
        return [bool(t) and a.fit > 0.0 for a, t in zip(self._anchors, self.solution.trusted, strict=True)]

    @property
    def certain(self) -> bool:
        """True when submaps have fitted well for some way, and the odometry since leaves little doubt."""
        return self.solution is not None and self._is_certain(self.solution.covariance[-1])

    def correction(self, T_map_vehicle: F64) -> MapMatch | None:
        """Where the newest scan is, when its online pose (4, 4) is farther from there than either is uncertain."""
        if not self.supported or self.solution is None:
            return None
        par, T_local = self.parameters, local_poses(self._scans, self._motion)
        T_anchor_scan = T_inverse(T_local[self._index(self._anchors[-1].scan)]) @ T_local[-1]
        T, covariance = self.solution.T_map_vehicle[-1] @ T_anchor_scan, self.solution.covariance[-1] + self._floor()
        off, sigma = T_inverse(T) @ T_map_vehicle, np.sqrt(np.diag(covariance))
        far = np.hypot(off[0, 3], off[1, 3]) > par.correct_m + 3.0 * sigma[3:5].max()
        turned = abs(off[1, 0]) > np.radians(par.correct_deg) + 3.0 * sigma[2]
        return MapMatch(T, covariance) if far or turned else None

    # --- anchors ---------------------------------------------------------------------------------------------------

    def _passed(self, anchor: SubmapScan, newest: SubmapScan) -> bool:
        """True when what comes after the newest scan no longer belongs to the anchor's submap."""
        par = self.parameters
        return newest.way_m - anchor.way_m >= par.half_m or newest.t_ns - anchor.t_ns >= par.half_s * 1e9

    def _anchor_after(self, anchor: SubmapScan) -> SubmapScan:
        """The first scan that is far enough on, or else the newest."""
        par = self.parameters
        for scan in self._scans[self._index(anchor) + 1 :]:
            if scan.way_m - anchor.way_m >= par.every_m or scan.t_ns - anchor.t_ns >= par.every_s * 1e9:
                return scan
        return self._scans[-1]

    def _index(self, scan: SubmapScan) -> int:
        return scan.number - self._scans[0].number

    def _add_anchor(self, scan: SubmapScan) -> None:
        """Make and match the submap of the next anchor, then place all anchors anew."""
        T_local = local_poses(self._scans, self._motion)
        index = self._index(scan)
        submap = make_submap(self._scans, T_local, index, self.parameters)
        predicted, known = scan.T_map_vehicle, False
        if self.solution is not None:
            before = self._index(self._anchors[-1].scan)
            predicted = self.solution.T_map_vehicle[-1] @ T_inverse(T_local[before]) @ T_local[index]
            known = bool(np.sqrt(np.diag(self.solution.covariance[-1])[3:5]).max() < self.parameters.near_m)
        match, fit = self._matched(submap, predicted, known)
        self._anchors.append(_Anchor(scan, submap, match, fit))
        self._teach()
        T_local = local_poses(self._scans, self._motion)
        self._place(T_local)
        self._make_again(T_local)
        self._ask_again(T_local)
        self._count_firm()
        self._forget()

    def _count_firm(self) -> None:
        assert self.solution is not None
        self._firm += bool(self.solution.trusted[-1]) and self._anchors[-1].fit >= self.parameters.firm_fit

    def _matched(self, submap: Submap, predicted: F64, known: bool) -> tuple[MapMatch | None, float]:
        """The match of a submap near its predicted pose, if enough of it matches, and its fit."""
        par = self.parameters
        registration = replace(self.registration, scales=par.scales if known else par.first_scales)
        match_map = self._map.near(predicted[:3, 3])
        try:
            found = register(submap.points_m, predicted, match_map, registration, "near", submap.wheels_m)
        except RegistrationError:
            return self._settled(submap, predicted), 0.0
        if found.matching_ratio < par.min_matching_ratio:
            return self._settled(submap, predicted), 0.0
        return MapMatch(found.T_map_vehicle, found.covariance * par.overlap), found.fit

    def _settled(self, submap: Submap, predicted: F64) -> MapMatch | None:
        """Height and attitude at least, by the wheels."""
        return settled(predicted, self._map.near(predicted[:3, 3]), self.registration, submap.wheels_m)

    def _place(self, T_local: F64) -> None:
        """Solve for all anchors of the window."""
        start = self._start or _loose(self._anchors[0].scan.T_map_vehicle)
        steps = [self._step(T_local, a.scan, b.scan) for a, b in pairwise(self._anchors)]
        matches = [anchor.match for anchor in self._anchors]
        self.solution = solve(start, steps, matches, self.parameters.inlier_chi2)

    def _ask_again(self, T_local: F64) -> None:
        """Match the submaps once more that do not agree with the rest, from where the rest says that they are."""
        if self._match_doubted(lambda anchor, T: self._matched(anchor.submap, T, True)):
            self._place(T_local)
        if self._match_doubted(lambda anchor, T: (self._settled(anchor.submap, T), 0.0)):
            self._place(T_local)

    def _make_again(self, T_local: F64) -> None:
        """Submaps that were made before the gyro's bias was known are bent: make and match them again."""
        bias = self._motion.yaw_bias_radps
        if abs(bias - self._made_with_radps) < np.radians(self.parameters.bent_degps):
            return
        self._made_with_radps = bias
        assert self.solution is not None
        for anchor, T in zip(self._anchors, self.solution.T_map_vehicle, strict=True):
            if self._index(anchor.scan) >= self._final:
                anchor.submap = make_submap(self._scans, T_local, self._index(anchor.scan), self.parameters)
                anchor.match, anchor.fit = self._matched(anchor.submap, T, True)
        self._place(T_local)

    def _match_doubted(self, matched: Callable[[_Anchor, F64], tuple[MapMatch | None, float]]) -> bool:
        """Give anchors that do not agree with the rest, and may still matter to a pose, another match; any?"""
        assert self.solution is not None
        doubted = False
        for anchor, T, trusted in zip(self._anchors, self.solution.T_map_vehicle, self.solution.trusted, strict=True):
            if not trusted and self._index(anchor.scan) >= self._final:
                (anchor.match, anchor.fit), doubted = matched(anchor, T), True
        return doubted

    def _teach(self) -> None:
        """Wheels and gyro learn from submaps, too: single scans of a sparse sensor seldom fit well enough to teach."""
        T_local = local_poses(self._scans, self._motion, driven_only=True)
        T = [T_local[self._index(anchor.scan)] for anchor in self._anchors]
        steps = [T_inverse(a) @ b for a, b in pairwise(T)]
        matches = [anchor.match if anchor.fit > 0.0 else None for anchor in self._anchors]
        drift = drift_of([anchor.scan.t_ns for anchor in self._anchors], steps, matches)
        if drift is not None:
            self._teacher.correct(drift, self.parameters.overlap)

    def _step(self, T_local: F64, first: SubmapScan, last: SubmapScan) -> AnchorStep:
        par = self.parameters
        T = T_inverse(T_local[self._index(first)]) @ T_local[self._index(last)]
        way_m, dt_s = last.way_m - first.way_m, (last.t_ns - first.t_ns) * 1e-9
        grown = np.sqrt(max(way_m / par.every_m, dt_s / par.every_s))
        roll_pitch, yaw = np.radians(par.roll_pitch_deg), grown * np.radians(par.yaw_deg)
        scale, bias = self._teacher.uncertainty
        clock_rad, clock_m = self._teacher.clock_sigmas(first.t_ns, last.t_ns)
        sigmas = np.array([
            roll_pitch, roll_pitch, np.hypot(np.hypot(yaw, bias * dt_s), clock_rad),
            np.hypot(np.hypot(grown * par.longitudinal_m, scale * way_m), clock_m), grown * par.lateral_m,
            par.vertical_m,
        ])  # fmt: skip
        return AnchorStep(T, sigmas)

    def _forget(self) -> None:
        """Let go of the oldest anchors when the window is full, of the scans before, and of points done with."""
        while self._full():
            self._forget_oldest()
        waiting = min(self._final, self._index(self._anchors[-1].scan))
        for i, scan in enumerate(self._scans[:waiting]):
            if self._passed(scan, self._scans[waiting]) and len(scan.points_m):
                self._scans[i] = replace(scan, points_m=NO_POINTS)

    def _full(self) -> bool:
        """True when the oldest anchor can go: it is one too many or too old, and no scan waits for it."""
        par = self.parameters
        if len(self._anchors) < 3 or self._index(self._anchors[1].scan) > self._final:
            return False
        age_s = (self._anchors[-1].scan.t_ns - self._anchors[0].scan.t_ns) * 1e-9
        return len(self._anchors) > par.window or age_s > par.window_s

    def _forget_oldest(self) -> None:
        assert self.solution is not None
        oldest, s = self._anchors[1].scan, self.solution
        self._start = MapMatch(s.T_map_vehicle[1], s.covariance[1])
        self._anchors = self._anchors[1:]
        self._anchors[0].match = None  # it is in the prior now
        gone = self._index(oldest)
        self._scans, self._final = self._scans[gone:], self._final - gone
        self.solution = Solution(s.T_map_vehicle[1:], s.covariance[1:], s.trusted[1:])

    # --- scans -----------------------------------------------------------------------------------------------------

    def _leaving(self, newest: SubmapScan) -> list[SmoothedPose]:
        """The poses of scans that lie `lag_m` behind the newest anchor, or are too old to wait."""
        par, anchor = self.parameters, self._anchors[-1].scan
        learnt = self._teacher.uncertainty[1] < np.radians(par.learnt_degps)
        longest_s, n = (par.longest_s if learnt else par.unlearnt_s), self._final
        while n < len(self._scans):
            scan = self._scans[n]
            overdue = newest.t_ns - scan.t_ns > longest_s * 1e9
            if not overdue and (not learnt or anchor.way_m - scan.way_m < par.lag_m):
                break
            n += 1
        return self._finalise(n)

    def _finalise(self, end: int) -> list[SmoothedPose]:
        """The poses of the scans up to `end` that are not final yet."""
        first, self._final = self._final, end
        if end == first or self.solution is None:
            return []
        T_local = local_poses(self._scans, self._motion)
        at = np.array([self._index(anchor.scan) for anchor in self._anchors])
        return [self._pose(i, T_local, at, self.solution) for i in range(first, end)]

    def _pose(self, i: int, T_local: F64, at: NDArray[np.int64], s: Solution) -> SmoothedPose:
        """From the anchors before and after, each by how near it is; beyond the first or last, from that one alone."""
        after = int(np.clip(np.searchsorted(at, i), 1, max(len(at) - 1, 1)))
        low, high = after - 1, min(after, len(at) - 1)
        share = self._share(i, int(at[low]), int(at[high]))
        by_low, by_high = (s.T_map_vehicle[k] @ T_inverse(T_local[at[k]]) @ T_local[i] for k in (low, high))
        covariance = (1.0 - share) * s.covariance[low] + share * s.covariance[high]
        covariance, scan = covariance + self._floor(), self._scans[i]
        T = between(by_low, by_high, share)
        return SmoothedPose(scan.number, scan.t_ns, T, covariance, self._is_certain(covariance))

    def _is_certain(self, covariance: F64) -> bool:
        sigma_m = float(np.sqrt(np.diag(covariance)[3:5]).max())
        return self._firm >= FIRM and sigma_m < self.parameters.certain_m

    def _share(self, i: int, low: int, high: int) -> float:
        """How far along the way from one anchor to the next a scan is, 0 ... 1."""
        way = [self._scans[k].way_m for k in (low, i, high)]
        t = [self._scans[k].t_ns for k in (low, i, high)]
        a, b, c = way if way[2] - way[0] > 1e-3 else t
        return float(np.clip((b - a) / (c - a), 0.0, 1.0)) if c > a else 0.0

    def _floor(self) -> F64:
        par = self.parameters
        return np.diag([np.radians(par.floor_deg) ** 2] * 3 + [par.floor_m**2] * 3)


def between(T_first: F64, T_last: F64, share: float) -> F64:
    """(4, 4) the pose `share` (0 ... 1) of the way from one pose to another that is near it."""
    off = T_inverse(T_first) @ T_last
    return np.asarray(T_first @ T_from_R_t(exp_so3(share * log_so3(off[:3, :3])), share * off[:3, 3]))


def _loose(T: F64) -> MapMatch:
    return MapMatch(T, np.diag([FIRST_SIGMA_RAD**2] * 3 + [FIRST_SIGMA_M**2] * 3))
