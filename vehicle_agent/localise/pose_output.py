"""From tracked poses to those that leave the localiser: of the vehicle as it lies under its mount, with the mount's
own uncertainty.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse
from gnd.vehicle_agent.localise.calibration import MotionTeacher
from gnd.vehicle_agent.localise.estimates import Cause, Health, PoseEstimate, RefinedScan
from gnd.vehicle_agent.localise.graph import SmoothedPose
from gnd.vehicle_agent.localise.held_scan import HeldScan, estimate_of, settled_dispute
from gnd.vehicle_agent.localise.level import sees_tilt
from gnd.vehicle_agent.localise.map_matcher import MapMatcher
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.remount import lever_covariance
from gnd.vehicle_agent.localise.sweep import Sweeps

_MOUNTED_M: Final = 0.003
_MOUNTED_RAD: Final = np.radians(0.02)
_TRIMMED_RAD: Final = np.radians(0.004)
"""One sigma of a mount that is as the header has it: position and yaw; and of the axle's own course (tyres, camber of
the road) once that gives the yaw. All scans share it.
"""
_COURSE_RAD: Final = np.radians(0.012)
"""One sigma of the course where a pose's own covariance does not hold it: that of online poses."""


class PoseOutput:
    """Makes estimates and final scans of tracked poses.

    Args:
        motion, teacher, sweeps, matcher: of the drive.
        submaps: whether poses are refined in submaps: only these teach the course finely enough to trim the heading.
    """

    def __init__(
        self, motion: MotionBuffer, teacher: MotionTeacher, sweeps: Sweeps, matcher: MapMatcher, *, submaps: bool
    ) -> None:
        self._motion, self._teacher, self._sweeps, self._matcher = motion, teacher, sweeps, matcher
        self._mounting, self._submaps = teacher.mount, submaps

    def tracked(self, T_map_vehicle: F64) -> F64:
        """Return a pose (4, 4) of the vehicle in the axes of the mount in use, as it is tracked."""
        return T_map_vehicle @ T_inverse(self._mounting.T_used_vehicle(-self._trim_rad))

    def judged(self, health: Health, cause: Cause) -> tuple[Health, Cause]:
        """Return health and cause with what is known of the mount by now."""
        return self._teacher.doubted(health, cause, trimmed=self._submaps)

    def online(self, held: HeldScan) -> PoseEstimate:
        """Return the estimate of a scan's online pose."""
        return estimate_of(self._of_vehicle(held.online), held)

    def final(self, held: HeldScan, pose: SmoothedPose) -> RefinedScan:
        """Return a scan placed at its final pose."""
        scan = held.scan
        pose, disagrees = settled_dispute(pose, held.online)
        if not sees_tilt(scan.points):
            pose = self._matcher.on_the_road(pose)
        sweep = self._motion.trajectory(scan.t_ns, scan.end_ns) if held.sweep is None else held.sweep
        rays = scan.placed(sweep, self._mounting.T_used, held.t_ns, pose.T_map_vehicle)
        pose = replace(pose, covariance=pose.covariance + self._sweeps.pose_covariance(held.t_ns, held.unsure))
        estimate = estimate_of(self._of_vehicle(pose), held)
        health, cause = estimate.health, estimate.cause
        if held.cause == "mount":  # the scan came before the mount was known
            health, cause = "good", "none"
        health, cause = self.judged(health, cause)
        if disagrees and not pose.certain and health == "good":
            health, cause = "degraded", "disputed"
        return RefinedScan(held.t_ns, rays, replace(estimate, health=health, cause=cause, disagrees=disagrees))

    @property
    def _trim_rad(self) -> float:
        return self._teacher.trim_rad if self._submaps else self._teacher.header_trim_rad

    def _of_vehicle(self, pose: SmoothedPose) -> SmoothedPose:
        """Return the pose of the vehicle from a tracked one: the LiDAR stays where it is, the heading is that in which
        the rear axle drives. The covariance gains what is not known of the mount, with its lever arm.
        """
        trim_rad, scale = self._trim_rad, np.ones(6)
        least_rad = _COURSE_RAD if trim_rad else _MOUNTED_RAD
        if trim_rad and pose.axle_variance is not None:
            least_rad, scale[2] = _TRIMMED_RAD, np.sqrt(pose.axle_variance / pose.covariance[2, 2])
        T = pose.T_map_vehicle @ self._mounting.T_used_vehicle(-trim_rad)
        place = np.diag(np.array([0.0, 0.0, 0.0, _MOUNTED_M, _MOUNTED_M, 0.0]) ** 2)
        variance = np.append(self._mounting.tilt_variance_rad2(), self._teacher.yaw_sigma_rad(trim_rad, least_rad) ** 2)
        mounted = place + lever_covariance(self._mounting.T_vehicle_lidar()[:3, 3], variance)
        return replace(pose, T_map_vehicle=T, covariance=scale[:, None] * pose.covariance * scale + mounted)
