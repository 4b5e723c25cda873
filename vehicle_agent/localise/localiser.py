"""The localiser: predict, deskew, match, gate, fuse; poses are final when the lag has passed (GND, 3 (ii))."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import DriveItem, GnssFix, MotionSample, MountSigma, Scan
from gnd.schemas.sweep_distortion import DistortionSigma
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.arbiter import ArbitratedMotion, Wrong, believing_neither, who_is_wrong
from gnd.vehicle_agent.localise.calibration import MotionCalibration, MotionTeacher
from gnd.vehicle_agent.localise.co_moving import CoMoving
from gnd.vehicle_agent.localise.consistency import Innovations
from gnd.vehicle_agent.localise.estimates import Cause, Health, PoseEstimate, RefinedScan
from gnd.vehicle_agent.localise.first_pose import FirstPose, SearchPlace
from gnd.vehicle_agent.localise.graph import MapMatch, OdometryEdge, PoseGraph, Position, SmoothedPose
from gnd.vehicle_agent.localise.health import CAUSE_POOR_SIGMA_M, HealthMonitor
from gnd.vehicle_agent.localise.held_scan import (
    POSE_SHARE,
    SURE,
    HeldScan,
    end_ns,
    estimate_of,
    left_in_sweep,
    reference_ns,
    settled_dispute,
    sigmas_of,
    sweep_variance,
)
from gnd.vehicle_agent.localise.initialise import INITIALISE_RADIUS_SIGMAS
from gnd.vehicle_agent.localise.judge import Judge, Matched
from gnd.vehicle_agent.localise.level import on_the_road, sees_tilt, settled
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.mount import near_points
from gnd.vehicle_agent.localise.neighbours import FAR_M, UNSURE_M, hedged, weakest
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.packed_scan import pack
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.localise.refine import Refiner
from gnd.vehicle_agent.localise.registration import RegistrationResult, Start, register
from gnd.vehicle_agent.localise.remount import TRUSTED, Mounting, lever_covariance
from gnd.vehicle_agent.localise.sampling import sample_scan
from gnd.vehicle_agent.localise.scan_odometry import JointStep, ScanOdometry, ScanStep, joint_step

_LOST_GAP_S: Final = 15.0
"""After so long without scans it is lost."""
_TEACHING_FIT: Final = 0.75
"""Least fit of a match that teaches: where much has changed, matches are off together."""

F64 = NDArray[np.float64]
Distortion = Callable[[float, float], DistortionSigma]
"""Sigma of a pose from speed [m/s] and yaw rate [rad/s], by the motion that is left in the points of a sweep."""

MAX_GNSS_AGE_NS = 2_000_000_000
TOLD_M, TOLD_RAD = 0.1, 0.01  # one sigma of a pose from outside
MOUNTED_M, MOUNTED_RAD, TRIMMED_RAD = 0.003, np.radians(0.02), np.radians(0.004)
"""One sigma of a mount that is as told: position, and yaw; of the axle's own course (tyres, the road's camber) once
that tells the yaw. All scans share it.
"""
COURSE_RAD: Final = np.radians(0.012)
"""One sigma of the course where a pose's own covariance does not hold it: that of online poses."""
SWEPT_NS = 100_000_000
PAST_NS, MOST_FROM_PAST = 1_000_000_000, 5


@dataclass(frozen=True, slots=True, eq=False)
class _Told:
    """A pose from outside."""

    t_ns: int
    T_map_vehicle: F64
    trusted: bool


@dataclass(slots=True, eq=False)
class _Track:
    """What exists only while the pose is known."""

    graph: PoseGraph
    judge: Judge
    refiner: Refiner | None
    held: dict[int, HeldScan]
    wrong: Wrong = "open"  # of wheels and scans, since they contradict each other


class Localiser:
    """Feeds on motion, GNSS and scans in time order; holds the scans of the last `lag_s` seconds and nothing older.

    A scan waits until the motion to its end is known, is matched then, and comes out as `RefinedScan` when its pose is
    final. Scans taken while the pose is not known (before the first, or while lost) are dropped and counted.
    """

    def __init__(
        self,
        local_map: LocalMap,
        T_vehicle_lidar: F64,
        parameters: LocaliserParameters | None = None,
        distortion: Distortion | None = None,
        mount_sigma: MountSigma = TRUSTED,
    ) -> None:
        """Poses are sought on `local_map`; `distortion` tells what speed and turn do to the points, where they do;
        `mount_sigma` how far the mount is known.
        """
        self.parameters = parameters or LocaliserParameters()
        self.local_map = local_map
        self._mounting = Mounting(T_vehicle_lidar, mount_sigma)
        self.online: PoseEstimate | None = None
        """Newest pose, for progress and for choosing tiles; its health is `lost` until it is found again."""
        self._distortion = distortion
        self.innovations = Innovations()
        """Of believed matches against the prediction: NIS."""
        self.dropped_scans = 0
        self.initialisations = 0
        self._motion = MotionBuffer()
        self._teacher = MotionTeacher(self._motion, self.parameters.odometry, self._mounting)
        self._map = MatchMapCache(local_map, self.parameters.registration.noise_m)
        self._scan_odometry = ScanOdometry(self.parameters.scan_odometry, self.parameters.registration.noise_m)
        self._co_moving = CoMoving(self._mounting.T_used)
        self._fix: GnssFix | None = None
        self._pending: Scan | None = None
        self._newest_scan_ns = -1
        self._ready: deque[tuple[HeldScan, SmoothedPose]] = deque()
        self._first = FirstPose(self.parameters)
        self._last_ns: int | None = None  # of the newest scan that was looked at
        self._last_raw_m, self._repeated = np.empty((0, 3), np.float32), False
        self._from_past = 0  # scans in a row
        self._told: _Told | None = None
        self._track: _Track | None = None

    # --- what the agent calls ------------------------------------------------------------------------------------

    def push(self, item: DriveItem) -> Iterator[RefinedScan]:
        """Take the next measurement; gives the scans whose poses became final, oldest first, each placed when it is
        asked for: a whole lag that becomes final at once is large. What a localiser has no use for is left out.
        """
        if isinstance(item, Scan):
            return self.take_scan(item)
        if isinstance(item, MotionSample):
            self.push_motion(item)
        elif isinstance(item, GnssFix):
            self.push_gnss(item)
        return iter(())

    def push_motion(self, sample: MotionSample) -> None:
        """Take a sample of wheel speed and yaw rate; a scan that waited for it is matched."""
        self._motion.push(sample.t_ns, sample.speed_mps, sample.yaw_rate_radps)
        self._tell_gap(sample.t_ns)
        self._process_if_covered()

    def push_gnss(self, fix: GnssFix) -> None:
        """Take a GNSS fix: it starts the search for the first pose, bounds drift, and shows a wrong pose."""
        if np.isfinite([fix.lat_rad, fix.lon_rad, fix.height_m, fix.sigma_m]).all() and fix.sigma_m > 0:
            self._fix = fix

    def take_scan(self, scan: Scan) -> Iterator[RefinedScan]:
        """Take a scan; gives the scans whose poses became final. One that is empty, or not later than the one before,
        is dropped and counted.
        """
        if len(scan) == 0 or scan.t_ns <= self._newest_scan_ns:
            self.dropped_scans += 1
            self._see_past(scan)
            return self._take_ready()
        self._newest_scan_ns, self._from_past = scan.t_ns, 0
        self._process()
        self._pending = scan
        self._process_if_covered()
        return self._take_ready()

    def start_at(self, t_ns: int, T_map_vehicle: F64, *, trusted: bool = False) -> None:
        """Take a pose (4, 4) from outside, such as that of the last parking, instead of the present one or of a search.

        It is judged like any other; `trusted` spares it the first good match, but not the proof that no other place
        looks the same, nor the doubts that come later.
        """
        if self._track is not None:
            self._lose(self._track, "searching")
        self._told = _Told(t_ns, np.array(T_map_vehicle, np.float64), trusted)

    @property
    def state(self) -> tuple[Health, Cause]:
        """Health and cause now, also while there has been no pose yet."""
        return ("lost", self._first.cause) if self.online is None else (self.online.health, self.online.cause)

    def flush(self) -> Iterator[RefinedScan]:
        """Finish: give the scans that are still held, with their poses as they stand, one by one (they are large)."""
        self._process()
        track, self._track = self._track, None
        if track is not None:
            self._finalise(track, track.graph.flush() if track.refiner is None else track.refiner.flush())
        return self._take_ready()

    @property
    def speed_scale(self) -> float:
        """What the wheel speed is multiplied with, as learnt from the map."""
        return self._motion.speed_scale

    @property
    def yaw_bias_radps(self) -> float:
        """What is taken off the yaw rate, as learnt from the map."""
        return self._motion.yaw_bias_radps

    @property
    def points_travelling_along(self) -> int:
        """Sampled points so far that were left out because they travel along with the vehicle."""
        return self._co_moving.left_out

    @property
    def calibration(self) -> MotionCalibration:
        """What is known of clock, wheels, gyro and mount so far, with sigmas."""
        return self._teacher.calibration

    # --- one scan --------------------------------------------------------------------------------------------------

    def _process_if_covered(self) -> None:
        if self._pending is not None and len(self._motion) and self._motion.last_ns >= end_ns(self._pending):
            self._process()

    def _process(self) -> None:
        scan, self._pending = self._pending, None
        if scan is None:
            return
        self._repeated = np.array_equal(self._last_raw_m, scan.points_m)
        self._last_raw_m = scan.points_m
        chosen = sample_scan(scan.points_m, self.parameters.sampling)
        self._look_at_mount(scan)
        points = self._deskewed(scan, chosen, scan.points_m[chosen])
        chosen, points = self._without_company(scan, chosen, points)
        last_ns = scan.t_ns if self._last_ns is None else self._last_ns
        if self._track is not None and (scan.t_ns - last_ns) * 1e-9 > _LOST_GAP_S:
            self._lose(self._track, "gap")
        if self._track is None:
            self._start(scan, points)
        else:
            self._step(self._track, scan, chosen, points)
        self._last_ns = reference_ns(scan)

    def _without_company(self, scan: Scan, chosen: NDArray[np.int64], points: F64) -> tuple[NDArray[np.int64], F64]:
        """The sampled points, and these in the vehicle frame, without those on what travels along."""
        t_ns = reference_ns(scan)
        moved = self._motion.delta(t_ns if self._last_ns is None else self._last_ns, t_ns)
        stands = ~self._co_moving.see(scan.points_m, scan.t_offset_ns, scan.t_ns, t_ns, chosen, points, moved)
        return chosen[stands], points[stands]

    def _look_at_mount(self, scan: Scan) -> None:
        """Watch the mount; what it is known by then counts as soon as no track is torn by it."""
        t_ns, mounting = reference_ns(scan), self._mounting
        if mounting.watch.due(t_ns):
            near = near_points(scan.points_m)
            mounting.see(t_ns, self._deskewed(scan, near, scan.points_m[near]))
        if self._track is not None and self.online is not None and mounting.torn:
            T_map_vehicle = self.online.T_map_vehicle
            self._lose(self._track, "mount")
            self._told = _Told(self.online.t_ns, T_map_vehicle, trusted=False)
        if self._track is None and not self._ready:
            self._remount()

    def _remount(self) -> None:
        """Go on in the axes of the mount as it is known by now: what is held in others is dropped."""
        before = self._mounting.T_used
        T_now_before = self._mounting.remount()
        if np.array_equal(before, self._mounting.T_used):
            return
        self._teacher.remounted(T_now_before)
        self._co_moving.remounted(self._mounting.T_used)
        self._first = FirstPose(self.parameters)

    def _step(self, track: _Track, scan: Scan, chosen: NDArray[np.int64], points: F64) -> None:
        """Predict from the newest pose, match, gate, fuse."""
        t_ns, newest = reference_ns(scan), track.graph.newest
        odometry = self._odometry(track.held[newest].t_ns, t_ns)
        seen = self._scan_step(scan, chosen, points, odometry)
        joint, reach = joint_step(*odometry, seen), self._reach(track, odometry)
        if joint.slipped and seen is not None:
            joint, seen, doubt = self._arbitrated(track, scan, chosen, points, odometry, seen)
            reach = np.hypot(reach, doubt)
        else:
            track.wrong = "open"
        self._teacher.see_step(track.held[newest].t_ns, t_ns, odometry.T_before_now, seen, slipped=joint.slipped)
        self._co_moving.correct(joint.T_before_now)
        sweep = self._sweep_of_steady(scan) if joint.slipped else None
        unsure = sweep_variance(
            odometry.T_before_now, seen, (end_ns(scan) - scan.t_ns) / (t_ns - track.held[newest].t_ns)
        )
        points = points if sweep is None else self._deskewed(scan, chosen, scan.points_m[chosen], sweep)
        predicted = track.graph.pose(newest) @ joint.T_before_now
        result, believed = self._matched(track.judge.monitor, points, predicted, reach, t_ns)
        match = None
        if result is not None and believed:
            match = MapMatch(result.T_map_vehicle, result.covariance + self._distorted(t_ns, unsure))
            before = np.diag(np.square(joint.driven_sigmas)) + track.held[newest].online.covariance
            self.innovations.see(predicted, before, *match)
            if joint.slipped:
                self._teacher.forget()
            elif result.fit >= _TEACHING_FIT and not len(result.degenerate):
                self._teacher.learn(t_ns, result.T_map_vehicle, result.covariance)
        odometry = OdometryEdge(odometry.T_before_now, joint.driven_sigmas)
        gnss, T_now = self._gnss_at(track, t_ns, predicted), predicted if match is None else match.T_map_vehicle
        unknown_s = max(self._motion.unknown_s(track.held[newest].t_ns, t_ns), self._motion.age_s(t_ns))
        seen_scan = Matched(
            t_ns, points, joint.T_before_now, T_now, result, believed, unknown_s, self._teacher.clock_cause,
            repeated=self._repeated,
        )  # fmt: skip
        track.judge.see(seen_scan, self._map.near(T_now[:3, 3]))
        final = track.graph.add(t_ns, predicted, odometry, match or self._settled(predicted), gnss, seen)
        self._hold(track, scan, result.matching_ratio if result is not None else 0.0, sweep, unsure)
        if track.refiner is not None:
            final = self._refine(track, track.refiner, t_ns, points, joint.T_before_now, seen)
        self._finalise(track, final)
        if self.online is not None and self.online.health == "lost":
            self._lose(track, self.online.cause)

    def _scan_step(self, scan: Scan, chosen: NDArray[np.int64], points: F64, odometry: OdometryEdge) -> ScanStep | None:
        """The motion since the scan before, as the scans tell it."""
        if not self.parameters.scan_odometry.enabled:
            return None

        def points_going_on() -> F64:
            return self._deskewed(scan, chosen, scan.points_m[chosen], self._sweep_of_steady(scan))

        return self._scan_odometry.step(reference_ns(scan), points, *odometry, points_going_on)

    def _arbitrated(
        self, track: _Track, scan: Scan, chosen: NDArray[np.int64], points: F64, odometry: OdometryEdge, seen: ScanStep
    ) -> tuple[JointStep, ScanStep | None, F64]:
        """Wheels and scans contradict each other: the joint step, and the scans' own, after the map was asked, and the
        sigmas (6,) that this adds to the motion. Scans that are wrong begin anew.
        """
        newest = track.graph.newest
        T_before, joint = track.graph.pose(newest), joint_step(*odometry, seen)
        sweep = self._sweep_of_steady(scan)
        going_on = points if sweep is None else self._deskewed(scan, chosen, scan.points_m[chosen], sweep)
        starts = ((points, odometry.T_before_now), (going_on, seen.T_before_now))
        matches = [self._match(some, T_before @ T, "near") for some, T in starts]
        driven = ArbitratedMotion(odometry.T_before_now, np.diag(np.square(odometry.sigmas)))
        told = [one for one in matches if one is not None]
        covariance = track.held[newest].online.covariance
        wrong = who_is_wrong(T_before, covariance, driven, ArbitratedMotion(seen.T_before_now, seen.covariance), told)
        if wrong == "open":
            slipped = self._motion.slipped(track.held[newest].t_ns, reference_ns(scan))
            wrong = "wheels" if slipped else track.wrong
        track.wrong = wrong
        if wrong == "wheels":
            return joint, seen, np.zeros(6)
        if wrong == "scans":
            self._scan_odometry.begin(reference_ns(scan), points)
            return joint_step(*odometry, None), None, np.zeros(6)
        joint, unsure = believing_neither(*odometry, seen)
        return joint, unsure, joint.driven_sigmas

    def _reach(self, track: _Track, odometry: OdometryEdge) -> F64:
        """(6,) one sigma of where a match may lie: of the motion, and of a pose that is poorly known itself."""
        covariance = track.held[track.graph.newest].online.covariance
        if np.sqrt(np.linalg.eigvalsh(covariance[3:5, 3:5])[1]) < CAUSE_POOR_SIGMA_M:
            return odometry.sigmas
        return np.asarray(np.hypot(odometry.sigmas, np.sqrt(np.diag(covariance))))

    def _sweep_of_steady(self, scan: Scan) -> Trajectory | None:
        """The motion during the sweep as the scans tell it; None before they have told any."""
        steady = self._scan_odometry.steady
        return None if steady is None else steady.trajectory(scan.t_ns, end_ns(scan))

    def _odometry(self, first_ns: int, last_ns: int) -> OdometryEdge:
        delta = self._motion.delta(first_ns, last_ns)
        return OdometryEdge(delta, self._teacher.sigmas_between(first_ns, last_ns, delta))

    def _matched(
        self, monitor: HealthMonitor, points: F64, predicted: F64, sigmas: F64, t_ns: int
    ) -> tuple[RegistrationResult | None, bool]:
        """The match, and whether to believe it: near the prediction if that will do, else a wider one."""
        near = self._match(points, predicted, "near")
        if near is not None:
            m = self._map.near(predicted[:3, 3])
            near, _ = hedged(points, near, m, self.parameters.registration, wheels_m=self._mounting.wheels_m)
        if not monitor.doubtful(near):
            monitor.see_wider(near, None)
            believed = monitor.believe(near, predicted, sigmas, t_ns)
            monitor.see_verdict(near, believed)
            return near, believed
        wide = self._match(points, predicted, "wide")
        monitor.see_wider(near, wide)
        if monitor.believe(near, predicted, sigmas, t_ns):
            monitor.see_verdict(near, True)
            return near, True
        believed = monitor.believe(wide, predicted, sigmas, t_ns)
        monitor.see_verdict(wide, believed)
        return wide, believed

    def _match(self, points: F64, predicted: F64, start: Start) -> RegistrationResult | None:
        try:
            m, wheels_m = self._map.near(predicted[:3, 3]), self._mounting.wheels_m
            return register(points, predicted, m, self.parameters.registration, start, wheels_m)
        except RegistrationError:
            return None

    def _settled(self, predicted: F64) -> MapMatch | None:
        """What a scan without a match still knows: its wheels stand on the ground."""
        m = self._map.near(predicted[:3, 3])
        return settled(predicted, m, self.parameters.registration, self._mounting.wheels_m)

    def _gnss_at(self, track: _Track, t_ns: int, T_map_vehicle: F64) -> Position | None:
        """A new fix as position of the vehicle at `t_ns`; the monitor is told how far off it is."""
        fix, self._fix = self._fix, None
        if fix is None or abs(t_ns - fix.t_ns) > MAX_GNSS_AGE_NS:
            return None
        at_fix = T_map_vehicle @ self._motion.delta(t_ns, fix.t_ns)
        offset = self._p_map(fix) - at_fix[:3, 3]
        track.judge.see_position(T_map_vehicle[:3, 3] + offset, fix.sigma_m, T_map_vehicle)
        return Position(T_map_vehicle[:3, 3] + offset, fix.sigma_m)

    def _p_map(self, fix: GnssFix) -> F64:
        frame = self.local_map.grid_frame.frame
        return frame.enu_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m).reshape(3)

    def _hold(
        self,
        track: _Track,
        scan: Scan,
        matching_ratio: float,
        sweep: Trajectory | None = None,
        unsure: F64 = SURE,
    ) -> None:
        """Keep the scan until its pose is final, and tell the online pose."""
        t_ns, number = reference_ns(scan), track.graph.newest
        pose, monitor = self._drifted(track, track.graph.smoothed(number)[0]), track.judge.monitor
        if track.refiner is not None:
            pose = replace(pose, covariance=track.refiner.as_seen(pose.covariance) + left_in_sweep(unsure))
        sigma_m, sigma_rad = sigmas_of(pose)
        monitor.see_sigma(sigma_m, sigma_rad)
        health, cause = self._with_mount(*monitor.judge(t_ns))
        held = HeldScan(pack(scan), sweep, t_ns, matching_ratio, health, cause, monitor.degenerate, pose, unsure)
        track.held[number] = held
        self.online = estimate_of(self._trimmed(pose), held)

    def _drifted(self, track: _Track, pose: SmoothedPose) -> SmoothedPose:
        """The pose with what wheels may be off by since the map last told the place along. The graph takes their
        errors for independent from step to step; the scale's are not.
        """
        along = np.zeros(6)
        along[3] = (self._teacher.uncertainty[0] * track.judge.uniqueness.untold_m) ** 2
        return replace(pose, covariance=pose.covariance + np.diag(along))

    def _refine(
        self,
        track: _Track,
        refiner: Refiner,
        t_ns: int,
        points: F64,
        T_before_now: F64 | None = None,
        seen: ScanStep | None = None,
    ) -> list[SmoothedPose]:
        """Give the scan to the submaps, and let what they say correct the online pose; the poses that became final."""
        number = track.graph.newest
        T_online = track.graph.pose(number)
        refiner.unique = track.judge.monitor.unique
        final = refiner.push(number, t_ns, points, T_online, T_before_now, seen)
        track.judge.monitor.certain = refiner.certain and not track.judge.uniqueness.beaten
        correction = refiner.correction(T_online)
        if correction is not None:
            track.graph.restart(*correction)
        return final

    # --- the first pose, and the last --------------------------------------------------------------------------------

    def _start(self, scan: Scan, points: F64) -> None:
        """Search for the pose, and follow what was found until one has won."""
        t_ns = reference_ns(scan)
        if self._told is not None:
            self._begin_as_told(scan, points, self._told)
            return
        if self._mounting.waits:
            self.dropped_scans += 1
            self._first.cause = "mount"
            self._tell_lost(t_ns, "mount")
            return
        moved = self._motion.delta(t_ns if self._last_ns is None else self._last_ns, t_ns)
        found = self._first.see(t_ns, points, moved, self._place(t_ns), self._map)
        if found is None:
            self.dropped_scans += 1
            self._tell_lost(t_ns, self._first.cause)
            return
        self.initialisations += 1
        self._begin(scan, points, found.registration, found.fit)

    def _begin_as_told(self, scan: Scan, points: F64, told: _Told) -> None:
        self._told = None
        T = told.T_map_vehicle @ self._motion.delta(told.t_ns, reference_ns(scan))
        T = T @ T_inverse(self._mounting.T_used_vehicle(-self._trim_rad))
        covariance = np.diag([TOLD_RAD**2] * 3 + [TOLD_M**2] * 3)
        fit = 1.0 if told.trusted else 0.0
        self._begin(scan, points, RegistrationResult(T, covariance, 0.0, fit, 1.0, 0, True, np.empty((0, 6))), fit)

    def _begin(self, scan: Scan, points: F64, result: RegistrationResult, fit: float) -> None:
        """Track from this pose on."""
        par, t_ns = self.parameters, reference_ns(scan)
        self._first = FirstPose(par)
        judge = Judge(par, self._mounting.T_used[:3, 3], t_ns)
        covariance, contested = self._hedged_first(points, result)
        if contested:
            judge.monitor.prove_first()
        judge.monitor.see_match(fit, result.fit, result.degenerate)
        judge.monitor.scans_prove = not par.refine.enabled or sees_tilt(scan.points_m)
        T = result.T_map_vehicle
        judge.begin(points, T, self._place(t_ns), self._map.near(T[:3, 3]))
        if judge.monitor.trusted:
            judge.challenger.rest(t_ns)
        self._track = _Track(PoseGraph(par.graph), judge, self._new_refiner(), {})
        self._track.graph.add(t_ns, result.T_map_vehicle, None, MapMatch(result.T_map_vehicle, covariance), None)
        self._hold(self._track, scan, result.matching_ratio)
        if self._track.refiner is not None:
            self._refine(self._track, self._track.refiner, t_ns, points)
        self._scan_odometry.begin(t_ns, points)

    def _hedged_first(self, points: F64, result: RegistrationResult) -> tuple[F64, bool]:
        """The covariance (6, 6) of a first pose, and whether it must be proven: a neighbouring minimum fits as well, or
        so little holds it that there may be one elsewhere. One that was told is no match, and has no neighbours.
        """
        if not result.iterations:
            return result.covariance, False
        m, par = self._map.near(result.T_map_vehicle[:3, 3]), self.parameters.registration
        known, contested = hedged(points, result, m, par, FAR_M, 0.0, self._mounting.wheels_m)
        return known.covariance, contested or weakest(result)[0] > UNSURE_M

    def _new_refiner(self) -> Refiner | None:
        par = self.parameters
        if not par.refine.enabled:
            return None
        return Refiner(par.refine, par.registration, self._map, self._motion, self._teacher)

    def _place(self, t_ns: int) -> SearchPlace | None:
        """Where the last fix says that the vehicle is; how far it has driven since is not known in which direction."""
        fix, sigmas = self._fix, INITIALISE_RADIUS_SIGMAS
        if fix is None or abs(t_ns - fix.t_ns) > MAX_GNSS_AGE_NS:
            return None
        moved_m = abs(self._motion.speed_mps * (t_ns - fix.t_ns) * 1e-9)
        return SearchPlace(self._p_map(fix), float(np.hypot(fix.sigma_m, moved_m)), sigmas * fix.sigma_m + moved_m)

    def _lose(self, track: _Track, cause: Cause) -> None:
        """The pose is wrong: nothing held may reach the evidence. A rival that has won is where the search begins."""
        self.dropped_scans += len(track.held)
        self._track = None
        self._teacher.forget()
        self._first = FirstPose(self.parameters)
        if track.judge.monitor.beaten:
            self._first.hypotheses = track.judge.challenger.rivals
        if self.online is not None:
            self._tell_lost(self.online.t_ns, cause)

    def _tell_lost(self, t_ns: int, cause: Cause) -> None:
        """The last pose, moved as odometry says, is worth nothing but to show roughly where."""
        if self.online is not None:
            T = self.online.T_map_vehicle @ self._motion.delta(self.online.t_ns, t_ns)
            self.online = replace(
                self.online, t_ns=t_ns, T_map_vehicle=T, health="lost", cause=cause, matching_ratio=0.0
            )

    def _tell_gap(self, now_ns: int) -> None:
        """Scans have stopped coming: the newest pose grows old."""
        if self._track is None or self.online is None or self._pending is not None:
            return
        age_s = (now_ns - self.online.t_ns) * 1e-9
        if age_s > self.parameters.health.degraded_after_s:
            health: Health = "lost" if age_s > _LOST_GAP_S else "degraded"
            self.online = replace(self.online, health=health, cause="gap")

    def _see_past(self, scan: Scan) -> None:
        """Scans from the past are dropped; when they go on, it is the clock that was wrong, and all begins anew."""
        if scan.t_ns >= self._newest_scan_ns - PAST_NS:
            return
        self._from_past += 1
        if self.online is not None:
            self.online = replace(self.online, health="degraded", cause="bad_time")
        if self._from_past < MOST_FROM_PAST:
            return
        self._motion.clear()
        self._teacher.clock.forget()
        self._co_moving.forget()
        self._fix = self._pending = self._last_ns = None
        self._newest_scan_ns, self._from_past = -1, 0
        if self._track is not None:
            self._lose(self._track, "bad_time")

    # --- final poses -------------------------------------------------------------------------------------------------

    def _finalise(self, track: _Track, poses: list[SmoothedPose]) -> None:
        for pose in poses:
            self._ready.append((track.held.pop(pose.number), pose))

    def _refined(self, held: HeldScan, pose: SmoothedPose) -> RefinedScan:
        scan = held.scan
        pose, disagrees = settled_dispute(pose, held.online)
        if not sees_tilt(scan.points):
            m, wheels_m = self._map.near(pose.T_map_vehicle[:3, 3]), self._mounting.wheels_m
            pose = on_the_road(pose, m, self.parameters.registration, wheels_m)
        sweep = self._motion.trajectory(scan.t_ns, scan.end_ns) if held.sweep is None else held.sweep
        ends, starts = scan.placed(sweep, self._mounting.T_used, held.t_ns, pose.T_map_vehicle)
        pose = replace(pose, covariance=pose.covariance + self._distorted(held.t_ns, held.unsure))
        estimate = replace(estimate_of(self._trimmed(pose), held), disagrees=disagrees)
        if held.cause == "mount":  # the scan came before the mount was known
            estimate = replace(estimate, health="good", cause="none")
        health, cause = self._with_mount(estimate.health, estimate.cause)
        estimate = replace(estimate, health=health, cause=cause)
        if disagrees and not pose.certain and estimate.health == "good":
            estimate = replace(estimate, health="degraded", cause="disputed")
        return RefinedScan(held.t_ns, ends, starts, estimate)

    def _distorted(self, t_ns: int, unsure: F64) -> F64:
        """(6, 6) what motion that is left in a sweep adds to a pose: all points agree on a wrong one. `unsure`: (3,)
        variance of the sweep's motion, beside what is known of its times.
        """
        variance = np.diag(left_in_sweep(unsure)).copy()
        if self._distortion is not None and len(self._motion):
            before = self._motion.delta(t_ns - SWEPT_NS, t_ns)
            dt_s = SWEPT_NS * 1e-9
            sigma = self._distortion(before[0, 3] / dt_s, float(np.arctan2(before[1, 0], before[0, 0])) / dt_s)
            variance[[3, 4, 2]] += np.square(sigma) * POSE_SHARE**2
        return np.diag(variance)

    def _trimmed(self, pose: SmoothedPose) -> SmoothedPose:
        """The pose of the vehicle as it lies under its mount, as far as that is known, from that in the axes of the
        mount in use: the LiDAR stays where it is, the heading is the one that the rear axle drives along. The
        covariance holds what neither scans nor map can know of the mount, with its lever arm.
        """
        trim_rad, scale = self._trim_rad, np.ones(6)
        least_rad = COURSE_RAD if trim_rad else MOUNTED_RAD
        if trim_rad and pose.axle_variance is not None:
            least_rad, scale[2] = TRIMMED_RAD, np.sqrt(pose.axle_variance / pose.covariance[2, 2])
        T = pose.T_map_vehicle @ self._mounting.T_used_vehicle(-trim_rad)
        place = np.diag(np.array([0.0, 0.0, 0.0, MOUNTED_M, MOUNTED_M, 0.0]) ** 2)
        variance = np.append(self._mounting.tilt_variance_rad2(), self._teacher.yaw_sigma_rad(trim_rad, least_rad) ** 2)
        mounted = place + lever_covariance(self._mounting.T_vehicle_lidar()[:3, 3], variance)
        return replace(pose, T_map_vehicle=T, covariance=scale[:, None] * pose.covariance * scale + mounted)

    @property
    def _trim_rad(self) -> float:
        """What the heading is turned by: finely only where submaps teach the course."""
        return self._teacher.trim_rad if self.parameters.refine.enabled else self._teacher.header_trim_rad

    def _with_mount(self, health: Health, cause: Cause) -> tuple[Health, Cause]:
        """Health and cause with what is known of the mount by now."""
        return self._teacher.doubted(health, cause, trimmed=self.parameters.refine.enabled)

    def _deskewed(
        self,
        scan: Scan,
        chosen: NDArray[np.int64],
        points_lidar_m: NDArray[np.float32],
        sweep: Trajectory | None = None,
    ) -> F64:
        """(K, 3) points (of the LiDAR's frame, at the times of the chosen points) in the vehicle frame at the scan's
        reference time; the motion is that of wheels and gyro, or `sweep`.
        """
        if sweep is None:
            sweep = self._motion.trajectory(scan.t_ns, end_ns(scan))
        offset_ns = scan.t_offset_ns[chosen]
        return deskew(points_lidar_m, offset_ns, scan.t_ns, sweep, self._mounting.T_used, reference_ns(scan))

    def _take_ready(self) -> Iterator[RefinedScan]:
        while self._ready:
            yield self._refined(*self._ready.popleft())
