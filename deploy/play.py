"""`gnd play`: a recording as if the vehicle drove now, on topics of ROS 2 over rmw_zenoh."""

import heapq
import logging
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Final

import click

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import DEFAULT_ENDPOINT, BusConfig
from gnd.fleet_bus.identity.options import identity_option
from gnd.fleet_bus.ros2 import LATCHED_QOS, MAX_DOMAIN, NO_HASH, SENSOR_QOS, RosNode, RosQos, RosTopic
from gnd.fleet_bus.serving import Request
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, MotionSample, Scan
from gnd.schemas.drive_mcap import REFERENCE_TOPIC, message_of, read_drive, read_header, topics_of
from gnd.schemas.errors import DriveError
from gnd.schemas.keys import live_key
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.sources.plain_keys import header_message
from gnd.vehicle_agent.sources.recording import paced
from gnd.vehicle_agent.sources.ros2_messages import (
    CLOUD,
    FIX,
    ODOMETRY,
    TRANSFORMS,
    fix_message,
    motion_message,
    scan_message,
    transform_message,
    type_hash,
)

VEHICLE_FRAME, LIDAR_FRAME = "base_link", "lidar"
START_S: Final = 0.5
"""From announcing the topics to the first message: subscribers find them in between."""
FIRST: Final = 500
"""The topics of so many messages are announced before the first is sent."""
_LOOK_S: Final = 0.1


@dataclass(frozen=True, slots=True)
class Played:
    """One message: its topic, its CDR, when it was measured, and when its driver would have sent it, ns."""

    topic: RosTopic
    qos: RosQos
    payload: bytes
    stamp_ns: int
    sent_ns: int


def messages_of_drive(header: DriveHeader, items: Iterator[DriveItem]) -> Iterator[Played]:
    """A drive's measurements as a vehicle's drivers publish them: a sweep when it has ended."""
    points, odometry, gnss, static = (
        RosTopic(name, kind, type_hash(kind))
        for name, kind in (("/points", CLOUD), ("/odometry", ODOMETRY), ("/gnss", FIX), ("/tf_static", TRANSFORMS))
    )
    reliable, told = RosQos(depth=0), False
    for item in items:
        if not told:
            told = True
            mount = transform_message(item.t_ns, VEHICLE_FRAME, LIDAR_FRAME, header.T_vehicle_lidar)
            yield Played(static, LATCHED_QOS, mount, item.t_ns, item.t_ns)
        match item:
            case Scan():
                sent_ns = item.t_ns + int(item.t_offset_ns.max(initial=0))
                yield Played(points, SENSOR_QOS, scan_message(item, LIDAR_FRAME), item.t_ns, sent_ns)
            case MotionSample():
                yield Played(odometry, reliable, motion_message(item, VEHICLE_FRAME), item.t_ns, item.t_ns)
            case GnssFix():
                yield Played(gnss, reliable, fix_message(item), item.t_ns, item.t_ns)


def play(
    node: RosNode, messages: Iterator[Played], pace: float, stop: threading.Event, listener_s: float = 0.0
) -> Counter[str]:
    """Publish messages at their times.

    Args:
        node: on which.
        messages: in the order in which they are sent, or nearly.
        pace: 1 in real time, 0 as fast as they can be sent.
        stop: ends it.
        listener_s: so long somebody is waited for who listens to clouds.

    Returns:
        How many, by topic.
    """
    coming = _by_sending(messages)
    first = list(islice(coming, FIRST))
    publishers = {m.topic: node.publisher(m.topic, m.qos) for m in {m.topic: m for m in first}.values()}
    _wait_for_listener(node, {topic.name for topic in publishers if topic.type_name == CLOUD}, listener_s, stop)
    sent: Counter[str] = Counter()
    start_s = time.monotonic() + START_S
    for message in chain(first, coming):
        if message.topic not in publishers:
            publishers[message.topic] = node.publisher(message.topic, message.qos)
        due_s = start_s + (message.sent_ns - first[0].sent_ns) * 1e-9 / pace if pace else start_s
        if stop.wait(max(0.0, due_s - time.monotonic())):
            break
        publishers[message.topic].put(message.payload, message.sent_ns)
        sent[message.topic.name] += 1
    stop.wait(START_S)  # what was sent last is still on its way
    return sent


def _wait_for_listener(node: RosNode, topics: set[str], most_s: float, stop: threading.Event) -> None:
    until_s = time.monotonic() + most_s
    while time.monotonic() < until_s and not stop.wait(_LOOK_S):
        if any(one.kind == "MS" and one.topic.name in topics for one in node.endpoints()):
            return


def _by_sending(messages: Iterator[Played]) -> Iterator[Played]:
    """Messages in the order in which they are sent: what is measured over a while is sent at its end."""
    waiting: list[tuple[int, int, Played]] = []
    for number, message in enumerate(messages):
        while waiting and waiting[0][0] <= message.stamp_ns:
            yield heapq.heappop(waiting)[2]
        heapq.heappush(waiting, (message.sent_ns, number, message))
    while waiting:
        yield heapq.heappop(waiting)[2]


def messages_of_bag(path: Path) -> Iterator[Played]:
    """The messages of a bag of ROS 2 (MCAP or SQLite, a file or its folder), byte for byte, when they were recorded.

    Raises:
        ImportDriveError: it is none, or damaged.
    """
    from rosbags.highlevel import AnyReader, AnyReaderError

    try:
        with AnyReader([path]) as reader:
            for connection, t_ns, payload in reader.messages():
                topic = RosTopic(connection.topic, connection.msgtype, connection.digest or NO_HASH)
                latched = connection.topic.endswith("/tf_static")
                yield Played(topic, LATCHED_QOS if latched else RosQos(depth=0), bytes(payload), t_ns, t_ns)
    except AnyReaderError as error:
        raise ImportDriveError(f"{path}: neither a drive nor a bag of ROS 2: {error}") from error


def play_plain(
    bus: Bus, vehicle: str, recording: Path, pace: float, stop: threading.Event, listener_s: float = 0.0
) -> Counter[str]:
    """Put the messages of a drive of ours on the plain keys of a vehicle, each when it was measured.

    Args:
        bus: open.
        vehicle: pseudonym, part of the keys.
        recording: the drive.
        pace: 1 in real time, 0 as fast as they can be sent.
        stop: ends it.
        listener_s: so long somebody is waited for who asks for the header.

    Returns:
        How many, by topic.

    Raises:
        DriveError: it is no drive, or damaged.
    """
    header, asked = read_header(recording), threading.Event()
    topics = [topic for topic in topics_of(recording) if topic != REFERENCE_TOPIC]  # which no vehicle has

    def answer(_: Request) -> bytes:
        asked.set()
        return header_message(header, topics)

    sent: Counter[str] = Counter()
    with bus.serve(live_key(vehicle, "header"), answer):
        asked.wait(listener_s)
        stop.wait(START_S)  # who has asked listens a moment later
        for item in paced(read_drive(recording), pace, stop):
            topic, message = message_of(item)
            if stop.is_set():
                break
            if topic in topics:
                bus.publish(live_key(vehicle, topic), message, kind="control")
                sent[topic] += 1
        stop.wait(START_S)
    return sent


@click.command(name="play")
@identity_option
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--ros2", "on", flag_value="ros2", help="On topics of ROS 2 over rmw_zenoh.")
@click.option("--zenoh", "on", flag_value="zenoh", help="On plain keys: a drive of ours with all that it holds.")
@click.option("--connect", multiple=True, default=(DEFAULT_ENDPOINT,), show_default=True, help="Router; repeatable.")
@click.option("--domain", type=click.IntRange(0, MAX_DOMAIN), default=0, show_default=True, help="ROS_DOMAIN_ID.")
@click.option("--vehicle", default="vehicle", show_default=True, help="Pseudonym, part of plain keys.")
@click.option("--pace", type=click.FloatRange(min=0), default=1.0, show_default=True, help="1 = real time.")
@click.option("--wait", type=click.FloatRange(min=0), default=0.0, help="Seconds to wait for somebody who listens.")
def play_command(
    recording: Path, on: str | None, connect: tuple[str, ...], domain: int, vehicle: str, pace: float, wait: float
) -> None:
    """Publish RECORDING as a vehicle's sensors would: a drive of ours, or a bag of ROS 2 byte for byte.

    `gnd agent --live ros2` (or zenoh) drives on it, and so does whatever else listens to these topics.
    """
    if on is None:
        raise click.UsageError("on what: --ros2 or --zenoh?")
    if not recording.exists():
        raise ImportDriveError(f"no recording at {recording}")
    logging.basicConfig(level=logging.ERROR, format="%(asctime)s %(name)s %(message)s")
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with open_bus(BusConfig(connect=connect), name="play") as bus:
        if on == "zenoh":
            sent = play_plain(bus, vehicle, recording, pace, stop, wait)
        else:
            sent = play(RosNode(bus, domain, "gnd_play"), messages_of(recording), pace, stop, wait)
    for topic, count in sorted(sent.items()):
        click.echo(f"{count:7d}  {topic}")


def messages_of(recording: Path) -> Iterator[Played]:
    """The messages of a drive of ours, or of a bag of ROS 2.

    Raises:
        ImportDriveError: it is neither.
        DriveError: a drive that is damaged.
    """
    try:
        header = read_header(recording)
    except DriveError:
        return messages_of_bag(recording)
    return messages_of_drive(header, read_drive(recording))
