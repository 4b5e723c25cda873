"""A map, its changes and the fleet as MCAP for Foxglove.

| topic | message | |
|---|---|---|
| /map | foxglove.PointCloud | means and counts of the newest map, frame `map` (ENU), at the start |
| /map/updates | foxglove.PointCloud | of each merged version what it changed: `change` 1 new, 2 modified, 3 deleted |
| /map/origin | foxglove.LocationFix | where the frame `map` lies |
| /vehicles/NAME | foxglove.LocationFix | the way of each vehicle of a run, for the map panel |
"""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer

from gnd.deploy.map_export.scene import ExportScene
from gnd.tile_store.export import write_whole

Message = tuple[int, str, Any]
"""Time, topic, message."""
_TYPES = {"<f4": PackedElementField.FLOAT32, "<u4": PackedElementField.UINT32, "|u1": PackedElementField.UINT8}
_NS_PER_S = 1_000_000_000


def write_mcap(scene: ExportScene, path: Path) -> None:
    """Write the scene; ExportError when the file cannot be written."""

    def write(stream: Any) -> None:
        with Writer(stream) as writer:
            for t_ns, topic, message in sorted(_messages(scene), key=lambda one: one[0]):
                writer.write_message(topic=topic, message=message, log_time=t_ns, publish_time=t_ns)

    write_whole(path, write)


def _messages(scene: ExportScene) -> Iterator[Message]:
    start_ns = scene.start_ns
    origin = math.degrees(scene.frame.lat_rad), math.degrees(scene.frame.lon_rad)
    yield start_ns, "/map/origin", _fix(start_ns, *origin)
    yield start_ns, "/map", _cloud(start_ns, scene.points_m, "count", scene.count.astype("<u4"))
    for update in scene.updates:
        yield update.t_ns, "/map/updates", _cloud(update.t_ns, update.points_m, "change", update.change)
    for name, way in scene.ways.items():
        for one in way:
            place = math.degrees(one.lat_rad), math.degrees(one.lon_rad)
            yield one.wall_ns, f"/vehicles/{name}", _fix(one.wall_ns, *place)


def _fix(t_ns: int, lat_deg: float, lon_deg: float) -> LocationFix:
    return LocationFix(timestamp=_stamp(t_ns), frame_id="map", latitude=lat_deg, longitude=lon_deg)


def _stamp(t_ns: int) -> Timestamp:
    return Timestamp(seconds=t_ns // _NS_PER_S, nanos=t_ns % _NS_PER_S)


def _cloud(t_ns: int, points_m: "np.ndarray[Any, Any]", name: str, values: "np.ndarray[Any, Any]") -> PointCloud:
    """Points with one more column."""
    columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, values.dtype.str)]
    rows = np.zeros(len(points_m), np.dtype(columns))
    for axis, column in zip("xyz", points_m.T, strict=True):
        rows[axis] = column
    rows[name] = values
    offsets: Mapping[str, Any] = rows.dtype.fields or {}
    fields = [PackedElementField(name=key, offset=offsets[key][1], type=_TYPES[kind]) for key, kind in columns]
    cloud = PointCloud(timestamp=_stamp(t_ns), frame_id="map", point_stride=rows.itemsize, fields=fields)
    cloud.pose.orientation.w = 1.0
    cloud.data = rows.tobytes()
    return cloud
