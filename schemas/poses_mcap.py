"""Estimated poses as an MCAP file of Foxglove's messages: it opens in Foxglove beside the drive itself.

| topic | message | |
|---|---|---|
| /NAME/pose | foxglove.PoseInFrame | one a pose, frame `map` |
| /NAME/path | foxglove.PosesInFrame | all poses at once, at the time of the first |
| /NAME/fix | foxglove.LocationFix | where the pose lies on the Earth, with its covariance where that is known |
| /tf | foxglove.FrameTransform | map → vehicle of the first track, where it moves the vehicle |
| /health | foxglove.Log | what has changed: info, warning or error |

NAME is that of a track, such as `refined`. The metadata record `gnd.poses` says where on the Earth `map` lies.
"""

import contextlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import ReferencePose
from gnd.schemas.drive_messages import MAP_FRAME, VEHICLE_FRAME, pose_message_of, timestamp_of, transform_message_of
from gnd.schemas.errors import BadValue, TrajectoryError

METADATA: Final = "gnd.poses"
TF_TOPIC: Final = "/tf"
HEALTH_TOPIC: Final = "/health"
LEVELS: Final[Mapping[str, Log.Level.ValueType]] = {"info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}

_Stamped = tuple[str, int, Message]
"""Topic, log time and message."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseTrack:
    """Poses under a name."""

    name: str
    """Such as "refined": letters, digits, _ and -."""
    poses: Trajectory
    """T_map_vehicle; map = ENU at the file's anchor."""
    position_cov_m2: F64 | None = None
    """(N, 3, 3) covariance of each position east, north, up, where it is known."""

    def __post_init__(self) -> None:
        if not self.name.replace("_", "").replace("-", "").isalnum():
            raise BadValue(f"track {self.name!r}: expected letters, digits, _ and -")
        if self.position_cov_m2 is not None and self.position_cov_m2.shape != (len(self.poses), 3, 3):
            raise BadValue(f"track {self.name}: {len(self.poses)} poses, but covariances {self.position_cov_m2.shape}")


@dataclass(frozen=True, slots=True)
class HealthNote:
    """Something to say about the poses from `t_ns` on."""

    t_ns: int
    level: str
    """info, warning or error."""
    text: str

    def __post_init__(self) -> None:
        if self.level not in LEVELS:
            raise BadValue(f"level {self.level!r} is none of {', '.join(LEVELS)}")


def write_poses_mcap(
    path: Path | str,
    anchor: LocalFrame,
    tracks: Sequence[PoseTrack],
    notes: Sequence[HealthNote] = (),
    metadata: Mapping[str, str] | None = None,
    *,
    moves_vehicle: bool = True,
) -> None:
    """Write the tracks in order of time; the file appears whole or not at all.

    Args:
        path: the file.
        anchor: where on the Earth the frame `map` of the poses lies.
        tracks: the poses. A track without poses only has its topics.
        notes: for the topic /health.
        metadata: more to keep in the record `gnd.poses`.
        moves_vehicle: the first track moves the frame `vehicle`; not beside a drive that does so itself.

    Raises:
        TrajectoryError: the file cannot be written.
    """
    messages = sorted(_messages(anchor, tracks, notes, moves_vehicle=moves_vehicle), key=lambda stamped: stamped[1])
    record = {
        "map_anchor_lat_rad": repr(float(anchor.lat_rad)),
        "map_anchor_lon_rad": repr(float(anchor.lon_rad)),
        "map_anchor_height_m": repr(float(anchor.height_m)),
        **(metadata or {}),
    }
    target = Path(path)
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as stream:
            _write(stream, _topics(tracks), messages, record)
        partial.replace(target)
    except OSError as error:
        raise TrajectoryError(f"{target}: cannot write: {error.strerror or error}") from None
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def _topics(tracks: Sequence[PoseTrack]) -> dict[str, type[Message]]:
    topics: dict[str, type[Message]] = {TF_TOPIC: FrameTransform, HEALTH_TOPIC: Log}
    for track in tracks:
        topics |= {f"/{track.name}/pose": PoseInFrame, f"/{track.name}/path": PosesInFrame}
        topics[f"/{track.name}/fix"] = LocationFix
    return topics


def _write(stream: IO[bytes], topics: Mapping[str, type[Message]], messages: Sequence[_Stamped], record: Any) -> None:
    writer = Writer(stream, compression=CompressionType.ZSTD)
    writer.start(profile="", library="gnd-fleet")
    writer.add_metadata(METADATA, record)
    channels = {
        topic: writer.register_channel(
            topic=topic, message_encoding="protobuf", schema_id=register_schema(writer, kind)
        )
        for topic, kind in topics.items()
    }
    for topic, t_ns, message in messages:
        writer.add_message(channels[topic], t_ns, message.SerializeToString(), t_ns)
    writer.finish()  # type: ignore[no-untyped-call]


def _messages(
    anchor: LocalFrame, tracks: Sequence[PoseTrack], notes: Sequence[HealthNote], *, moves_vehicle: bool
) -> Iterator[_Stamped]:
    for number, track in enumerate(tracks):
        if len(track.poses):
            yield from _track_messages(anchor, track, moves_vehicle=moves_vehicle and number == 0)
    for note in notes:
        log = Log(timestamp=timestamp_of(note.t_ns), level=LEVELS[note.level], message=note.text, name="gnd localise")
        yield HEALTH_TOPIC, note.t_ns, log


def _track_messages(anchor: LocalFrame, track: PoseTrack, *, moves_vehicle: bool) -> Iterator[_Stamped]:
    poses = [ReferencePose(int(t), T) for t, T in zip(track.poses.t_ns, track.poses.T_dst_vehicle, strict=True)]
    lat, lon, height = anchor.geodetic_from_enu(track.poses.T_dst_vehicle[:, :3, 3])
    yield f"/{track.name}/path", poses[0].t_ns, _path(poses)
    for k, pose in enumerate(poses):
        yield f"/{track.name}/pose", pose.t_ns, pose_message_of(pose)
        cov_m2 = None if track.position_cov_m2 is None else track.position_cov_m2[k]
        yield f"/{track.name}/fix", pose.t_ns, _fix(pose.t_ns, lat[k], lon[k], height[k], cov_m2)
        if moves_vehicle:
            yield TF_TOPIC, pose.t_ns, transform_message_of(pose.t_ns, MAP_FRAME, VEHICLE_FRAME, pose.T_map_vehicle)


def _path(poses: Sequence[ReferencePose]) -> PosesInFrame:
    return PosesInFrame(
        timestamp=timestamp_of(poses[0].t_ns),
        frame_id=MAP_FRAME,
        poses=[pose_message_of(pose).pose for pose in poses],
    )


def _fix(t_ns: int, lat_rad: float, lon_rad: float, height_m: float, cov_m2: F64 | None) -> LocationFix:
    """East, north, up at the anchor stand in for those at the position: 1 km away they differ by 0.01 degrees."""
    return LocationFix(
        timestamp=timestamp_of(t_ns),
        frame_id=VEHICLE_FRAME,
        latitude=math.degrees(lat_rad),
        longitude=math.degrees(lon_rad),
        altitude=height_m,
        position_covariance=[0.0] * 9 if cov_m2 is None else cov_m2.ravel().tolist(),
        position_covariance_type=LocationFix.UNKNOWN if cov_m2 is None else LocationFix.KNOWN,
    )
