"""A vehicle on ROS 2: its topics over rmw_zenoh as a source of measurements. No ROS needs to be installed."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import NoRouter
from gnd.fleet_bus.ros2 import LATCHED_QOS, RosMessage, RosNode, RosQos, RosTopic, publishers_of
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import exp_so3
from gnd.schemas.drive import DriveItem
from gnd.vehicle_agent.config import LiveParameters
from gnd.vehicle_agent.importers.point_cloud2 import decode_cloud, stamp_ns
from gnd.vehicle_agent.sources.live import ROUTER_WAIT_S, SCANS, LiveError, LiveItems
from gnd.vehicle_agent.sources.ros2_items import (
    RosMotion,
    T_between,
    fix_of_message,
    has_point_times,
    scan_of_message,
    stamped_transforms,
)
from gnd.vehicle_agent.sources.ros2_messages import (
    CLOUD,
    FIX,
    IMU,
    ODOMETRY,
    TRANSFORMS,
    decode,
    type_hash,
)

NO_TOPIC: Final = "none"
"""For a topic in the settings: nobody gives it."""
EVERYTHING: Final = RosQos(reliable=True, depth=0)
"""Small measurements are never left out."""
CLOUDS: Final = RosQos(reliable=False, depth=10)
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
    odometry: str
    imu: str


class RosSource:
    """The topics of one vehicle, listened to; made by `open_ros2`.

    Attributes:
        node: of this agent in the graph.
        topics: what is listened to.
        T_vehicle_lidar: (4, 4) the mount.
        has_times: whether the clouds tell the times of their points.
    """

    def __init__(self, node: RosNode, topics: RosTopics) -> None:
        self.node, self.topics = node, topics
        self.T_vehicle_lidar, self.has_times = np.eye(4), False
        self._first: dict[str, bytes] = {}
        self._frames: dict[str, tuple[str, F64]] = {}
        self._motion = RosMotion(gyro=bool(topics.imu))
        streams: dict[str, tuple[str, str, Callable[[RosMessage], DriveItem | None]]] = {
            "odometry": (topics.odometry, ODOMETRY, lambda message: self._motion.odometry(message.payload)),
            "imu": (topics.imu, IMU, lambda message: self._motion.imu(message.payload)),
            "gnss": (topics.gnss, FIX, lambda message: fix_of_message(message.payload)),
            SCANS: (topics.points, CLOUD, lambda message: scan_of_message(message.topic, message.payload)),
        }
        streams = {stream: what for stream, what in streams.items() if what[0]}
        self.items = LiveItems(list(streams))
        static = RosTopic("/tf_static", TRANSFORMS, type_hash(TRANSFORMS))
        node.subscribe(static, self._take_frames, LATCHED_QOS)
        self._subscriptions = []
        for stream, (topic, kind, read) in streams.items():
            qos = CLOUDS if stream == SCANS else EVERYTHING
            taken = node.subscribe(RosTopic(topic, kind, type_hash(kind)), self._putting(stream, read), qos)
            self._subscriptions.append(taken)

    def drive(self, stop: threading.Event, silent_s: float) -> Iterator[DriveItem]:
        """Measurements in the order of their stamps; see `LiveItems.drive`."""
        return self.items.drive(stop, silent_s)

    def account(self) -> dict[str, Any]:
        """What came and what did not, as plain values."""
        lost = {one.topic.name: one.lost + one.dropped for one in self._subscriptions if one.lost + one.dropped}
        return {**self.items.account(), "lost_on_the_way": lost}

    def wait_ready(self, live: LiveParameters, stop: threading.Event) -> None:
        """Wait for the first sweep, and find out how LiDAR and gyro are mounted.

        Raises:
            LiveError: stopped before, or nobody tells the mount.
            ImportDriveError: a cloud that is none.
        """
        while SCANS not in self._first or (self.topics.imu and "imu" not in self._first):
            if stop.wait(_LOOK_S):
                raise LiveError(f"stopped before {self.topics.points} and {self.topics.imu or 'no gyro'} gave anything")
        cloud = decode_cloud(self.topics.points, self._first[SCANS])
        self.has_times = has_point_times(self.topics.points, self._first[SCANS])
        if live.mount:
            self.T_vehicle_lidar = mount_of(live.mount)
        else:
            self.T_vehicle_lidar = self._wait_frame(live.vehicle_frame, cloud.frame_id, stop)
        if self.topics.imu:
            imu = decode(IMU, self._first["imu"]).header.frame_id
            T_vehicle_imu = T_between(self._frames, live.vehicle_frame, imu.lstrip("/"))
            self._motion = RosMotion(gyro=True, R_vehicle_imu=None if T_vehicle_imu is None else T_vehicle_imu[:3, :3])

    def _putting(self, stream: str, read: Callable[[RosMessage], DriveItem | None]) -> Callable[[RosMessage], None]:
        def put(message: RosMessage) -> None:
            self._first.setdefault(stream, message.payload)
            t_ns = stamp_ns(message.topic, message.payload)
            self.items.put(stream, t_ns, lambda: read(message))

        return put

    def _take_frames(self, message: RosMessage) -> None:
        for parent, child, T_parent_child in stamped_transforms(decode(TRANSFORMS, message.payload)):
            self._frames[child] = parent, T_parent_child

    def _wait_frame(self, vehicle_frame: str, lidar_frame: str, stop: threading.Event) -> F64:
        deadline_s = time.monotonic() + MOUNT_WAIT_S
        while (T := T_between(dict(self._frames), vehicle_frame, lidar_frame.lstrip("/"))) is None:
            if time.monotonic() >= deadline_s or stop.wait(_LOOK_S):
                known = ", ".join(sorted(self._frames)) or "none"
                raise LiveError(
                    f"/tf_static does not lead from {vehicle_frame!r} to the LiDAR's frame {lidar_frame!r} (frames:"
                    f" {known}): give --set live.vehicle_frame=NAME, or the mount in m and degrees:"
                    " --set live.mount=[x,y,z,roll,pitch,yaw]"
                )
        return T


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
    """The topics that are named, else the only ones of their type that somebody publishes.

    Clouds, positions and odometry are waited for as long as it takes; a gyro is used where there is one by then.

    Raises:
        LiveError: several topics could be meant; stopped before.
    """
    began_s, told = time.monotonic(), False
    while missing := _missing(node, live):
        if not told and time.monotonic() - began_s >= TELL_S:
            told = True
            _log.warning("domain %d: waiting for somebody who publishes %s", live.domain, " and ".join(missing))
        if stop.wait(_LOOK_S):
            raise LiveError(f"domain {live.domain}: stopped before anybody published {' and '.join(missing)}")
    stop.wait(SETTLE_S)
    found = node.endpoints()
    return RosTopics(
        points=_only(live.points, publishers_of(found, CLOUD), "points"),
        gnss=_only(live.gnss, publishers_of(found, FIX), "gnss"),
        odometry=_only(live.odometry, publishers_of(found, ODOMETRY), "odometry"),
        imu=_only(live.imu, publishers_of(found, IMU), "imu"),
    )


def _missing(node: RosNode, live: LiveParameters) -> list[str]:
    found = node.endpoints()
    needed = (live.points, CLOUD), (live.gnss, FIX), (live.odometry, ODOMETRY)
    return [kind for named, kind in needed if not named and not publishers_of(found, kind)]


def _only(named: str, found: list[str], setting: str) -> str:
    if named:
        return "" if named == NO_TOPIC else named
    if len(found) > 1:
        topics = ", ".join(found)
        raise LiveError(f"{len(found)} topics could be meant ({topics}): choose with --set live.{setting}=/TOPIC")
    return found[0] if found else ""


def mount_of(mount: tuple[float, ...]) -> F64:
    """(4, 4) T_vehicle_lidar of x, y, z in m and roll, pitch, yaw in degrees, turned about x, then y, then z."""
    T = np.eye(4)
    roll, pitch, yaw = np.radians(mount[3:])
    T[:3, :3] = exp_so3([0, 0, yaw]) @ exp_so3([0, pitch, 0]) @ exp_so3([roll, 0, 0])
    T[:3, 3] = mount[:3]
    return T
