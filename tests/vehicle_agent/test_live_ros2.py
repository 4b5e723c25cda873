"""A vehicle that drives now, on topics of ROS 2 over a real router, against the same drive from its file."""

import threading
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from gnd.deploy.play import messages_of, play, play_plain
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.ros2 import LATCHED_QOS, RosMessage, RosNode, RosQos, RosTopic
from gnd.gnd_map.arrays import F64
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.schemas.errors import SchemaError
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.config import AgentConfig, LiveParameters
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.cleaning import cleaned
from gnd.vehicle_agent.importers.ros.reader import open_ros
from gnd.vehicle_agent.sources.live import LiveError
from gnd.vehicle_agent.sources.plain_keys import open_plain, read_header_message
from gnd.vehicle_agent.sources.ros2 import open_ros2
from gnd.vehicle_agent.sources.ros2_messages import (
    CLOUD,
    DIAGNOSTICS,
    FIX,
    ODOMETRY,
    POSE,
    decode,
    type_hash,
)
from gnd.vehicle_agent.vehicle import open_vehicle

NEVER = threading.Event()
STORE = get_typestore(Stores.ROS2_JAZZY)


def node(endpoint: str, name: str) -> RosNode:
    return RosNode(open_bus(BusConfig(connect=(endpoint,)), name=name), 0, name)


def driven(config: AgentConfig) -> tuple[dict[str, Any], dict[int, F64]]:
    """What a drive came to, and its refined poses by time."""
    with open_vehicle(config, NEVER) as vehicle:
        for item in vehicle.drive():
            vehicle.push(item)
        vehicle.finish()
        return vehicle.result(), {one.t_ns: one.T_map_vehicle for one in vehicle.evaluation.estimates}


def played(endpoint: str, recording: Path) -> threading.Thread:
    def run() -> None:
        with node(endpoint, "play") as player:
            play(player, messages_of(recording), 1.0, NEVER, listener_s=30.0)

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def test_what_arrives_is_what_was_recorded(endpoint: str, recordings: Path) -> None:
    """Every scan, motion sample and fix, in the order of time; angles go through degrees and back."""
    recording, live = recordings / "probe.mcap", LiveParameters(source="ros2", connect=(endpoint,))
    playing = played(endpoint, recording)
    with open_ros2(live, "car-1", NEVER) as source:
        arrived = list(source.items.drive(NEVER, silent_s=1.0))
        account = source.account()
    playing.join()
    kept = [item for item in read_drive(recording) if isinstance(item, Scan | MotionSample | GnssFix)]
    assert [(type(item), item.t_ns) for item in arrived] == [(type(item), item.t_ns) for item in kept]
    for got, item in zip(arrived, kept, strict=True):
        if isinstance(item, Scan) and isinstance(got, Scan):
            assert np.array_equal(got.points_m, item.points_m)
            assert np.array_equal(got.t_offset_ns, item.t_offset_ns)
        elif isinstance(item, GnssFix):
            assert astuple(got) == pytest.approx(astuple(item), rel=1e-12)
        else:
            assert got == item
    assert np.allclose(source.T_vehicle_lidar, read_header(recording).T_vehicle_lidar, atol=1e-12)
    assert source.has_times
    assert account["scans_left_out"] == 0
    assert account["late"] == account["unreadable"] == account["lost_on_the_way"] == {}


@pytest.mark.slow
def test_a_vehicle_that_drives_now_finds_the_way_of_the_recording_and_tells_ros_of_it(
    cloud: Bus, endpoint: str, recordings: Path, tmp_path: Path
) -> None:
    quick = replace(AgentConfig("v", recordings, tmp_path).report, drain_s=0.2)  # nobody acknowledges here
    from_file = AgentConfig("probe", recordings / "probe.mcap", tmp_path / "file", connect=(endpoint,), report=quick)
    live = LiveParameters(source="ros2", connect=(endpoint,), silent_s=2.0)
    heard: dict[str, list[RosMessage]] = {}
    with (
        SqliteStore(recordings / "map.sqlite") as store,
        TileServer(store, cloud),
        node(endpoint, "listener") as listener,
    ):
        expected, expected_poses = driven(from_file)
        for name, kind in (
            ("pose", POSE),
            ("health", DIAGNOSTICS),
            ("map", CLOUD),
            ("changes", CLOUD),
            ("origin", FIX),
        ):
            qos = LATCHED_QOS if name in ("map", "origin") else RosQos(depth=0)
            listener.subscribe(RosTopic(f"/gnd/{name}", kind), heard.setdefault(name, []).append, qos)
        playing = played(endpoint, recordings / "probe.mcap")
        result, poses = driven(replace(from_file, drive=None, work_dir=tmp_path / "live", live=live))
        playing.join()

    left_out = result["live"]["scans_left_out"]  # on a busy machine, while the first tiles come
    assert result["scans"] + left_out == expected["scans"] == 55
    assert set(poses) <= set(expected_poses)
    assert len(poses) >= 55 - left_out
    apart_m = [float(np.linalg.norm(poses[t][:3, 3] - expected_poses[t][:3, 3])) for t in poses]
    assert max(apart_m) < (0.03 if left_out else 1e-6)
    assert_told(heard, result)


def assert_told(heard: dict[str, list[RosMessage]], result: dict[str, Any]) -> None:
    poses = [decode(POSE, message.payload) for message in heard["pose"]]
    assert len(poses) >= 40
    assert {pose.header.frame_id for pose in poses} == {"gnd_map"}
    x_m = np.array([(pose.pose.pose.position.x, pose.pose.pose.position.y) for pose in poses])
    assert 0.6 < np.linalg.norm(np.diff(x_m, axis=0), axis=1).sum() / (1000 * result["distance_km"]) < 1.1
    assert all(0 < pose.pose.covariance[0] < 1 for pose in poses)
    told = [decode(DIAGNOSTICS, message.payload).status[0] for message in heard["health"]]
    assert told[-1].message == "good"
    assert told[-1].level == 0
    assert len(heard["origin"]) == 1
    assert decode(CLOUD, heard["map"][-1].payload).width > 1000
    changes = [decode(CLOUD, message.payload) for message in heard["changes"]]
    assert sum(cloud.width for cloud in changes) == result["changed_voxels"]


def test_a_bag_that_is_played_gives_what_its_import_gives(endpoint: str, recordings: Path, tmp_path: Path) -> None:
    """A bag of ROS 2 in SQLite, byte for byte on the topics: live and imported, the same measurements."""
    bag = tmp_path / "bag"
    with Writer(bag, version=9) as writer:
        connections: dict[str, Any] = {}
        for message in messages_of(recordings / "probe.mcap"):
            name = message.topic.name
            if name not in connections:
                connections[name] = writer.add_connection(name, message.topic.type_name, typestore=STORE)
            writer.write(connections[name], message.sent_ns, message.payload)
    playing = played(endpoint, bag)
    with open_ros2(LiveParameters(source="ros2", connect=(endpoint,)), "car-1", NEVER) as source:
        arrived = list(source.items.drive(NEVER, silent_s=1.0))
    playing.join()
    recording = open_ros(bag, None)
    scans = [item for item in arrived if isinstance(item, Scan)]
    assert [scan.t_ns for scan in scans] == recording.t_ns.tolist()
    for i, scan in enumerate(scans):
        expected = cleaned(recording.read(i)).scan
        assert expected is not None
        for name in ("points_m", "t_offset_ns", "ring"):
            assert np.array_equal(getattr(scan, name), getattr(expected, name))
    assert [item for item in arrived if isinstance(item, MotionSample)] == list(recording.motion)
    assert [item for item in arrived if isinstance(item, GnssFix)] == list(recording.gnss)
    assert np.array_equal(source.T_vehicle_lidar, recording.T_vehicle_lidar)


def test_what_is_neither_drive_nor_bag_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"nothing")
    with pytest.raises(ImportDriveError, match="neither a drive nor a bag"):
        list(messages_of(tmp_path / "x.mcap"))


def test_several_topics_of_a_kind_must_be_told_apart(endpoint: str) -> None:
    with node(endpoint, "drivers") as drivers:
        for name, kind in (("/left", CLOUD), ("/right", CLOUD), ("/gnss", FIX), ("/odometry", ODOMETRY)):
            drivers.publisher(RosTopic(name, kind, type_hash(kind)))
        with pytest.raises(LiveError, match=r"2 topics could be meant \(/left, /right\): .*live\.points"):
            enter(LiveParameters(source="ros2", connect=(endpoint,)))


def test_a_mount_that_nobody_tells_is_asked_for(
    endpoint: str, recordings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gnd.vehicle_agent.sources.ros2.MOUNT_WAIT_S", 0.2)
    playing = played(endpoint, recordings / "probe.mcap")
    with pytest.raises(LiveError, match=r"does not lead from the vehicle's frame 'vehicle' to 'lidar' .*live\.mount"):
        enter(LiveParameters(source="ros2", connect=(endpoint,), vehicle_frame="vehicle"))
    told = LiveParameters(source="ros2", connect=(endpoint,), mount=(1.0, 0.0, 2.0, 0.0, 0.0, 90.0))
    with open_ros2(told, "car-1", NEVER) as source:
        assert source.T_vehicle_lidar[:3, 3].tolist() == [1.0, 0.0, 2.0]
        assert source.T_vehicle_lidar[:3, 0] == pytest.approx([0.0, 1.0, 0.0])
    playing.join()


def test_without_a_router_or_a_vehicle_it_says_what_is_missing(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gnd.vehicle_agent.sources.ros2.ROUTER_WAIT_S", 0.2)
    with pytest.raises(LiveError, match=r"rmw_zenohd"):
        enter(LiveParameters(source="ros2", connect=("tcp/127.0.0.1:9",)))
    stop = threading.Event()
    threading.Timer(0.5, stop.set).start()
    with pytest.raises(
        LiveError,
        match=r"before anybody published sensor_msgs/msg/PointCloud2 and sensor_msgs/msg/NavSatFix and nav_msgs",
    ):
        enter(LiveParameters(source="ros2", connect=(endpoint,)), stop)


def enter(live: LiveParameters, stop: threading.Event = NEVER) -> None:
    with open_ros2(live, "car-1", stop):
        pass


def test_plain_keys_carry_a_drive_as_it_is(endpoint: str, recordings: Path) -> None:
    recording, live = recordings / "probe.mcap", LiveParameters(source="zenoh", connect=(endpoint,))

    def run() -> None:
        with open_bus(BusConfig(connect=(endpoint,)), name="sensors") as bus:
            play_plain(bus, "car-1", recording, 1.0, NEVER, listener_s=30.0)

    playing = threading.Thread(target=run)
    playing.start()
    with open_plain(live, "car-1", NEVER) as source:
        arrived = list(source.items.drive(NEVER, silent_s=1.0))
        account = source.account()
    playing.join()
    kept = [item for item in read_drive(recording) if isinstance(item, Scan | MotionSample | GnssFix)]
    assert source.header == read_header(recording)
    assert sorted((item.t_ns, type(item).__name__) for item in arrived) == sorted(
        (item.t_ns, type(item).__name__) for item in kept
    )
    assert account["scans_left_out"] == 0
    assert account["late"] == account["unreadable"] == account["lost_on_the_way"] == {}


@pytest.mark.parametrize("body", [b"", b"{}", b"[1]", b'{"metadata": {}, "T_vehicle_lidar": [], "topics": []}'])
def test_a_header_that_is_none_is_refused(body: bytes) -> None:
    with pytest.raises(SchemaError):
        read_header_message(body)
