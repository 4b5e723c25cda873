"""Messages of ROS 2 in and out of CDR, by the definitions that `rosbags` brings: no ROS needs to be installed."""

from collections.abc import Mapping
from functools import cache
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import quaternion_xyzw_from_R
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.vehicle_agent.errors import VehicleError
from gnd.vehicle_agent.importers import point_cloud2
from gnd.vehicle_agent.importers.optional import library
from gnd.vehicle_agent.importers.ros import small_messages

CLOUD: Final = point_cloud2.SCHEMA
IMU: Final = small_messages.IMU
FIX: Final = small_messages.NAV_SAT_FIX
ODOMETRY: Final = small_messages.ODOMETRY
TRANSFORMS: Final = small_messages.TF
POSE: Final = small_messages.POSE_COVARIANCE
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
NS_PER_S: Final = 1_000_000_000
_FIELD_CODES: Final = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}  # sensor_msgs/PointField
_KNOWN_DIAGONAL: Final = 2  # sensor_msgs/NavSatFix


class BadRosMessage(VehicleError):
    """Bytes that are no message of their type, or one that cannot be used."""


@cache
def type_store() -> Any:
    """The types that are known, by `rosbags`; MissingExtra: it is not installed."""
    types = library("rosbags.typesys", "ros")
    return types.get_typestore(types.Stores.ROS2_JAZZY)


def type_hash(type_name: str) -> str:
    """The hash of a type (REP 2016), such as "RIHS01_df66…", by which rmw_zenoh keys it."""
    return str(type_store().hash_rihs01(type_name))


def decode(type_name: str, cdr: bytes) -> Any:
    """A message with the fields of its definition.

    Raises:
        BadRosMessage: cut off, or bytes of something else.
    """
    try:
        return type_store().deserialize_cdr(cdr, type_name)
    except Exception as error:  # the library raises what its generated code meets: IndexError, struct.error, ...
        raise BadRosMessage(f"{len(cdr)} bytes are no {type_name}: {error}") from error


def encode(type_name: str, values: Mapping[str, Any]) -> bytes:
    """CDR of a message; fields that `values` leaves out are zero or empty.

    Args:
        type_name: such as `FIX`.
        values: by field; of a message in the message again a mapping, of several a list of them.
    """
    return bytes(type_store().serialize_cdr(_filled(type_name, values), type_name))


def _filled(type_name: str, values: Mapping[str, Any]) -> SimpleNamespace:
    fields = type_store().fielddefs[type_name][1]
    unknown = set(values) - {name for name, _ in fields}
    if unknown:
        raise BadRosMessage(f"{type_name} has no field {', '.join(sorted(unknown))}")
    return SimpleNamespace(**{name: _value(kind, values.get(name)) for name, kind in fields})


def _value(kind: tuple[Any, Any], value: Any) -> Any:
    """A field's value as the serialiser wants it, zero where there is none."""
    what, of = kind[0].name, kind[1]
    if what == "NAME":
        return _filled(of, value or {})
    if what == "BASE":
        return ("" if of[0] == "string" else 0) if value is None else value
    element, count = of
    if element[0].name == "NAME":
        return [_filled(element[1], one) for one in value or []]
    if element[1][0] == "string":
        return list(value or [])
    dtype = np.dtype(element[1][0].replace("octet", "uint8"))
    return np.zeros(count if what == "ARRAY" else 0, dtype) if value is None else np.ascontiguousarray(value, dtype)


def stamp_of(message: Any) -> int:
    """Time of a message's header, ns."""
    return int(message.header.stamp.sec) * NS_PER_S + int(message.header.stamp.nanosec)


def header(t_ns: int, frame_id: str) -> dict[str, Any]:
    """A header for `encode`."""
    return {"stamp": {"sec": t_ns // NS_PER_S, "nanosec": t_ns % NS_PER_S}, "frame_id": frame_id}


def cloud_message(t_ns: int, frame_id: str, points: np.ndarray[Any, np.dtype[np.void]]) -> bytes:
    """A PointCloud2 of packed points: (N,) structured, each field one number."""
    return encode(CLOUD, cloud_values(t_ns, frame_id, points))


def cloud_values(t_ns: int, frame_id: str, points: np.ndarray[Any, np.dtype[np.void]]) -> dict[str, Any]:
    """A PointCloud2 for `encode`, of packed points: (N,) structured, each field one number."""
    dtype = points.dtype
    fields = [
        {"name": name, "offset": dtype.fields[name][1], "datatype": _FIELD_CODES[dtype[name].str[1:]], "count": 1}
        for name in dtype.names or ()
        if dtype.fields is not None
    ]
    return {
        "header": header(t_ns, frame_id),
        "height": 1,
        "width": len(points),
        "fields": fields,
        "point_step": dtype.itemsize,
        "row_step": dtype.itemsize * len(points),
        "data": np.frombuffer(points.tobytes(), np.uint8),
        "is_dense": True,
    }


def scan_message(scan: Scan, frame_id: str) -> bytes:
    """A sweep as a PointCloud2 with x, y, z, t (ns after the stamp) and, where it has them, rings."""
    fields: list[tuple[str, str]] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")]
    packed = np.zeros(len(scan), np.dtype([*fields, ("ring", "<u2")] if scan.ring is not None else fields))
    for axis, name in enumerate("xyz"):
        packed[name] = scan.points_m[:, axis]
    packed["t"] = scan.t_offset_ns
    if scan.ring is not None:
        packed["ring"] = scan.ring
    return cloud_message(scan.t_ns, frame_id, packed)


def fix_message(fix: GnssFix, frame_id: str = "gnss") -> bytes:
    """A position as a NavSatFix with its covariance."""
    values = {
        "header": header(fix.t_ns, frame_id),
        "latitude": float(np.degrees(fix.lat_rad)),
        "longitude": float(np.degrees(fix.lon_rad)),
        "altitude": fix.height_m,
        "position_covariance": np.eye(3).ravel() * fix.sigma_m**2,
        "position_covariance_type": _KNOWN_DIAGONAL,
    }
    return encode(FIX, values)


def motion_message(sample: MotionSample, vehicle_frame: str) -> bytes:
    """Wheel speed and yaw rate as the twist of an Odometry, whose pose is left open."""
    twist = {"linear": {"x": sample.speed_mps}, "angular": {"z": sample.yaw_rate_radps}}
    values = {"header": header(sample.t_ns, "odom"), "child_frame_id": vehicle_frame, "twist": {"twist": twist}}
    return encode(ODOMETRY, values | {"pose": {"covariance": np.diag([-1.0, *[0.0] * 5]).ravel()}})


def transform_message(t_ns: int, parent: str, child: str, T_parent_child: F64) -> bytes:
    """One transform as a TFMessage."""
    one = {"header": header(t_ns, parent), "child_frame_id": child, "transform": _transform(T_parent_child)}
    return encode(TRANSFORMS, {"transforms": [one]})


def pose_message(t_ns: int, frame_id: str, T_frame_vehicle: F64, covariance: F64) -> bytes:
    """A pose with its covariance.

    Args:
        t_ns: of the pose.
        frame_id: in which it is given.
        T_frame_vehicle: (4, 4).
        covariance: (6, 6) of x, y, z in m and rotation about x, y, z of the frame in rad.
    """
    moved = _transform(T_frame_vehicle)
    pose = {"position": moved["translation"], "orientation": moved["rotation"]}
    values = {"header": header(t_ns, frame_id), "pose": {"pose": pose, "covariance": covariance.ravel()}}
    return encode(POSE, values)


def _transform(T: F64) -> dict[str, dict[str, float]]:
    turned = quaternion_xyzw_from_R(T[:3, :3])
    return {
        "translation": dict(zip("xyz", map(float, T[:3, 3]), strict=True)),
        "rotation": dict(zip("xyzw", map(float, turned), strict=True)),
    }
