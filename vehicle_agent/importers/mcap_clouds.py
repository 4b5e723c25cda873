"""MCAP files with `foxglove.PointCloud`, and drives of our own; bags of ROS 2 are read by `ros.reader`.

A recording of Foxglove gives the clouds alone: LiDAR odometry finds the track, the mount is estimated. A drive of ours
keeps everything that it holds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from mcap.summary import Summary

from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import GnssFix, MotionSample
from gnd.schemas.drive_mcap import POINTS_TOPIC, is_drive, load_track, read_header
from gnd.schemas.drive_messages import ns_of
from gnd.schemas.errors import DriveError
from gnd.schemas.mcap_file import open_mcap
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.fields import Field, TimeRule, scan_of_fields, unpack
from gnd.vehicle_agent.importers.files import files_below
from gnd.vehicle_agent.importers.recording import NOMINAL, Recording, RecordingAnchor
from gnd.vehicle_agent.importers.stamps import in_time_order

FOXGLOVE_CLOUD: Final = "foxglove.PointCloud"
_OWN_TIMES: Final = TimeRule("t_offset")
_FOXGLOVE_CODES: Final = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}


@dataclass(frozen=True, slots=True)
class _At:
    """Where a cloud lies: file, log time, how many of the topic with this log time come before it, and its stamp."""

    path: Path
    log_ns: int
    nth: int
    stamp_ns: int


def open_mcap_clouds(place: Path, anchor: RecordingAnchor | None, topic: str | None = None) -> Recording:
    """A file, or a folder with the files of one recording.

    Args:
        place: `.mcap` file or folder.
        anchor: where on the Earth the first pose is put; a drive of ours tells its place itself.
        topic: of the clouds; may be left out where there is only one.

    Raises:
        ImportDriveError: no clouds, several topics with clouds, or clouds that cannot be.
        DriveError: a file is damaged or cut off.
    """
    paths = _paths(place)
    if not paths:
        raise ImportDriveError(f"{place}: no .mcap file there")
    if len(paths) == 1 and is_drive(paths[0]):
        return _own_drive(paths[0])
    chosen, schema = _topic(paths, topic)
    clouds, notes = in_time_order([at for path in paths for at in _index(path, chosen)])
    return Recording(
        name=place.stem,
        sensor_model="unknown",
        source=f"{schema} on {chosen} of {place.name}; track by LiDAR odometry",
        T_vehicle_lidar=np.eye(4),
        t_ns=np.array([at.stamp_ns for at in clouds], np.int64),
        read=lambda i: _read(clouds[i], chosen),
        anchor=anchor or NOMINAL,
        notes=notes,
        mount="assumed",
        placed=anchor is not None,
    )


def _paths(place: Path) -> list[Path]:
    return [place] if place.is_file() else files_below(place, ".mcap") if place.is_dir() else []


def is_foxglove_or_own(place: Path) -> bool:
    """Whether the MCAP files of a place hold a drive of ours or Foxglove's clouds; what cannot be read does not."""
    for path in _paths(place):
        try:
            with open_mcap(path) as (_, summary):
                if _cloud_topics(summary) or is_drive(path):
                    return True
        except DriveError:
            continue
    return False


def _own_drive(path: Path) -> Recording:
    """A drive of ours: poses where it has them for all scans, odometry and fixes as they are."""
    header, track = read_header(path), load_track(path)
    clouds, notes = in_time_order(_index(path, POINTS_TOPIC))
    frame = header.anchor
    t_ns, reference = np.array([at.stamp_ns for at in clouds], np.int64), track.reference
    covered = len(reference.t_ns) > 1 and reference.t_ns[0] <= t_ns[0] and t_ns[-1] <= reference.t_ns[-1]
    return Recording(
        name=header.drive_id,
        sensor_model=header.sensor_model,
        source=header.source,
        T_vehicle_lidar=header.T_vehicle_lidar,
        t_ns=t_ns,
        read=lambda i: _read(clouds[i], POINTS_TOPIC, _OWN_TIMES),
        anchor=RecordingAnchor(np.degrees(frame.lat_rad), np.degrees(frame.lon_rad), frame.height_m),
        track=Trajectory(reference.t_ns, reference.T_map_vehicle) if covered else None,
        gnss=tuple(GnssFix(int(t), *map(float, row)) for t, *row in zip(*track.gnss, strict=True)),
        motion=tuple(MotionSample(int(t), float(v), float(w)) for t, v, w in zip(*track.motion, strict=True)),
        notes=notes,
        deskew=header.deskew,
        sweep_ns=header.sweep_ns,
        mount=header.mount,
        mount_sigma=header.mount_sigma,
        placed=not header.nowhere,
    )


def _topic(paths: Sequence[Path], wanted: str | None) -> tuple[str, str]:
    """Topic and schema of the clouds."""
    found: dict[str, str] = {}
    for path in paths:
        with open_mcap(path) as (_, summary):
            found |= _cloud_topics(summary)
    if wanted is not None and wanted in found:
        return wanted, found[wanted]
    names = ", ".join(sorted(found)) or "none"
    if wanted is not None or not found:
        asked = f"topic {wanted}: " if wanted else ""
        raise ImportDriveError(f"{paths[0]}: {asked}no {FOXGLOVE_CLOUD}; topics with clouds: {names}")
    if len(found) > 1:
        raise ImportDriveError(f"{paths[0]}: clouds on {len(found)} topics ({names}); choose one with --topic")
    return next(iter(found.items()))


def _cloud_topics(summary: Summary) -> dict[str, str]:
    found = {}
    for channel in summary.channels.values():
        schema = summary.schemas.get(channel.schema_id)
        if schema is not None and schema.name == FOXGLOVE_CLOUD and channel.message_encoding == "protobuf":
            found[channel.topic] = schema.name
    return found


def _index(path: Path, topic: str) -> list[_At]:
    """Where the clouds of a file lie, and when they were stamped (log time where the stamp is zero)."""
    found: list[_At] = []
    with open_mcap(path) as (reader, _):
        for _, _, message in reader.iter_messages(topics=[topic]):
            nth = found[-1].nth + 1 if found and found[-1].log_ns == message.log_time else 0
            stamp = ns_of(PointCloud.FromString(message.data).timestamp)
            found.append(_At(path, message.log_time, nth, stamp or message.log_time))
    return found


def _read(at: _At, topic: str, rule: TimeRule | None = None) -> RawScan:
    with open_mcap(at.path) as (reader, _):
        messages = reader.iter_messages(topics=[topic], starting_at=at.log_ns, ending_at=at.log_ns)
        data = next(message.data for nth, (_, _, message) in enumerate(messages) if nth == at.nth)
    where = f"{at.path}: cloud at {at.stamp_ns} ns"
    cloud = PointCloud.FromString(data)
    fields = [Field(f.name, f.offset, _FOXGLOVE_CODES.get(f.type, "u1")) for f in cloud.fields]
    n = len(cloud.data) // max(cloud.point_stride, 1)
    return scan_of_fields(unpack(where, fields, cloud.point_stride, cloud.data, n), at.stamp_ns, rule)
