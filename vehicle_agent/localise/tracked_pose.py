"""The pose while it is known: predict, match, gate, fuse, scan by scan (GND, 3 (ii))."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import GnssFix
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.arbiter import ArbitratedMotion, Wrong, believing_neither, who_is_wrong
from gnd.vehicle_agent.localise.calibration import MotionTeacher
from gnd.vehicle_agent.localise.co_moving import CoMoving
from gnd.vehicle_agent.localise.consistency import Innovations
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from gnd.vehicle_agent.localise.first_pose import SearchPlace
from gnd.vehicle_agent.localise.graph import MapMatch, OdometryEdge, PoseGraph, Position, SmoothedPose
from gnd.vehicle_agent.localise.health import CAUSE_POOR_SIGMA_M
from gnd.vehicle_agent.localise.held_scan import HeldScan, sigmas_of
from gnd.vehicle_agent.localise.judge import Judge, Matched
from gnd.vehicle_agent.localise.level import sees_tilt
from gnd.vehicle_agent.localise.map_matcher import MapMatcher
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.packed_scan import pack
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.localise.pose_output import PoseOutput
from gnd.vehicle_agent.localise.refine import Refiner
from gnd.vehicle_agent.localise.registration import RegistrationResult
from gnd.vehicle_agent.localise.remount import Mounting
from gnd.vehicle_agent.localise.scan_odometry import JointStep, ScanOdometry, ScanStep, joint_step
from gnd.vehicle_agent.localise.sweep import (
    SURE,
    Distortion,
    SampledScan,
    Sweeps,
    end_ns,
    left_in_sweep,
    sweep_variance,
)

_TEACHING_FIT: Final = 0.75
"""Least fit of a match from which odometry is learnt: where much has changed, matches are off together."""
MAX_GNSS_AGE_NS: Final = 2_000_000_000
_COMPARE_MS: Final = 36.0
_SEARCH_MS: Final = 13.0
_SOLVE_MS: Final = 22.0
"""How long it takes to compare the pose with others, to search rivals, and to solve the stretch."""

FinalScan = tuple[HeldScan, SmoothedPose]
"""A scan and its final pose, in the axes of the mount in use."""


class DriveState:
    """What outlives a track: the sensors as learnt, the mount in use, scan-to-scan odometry, the map.

    Attributes:
        motion: of wheels and gyro, with what `teacher` has learnt of them.
        co_moving: what travels along with the vehicle.
        innovations: of believed matches against the prediction (NIS).
    """

    def __init__(
        self, local_map: LocalMap, parameters: LocaliserParameters, mounting: Mounting, distortion: Distortion | None
    ) -> None:
        noise_m = parameters.registration.noise_m
        self.local_map, self.parameters, self.mounting = local_map, parameters, mounting
        self.motion = MotionBuffer()
        self.teacher = MotionTeacher(self.motion, mounting)
        self.scan_odometry = ScanOdometry(noise_m)
        self.co_moving = CoMoving(mounting.T_used)
        self.matcher = MapMatcher(MatchMapCache(local_map, noise_m), parameters.registration, mounting)
        self.sweeps = Sweeps(self.motion, mounting, distortion)
        self.output = PoseOutput(
            self.motion, self.teacher, self.sweeps, self.matcher, submaps=parameters.refine.enabled
        )
        self.innovations = Innovations()

    def p_map_m(self, fix: GnssFix) -> F64:
        """Return the position (3,) of a fix in the map frame."""
        frame = self.local_map.grid_frame.frame
        return frame.enu_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m).reshape(3)


@dataclass(frozen=True, slots=True, eq=False)
class _MotionStep:
    """The motion since the scan before.

    Attributes:
        T_driven: (4, 4) by wheels and gyro.
        joint: by wheels, gyro and scans.
        seen: by the scans, where they can be relied on.
        reach: (6,) one sigma of where a match may lie beside the prediction.
        sweep: the motion during the sweep by the scans, where the wheels slip.
        unsure: (3,) variance of the sweep's motion (`sweep_variance`).
    """

    T_driven: F64
    joint: JointStep
    seen: ScanStep | None
    reach: F64
    sweep: Trajectory | None
    unsure: F64


class TrackedPose:
    """One track: from a first pose until it is lost or the drive ends.

    Args:
        drive: what outlives the track.
        scan: the first one.
        first: its pose. A pose from outside has no iterations.
        fit: of that pose among those that were searched.
        place: where GNSS puts the vehicle.

    Attributes:
        judge: judges the pose, scan by scan.
        graph: of the poses in the lag.
        held: scans whose poses are not final, by their number in the graph.
        online: the newest pose.
    """

    def __init__(
        self, drive: DriveState, scan: SampledScan, first: RegistrationResult, fit: float, place: SearchPlace | None
    ) -> None:
        par, t_ns, T = drive.parameters, scan.t_ns, first.T_map_vehicle
        self._drive = drive
        self._wrong: Wrong = "open"  # wheels or scans, since they contradict each other
        covariance, contested = drive.matcher.first(scan.points_m, first)
        self.judge = Judge(par, drive.mounting.T_used[:3, 3], t_ns)
        self._judge_first(scan, first, fit, place, contested=contested)
        self._refiner: Refiner | None = None
        if par.refine.enabled:
            self._refiner = Refiner(par.refine, par.registration, drive.matcher.maps, drive.motion, drive.teacher)
        self.graph = PoseGraph(par.graph)
        self.graph.add(t_ns, T, None, MapMatch(T, covariance), None)
        self.held: dict[int, HeldScan] = {}
        self.online = self._hold(scan, first.matching_ratio, None, SURE)
        if self._refiner is not None:
            self._refine(self._refiner, scan, scan.points_m, None, None)
        drive.scan_odometry.begin(t_ns, scan.points_m)

    def step(self, scan: SampledScan, fix: GnssFix | None) -> list[FinalScan]:
        """Take the next scan, and a GNSS fix that came since the last; return the scans whose poses became final."""
        drive, t_ns, before = self._drive, scan.t_ns, self.held[self.graph.newest]
        step = self._motion_since(before, scan)
        points = scan.points_m if step.sweep is None else drive.sweeps.deskewed(scan.scan, scan.chosen, step.sweep)
        predicted = self.graph.pose(self.graph.newest) @ step.joint.T_before_now
        result, believed = drive.matcher.gated(self.judge.monitor, points, predicted, step.reach, t_ns)
        match = self._learnt_from(result, predicted, before, step, t_ns) if result is not None and believed else None
        T_now = predicted if match is None else match.T_map_vehicle
        gnss = self._position(fix, t_ns, predicted)
        unknown_s = max(drive.motion.unknown_s(before.t_ns, t_ns), drive.motion.age_s(t_ns))
        matched = Matched(
            t_ns, points, step.joint.T_before_now, T_now, result, believed, unknown_s, drive.teacher.clock_cause,
            repeated=scan.repeated,
        )  # fmt: skip
        self.judge.see(matched, drive.matcher.maps.near(T_now[:3, 3]))
        odometry = OdometryEdge(step.T_driven, step.joint.driven_sigmas)
        final = self.graph.add(t_ns, predicted, odometry, match or drive.matcher.by_wheels(predicted), gnss, step.seen)
        self.online = self._hold(scan, 0.0 if result is None else result.matching_ratio, step.sweep, step.unsure)
        if self._refiner is not None:
            final = self._refine(self._refiner, scan, points, step.joint.T_before_now, step.seen)
        return self._taken(final)

    @property
    def seldom_ms(self) -> float:
        """How long that took, as `ScanRoom` counts, which is not done with every scan, but was with the newest: to
        compare the pose with others, to search rivals, to solve the stretch.
        """
        solved = self._refiner is not None and self._refiner.solved
        judge = self.judge
        return _COMPARE_MS * judge.uniqueness.tested + _SEARCH_MS * judge.challenger.searched + _SOLVE_MS * solved

    def flush(self) -> list[FinalScan]:
        """Return the scans that are held, with their poses as they stand."""
        return self._taken(self.graph.flush() if self._refiner is None else self._refiner.flush())

    # --- the motion since the scan before ----------------------------------------------------------------------------

    def _motion_since(self, before: HeldScan, scan: SampledScan) -> _MotionStep:
        drive, t_ns = self._drive, scan.t_ns
        T_driven = drive.motion.delta(before.t_ns, t_ns)
        driven = OdometryEdge(T_driven, drive.teacher.sigmas_between(before.t_ns, t_ns, T_driven))
        seen = self._scan_step(scan, driven)
        joint, reach = joint_step(*driven, seen), self._reach(driven)
        if joint.slipped and seen is not None:
            joint, seen, doubt = self._arbitrated(before, scan, driven, seen)
            reach = np.hypot(reach, doubt)
        else:
            self._wrong = "open"
        drive.teacher.see_step(before.t_ns, t_ns, T_driven, seen, slipped=joint.slipped)
        drive.co_moving.correct(joint.T_before_now)
        sweep = self._sweep_by_scans(scan) if joint.slipped else None
        share = (end_ns(scan.scan) - scan.scan.t_ns) / (t_ns - before.t_ns)
        return _MotionStep(T_driven, joint, seen, reach, sweep, sweep_variance(T_driven, seen, share))

    def _scan_step(self, scan: SampledScan, driven: OdometryEdge) -> ScanStep | None:
        """The motion since the scan before by the scans."""
        drive = self._drive
        if not drive.parameters.scan_odometry.enabled:
            return None

        def points_going_on() -> F64:
            return drive.sweeps.deskewed(scan.scan, scan.chosen, self._sweep_by_scans(scan))

        return drive.scan_odometry.step(scan.t_ns, scan.points_m, *driven, points_going_on)

    def _sweep_by_scans(self, scan: SampledScan) -> Trajectory | None:
        """The motion during the sweep, steady as in the last step between scans; None without one."""
        steady = self._drive.scan_odometry.steady
        return None if steady is None else steady.trajectory(scan.scan.t_ns, end_ns(scan.scan))

    def _reach(self, driven: OdometryEdge) -> F64:
        """(6,) one sigma of where a match may lie: of the motion, and of a pose that is poorly known itself."""
        covariance = self.held[self.graph.newest].online.covariance
        if np.sqrt(np.linalg.eigvalsh(covariance[3:5, 3:5])[1]) < CAUSE_POOR_SIGMA_M:
            return driven.sigmas
        return np.asarray(np.hypot(driven.sigmas, np.sqrt(np.diag(covariance))))

    def _arbitrated(
        self, before: HeldScan, scan: SampledScan, driven: OdometryEdge, seen: ScanStep
    ) -> tuple[JointStep, ScanStep | None, F64]:
        """Wheels and scans contradict each other, and the map is asked: the joint step, the scans' own, and the sigmas
        (6,) that this adds to the motion. Where the scans are wrong, their odometry begins anew.
        """
        drive, points = self._drive, scan.points_m
        T_before, sweep = self.graph.pose(self.graph.newest), self._sweep_by_scans(scan)
        going_on = points if sweep is None else drive.sweeps.deskewed(scan.scan, scan.chosen, sweep)
        starts = ((points, driven.T_before_now), (going_on, seen.T_before_now))
        matches = [drive.matcher.match(some, T_before @ T, "near") for some, T in starts]
        self._wrong = self._who_is_wrong(before, scan.t_ns, driven, seen, [m for m in matches if m is not None])
        if self._wrong == "wheels":
            return joint_step(*driven, seen), seen, np.zeros(6)
        if self._wrong == "scans":
            drive.scan_odometry.begin(scan.t_ns, points)
            return joint_step(*driven, None), None, np.zeros(6)
        joint, unsure = believing_neither(*driven, seen)
        return joint, unsure, joint.driven_sigmas

    def _who_is_wrong(
        self, before: HeldScan, t_ns: int, driven: OdometryEdge, seen: ScanStep, matches: list[RegistrationResult]
    ) -> Wrong:
        by_wheels = ArbitratedMotion(driven.T_before_now, np.diag(np.square(driven.sigmas)))
        by_scans = ArbitratedMotion(seen.T_before_now, seen.covariance)
        T_before, covariance = self.graph.pose(self.graph.newest), before.online.covariance
        wrong = who_is_wrong(T_before, covariance, by_wheels, by_scans, matches)
        if wrong != "open":
            return wrong
        return "wheels" if self._drive.motion.slipped(before.t_ns, t_ns) else self._wrong

    # --- what a match and a fix tell ---------------------------------------------------------------------------------

    def _learnt_from(
        self, result: RegistrationResult, predicted: F64, before: HeldScan, step: _MotionStep, t_ns: int
    ) -> MapMatch:
        """A believed match for the graph; its innovation is counted, and the sensors learn from it."""
        drive = self._drive
        match = MapMatch(result.T_map_vehicle, result.covariance + drive.sweeps.pose_covariance(t_ns, step.unsure))
        covariance = np.diag(np.square(step.joint.driven_sigmas)) + before.online.covariance
        drive.innovations.see(predicted, covariance, *match)
        if step.joint.slipped:
            drive.teacher.forget()
        elif result.fit >= _TEACHING_FIT and not len(result.degenerate):
            drive.teacher.learn(t_ns, result.T_map_vehicle, result.covariance)
        return match

    def _position(self, fix: GnssFix | None, t_ns: int, T_map_vehicle: F64) -> Position | None:
        """A fix as position of the vehicle at `t_ns`; the judge compares it with the pose."""
        if fix is None or abs(t_ns - fix.t_ns) > MAX_GNSS_AGE_NS:
            return None
        at_fix = T_map_vehicle @ self._drive.motion.delta(t_ns, fix.t_ns)
        p_map_m = T_map_vehicle[:3, 3] + (self._drive.p_map_m(fix) - at_fix[:3, 3])
        self.judge.see_position(p_map_m, fix.sigma_m, T_map_vehicle)
        return Position(p_map_m, fix.sigma_m)

    def _judge_first(
        self, scan: SampledScan, first: RegistrationResult, fit: float, place: SearchPlace | None, *, contested: bool
    ) -> None:
        monitor, T = self.judge.monitor, first.T_map_vehicle
        if contested:
            monitor.prove_first()
        monitor.see_match(fit, first.fit, first.degenerate)
        monitor.scans_prove = not self._drive.parameters.refine.enabled or sees_tilt(scan.scan.points_m)
        self.judge.begin(scan.points_m, T, place, self._drive.matcher.maps.near(T[:3, 3]))
        if monitor.trusted:
            self.judge.challenger.rest(scan.t_ns)

    # --- the newest pose, and the final ones -------------------------------------------------------------------------

    def _hold(self, scan: SampledScan, matching_ratio: float, sweep: Trajectory | None, unsure: F64) -> PoseEstimate:
        """Keep the scan until its pose is final; return the estimate of the online pose."""
        number, monitor, output = self.graph.newest, self.judge.monitor, self._drive.output
        pose = self._drifted(self.graph.smoothed(number)[0])
        if self._refiner is not None:
            pose = replace(pose, covariance=self._refiner.as_seen(pose.covariance) + left_in_sweep(unsure))
        monitor.see_sigma(*sigmas_of(pose))
        health, cause = output.judged(*monitor.judge(scan.t_ns))
        packed, degenerate = pack(scan.scan), monitor.degenerate
        held = HeldScan(packed, sweep, scan.t_ns, matching_ratio, health, cause, degenerate, pose, unsure)
        self.held[number] = held
        return output.online(held)

    def _drifted(self, pose: SmoothedPose) -> SmoothedPose:
        """The pose with what the wheel scale may be off by since the map last constrained the place along the way. The
        graph takes the errors of wheels for independent from step to step; that of the scale is not.
        """
        along = np.zeros(6)
        along[3] = (self._drive.teacher.uncertainty[0] * self.judge.uniqueness.unconstrained_m) ** 2
        return replace(pose, covariance=pose.covariance + np.diag(along))

    def _refine(
        self, refiner: Refiner, scan: SampledScan, points_m: F64, T_before_now: F64 | None, seen: ScanStep | None
    ) -> list[SmoothedPose]:
        """Give the scan to the submaps, and correct the online pose by them; return the poses that became final."""
        number, monitor = self.graph.newest, self.judge.monitor
        T_online = self.graph.pose(number)
        refiner.unique = monitor.unique
        final = refiner.push(
            number, scan.t_ns, points_m, T_online, T_before_now, seen, busy=self.judge.uniqueness.tested
        )
        monitor.certain = refiner.certain and not self.judge.uniqueness.beaten
        correction = refiner.correction(T_online)
        if correction is not None:
            self.graph.restart(*correction)
        return final

    def _taken(self, poses: list[SmoothedPose]) -> list[FinalScan]:
        return [(self.held.pop(pose.number), pose) for pose in poses]
