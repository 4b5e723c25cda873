"""ROS 2 bags of clouds, fixes, odometry and mounts, written with `rosbags`."""

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import CompressionFormat, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

SECOND = 1_000_000_000
STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def message(kind: str, **fields):
    return TYPES[kind](**fields)


def header(stamp_ns: int, frame: str):
    stamp = message("builtin_interfaces/msg/Time", sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def cloud(points: np.ndarray, stamp_ns: int, frame: str = "lidar"):
    """PointCloud2 of a structured array."""
    fields = [
        message("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=CODES[kind.str[1:]], count=1)
        for name, (kind, offset) in points.dtype.fields.items()
    ]
    return message(
        "sensor_msgs/msg/PointCloud2", header=header(stamp_ns, frame), height=1, width=len(points), fields=fields,
        is_bigendian=False, point_step=points.dtype.itemsize, row_step=points.nbytes,
        data=np.frombuffer(points.tobytes(), np.uint8), is_dense=True,
    )  # fmt: skip


def fix(stamp_ns: int, place, sigma_m: float, status: int = 0, frame: str = "gnss", known: int = 2):
    """NavSatFix at (latitude, longitude in degrees, height)."""
    service = message("sensor_msgs/msg/NavSatStatus", status=status, service=1)
    return message(
        "sensor_msgs/msg/NavSatFix", header=header(stamp_ns, frame), status=service, latitude=place[0],
        longitude=place[1], altitude=place[2], position_covariance=np.diag([sigma_m**2] * 3).ravel(),
        position_covariance_type=known,
    )  # fmt: skip


def vector(x: float, y: float, z: float, kind: str = "Vector3"):
    return message(f"geometry_msgs/msg/{kind}", x=float(x), y=float(y), z=float(z))


def quaternion(q=(0.0, 0.0, 0.0, 1.0)):
    return message("geometry_msgs/msg/Quaternion", x=float(q[0]), y=float(q[1]), z=float(q[2]), w=float(q[3]))


def odometry(stamp_ns: int, p, q, speed: float, rate: float, child: str = "base_link"):
    pose = message("geometry_msgs/msg/Pose", position=vector(*p, kind="Point"), orientation=quaternion(q))
    twist = message("geometry_msgs/msg/Twist", linear=vector(speed, 0, 0), angular=vector(0, 0, rate))
    zeros = np.zeros(36)
    return message(
        "nav_msgs/msg/Odometry", header=header(stamp_ns, "odom"), child_frame_id=child,
        pose=message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=zeros),
        twist=message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=zeros),
    )  # fmt: skip


def imu(stamp_ns: int, rate, frame: str = "imu"):
    nine = np.zeros(9)
    return message(
        "sensor_msgs/msg/Imu", header=header(stamp_ns, frame), orientation=quaternion(), orientation_covariance=nine,
        angular_velocity=vector(*rate), angular_velocity_covariance=nine, linear_acceleration=vector(0, 0, 9.81),
        linear_acceleration_covariance=nine,
    )  # fmt: skip


def transforms(stamp_ns: int, *edges):
    """TFMessage of (parent, child, position, quaternion)."""
    made = [
        message(
            "geometry_msgs/msg/TransformStamped",
            header=header(stamp_ns, parent),
            child_frame_id=child,
            transform=message("geometry_msgs/msg/Transform", translation=vector(*p), rotation=quaternion(q)),
        )
        for parent, child, p, q in edges
    ]
    return message("tf2_msgs/msg/TFMessage", transforms=made)


def write_bag(path: Path, messages, storage: str = "mcap", compression=None) -> Path:
    """A bag of (topic, log time, message), in this order."""
    plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage]
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, log_ns, content in messages:
            kind = content.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], log_ns, STORE.serialize_cdr(content, kind))
    return path
