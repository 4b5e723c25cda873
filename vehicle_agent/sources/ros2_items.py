"""What messages of ROS 2 measure: sweeps, positions, wheel speed and yaw rate, and where the LiDAR is mounted."""

import math
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.vehicle_agent.importers.cleaning import cleaned
from gnd.vehicle_agent.importers.fields import TIME_FIELDS, scan_of_fields
from gnd.vehicle_agent.importers.point_cloud2 import decode_cloud
from gnd.vehicle_agent.sources.ros2_messages import (
    FIX,
    IMU,
    ODOMETRY,
    BadRosMessage,
    T_of_transform,
    decode,
    stamp_of,
)

SIGMA_UNKNOWN_M: Final = 10.0
"""Of a position whose covariance the receiver does not know."""
_NO_FIX: Final = -1  # sensor_msgs/NavSatStatus
_UNKNOWN_COVARIANCE: Final = 0  # sensor_msgs/NavSatFix


def scan_of_message(where: str, data: bytes) -> Scan | None:
    """The sweep of a PointCloud2; None where it has no point that can be."""
    cloud = decode_cloud(where, data)
    return cleaned(scan_of_fields(cloud.points, cloud.stamp_ns)).scan


def has_point_times(where: str, data: bytes) -> bool:
    """Whether a PointCloud2 tells the time of each point."""
    return not set(TIME_FIELDS).isdisjoint(decode_cloud(where, data).points.dtype.names or ())


def fix_of_message(data: bytes) -> GnssFix | None:
    """The position of a NavSatFix, None while the receiver has none; sigma is that of its worst axis."""
    fix = decode(FIX, data)
    values = fix.latitude, fix.longitude, fix.altitude
    if fix.status.status <= _NO_FIX or not all(map(math.isfinite, values)):
        return None
    worst = float(np.max(fix.position_covariance.reshape(3, 3).diagonal()))
    known = fix.position_covariance_type != _UNKNOWN_COVARIANCE and 0 < worst < math.inf
    sigma_m = math.sqrt(worst) if known else SIGMA_UNKNOWN_M
    return GnssFix(stamp_of(fix), math.radians(values[0]), math.radians(values[1]), values[2], sigma_m)


class RosMotion:
    """Wheel speed and yaw rate out of an odometry's twist and, where there is one, a gyro.

    Without a gyro each odometry message is a sample. With one each of its messages is: with the newest speed, and the
    rate about the vehicle's vertical.

    Args:
        gyro: whether an Imu gives the yaw rate.
        R_vehicle_imu: (3, 3) how the gyro is turned in the vehicle.
    """

    def __init__(self, *, gyro: bool, R_vehicle_imu: F64 | None = None) -> None:
        self._gyro = gyro
        self._up_imu = np.array([0.0, 0.0, 1.0]) if R_vehicle_imu is None else R_vehicle_imu[2]
        self._speed_mps: float | None = None

    def odometry(self, data: bytes) -> MotionSample | None:
        """Take an Odometry."""
        message = decode(ODOMETRY, data)
        twist = message.twist.twist
        self._speed_mps = float(twist.linear.x)
        return None if self._gyro else MotionSample(stamp_of(message), self._speed_mps, float(twist.angular.z))

    def imu(self, data: bytes) -> MotionSample | None:
        """Take an Imu; None until a speed is known."""
        message = decode(IMU, data)
        if self._speed_mps is None:
            return None
        rate = message.angular_velocity
        yaw_rate = float(self._up_imu @ [rate.x, rate.y, rate.z])
        return MotionSample(stamp_of(message), self._speed_mps, yaw_rate)


def stamped_transforms(message: Any) -> Iterable[tuple[str, str, F64]]:
    """Parent, child and (4, 4) T_parent_child of a TFMessage's transforms."""
    for one in message.transforms:
        yield one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/"), T_of_transform(one.transform)


def T_between(transforms: Mapping[str, tuple[str, F64]], ancestor: str, frame: str) -> F64 | None:
    """(4, 4) T_ancestor_frame along a tree of static transforms; None where it does not lead there.

    Args:
        transforms: by child: its parent, and T_parent_child.
        ancestor: such as "base_link"; either of the two frames may be above the other, or both below a third.
        frame: such as "lidar".

    Raises:
        BadRosMessage: the transforms go round in a circle.
    """
    up_ancestor, up_frame = _to_root(transforms, ancestor), _to_root(transforms, frame)
    shared = next((name for name in up_frame if name in up_ancestor), None)
    return None if shared is None else T_inverse(up_ancestor[shared]) @ up_frame[shared]


def _to_root(transforms: Mapping[str, tuple[str, F64]], frame: str) -> dict[str, F64]:
    """T_above_frame for a frame and all above it, nearest first."""
    found, T = {frame: np.eye(4)}, np.eye(4)
    while frame in transforms:
        frame, T_parent_child = transforms[frame]
        if frame in found:
            raise BadRosMessage(f"the static transforms go round in a circle at {frame!r}")
        T = T_parent_child @ T
        found[frame] = T
    return found
