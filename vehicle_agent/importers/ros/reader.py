"""ROS 2 bags into recordings: clouds with times of points, fixes, motion of odometry, mount of tf_static."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.schemas.drive import GnssFix, MotionSample
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.fields import TimeRule, scan_of_fields, time_rule, times_of
from gnd.vehicle_agent.importers.point_cloud2 import SCHEMA as POINT_CLOUD2
from gnd.vehicle_agent.importers.point_cloud2 import decode_cloud, head_of
from gnd.vehicle_agent.importers.recording import NOMINAL, Entry, Recording, RecordingAnchor
from gnd.vehicle_agent.importers.ros.bag import Bag, Topic
from gnd.vehicle_agent.importers.ros.small_messages import (
    IMU,
    NAV_SAT_FIX,
    ODOMETRY,
    POSE,
    POSE_COVARIANCE,
    SPEEDS,
    STAMPED_NS,
    TF,
    Small,
    fixes_of_topic,
    motion_of_topic,
    poses_of_topic,
    read_small,
)
from gnd.vehicle_agent.importers.stamps import in_time_order

F64 = NDArray[np.float64]

PACKETS: Final = {
    "velodyne_msgs/msg/VelodyneScan": "velodyne_pointcloud (velodyne_transform_node)",
    "ouster_sensor_msgs/msg/PacketMsg": "ouster_ros (os_cloud)",
    "ouster_ros/msg/PacketMsg": "ouster_ros (os_cloud)",
    "ouster_msgs/msg/PacketMsg": "ouster_ros (os_cloud)",
    "nebula_msgs/msg/NebulaPackets": "nebula_ros (…_ros_wrapper_node)",
    "pandar_msgs/msg/PandarScan": "nebula_ros or pandar_pointcloud",
    "hesai_ros_driver/msg/UdpFrame": "hesai_ros_driver",
    "rslidar_msg/msg/RslidarPacket": "rslidar_sdk",
    "robosense_msgs/msg/RobosenseScan": "nebula_ros",
    "livox_ros_driver2/msg/CustomMsg": "livox_ros_driver2 with xfer_format 0 (PointCloud2)",
    "livox_interfaces/msg/CustomMsg": "livox_ros2_driver with xfer_format 0 (PointCloud2)",
}
"""Raw packets of sensors: only the sensor's own node, with its calibration, makes points of them."""
CLOCKS_NS: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class _CloudAt:
    """Where a cloud lies in the bag, when it was stamped, and in which frame."""

    file: int
    log_ns: int
    nth: int
    stamp_ns: int
    frame: str


def open_ros(place: Path, anchor: RecordingAnchor | None, choices: Choices | None = None) -> Recording:
    """A bag: a folder with metadata.yaml, a folder of .mcap or .db3 files of one recording, or one such file.

    Raises:
        ImportDriveError: no clouds, several topics with clouds, two sensors on one topic, or a damaged bag.
        MissingExtra: `rosbags` is not installed.
    """
    choices = choices or Choices()
    bag = Bag(place, strict=choices.strict)
    topic = cloud_topic(bag, choices.topic)
    indexed = _index(bag, topic)
    clouds, notes = in_time_order(indexed)
    frame, small = _one_frame(place, topic, clouds), read_small(bag)
    base = small.transforms.base(_odometry_frames(bag, small))
    mount = None if base is None else small.transforms.between(base, frame)
    found = _measured(bag, small, base)
    rule, first = _time_rule(bag, topic, clouds, choices)
    shift_ns, clock_note = _shift(first, clouds[0].stamp_ns, rule)
    recording = Recording(
        name=place.stem,
        sensor_model="unknown",
        source=f"{POINT_CLOUD2} on {topic} of {place.name}",
        T_vehicle_lidar=np.eye(4) if mount is None else mount,
        t_ns=np.array([at.stamp_ns + shift_ns for at in clouds], np.int64),
        read=lambda i: _read(bag, topic, clouds[i], rule),
        anchor=anchor or _place(found.fixes) or NOMINAL,
        gnss=found.fixes,
        motion=found.motion,
        notes=(*bag.notes, *notes, *_clock_note(indexed), *clock_note, *found.notes),
        mount="assumed" if mount is None else "given",
        placed=anchor is not None or bool(found.fixes),
        lever_m=found.lever_m,
        poses_on=lambda name: poses_of_topic(bag, small, bag.topics, name, base),
    )
    cloud = f"frame {frame}, {', '.join(first.dtype.names or ())}; {rule.said}"
    how = "" if mount is None else f"{frame} on {base}"
    return replace(recording, entries=_entries(bag, topic, cloud, found, how))


def cloud_topic(bag: Bag, wanted: str | None) -> str:
    """The topic of the clouds.

    Raises:
        ImportDriveError: none, several and none chosen, or another one chosen; with what to do about raw packets.
    """
    found = [topic.name for topic in bag.topics if topic.kind == POINT_CLOUD2 and topic.count]
    if wanted in found:
        return str(wanted)
    names = ", ".join(found) or "none"
    packets = [topic for topic in bag.topics if topic.kind in PACKETS]
    hint = "".join(f"; {one.name} holds packets: play the bag through {PACKETS[one.kind]} and record its points"
                   for one in packets)  # fmt: skip
    if wanted is not None or not found:
        asked = f"topic {wanted}: " if wanted else ""
        raise ImportDriveError(f"{bag.place}: {asked}no {POINT_CLOUD2}; topics with clouds: {names}{hint}")
    if len(found) > 1:
        raise ImportDriveError(f"{bag.place}: clouds on {len(found)} topics ({names}); choose one with --topic")
    return found[0]


def _index(bag: Bag, topic: str) -> list[_CloudAt]:
    found = []
    for message in bag.messages([topic]):
        stamp_ns, frame = head_of(f"{bag.place}: {topic}", message.data)
        stamp_ns = stamp_ns if stamp_ns > STAMPED_NS else message.log_ns
        found.append(_CloudAt(message.file, message.log_ns, message.nth, stamp_ns, frame.lstrip("/")))
    return found


def _clock_note(clouds: list[_CloudAt]) -> tuple[str, ...]:
    """A warning where the stamps and the times of recording are of two clocks."""
    late_ns = int(np.median([at.log_ns - at.stamp_ns for at in clouds])) if clouds else 0
    if abs(late_ns) <= CLOCKS_NS:
        return ()
    return (f"the clouds' stamps are {late_ns * 1e-9:+.3f} s from when they were recorded: two clocks",)


def _one_frame(place: Path, topic: str, clouds: list[_CloudAt]) -> str:
    frames = Counter(at.frame for at in clouds)
    if len(frames) > 1:
        held = ", ".join(f"{n} in {frame}" for frame, n in frames.most_common())
        raise ImportDriveError(f"{place}: clouds of {len(frames)} sensors on {topic} ({held}): give each its own topic")
    return next(iter(frames), "")


def _odometry_frames(bag: Bag, small: Small) -> list[str]:
    kinds = {topic.name: topic.kind for topic in bag.topics}
    return [messages[0][1].child_frame_id for name, messages in small.by_topic.items() if kinds[name] == ODOMETRY]


def _time_rule(bag: Bag, topic: str, clouds: list[_CloudAt], choices: Choices) -> tuple[TimeRule, NDArray[np.void]]:
    """How times of points are read, and the points of the first cloud that has any."""
    points = np.zeros(0, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    for at in clouds[:20]:
        data = bag.again(topic, at.file, at.log_ns, at.nth)
        points = decode_cloud(f"{bag.place}: {topic}", data).points
        if len(points):
            break
    return time_rule(points, choices.fields), points


def _shift(points: NDArray[np.void], stamp_ns: int, rule: TimeRule) -> tuple[int, tuple[str, ...]]:
    """When a sweep begins after its stamp, and a warning where its points count by another clock."""
    if rule.field is None or not len(points):
        return 0, ()
    begin_ns = times_of(points[rule.field], stamp_ns, rule)[0]
    apart_s = (float(np.nanmin(points[rule.field].astype(np.float64))) * rule.ns - stamp_ns) * 1e-9
    if rule.absolute and abs(apart_s) > CLOCKS_NS * 1e-9:
        known = {18: " (GPS time is 18 s ahead of UTC)", 37: " (TAI is 37 s ahead of UTC)"}.get(round(abs(apart_s)), "")
        return 0, (f"points' clock is {apart_s:+.3f} s from the stamps{known}: the stamps count",)
    return begin_ns - stamp_ns, ()


def _read(bag: Bag, topic: str, at: _CloudAt, rule: TimeRule) -> RawScan:
    data = bag.again(topic, at.file, at.log_ns, at.nth)
    return scan_of_fields(decode_cloud(f"{bag.place}: cloud at {at.stamp_ns} ns", data).points, at.stamp_ns, rule)


@dataclass(frozen=True, slots=True)
class _Measured:
    """Fixes, motion, where the antenna sits, and the topics they come from, with what they are used for."""

    fixes: tuple[GnssFix, ...]
    motion: tuple[MotionSample, ...]
    lever_m: tuple[float, float, float]
    used: dict[str, str]
    why: dict[str, str]
    notes: tuple[str, ...]


def _measured(bag: Bag, small: Small, base: str | None) -> _Measured:
    used, why, notes = dict[str, str](), dict[str, str](), list[str]()
    fixes, lever = _fixes(bag, small, base, used, why, notes)
    motion = _motion(bag, small, base, used, why, notes)
    return _Measured(fixes, motion, lever, used, why, tuple(notes))


def _held(bag: Bag, small: Small, kinds: tuple[str, ...]) -> list[Topic]:
    """Topics with messages of these types, by type and then by how many."""
    held = [topic for topic in bag.topics if topic.kind in kinds and small.by_topic.get(topic.name)]
    return sorted(held, key=lambda topic: (kinds.index(topic.kind), -topic.count))


def _fixes(
    bag: Bag, small: Small, base: str | None, used: dict[str, str], why: dict[str, str], notes: list[str]
) -> tuple[tuple[GnssFix, ...], tuple[float, float, float]]:
    for topic in _held(bag, small, (NAV_SAT_FIX,)):
        messages = small.by_topic[topic.name]
        fixes, said = fixes_of_topic(messages)
        if not fixes:
            why[topic.name] = "no fix has a position"
            continue
        used[topic.name] = "place"
        notes += [f"{topic.name}: {one}" for one in said]
        antenna = messages[0][1].header.frame_id
        T = None if base is None else small.transforms.between(base, antenna)
        return fixes, (0.0, 0.0, 0.0) if T is None else (float(T[0, 3]), float(T[1, 3]), float(T[2, 3]))
    return (), (0.0, 0.0, 0.0)


def _motion(
    bag: Bag, small: Small, base: str | None, used: dict[str, str], why: dict[str, str], notes: list[str]
) -> tuple[MotionSample, ...]:
    imus = _held(bag, small, (IMU,))
    imu = small.by_topic[imus[0].name] if imus else []
    R = None
    if imu and base is not None:
        T = small.transforms.between(base, imu[0][1].header.frame_id)
        R = None if T is None else T[:3, :3]
    for topic in _held(bag, small, SPEEDS):
        samples, said = motion_of_topic(topic.kind, small.by_topic[topic.name], imu, R)
        if not samples:
            why[topic.name] = said
            continue
        used[topic.name] = "speed" if said else "speed and yaw rate"
        if said:
            used[imus[0].name] = "yaw rate"
        if (lost := len({t_ns for t_ns, _ in small.by_topic[topic.name]}) - len(samples)) > 0:
            notes.append(f"{topic.name}: {lost} speeds without a number or without a turn rate near them: left out")
        return samples
    why.update({one.name: "gives no speed" for one in imus})
    return ()


def _place(fixes: tuple[GnssFix, ...]) -> RecordingAnchor | None:
    if not fixes:
        return None
    first = fixes[0]
    return RecordingAnchor(float(np.degrees(first.lat_rad)), float(np.degrees(first.lon_rad)), first.height_m)


def _entries(bag: Bag, clouds: str, detail: str, found: _Measured, mount: str) -> tuple[Entry, ...]:
    entries = []
    for topic in bag.topics:
        used, why = found.used.get(topic.name, ""), found.why.get(topic.name, "")
        if topic.name == clouds:
            used = "scans"
        if topic.kind == TF and "static" in topic.name:
            used, why = (f"mount: {mount}" if mount else ""), "it does not connect the clouds with the vehicle"
        if topic.kind in (POSE, POSE_COVARIANCE, ODOMETRY) and not used:
            why = why or f"--poses {topic.name} takes it as the track"
        if topic.kind in PACKETS:
            why = "packets"
        entries.append(Entry(topic.name, topic.kind, topic.count, detail if topic.name == clouds else "", used, why))
    return tuple(entries)
