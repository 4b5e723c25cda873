"""What messages of ROS 2 measure, by the rules of the import: the same bytes give the same values."""

import math
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.vehicle_agent.importers.cleaning import cleaned
from gnd.vehicle_agent.importers.fields import TimeRule, scan_of_fields, time_rule, times_of
from gnd.vehicle_agent.importers.point_cloud2 import decode_cloud
from gnd.vehicle_agent.importers.ros.small_messages import TWIST, fixes_of_topic
from gnd.vehicle_agent.sources.live import LiveError
from gnd.vehicle_agent.sources.ros2_messages import FIX, IMU, ODOMETRY, decode, stamp_of

MOVED_M: Final = 1.0
STALE_NS: Final = 200_000_000
"""A gyro's rate this far from a speed says nothing about it."""


class RosScans:
    """Sweeps out of PointCloud2; how the times of points are counted, the first sweep with points tells.

    Attributes:
        frame: of the first cloud.
        rule: how times are read; its `field` is None where the clouds tell none.
        shift_ns: from a cloud's stamp to the beginning of its sweep.
    """

    def __init__(self, where: str, first: bytes) -> None:
        cloud = decode_cloud(where, first)
        self._where, self.frame = where, cloud.frame_id.lstrip("/")
        self.rule: TimeRule = time_rule(cloud.points)
        self.shift_ns = 0
        if self.rule.field is not None and len(cloud.points):
            self.shift_ns = times_of(cloud.points[self.rule.field], cloud.stamp_ns, self.rule)[0] - cloud.stamp_ns

    def scan(self, data: bytes) -> Scan | None:
        """The sweep of a PointCloud2; None where it has no point that can be.

        Raises:
            ImportDriveError: cut off, or no cloud.
        """
        cloud = decode_cloud(self._where, data)
        return cleaned(scan_of_fields(cloud.points, cloud.stamp_ns, self.rule)).scan


def fix_of_message(data: bytes) -> GnssFix | None:
    """The position of a NavSatFix, None while the receiver has none."""
    fix = decode(FIX, data)
    found, _ = fixes_of_topic([(stamp_of(fix), fix)])
    return found[0] if found else None


class RosMotion:
    """Speed and yaw rate out of the twists of one topic; the yaw rate of a gyro where one is named.

    Args:
        kind: Odometry, TwistStamped or TwistWithCovarianceStamped.
        R_vehicle_imu: (3, 3) how the gyro is turned in the vehicle; None: there is none.
    """

    def __init__(self, kind: str, R_vehicle_imu: F64 | None = None) -> None:
        self._kind, self._R = kind, R_vehicle_imu
        self._gyro: tuple[int, float] | None = None
        self._speed: tuple[int, float] | None = None
        self._began_at: Any = None
        """Position of the first odometry, until a speed was not zero."""
        self._has_speed = kind != ODOMETRY

    def twist(self, data: bytes) -> MotionSample | None:
        """Take a message with a twist; with a gyro its sample comes with the gyro's next one.

        Raises:
            LiveError: an odometry's twist is zero although its poses move: it does not fill it.
        """
        message: Any = decode(self._kind, data)
        twist = message.twist if self._kind == TWIST else message.twist.twist
        speed_mps, t_ns = float(twist.linear.x), stamp_of(message)
        self._has_speed = self._has_speed or speed_mps != 0.0
        if not self._has_speed:
            self._check_stands(message.pose.pose.position)
        if self._R is None:
            return MotionSample(t_ns, speed_mps, float(twist.angular.z))
        self._speed = t_ns, speed_mps
        return None

    def _check_stands(self, position: Any) -> None:
        self._began_at = self._began_at or position
        way_m = math.hypot(position.x - self._began_at.x, position.y - self._began_at.y)
        if way_m > MOVED_M:
            raise LiveError(
                f"the odometry's twist is zero although its poses have moved by {way_m:.1f} m: it does not tell the"
                " speed; choose another topic with --set live.speed=/TOPIC"
            )

    def gyro(self, data: bytes) -> MotionSample | None:
        """Take an Imu: the speed before it gets the rate at its time, between this sample and the one before."""
        message = decode(IMU, data)
        rate = message.angular_velocity
        before, now_ns = self._gyro, stamp_of(message)
        rate_radps = 0.0 if self._R is None else float(self._R[2] @ [rate.x, rate.y, rate.z])
        self._gyro = now_ns, rate_radps
        if self._speed is None or now_ns < self._speed[0]:
            return None
        (t_ns, speed_mps), self._speed = self._speed, None
        if before is None or now_ns - before[0] > STALE_NS:
            return None  # nobody knows how the vehicle turned then
        between = np.interp(t_ns, [before[0], now_ns], [before[1], rate_radps])
        return MotionSample(t_ns, speed_mps, float(between))
