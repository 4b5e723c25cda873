"""The localiser: predict, deskew, match, gate, fuse; poses are final when the lag has passed (GND, 3 (ii))."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd_map.motion import Trajectory, deskew
from gnd_map.se3 import T_from_R_t, T_inverse, exp_so3
from schemas.drive import GnssFix, MotionSample, Scan
from schemas.sweep_distortion import DistortionSigma
from vehicle_agent.errors import RegistrationError
from vehicle_agent.local_map import LocalMap
from vehicle_agent.localise.calibration import MotionCalibration, MotionTeacher
from vehicle_agent.localise.consistency import Innovations
from vehicle_agent.localise.estimates import Cause, Health, PoseEstimate, RefinedScan
from vehicle_agent.localise.first_pose import FirstPose, Place
from vehicle_agent.localise.graph import MapMatch, Odometry, PoseGraph, Position, SmoothedPose
from vehicle_agent.localise.health import HealthMonitor
from vehicle_agent.localise.judge import Judge, Matched
from vehicle_agent.localise.level import on_the_road, sees_tilt, settled
from vehicle_agent.localise.match_map import MatchMapCache
from vehicle_agent.localise.mount import MountWatch, near_points
from vehicle_agent.localise.odometry import MotionBuffer
from vehicle_agent.localise.packed_scan import PackedScan, pack
from vehicle_agent.localise.parameters import LocaliserParameters
from vehicle_agent.localise.refine import Refiner
from vehicle_agent.localise.registration import RegistrationResult, Start, register
from vehicle_agent.localise.sampling import sample_scan
from vehicle_agent.localise.scan_odometry import ScanOdometry, ScanStep, joint_step
from vehicle_agent.localise.stretch import log_se3

F64 = NDArray[np.float64]
Distortion = Callable[[float, float], DistortionSigma]
"""Sigma of a pose from speed [m/s] and yaw rate [rad/s], by the motion that is left in the points of a sweep."""

MAX_GNSS_AGE_NS = 2_000_000_000
TOLD_M, TOLD_RAD = 0.1, 0.01  # one sigma of a pose from outside
OVERRULED: Final[tuple[Cause, ...]] = ("wrong_pose", "stale_map", "poor_place", "no_match", "unconfirmed")
"""What single scans hold against a pose and submaps may know better."""
DISPUTED_CHI2 = 21.1  # of heading and place, three degrees of freedom: 99.99 %
DISPUTED_VARIANCE = np.array([np.radians(0.1), 0.02, 0.02]) ** 2  # what online poses are wrong by in changed places
MOUNTED_M, MOUNTED_RAD, TRIMMED_RAD = 0.003, np.radians(0.02), np.radians(0.004)
"""One sigma of a mount that is as told: position, and yaw; of the axle's own course (tyres, the road's camber) once
that tells the yaw. All scans share it.
"""
COURSE_RAD: Final = np.radians(0.012)
"""One sigma of the course where a pose's own covariance does not hold it: that of online poses."""
SWEPT_NS = 100_000_000
POSE_SHARE = 0.25
"""Of what distortion moves a point by, as far as it moves a pose, which is held by points all around."""
SURE: Final = np.zeros(3)
PAST_NS, MOST_FROM_PAST = 1_000_000_000, 5


@dataclass(frozen=True, slots=True, eq=False)
class _HeldScan:
    """A scan in the lag: what is needed to make it final, and how its match went. `sweep` is the motion during the
    sweep where it is not the one that wheels and gyro tell; `online` the pose as it was when the scan came; `unsure`
    (3,) variance of the sweep's motion forward, left and in yaw.
    """

    scan: PackedScan
    sweep: Trajectory | None
    t_ns: int
    matching_ratio: float
    health: Health
    cause: Cause
    degenerate: tuple[str, ...]
    online: SmoothedPose
    unsure: F64


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
    held: dict[int, _HeldScan]


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
    ) -> None:
        """Poses are sought on `local_map`; `distortion` tells what speed and turn do to the points, where they do."""
        self.parameters = parameters or LocaliserParameters()
        self.local_map = local_map
        self.T_vehicle_lidar = np.asarray(T_vehicle_lidar, dtype=np.float64)
        self.online: PoseEstimate | None = None
        """Newest pose, for progress and for choosing tiles; its health is `lost` until it is found again."""
        self._distortion = distortion
        self.innovations = Innovations()
        """Of believed matches against the prediction: NIS."""
        self.dropped_scans = 0
        self.initialisations = 0
        self._motion = MotionBuffer()
        self._teacher = MotionTeacher(self._motion, self.parameters.odometry, MountWatch(self.T_vehicle_lidar))
        self._map = MatchMapCache(local_map, self.parameters.registration.noise_m)
        self._scan_odometry = ScanOdometry(self.parameters.scan_odometry)
        self._fix: GnssFix | None = None
        self._pending: Scan | None = None
        self._newest_scan_ns = -1
        self._ready: deque[tuple[_HeldScan, SmoothedPose]] = deque()
        self._first = FirstPose(self.parameters)
        self._last_ns: int | None = None  # of the newest scan that was looked at
        self._from_past = 0  # scans in a row
        self._told: _Told | None = None
        self._track: _Track | None = None

    # --- what the agent calls ------------------------------------------------------------------------------------

    def push_motion(self, sample: MotionSample) -> None:
        """Take a sample of wheel speed and yaw rate; a scan that waited for it is matched."""
        self._motion.push(sample.t_ns, sample.speed_mps, sample.yaw_rate_radps)
        self._tell_gap(sample.t_ns)
        self._process_if_covered()

    def push_gnss(self, fix: GnssFix) -> None:
        """Take a GNSS fix: it starts the search for the first pose, bounds drift, and shows a wrong pose."""
        if np.isfinite([fix.lat_rad, fix.lon_rad, fix.height_m, fix.sigma_m]).all() and fix.sigma_m > 0:
            self._fix = fix

    def push_scan(self, scan: Scan) -> list[RefinedScan]:
        """Take a scan; give the scans whose poses became final, oldest first. A scan that is empty, or not later than
        the one before, is dropped and counted.
        """
        if len(scan) == 0 or scan.t_ns <= self._newest_scan_ns:
            self.dropped_scans += 1
            self._see_past(scan)
            return list(self._take_ready())
        self._newest_scan_ns, self._from_past = scan.t_ns, 0
        self._process()
        self._pending = scan
        self._process_if_covered()
        return list(self._take_ready())

    def start_at(self, t_ns: int, T_map_vehicle: F64, *, trusted: bool = False) -> None:
        """Take a pose (4, 4) from outside, such as that of the last parking, instead of the present one or of a search.

        It is judged like any other; `trusted` spares it the first proof, not the doubts that come later.
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
    def calibration(self) -> MotionCalibration:
        """What is known of clock, wheels, gyro and mount so far, with sigmas."""
        return self._teacher.calibration

    # --- one scan --------------------------------------------------------------------------------------------------

    def _process_if_covered(self) -> None:
        if self._pending is not None and len(self._motion) and self._motion.last_ns >= _end_ns(self._pending):
            self._process()

    def _process(self) -> None:
        scan, self._pending = self._pending, None
        if scan is None:
            return
        chosen = sample_scan(scan.points_m, self.parameters.sampling)
        points = self._deskewed(scan, chosen, scan.points_m[chosen])
        self._look_at_mount(scan)
        last_ns = scan.t_ns if self._last_ns is None else self._last_ns
        if self._track is not None and (scan.t_ns - last_ns) * 1e-9 > self.parameters.causes.lost_gap_s:
            self._lose(self._track, "gap")
        if self._track is None:
            self._start(scan, points)
        else:
            self._step(self._track, scan, chosen, points)
        self._last_ns = _reference_ns(scan)

    def _look_at_mount(self, scan: Scan) -> None:
        t_ns, watch = _reference_ns(scan), self._teacher.mount
        if watch.due(t_ns):
            near = near_points(scan.points_m)
            watch.see(t_ns, self._deskewed(scan, near, scan.points_m[near]))

    def _step(self, track: _Track, scan: Scan, chosen: NDArray[np.int64], points: F64) -> None:
        """Predict from the newest pose, match, gate, fuse."""
        t_ns, newest = _reference_ns(scan), track.graph.newest
        odometry = self._odometry(track.held[newest].t_ns, t_ns)
        seen = self._scan_step(scan, chosen, points, odometry)
        self._teacher.clock.see(track.held[newest].t_ns, t_ns, seen)
        joint = joint_step(*odometry, seen)
        sweep = self._sweep_of_steady(scan) if joint.slipped else None
        unsure = _unsure(odometry.T_before_now, seen, (_end_ns(scan) - scan.t_ns) / (t_ns - track.held[newest].t_ns))
        points = points if sweep is None else self._deskewed(scan, chosen, scan.points_m[chosen], sweep)
        predicted = track.graph.pose(newest) @ joint.T_before_now
        result, believed = self._matched(track.judge.monitor, points, predicted, odometry.sigmas, t_ns)
        match = None
        if result is not None and believed:
            match = MapMatch(result.T_map_vehicle, result.covariance + self._distorted(t_ns, unsure))
            before = np.diag(np.square(joint.driven_sigmas)) + track.held[newest].online.covariance
            self.innovations.see(predicted, before, *match)
            if joint.slipped:
                self._teacher.forget()
            elif result.fit >= self.parameters.odometry.teaching_fit and not len(result.degenerate):
                self._teacher.learn(t_ns, result.T_map_vehicle, result.covariance)
        odometry = Odometry(odometry.T_before_now, joint.driven_sigmas)
        gnss, T_now = self._gnss_at(track, t_ns, predicted), predicted if match is None else match.T_map_vehicle
        unknown_s = max(self._motion.unknown_s(track.held[newest].t_ns, t_ns), self._motion.age_s(t_ns))
        seen_scan = Matched(t_ns, points, joint.T_before_now, T_now, result, believed, unknown_s, self._teacher.cause)
        track.judge.see(seen_scan, self._map.near(T_now[:3, 3]))
        final = track.graph.add(t_ns, predicted, odometry, match or self._settled(predicted), gnss, seen)
        self._hold(track, scan, result.matching_ratio if result is not None else 0.0, sweep, unsure)
        if track.refiner is not None:
            final = self._refine(track, track.refiner, t_ns, points, joint.T_before_now, seen)
        self._finalise(track, final)
        if self.online is not None and self.online.health == "lost":
            self._lose(track, self.online.cause)

    def _scan_step(self, scan: Scan, chosen: NDArray[np.int64], points: F64, odometry: Odometry) -> ScanStep | None:
        """The motion since the scan before, as the scans tell it."""
        if not self.parameters.scan_odometry.enabled:
            return None

        def points_going_on() -> F64:
            return self._deskewed(scan, chosen, scan.points_m[chosen], self._sweep_of_steady(scan))

        return self._scan_odometry.step(_reference_ns(scan), points, *odometry, points_going_on)

    def _sweep_of_steady(self, scan: Scan) -> Trajectory | None:
        """The motion during the sweep as the scans tell it; None before they have told any."""
        steady = self._scan_odometry.steady
        return None if steady is None else steady.trajectory(scan.t_ns, _end_ns(scan))

    def _odometry(self, first_ns: int, last_ns: int) -> Odometry:
        delta = self._motion.delta(first_ns, last_ns)
        return Odometry(delta, self._teacher.sigmas_between(first_ns, last_ns, delta))

    def _matched(
        self, monitor: HealthMonitor, points: F64, predicted: F64, sigmas: F64, t_ns: int
    ) -> tuple[RegistrationResult | None, bool]:
        """The match, and whether to believe it: near the prediction if that will do, else a wider one."""
        near = self._match(points, predicted, "near")
        if not monitor.doubtful(near):
            monitor.see_wider(near, None)
            return near, monitor.believe(near, predicted, sigmas, t_ns)
        wide = self._match(points, predicted, "wide")
        monitor.see_wider(near, wide)
        if monitor.believe(near, predicted, sigmas, t_ns):
            return near, True
        return wide, monitor.believe(wide, predicted, sigmas, t_ns)

    def _match(self, points: F64, predicted: F64, start: Start) -> RegistrationResult | None:
        try:
            return register(points, predicted, self._map.near(predicted[:3, 3]), self.parameters.registration, start)
        except RegistrationError:
            return None

    def _settled(self, predicted: F64) -> MapMatch | None:
        """What a scan without a match still knows: its wheels stand on the ground."""
        return settled(predicted, self._map.near(predicted[:3, 3]), self.parameters.registration)

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
        t_ns, number = _reference_ns(scan), track.graph.newest
        pose, monitor = track.graph.smoothed(number)[0], track.judge.monitor
        if track.refiner is not None:
            pose = replace(pose, covariance=track.refiner.as_seen(pose.covariance) + _left_in(unsure))
        sigma_m, sigma_rad = _sigmas(pose)
        monitor.see_sigma(sigma_m, sigma_rad)
        health, cause = monitor.judge(t_ns)
        held = _HeldScan(pack(scan), sweep, t_ns, matching_ratio, health, cause, monitor.degenerate, pose, unsure)
        track.held[number] = held
        self.online = _estimate(self._trimmed(pose), held)

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
        final = refiner.push(number, t_ns, points, T_online, T_before_now, seen)
        track.judge.monitor.certain = refiner.certain
        correction = refiner.correction(T_online)
        if correction is not None:
            track.graph.restart(*correction)
        return final

    # --- the first pose, and the last --------------------------------------------------------------------------------

    def _start(self, scan: Scan, points: F64) -> None:
        """Search for the pose, and follow what was found until one has won."""
        t_ns = _reference_ns(scan)
        if self._told is not None:
            self._begin_as_told(scan, points, self._told)
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
        T = told.T_map_vehicle @ self._motion.delta(told.t_ns, _reference_ns(scan))
        covariance = np.diag([TOLD_RAD**2] * 3 + [TOLD_M**2] * 3)
        fit = 1.0 if told.trusted else 0.0
        self._begin(scan, points, RegistrationResult(T, covariance, 0.0, fit, 1.0, 0, True, np.empty((0, 6))), fit)

    def _begin(self, scan: Scan, points: F64, result: RegistrationResult, fit: float) -> None:
        """Track from this pose on."""
        par, t_ns = self.parameters, _reference_ns(scan)
        self._first = FirstPose(par)
        judge = Judge(par, self.T_vehicle_lidar[:3, 3], t_ns)
        judge.monitor.see_match(fit, result.fit, result.degenerate)
        judge.monitor.scans_prove = not par.refine.enabled or sees_tilt(scan.points_m)
        if judge.monitor.trusted:
            judge.challenger.rest(t_ns)
        self._track = _Track(PoseGraph(par.graph), judge, self._new_refiner(), {})
        self._track.graph.add(t_ns, result.T_map_vehicle, None, MapMatch(result.T_map_vehicle, result.covariance), None)
        self._hold(self._track, scan, result.matching_ratio)
        if self._track.refiner is not None:
            self._refine(self._track, self._track.refiner, t_ns, points)
        self._scan_odometry.begin(t_ns, points)

    def _new_refiner(self) -> Refiner | None:
        par = self.parameters
        if not par.refine.enabled:
            return None
        return Refiner(par.refine, par.registration, self._map, self._motion, self._teacher)

    def _place(self, t_ns: int) -> Place | None:
        """Where the last fix says that the vehicle is; how far it has driven since is not known in which direction."""
        fix, sigmas = self._fix, self.parameters.initialise.radius_sigmas
        if fix is None or abs(t_ns - fix.t_ns) > MAX_GNSS_AGE_NS:
            return None
        moved_m = abs(self._motion.speed_mps * (t_ns - fix.t_ns) * 1e-9)
        return Place(self._p_map(fix), float(np.hypot(fix.sigma_m, moved_m)), sigmas * fix.sigma_m + moved_m)

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
            health: Health = "lost" if age_s > self.parameters.causes.lost_gap_s else "degraded"
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
        self._fix = self._pending = self._last_ns = None
        self._newest_scan_ns, self._from_past = -1, 0
        if self._track is not None:
            self._lose(self._track, "bad_time")

    # --- final poses -------------------------------------------------------------------------------------------------

    def _finalise(self, track: _Track, poses: list[SmoothedPose]) -> None:
        for pose in poses:
            self._ready.append((track.held.pop(pose.number), pose))

    def _refined(self, held: _HeldScan, pose: SmoothedPose) -> RefinedScan:
        scan = held.scan
        pose, disagrees = _settled_dispute(pose, held.online)
        if not sees_tilt(scan.points):
            pose = on_the_road(pose, self._map.near(pose.T_map_vehicle[:3, 3]), self.parameters.registration)
        sweep = self._motion.trajectory(scan.t_ns, scan.end_ns) if held.sweep is None else held.sweep
        ends, starts = scan.placed(sweep, self.T_vehicle_lidar, held.t_ns, pose.T_map_vehicle)
        pose = replace(pose, covariance=pose.covariance + self._distorted(held.t_ns, held.unsure))
        estimate = replace(_estimate(self._trimmed(pose), held), disagrees=disagrees)
        if disagrees and not pose.certain and estimate.health == "good":
            estimate = replace(estimate, health="degraded", cause="disputed")
        return RefinedScan(held.t_ns, ends, starts, estimate)

    def _distorted(self, t_ns: int, unsure: F64) -> F64:
        """(6, 6) what motion that is left in a sweep, and a mount that is certainly tilted, add to a pose: all points
        agree on a wrong one. `unsure`: (3,) variance of the sweep's motion, beside what is known of its times.
        """
        variance = np.diag(_left_in(unsure)).copy()
        if self._distortion is not None and len(self._motion):
            before = self._motion.delta(t_ns - SWEPT_NS, t_ns)
            dt_s = SWEPT_NS * 1e-9
            sigma = self._distortion(before[0, 3] / dt_s, float(np.arctan2(before[1, 0], before[0, 0])) / dt_s)
            variance[[3, 4, 2]] += np.square(sigma) * POSE_SHARE**2
        tilt, height_m = self._teacher.mount.residual, self.T_vehicle_lidar[2, 3]
        if "pitch" in tilt.doubtful:
            variance[3] += (height_m * tilt.pitch_rad) ** 2
        if "roll" in tilt.doubtful:
            variance[4] += (height_m * tilt.roll_rad) ** 2
        return np.diag(variance)

    def _trimmed(self, pose: SmoothedPose) -> SmoothedPose:
        """The pose with the heading that the rear axle drives along: what the LiDAR's mount is turned by is taken out
        of it. The points stay where the mount as told puts them, which is how they were matched. The covariance holds
        what neither scans nor map can know of the mount.
        """
        turned_rad = self._teacher.trim_rad if self.parameters.refine.enabled else 0.0
        turn = T_from_R_t(exp_so3(np.array([0.0, 0.0, turned_rad])), np.zeros(3))
        yaw_rad, scale = COURSE_RAD if turned_rad else MOUNTED_RAD, np.ones(6)
        if turned_rad and pose.axle_variance is not None:
            yaw_rad, scale[2] = TRIMMED_RAD, np.sqrt(pose.axle_variance / pose.covariance[2, 2])
        variance = np.array([0.0, 0.0, yaw_rad, MOUNTED_M, MOUNTED_M, 0.0]) ** 2
        covariance = scale[:, None] * pose.covariance * scale + np.diag(variance)
        return replace(pose, T_map_vehicle=pose.T_map_vehicle @ turn, covariance=covariance)

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
            sweep = self._motion.trajectory(scan.t_ns, _end_ns(scan))
        offset_ns = scan.t_offset_ns[chosen]
        return deskew(points_lidar_m, offset_ns, scan.t_ns, sweep, self.T_vehicle_lidar, _reference_ns(scan))

    def _take_ready(self) -> Iterator[RefinedScan]:
        while self._ready:
            yield self._refined(*self._ready.popleft())


def _end_ns(scan: Scan) -> int:
    """Time of the last point."""
    return scan.t_ns + int(scan.t_offset_ns.max(initial=0))


def _reference_ns(scan: Scan) -> int:
    """The middle of the sweep: what the motion is wrong by is shared by both halves."""
    return (scan.t_ns + _end_ns(scan)) // 2


def _unsure(T_driven: F64, seen: ScanStep | None, share: float) -> F64:
    """(3,) variance, forward, left and in yaw, of a sweep's motion that was taken off its points: what wheels and gyro
    (4, 4) differ from the scans by since the scan before, more than scans are uncertain; a sweep is a `share` of that.
    """
    if seen is None:
        return SURE
    off = log_se3(T_inverse(T_driven) @ seen.T_before_now)
    return np.asarray(np.maximum(off**2 - np.diag(seen.covariance), 0.0)[[3, 4, 2]] * min(share, 1.0) ** 2)


def _left_in(unsure: F64) -> F64:
    """(6, 6) what that does to a pose: points were measured at any time of the sweep, and its middle is right."""
    variance = np.zeros(6)
    variance[[3, 4, 2]] = unsure * POSE_SHARE**2 / 12.0
    return np.diag(variance)


def _settled_dispute(refined: SmoothedPose, online: SmoothedPose) -> tuple[SmoothedPose, bool]:
    """The refined pose, or the online one where they lie farther apart than both are uncertain and the stretch has not
    fitted well for long: then what both say is in doubt, and the covariance holds the other one, too.
    """
    off = log_se3(T_inverse(online.T_map_vehicle) @ refined.T_map_vehicle)
    horizontal = off[[2, 3, 4]]
    both = (refined.covariance + online.covariance)[np.ix_([2, 3, 4], [2, 3, 4])] + np.diag(DISPUTED_VARIANCE)
    if float(horizontal @ np.linalg.solve(both, horizontal)) < DISPUTED_CHI2:
        return refined, False
    if refined.certain:
        return refined, True
    return replace(online, covariance=online.covariance + np.outer(off, off), certain=False), True


def _sigmas(pose: SmoothedPose) -> tuple[float, float]:
    """The larger horizontal one-sigma axis [m], and that of the heading [rad]."""
    R, covariance = pose.T_map_vehicle[:3, :3], pose.covariance
    horizontal = (R @ covariance[3:, 3:] @ R.T)[:2, :2]
    return float(np.sqrt(np.linalg.eigvalsh(horizontal)[1])), float(np.sqrt(covariance[2, 2]))


def _estimate(pose: SmoothedPose, held: _HeldScan) -> PoseEstimate:
    sigma_m, sigma_rad = _sigmas(pose)
    overruled = pose.certain and held.health != "good" and held.cause in OVERRULED
    return PoseEstimate(
        t_ns=pose.t_ns,
        T_map_vehicle=pose.T_map_vehicle,
        sigma_m=sigma_m,
        sigma_rad=sigma_rad,
        matching_ratio=held.matching_ratio,
        health="good" if overruled else held.health,
        cause="stale_map" if overruled else held.cause,
        degenerate=held.degenerate,
        covariance=pose.covariance,
    )
