"""MCAP files with ROS 2 clouds, written by Foxglove's own encoder: an oracle that shares nothing with our reader."""

from pathlib import Path
from typing import IO

import numpy as np
from mcap_ros2.writer import Writer

MSGDEF = """std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
"""
KINDS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
SECOND = 1_000_000_000


def message_of(points: np.ndarray, stamp_ns: int, height: int = 1, padding: int = 0) -> dict:
    """A PointCloud2 of a structured array (N,); `padding` bytes after each row."""
    dtype, width = points.dtype, len(points) // height
    fields = [
        {"name": name, "offset": offset, "datatype": KINDS[kind.str[1:]], "count": 1}
        for name, (kind, offset) in dtype.fields.items()
    ]
    rows = np.zeros((height, width * dtype.itemsize + padding), np.uint8)
    rows[:, : width * dtype.itemsize] = np.frombuffer(points.tobytes(), np.uint8).reshape(height, -1)
    return {
        "header": {"stamp": {"sec": stamp_ns // SECOND, "nanosec": stamp_ns % SECOND}, "frame_id": "velodyne"},
        "height": height,
        "width": width,
        "fields": fields,
        "is_bigendian": any(kind.str[0] == ">" for kind, _ in dtype.fields.values()),
        "point_step": dtype.itemsize,
        "row_step": rows.shape[1],
        "data": rows.tobytes(),
        "is_dense": False,
    }


def write_ros(path: Path, clouds: list[tuple[str, int, dict]]) -> Path:
    """Clouds as (topic, log time, message)."""
    with path.open("wb") as stream:
        write_clouds(stream, clouds)
    return path


def write_clouds(stream: IO[bytes], clouds: list[tuple[str, int, dict]]) -> None:
    """The same into a stream."""
    writer = Writer(stream, chunk_size=200_000)
    schema = writer.register_msgdef("sensor_msgs/msg/PointCloud2", MSGDEF)
    for topic, log_ns, message in clouds:
        writer.write_message(topic, schema, message, log_time=log_ns, publish_time=log_ns)
    writer.finish()


def packed(points: np.ndarray, order: str = "<") -> np.ndarray:
    """(N,) x, y, z, intensity, ring, time of points (N, 3), as Velodyne's driver lays them out."""
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("ring", "u2"), ("time", "f4")]
    out = np.zeros(len(points), np.dtype([(name, order + kind) for name, kind in fields]))
    for axis, name in enumerate("xyz"):
        out[name] = points[:, axis]
    out["ring"], out["time"] = np.arange(len(points)) % 16, np.linspace(-0.05, 0.05, len(points))
    return out
