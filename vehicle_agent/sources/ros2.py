"""A vehicle on ROS 2: its topics over rmw_zenoh as a source of measurements. No ROS needs to be installed."""

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import NoRouter
from gnd.fleet_bus.ros2 import LATCHED_QOS, RosEndpoint, RosMessage, RosNode, RosQos, RosTopic, publishers_of
from gnd.gnd_map.arrays import F64
from gnd.schemas.drive import DriveItem
from gnd.vehicle_agent.config import LiveParameters
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.choices import mount_of_numbers
from gnd.vehicle_agent.importers.point_cloud2 import decode_cloud, head_of
from gnd.vehicle_agent.importers.ros.small_messages import SPEEDS
from gnd.vehicle_agent.importers.ros.transforms import StaticTransforms
from gnd.vehicle_agent.sources.live import ROUTER_WAIT_S, SCANS, LiveError, LiveItems
from gnd.vehicle_agent.sources.ros2_items import RosMotion, RosScans, fix_of_message
from gnd.vehicle_agent.sources.ros2_messages import CLOUD, FIX, IMU, ODOMETRY, TRANSFORMS, decode, type_hash

EVERYTHING: Final = RosQos(reliable=True, depth=0)
"""Small measurements are never left out."""
CLOUDS: Final = RosQos(reliable=False, depth=10)
NEEDED: Final[dict[str, tuple[str, ...]]] = {"points": (CLOUD,), "gnss": (FIX,), "speed": SPEEDS}
"""Settings of topics, and the types that will do, the best first."""
SPEED, GYRO, GNSS = "speed", "gyro", "gnss"
SETTLE_S: Final = 1.0
"""Publishers that start together are all there by then."""
MOUNT_WAIT_S: Final = 5.0
TELL_S: Final = 5.0
_LOOK_S: Final = 0.05

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RosTopics:
    """Which topic gives what; "": none does."""

    points: str
    gnss: str
    speed: str
    speed_kind: str
    imu: str


class RosSource:
    """The topics of one vehicle, listened to; made by `open_ros2`, and driven once `wait_ready` has come back.

    Attributes:
        node: of this agent in the graph.
        topics: what is listened to.
        T_vehicle_lidar: (4, 4) the mount.
    """

    def __init__(self, node: RosNode, topics: RosTopics) -> None:
        self.node, self.topics = node, topics
        self.T_vehicle_lidar = np.eye(4)
        self._first: dict[str, bytes] = {}
        self._frames = StaticTransforms()
        self._scans: RosScans | None = None
        self._motion = RosMotion(topics.speed_kind)
        streams = {  # of equal stamps in this order, as a drive is read from its file
            SCANS: (topics.points, CLOUD),
            SPEED: (topics.speed, topics.speed_kind),
            GYRO: (topics.imu, IMU),
            GNSS: (topics.gnss, FIX),
        }
        streams = {stream: (topic, kind) for stream, (topic, kind) in streams.items() if topic}
        self.items = LiveItems(list(streams))
        static = RosTopic("/tf_static", TRANSFORMS, type_hash(TRANSFORMS))
        node.subscribe(static, self._take_frames, LATCHED_QOS)
        self._subscriptions = []
        for stream, (topic, kind) in streams.items():
            qos = CLOUDS if stream == SCANS else EVERYTHING
            taken = node.subscribe(RosTopic(topic, kind, type_hash(kind)), partial(self._put, stream), qos)
            self._subscriptions.append(taken)

    @property
    def has_times(self) -> bool:
        """Whether the clouds tell the times of their points."""
        return self._scans is not None and self._scans.rule.field is not None

    def account(self) -> dict[str, Any]:
        """What came and what did not, as plain values."""
        lost = {one.topic.name: one.lost + one.dropped for one in self._subscriptions if one.lost + one.dropped}
        return {**self.items.account(), "lost_on_the_way": lost}

    def wait_ready(self, live: LiveParameters, stop: threading.Event) -> None:
        """Wait for the first sweep, and find out how LiDAR and gyro are mounted.

        Raises:
            LiveError: stopped before, or nobody tells a mount.
            ImportDriveError: a cloud that is none.
        """
        needed = {SCANS, SPEED} | ({GYRO} if self.topics.imu else set())
        while missing := needed - self._first.keys():
            if stop.wait(_LOOK_S):
                raise LiveError(f"stopped before anything came of {', '.join(sorted(missing))}")
        self._scans = RosScans(self.topics.points, self._first[SCANS])
        given = mount_of_numbers(live.mount) if live.mount else None
        self.T_vehicle_lidar = self._wait_frame(live, self._scans.frame, stop) if given is None else given
        if self.topics.imu:
            imu = decode(IMU, self._first[GYRO]).header.frame_id
            self._motion = RosMotion(self.topics.speed_kind, self._wait_frame(live, imu, stop)[:3, :3])

    def _put(self, stream: str, message: RosMessage) -> None:
        try:
            t_ns, _ = head_of(message.topic, message.payload)
            if stream not in self._first and self._shows(stream, message):
                self._first[stream] = message.payload
        except ImportDriveError as error:
            self.items.refuse(stream, error)
            return
        if stream == SCANS and self._scans is not None:
            t_ns += self._scans.shift_ns
        self.items.put(stream, t_ns, lambda: self._read(stream, message.payload))

    def _shows(self, stream: str, message: RosMessage) -> bool:
        """Whether a message can be the first: how times of points are counted, a cloud without points does not show."""
        return stream != SCANS or len(decode_cloud(message.topic, message.payload).points) > 0

    def _read(self, stream: str, data: bytes) -> DriveItem | None:
        """The measurement of a message; called once `wait_ready` has come back."""
        if stream == SCANS:
            return None if self._scans is None else self._scans.scan(data)
        if stream == GNSS:
            return fix_of_message(data)
        return self._motion.twist(data) if stream == SPEED else self._motion.gyro(data)

    def _take_frames(self, message: RosMessage) -> None:
        self._frames.add(decode(TRANSFORMS, message.payload).transforms)

    def _wait_frame(self, live: LiveParameters, frame: str, stop: threading.Event) -> F64:
        """T_vehicle_frame from /tf_static."""
        deadline_s = time.monotonic() + MOUNT_WAIT_S
        while True:
            base = live.vehicle_frame or self._frames.base(self._odometry_frames())
            if base is not None and (T := self._frames.between(base, frame)) is not None:
                return T
            if time.monotonic() >= deadline_s or stop.wait(_LOOK_S):
                known = ", ".join(sorted(self._frames.frames)) or "none"
                raise LiveError(
                    f"/tf_static does not lead from the vehicle's frame {base!r} to {frame!r} (frames: {known}): give"
                    " --set live.vehicle_frame=NAME, or the LiDAR's mount in m and degrees:"
                    " --set live.mount=[x,y,z,roll,pitch,yaw]"
                )

    def _odometry_frames(self) -> list[str]:
        if self.topics.speed_kind != ODOMETRY:
            return []
        return [decode(ODOMETRY, self._first[SPEED]).child_frame_id]


@contextmanager
def open_ros2(live: LiveParameters, vehicle: str, stop: threading.Event) -> Iterator[RosSource]:
    """Join the graph, find the topics, wait for the first sweep and the mount.

    Args:
        live: which router, domain, topics and frames.
        vehicle: pseudonym, part of the node's name.
        stop: ends the waiting.

    Raises:
        LiveError: no router, several topics of a kind, or no mount; stopped before.
    """
    try:
        bus = open_bus(BusConfig(connect=live.connect, open_timeout_s=ROUTER_WAIT_S), name=f"{vehicle} ros2")
    except NoRouter as error:
        raise LiveError(f"{error}, or with `ros2 run rmw_zenoh_cpp rmw_zenohd`") from error
    name = "gnd_" + "".join(c if c.isascii() and c.isalnum() else "_" for c in vehicle)
    with RosNode(bus, live.domain, name) as node:
        source = RosSource(node, find_topics(node, live, stop))
        source.wait_ready(live, stop)
        yield source


def find_topics(node: RosNode, live: LiveParameters, stop: threading.Event) -> RosTopics:
    """The topics that are named, else the only ones of their types that somebody publishes.

    They are waited for as long as it takes. A gyro is used where it is named.

    Raises:
        LiveError: several topics could be meant; stopped before.
    """
    began_s, told = time.monotonic(), False
    while missing := _missing(live, node.endpoints()):
        if not told and time.monotonic() - began_s >= TELL_S:
            told = True
            _log.warning("domain %d: waiting for somebody who publishes %s", live.domain, " and ".join(missing))
        if stop.wait(_LOOK_S):
            raise LiveError(f"domain {live.domain}: stopped before anybody published {' and '.join(missing)}")
    stop.wait(SETTLE_S)
    found = node.endpoints()
    points, gnss, speed = (_only(live, name, kinds, found) for name, kinds in NEEDED.items())
    kinds = {one.topic.name: one.topic.type_name for one in found if one.kind == "MP"}
    if kinds.get(speed) not in SPEEDS:
        raise LiveError(f"{speed}: {kinds.get(speed, 'nobody')} gives no speed; {', '.join(SPEEDS)} do")
    return RosTopics(points, gnss, speed, kinds[speed], live.imu)


def _missing(live: LiveParameters, found: list[RosEndpoint]) -> list[str]:
    """What nobody publishes yet."""
    published = {one.topic.name for one in found if one.kind == "MP"}
    missing = []
    for name, kinds in NEEDED.items():
        named = getattr(live, name)
        if named not in published and (named or not any(publishers_of(found, kind) for kind in kinds)):
            missing.append(named or kinds[0])
    return missing


def _only(live: LiveParameters, name: str, kinds: tuple[str, ...], found: list[RosEndpoint]) -> str:
    named: str = getattr(live, name)
    topics = next((topics for kind in kinds if (topics := publishers_of(found, kind))), [])
    if not named and len(topics) > 1:
        raise LiveError(
            f"{len(topics)} topics could be meant ({', '.join(topics)}): choose with --set live.{name}=/TOPIC"
        )
    return named or topics[0]
