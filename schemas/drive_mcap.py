"""Recorded drives as MCAP files that open in Foxglove; written whole or not at all, read as a stream.

| topic | message | |
|---|---|---|
| /lidar/points | foxglove.PointCloud | one sweep, firing order, log time = start of the sweep |
| /vehicle/motion | gnd.v1.VehicleMotion | wheel speed and yaw rate |
| /gnss | foxglove.LocationFix | |
| /detections | gnd.v1.Detections | map features that a detector saw in one look; may be missing |
| /lanes | gnd.v1.LaneLook | lane markings that a camera saw; may be missing |
| /reference/pose | foxglove.PoseInFrame | where the vehicle truly was; may be missing |
| /tf | foxglove.FrameTransform | the same pose, so that Foxglove shows the scans in the map |
| /tf_static | foxglove.FrameTransform | mount of the LiDAR, once |

The metadata record `gnd.drive` holds the header. Scans fill chunks of their own, the rest shares chunks of some
seconds, so that the track is read without unpacking the points.
"""

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import Message
from mcap.reader import SeekingReader
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from gnd.gnd_map.arrays import F64
from gnd.schemas import limits
from gnd.schemas.drive import (
    Detections,
    DriveHeader,
    DriveItem,
    DriveTrack,
    GnssFix,
    LaneLook,
    MotionSample,
    ReferencePose,
    Scan,
    track_of,
)
from gnd.schemas.drive_messages import (
    LIDAR_FRAME,
    MAP_FRAME,
    VEHICLE_FRAME,
    T_of_transform,
    cloud_of,
    fix_of,
    gnss_of,
    motion_message_of,
    motion_of,
    pose_message_of,
    reference_of,
    scan_of,
    transform_message_of,
)
from gnd.schemas.drive_metadata import METADATA, header_of, metadata_of
from gnd.schemas.errors import DriveError
from gnd.schemas.generated import detections_pb2, lane_look_pb2
from gnd.schemas.generated.vehicle_motion_pb2 import VehicleMotion
from gnd.schemas.look_messages import detections_message_of, detections_of, lane_message_of, lanes_of
from gnd.schemas.mcap_file import open_mcap, write_errors
from gnd.schemas.wire import parse

POINTS_TOPIC: Final = "/lidar/points"
MOTION_TOPIC: Final = "/vehicle/motion"
GNSS_TOPIC: Final = "/gnss"
REFERENCE_TOPIC: Final = "/reference/pose"
DETECTIONS_TOPIC: Final = "/detections"
LANES_TOPIC: Final = "/lanes"
TF_TOPIC: Final = "/tf"
TF_STATIC_TOPIC: Final = "/tf_static"

_CHUNK_BYTES: Final = 1 << 20
_SMALL_SPAN_NS: Final = 10_000_000_000
_SMALL_COUNT: Final = 10_000

_MESSAGES: Final[Mapping[str, type[Message]]] = {
    POINTS_TOPIC: PointCloud,
    MOTION_TOPIC: VehicleMotion,
    GNSS_TOPIC: LocationFix,
    REFERENCE_TOPIC: PoseInFrame,
    TF_TOPIC: FrameTransform,
    TF_STATIC_TOPIC: FrameTransform,
    DETECTIONS_TOPIC: detections_pb2.Detections,
    LANES_TOPIC: lane_look_pb2.LaneLook,
}
_LOOKS: Final = (DETECTIONS_TOPIC, LANES_TOPIC)
"""Topics that a recording has only if something looked: without them its bytes are those of older programs."""
_LIMITS: Final[Mapping[str, int]] = {
    DETECTIONS_TOPIC: limits.MAX_DETECTIONS_BYTES,
    LANES_TOPIC: limits.MAX_LANE_LOOK_BYTES,
}
_MOST_BYTES: Final = 1 << 28
_ITEMS: Final[Mapping[str, Callable[[Any], DriveItem]]] = {
    POINTS_TOPIC: scan_of,
    MOTION_TOPIC: motion_of,
    GNSS_TOPIC: gnss_of,
    REFERENCE_TOPIC: reference_of,
    DETECTIONS_TOPIC: detections_of,
    LANES_TOPIC: lanes_of,
}


ITEM_TOPICS: Final = tuple(_ITEMS)


class DriveWriter:
    """Writes one drive; the file appears under its name when the `with` block ends, and not at all when it fails.

    Items may come in any order within some ten seconds; readers get them in time order.

    Raises:
        DriveError: the folder does not exist, is not writable, the disk is full.
    """

    def __init__(self, path: Path | str, header: DriveHeader) -> None:
        self._path = Path(path)
        self._partial = self._path.with_name(f".{self._path.name}.{os.getpid()}.partial")
        self._header = header
        self._small: list[tuple[str, int, Message]] = []
        self._mount_written = False
        with write_errors(self._path):
            self._stream = self._partial.open("wb")
        self._writer = Writer(self._stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="gnd-fleet")
        self._writer.add_metadata(METADATA, metadata_of(header))
        self._channels = {topic: self._channel(topic, kind) for topic, kind in _MESSAGES.items() if topic not in _LOOKS}

    def _channel(self, topic: str, kind: type[Message]) -> int:
        schema_id = register_schema(self._writer, kind)
        return self._writer.register_channel(topic=topic, message_encoding="protobuf", schema_id=schema_id)

    def scan(self, scan: Scan) -> None:
        """Add one sweep."""
        self._add_mount(scan.t_ns)
        with write_errors(self._path):
            self._write(POINTS_TOPIC, scan.t_ns, cloud_of(scan))

    def motion(self, sample: MotionSample) -> None:
        """Add one odometry sample."""
        self._add_small(MOTION_TOPIC, sample.t_ns, motion_message_of(sample))

    def gnss(self, fix: GnssFix) -> None:
        """Add one GNSS fix."""
        self._add_small(GNSS_TOPIC, fix.t_ns, fix_of(fix))

    def reference(self, pose: ReferencePose) -> None:
        """Add one pose of the truth."""
        self._add_small(REFERENCE_TOPIC, pose.t_ns, pose_message_of(pose))
        tf = transform_message_of(pose.t_ns, MAP_FRAME, VEHICLE_FRAME, pose.T_map_vehicle)
        self._add_small(TF_TOPIC, pose.t_ns, tf)

    def detections(self, look: Detections) -> None:
        """Add one look of a detector."""
        self._add_small(DETECTIONS_TOPIC, look.t_ns, detections_message_of(look))

    def lanes(self, look: LaneLook) -> None:
        """Add one look at lane markings."""
        self._add_small(LANES_TOPIC, look.t_ns, lane_message_of(look))

    def add(self, item: DriveItem) -> None:
        """Add an item of any kind: what `read_drive` yields."""
        match item:
            case Scan():
                self.scan(item)
            case MotionSample():
                self.motion(item)
            case GnssFix():
                self.gnss(item)
            case ReferencePose():
                self.reference(item)
            case Detections():
                self.detections(item)
            case LaneLook():
                self.lanes(item)

    def _add_mount(self, t_ns: int) -> None:
        """The mount goes in with the first item, at its time: a viewer's time line begins where the drive does."""
        if not self._mount_written:
            self._mount_written = True
            tf = transform_message_of(t_ns, VEHICLE_FRAME, LIDAR_FRAME, self._header.T_vehicle_lidar)
            self._add_small(TF_STATIC_TOPIC, t_ns, tf)

    def _add_small(self, topic: str, t_ns: int, message: Message) -> None:
        self._add_mount(t_ns)
        self._small.append((topic, t_ns, message))
        if len(self._small) >= _SMALL_COUNT or abs(t_ns - self._small[0][1]) >= _SMALL_SPAN_NS:
            self._write_small()

    def _write_small(self) -> None:
        """The small messages so far as a chunk of their own."""
        with write_errors(self._path):
            self._writer.flush()  # type: ignore[no-untyped-call]
            for topic, t_ns, message in self._small:
                self._write(topic, t_ns, message)
            self._writer.flush()  # type: ignore[no-untyped-call]
        self._small.clear()

    def _write(self, topic: str, t_ns: int, message: Message) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._channel(topic, _MESSAGES[topic])
        self._writer.add_message(self._channels[topic], t_ns, message.SerializeToString(), t_ns)

    def close(self) -> None:
        """Write the index and give the file its name. Called by the end of the `with` block."""
        self._add_mount(0)
        self._write_small()
        with write_errors(self._path):
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._stream.close()
            self._partial.replace(self._path)

    def discard(self) -> None:
        """Throw away what was written. Called when the `with` block fails."""
        with contextlib.suppress(OSError):  # a full disk fails once more on what is still buffered
            self._stream.close()
        self._partial.unlink(missing_ok=True)

    def __enter__(self) -> "DriveWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self.discard()
            return
        try:
            self.close()
        except BaseException:
            self.discard()
            raise


def read_header(path: Path | str) -> DriveHeader:
    """The header of a drive; `DriveError` when the file is none."""
    with open_mcap(Path(path)) as (reader, summary):
        _check_channels(summary)
        metadata = next((m.metadata for m in reader.iter_metadata() if m.name == METADATA), None)
        if metadata is None:
            raise DriveError(
                f"MCAP file without a metadata record {METADATA!r}; turn it into a drive with"
                f" `gnd import auto {path} -o drive.mcap`"
            )
        return header_of(metadata, _mount_of(reader))


def is_drive(path: Path | str) -> bool:
    """Whether an MCAP file is a drive; `DriveError` when it cannot be read."""
    with open_mcap(Path(path)) as (reader, _):
        return any(record.name == METADATA for record in reader.iter_metadata())


def read_drive(path: Path | str) -> Iterator[DriveItem]:
    """Scans, motion samples, GNSS fixes, reference poses and looks in time order, some seconds of them in memory.

    Raises:
        DriveError: no such file, not MCAP, cut off or damaged (when the damaged part is reached).
    """
    with open_mcap(Path(path)) as (reader, summary):
        _check_channels(summary)
        for _, channel, message in reader.iter_messages(topics=list(_ITEMS)):
            yield item_of(channel.topic, message.data)


def topics_of(path: Path | str) -> list[str]:
    """Those of `ITEM_TOPICS` of which a drive has messages; `DriveError`."""
    with open_mcap(Path(path)) as (_, summary):
        counts = summary.statistics.channel_message_counts if summary.statistics is not None else {}
        found = {channel.topic for channel_id, channel in summary.channels.items() if counts.get(channel_id)}
    return [topic for topic in ITEM_TOPICS if topic in found]


def load_track(path: Path | str) -> DriveTrack:
    """Motion, GNSS and reference poses of a whole drive as arrays, without unpacking the scans; `DriveError`."""
    with open_mcap(Path(path)) as (reader, summary):
        _check_channels(summary)
        items = [
            item_of(channel.topic, message.data)
            for _, channel, message in reader.iter_messages(topics=[MOTION_TOPIC, GNSS_TOPIC, REFERENCE_TOPIC])
        ]
    return track_of(items)


class DriveCounts(NamedTuple):
    """How much a drive holds."""

    scans: int
    motion: int
    gnss: int
    reference: int
    first_ns: int
    last_ns: int
    detections: int = 0
    lanes: int = 0


def drive_counts(path: Path | str) -> DriveCounts:
    """Number of items of each kind, and the time of the first and last, from the file's summary alone; `DriveError`."""
    with open_mcap(Path(path)) as (_, summary):
        _check_channels(summary)
        statistics = summary.statistics
        if statistics is None:
            raise DriveError("recording has no statistics; restore it with `mcap recover`")
        counts = {c.topic: statistics.channel_message_counts.get(c.id, 0) for c in summary.channels.values()}
        return DriveCounts(
            scans=counts.get(POINTS_TOPIC, 0),
            motion=counts.get(MOTION_TOPIC, 0),
            gnss=counts.get(GNSS_TOPIC, 0),
            reference=counts.get(REFERENCE_TOPIC, 0),
            first_ns=statistics.message_start_time,
            last_ns=statistics.message_end_time,
            detections=counts.get(DETECTIONS_TOPIC, 0),
            lanes=counts.get(LANES_TOPIC, 0),
        )


def item_of(topic: str, data: bytes) -> DriveItem:
    """The item of a message on a topic of `ITEM_TOPICS`.

    Raises:
        SchemaError: it is none.
    """
    return _ITEMS[topic](parse(_MESSAGES[topic], data, _LIMITS.get(topic, _MOST_BYTES)))


def message_of(item: DriveItem) -> tuple[str, bytes]:
    """Topic and message of an item: what `item_of` reads."""
    match item:
        case Scan():
            return POINTS_TOPIC, cloud_of(item).SerializeToString()
        case MotionSample():
            return MOTION_TOPIC, motion_message_of(item).SerializeToString()
        case GnssFix():
            return GNSS_TOPIC, fix_of(item).SerializeToString()
        case ReferencePose():
            return REFERENCE_TOPIC, pose_message_of(item).SerializeToString()
        case Detections():
            return DETECTIONS_TOPIC, detections_message_of(item).SerializeToString()
        case LaneLook():
            return LANES_TOPIC, lane_message_of(item).SerializeToString()


def _check_channels(summary: Summary) -> None:
    """Refuse a topic of ours that carries something else."""
    for channel in summary.channels.values():
        schema = summary.schemas.get(channel.schema_id)
        expected = _MESSAGES.get(channel.topic)
        if expected and (schema is None or schema.name != expected.DESCRIPTOR.full_name):
            found = schema.name if schema else "no schema"
            raise DriveError(f"topic {channel.topic} carries {found}, expected {expected.DESCRIPTOR.full_name}")


def _mount_of(reader: SeekingReader) -> F64:
    for _, _, message in reader.iter_messages(topics=[TF_STATIC_TOPIC]):
        transform = FrameTransform.FromString(message.data)
        if (transform.parent_frame_id, transform.child_frame_id) == (VEHICLE_FRAME, LIDAR_FRAME):
            return T_of_transform(transform)
    raise DriveError(f"no transform {VEHICLE_FRAME} → {LIDAR_FRAME} on {TF_STATIC_TOPIC}: how is the LiDAR mounted?")
