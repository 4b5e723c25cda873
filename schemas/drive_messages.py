"""The values of a drive as Foxglove's well-known protobuf messages (and our own for odometry), encode beside decode.

Foxglove shows them as they are: the point cloud, the position on a map, the pose. Units and frames are Foxglove's:
degrees for positions, a point cloud in the frame `lidar`, quaternions x, y, z, w.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from itertools import pairwise
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import R_from_quaternion_xyzw, T_from_R_t, quaternion_xyzw_from_R
from gnd.schemas import limits
from gnd.schemas.drive import GnssFix, MotionSample, ReferencePose, Scan
from gnd.schemas.errors import BadValue
from gnd.schemas.generated.vehicle_motion_pb2 import VehicleMotion
from gnd.schemas.wire import check_length, refusing

LIDAR_FRAME: Final = "lidar"
VEHICLE_FRAME: Final = "vehicle"
MAP_FRAME: Final = "map"

_NS: Final = 1_000_000_000
_NUMERIC: Final[dict[PackedElementField.NumericType.ValueType, str]] = {
    PackedElementField.UINT8: "u1",
    PackedElementField.INT8: "i1",
    PackedElementField.UINT16: "<u2",
    PackedElementField.INT16: "<i2",
    PackedElementField.UINT32: "<u4",
    PackedElementField.INT32: "<i4",
    PackedElementField.FLOAT32: "<f4",
    PackedElementField.FLOAT64: "<f8",
}
_POINT_FIELDS: Final = (
    ("x", PackedElementField.FLOAT32),
    ("y", PackedElementField.FLOAT32),
    ("z", PackedElementField.FLOAT32),
    ("t_offset", PackedElementField.UINT32),
)
_RING_FIELD: Final = ("ring", PackedElementField.UINT16)

_Layout = tuple[tuple[str, int, PackedElementField.NumericType.ValueType], ...]
"""Name, byte offset and numeric type of each field of a packed point."""


def timestamp_of(t_ns: int) -> Timestamp:
    """Protobuf's time of int ns UTC."""
    return Timestamp(seconds=t_ns // _NS, nanos=t_ns % _NS)


def ns_of(timestamp: Timestamp) -> int:
    """Int ns UTC of protobuf's time."""
    return int(timestamp.seconds) * _NS + int(timestamp.nanos)


def cloud_of(scan: Scan) -> PointCloud:
    """foxglove.PointCloud, points packed x, y, z [m] float32, t_offset [ns] uint32, ring uint16 (where known)."""
    layout = _own_layout(with_ring=scan.ring is not None)
    dtype = _dtype_of(layout, _stride_of(layout))
    packed = np.empty(len(scan), dtype)
    _xyz_view(packed.data, dtype)[:] = scan.points_m
    packed["t_offset"] = scan.t_offset_ns
    if scan.ring is not None:
        packed["ring"] = scan.ring
    return PointCloud(
        timestamp=timestamp_of(scan.t_ns),
        frame_id=LIDAR_FRAME,
        pose=_pose_of(np.eye(4)),
        point_stride=dtype.itemsize,
        fields=(PackedElementField(name=name, offset=offset, type=kind) for name, offset, kind in layout),
        data=packed.tobytes(),
    )


def scan_of(cloud: PointCloud) -> Scan:
    """The scan of a point cloud with float32 x, y, z, a time of each point `t_offset` [ns], and perhaps `ring`.

    Points that are not finite (drivers write NaN for beams without a return) are left out.

    Raises:
        BadValue: fields are missing or do not fit, or the cloud has a pose of its own.
    """
    data, t_ns = cloud.data, ns_of(cloud.timestamp)
    dtype = _dtype_of(tuple((f.name, f.offset, f.type) for f in cloud.fields), cloud.point_stride)
    _check_cloud(cloud, dtype, len(data))
    packed = np.frombuffer(data, dtype)
    # Copied once into rows of their own: packed points are not aligned, and kernels want one layout.
    points = np.ascontiguousarray(_xyz_view(data, dtype))
    finite = np.isfinite(points)
    if not finite.all():
        packed, points = packed[finite.all(axis=1)], points[finite.all(axis=1)]
    return Scan(
        t_ns=t_ns,
        points_m=points,
        t_offset_ns=np.ascontiguousarray(packed["t_offset"]),
        ring=packed["ring"].astype(np.uint16) if "ring" in (dtype.names or ()) else None,
    )


def _xyz_view(data: bytes | memoryview, dtype: np.dtype[np.void]) -> npt.NDArray[np.float32]:
    """(N, 3) view of x, y, z, which lie side by side in every packed point. Of the bytes themselves: numpy would write
    down the layout of an array in words, a letter for every byte that no field has.
    """
    start = dtype.fields["x"][1]  # type: ignore[index]
    n = memoryview(data).nbytes // dtype.itemsize
    return np.ndarray((n, 3), "<f4", data, start, (dtype.itemsize, 4))


def _own_layout(*, with_ring: bool) -> _Layout:
    fields = (*_POINT_FIELDS, _RING_FIELD) if with_ring else _POINT_FIELDS
    offsets = np.cumsum([0, *(np.dtype(_NUMERIC[kind]).itemsize for _, kind in fields)])
    return tuple((name, int(offset), kind) for (name, kind), offset in zip(fields, offsets, strict=False))


def _stride_of(layout: _Layout) -> int:
    _, offset, kind = layout[-1]
    return offset + np.dtype(_NUMERIC[kind]).itemsize


@lru_cache(maxsize=64)
def _dtype_of(layout: _Layout, stride: int) -> np.dtype[np.void]:
    """The numpy type of one packed point; `BadValue` when it cannot be."""
    unknown = [name for name, _, kind in layout if kind not in _NUMERIC]
    if unknown:
        raise BadValue(f"point field {unknown[0]!r} has an unknown numeric type")
    names, offsets, kinds = zip(*layout, strict=True) if layout else ((), (), ())
    with refusing(f"points of {stride} bytes with fields {', '.join(names) or 'none'}"):
        formats = [_NUMERIC[kind] for kind in kinds]
        for name, offset, form in zip(names, offsets, formats, strict=True):
            if offset + np.dtype(form).itemsize > stride:  # beyond 2 GiB numpy takes it, and reads outside the points
                raise BadValue(f"point field {name!r} at byte {offset} lies outside points of {stride} bytes")
        return np.dtype({"names": list(names), "offsets": list(offsets), "formats": formats, "itemsize": stride})


def _check_cloud(cloud: PointCloud, dtype: np.dtype[np.void], size: int) -> None:
    missing = {"x", "y", "z", "t_offset"} - set(dtype.names or ())
    if missing:
        raise BadValue(f"points lack {', '.join(sorted(missing))}; deskewing needs the time of each point")
    _check_types(dtype)
    fields: Mapping[str, Any] = dtype.fields or {}
    spans = sorted((field[1], field[1] + field[0].itemsize) for field in fields.values())
    if any(end > start for (_, end), (start, _) in pairwise(spans)):
        raise BadValue(f"point fields {', '.join(fields)} at bytes {[start for start, _ in spans]} overlap")
    if dtype.itemsize < 1 or size % dtype.itemsize:
        raise BadValue(f"{size} bytes of points are no multiple of the {dtype.itemsize} bytes of a point")
    check_length("point cloud", size // dtype.itemsize, limits.MAX_POINTS_OF_SCAN, "points")
    if cloud.pose != _NO_POSE and not np.allclose(_T_of(cloud.pose), np.eye(4)):
        raise BadValue(f"point cloud has a pose of its own in frame {cloud.frame_id!r}; expected points of the sensor")


def _check_types(dtype: np.dtype[np.void]) -> None:
    fields: Mapping[str, tuple[Any, ...]] = dtype.fields or {}
    x = fields["x"][1]
    expected = {"x": ("<f4", x), "y": ("<f4", x + 4), "z": ("<f4", x + 8), "t_offset": ("<u4", fields["t_offset"][1])}
    for name, (kind, offset) in expected.items():
        found = fields[name][:2]
        if found != (np.dtype(kind), offset):
            raise BadValue(f"point field {name!r} is {found[0]} at byte {found[1]}, expected {kind} at byte {offset}")


def fix_of(fix: GnssFix) -> LocationFix:
    """foxglove.LocationFix: degrees, metres, covariance in m^2 east, north, up."""
    variance = fix.sigma_m**2
    return LocationFix(
        timestamp=timestamp_of(fix.t_ns),
        frame_id=VEHICLE_FRAME,
        latitude=math.degrees(fix.lat_rad),
        longitude=math.degrees(fix.lon_rad),
        altitude=fix.height_m,
        position_covariance=[variance, 0, 0, 0, variance, 0, 0, 0, variance],
        position_covariance_type=LocationFix.DIAGONAL_KNOWN,
    )


def gnss_of(message: LocationFix) -> GnssFix:
    """The fix of a foxglove.LocationFix with a known covariance; sigma = root mean square of east and north."""
    covariance = message.position_covariance
    if len(covariance) != 9 or message.position_covariance_type == LocationFix.UNKNOWN:
        t_ns = ns_of(message.timestamp)
        raise BadValue(f"GNSS fix at {t_ns} ns has no known covariance ({len(covariance)} of 9 values)")
    variance = 0.5 * (covariance[0] + covariance[4])
    if not 0 <= variance < math.inf:
        raise BadValue(f"GNSS fix at {ns_of(message.timestamp)} ns has a variance of {variance} m^2")
    return GnssFix(
        t_ns=ns_of(message.timestamp),
        lat_rad=math.radians(message.latitude),
        lon_rad=math.radians(message.longitude),
        height_m=message.altitude,
        sigma_m=math.sqrt(variance),
    )


def motion_message_of(sample: MotionSample) -> VehicleMotion:
    """gnd.v1.VehicleMotion."""
    return VehicleMotion(
        timestamp=timestamp_of(sample.t_ns), speed_mps=sample.speed_mps, yaw_rate_radps=sample.yaw_rate_radps
    )


def motion_of(message: VehicleMotion) -> MotionSample:
    """The sample of a gnd.v1.VehicleMotion."""
    return MotionSample(ns_of(message.timestamp), message.speed_mps, message.yaw_rate_radps)


def pose_message_of(pose: ReferencePose) -> PoseInFrame:
    """foxglove.PoseInFrame in the frame `map`."""
    return PoseInFrame(timestamp=timestamp_of(pose.t_ns), frame_id=MAP_FRAME, pose=_pose_of(pose.T_map_vehicle))


def reference_of(message: PoseInFrame) -> ReferencePose:
    """The reference pose of a foxglove.PoseInFrame."""
    if message.frame_id != MAP_FRAME:
        raise BadValue(f"reference pose in frame {message.frame_id!r}, expected {MAP_FRAME!r}")
    return ReferencePose(ns_of(message.timestamp), _T_of(message.pose))


def transform_message_of(t_ns: int, parent: str, child: str, T_parent_child: F64) -> FrameTransform:
    """foxglove.FrameTransform from `t_ns` on."""
    pose = _pose_of(T_parent_child)
    return FrameTransform(
        timestamp=timestamp_of(t_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=pose.position,
        rotation=pose.orientation,
    )


def T_of_transform(message: FrameTransform) -> F64:
    """(4, 4) T_parent_child of a foxglove.FrameTransform."""
    return _T_of(Pose(position=message.translation, orientation=message.rotation))


_NO_POSE: Final = Pose(position=Vector3(), orientation=Quaternion(w=1.0))


def _pose_of(T: F64) -> Pose:
    x, y, z, w = quaternion_xyzw_from_R(T[:3, :3])
    return Pose(position=Vector3(x=T[0, 3], y=T[1, 3], z=T[2, 3]), orientation=Quaternion(x=x, y=y, z=z, w=w))


def _T_of(pose: Pose) -> F64:
    p, q = pose.position, pose.orientation
    xyzw = (q.x, q.y, q.z, q.w) if pose.HasField("orientation") else (0.0, 0.0, 0.0, 1.0)
    with refusing("orientation"):
        return T_from_R_t(R_from_quaternion_xyzw(xyzw), (p.x, p.y, p.z))
