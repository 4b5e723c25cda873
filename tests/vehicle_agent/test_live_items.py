"""Live measurements: in the order of their stamps, bounded, and refused where their times cannot be."""

import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.sources.live import BACK_NS, MOST_SCANS, SCANS, LiveError, LiveItems
from gnd.vehicle_agent.sources.ros2_items import (
    RosMotion,
    T_between,
    fix_of_message,
    has_point_times,
    scan_of_message,
    stamped_transforms,
)
from gnd.vehicle_agent.sources.ros2_messages import (
    FIX,
    IMU,
    TRANSFORMS,
    BadRosMessage,
    decode,
    encode,
    fix_message,
    header,
    motion_message,
    scan_message,
    transform_message,
)
from gnd.vehicle_agent.sources.stamp_order import HOLD_S, StampOrder

NEVER = threading.Event()
S = 1_000_000_000


def scan(t_ns: int) -> Scan:
    rng = np.random.default_rng(t_ns % 1000)
    points_m = rng.normal(0, 10, (100, 3)).astype(np.float32)
    return Scan(t_ns, points_m, np.linspace(0, 1e8, 100).astype(np.uint32), np.arange(100, dtype=np.uint16) % 16)


@given(
    st.dictionaries(st.sampled_from("abc"), st.sets(st.integers(0, 1000), max_size=30).map(sorted), min_size=1),
    st.randoms(use_true_random=False),
)
def test_streams_in_order_are_merged_like_a_sorted_recording(streams: dict[str, list[int]], random) -> None:
    order: StampOrder[tuple[int, str, int]] = StampOrder(sorted(streams))
    waiting = {name: [(t, name, i) for i, t in enumerate(stamps)] for name, stamps in streams.items()}
    given_out: list[tuple[int, str, int]] = []
    while any(waiting.values()):  # however the messages interleave on their way
        name = random.choice([name for name, items in waiting.items() if items])
        item = waiting[name].pop(0)
        order.put(name, item[0], item, 0.0)
        given_out += order.take(0.0)
    given_out += order.take(HOLD_S)
    assert given_out == sorted(given_out) == sorted((t, n, i) for n, ts in streams.items() for i, t in enumerate(ts))
    assert not len(order)
    assert not any(order.late.values())


def test_nothing_waits_longer_for_a_silent_stream() -> None:
    order: StampOrder[str] = StampOrder(["gnss", "scans"])
    order.put("scans", 10, "first", 0.0)
    order.put("scans", 20, "second", 0.1)
    assert order.take(HOLD_S - 0.01) == []
    assert order.take(HOLD_S) == ["first"]
    order.put("gnss", 5, "late", 0.35)
    assert order.late["gnss"] == 1
    assert order.take(0.35) == ["late"]
    order.put("gnss", 30, "fix", 0.36)
    assert order.take(0.36) == ["second"]


def test_the_newest_scans_count_and_the_others_are_counted() -> None:
    items = LiveItems(["odometry", SCANS])
    now_ns = time.time_ns()
    for i in range(MOST_SCANS + 7):
        items.put(SCANS, now_ns + i, lambda i=i: scan(now_ns + i))
        items.put("odometry", now_ns + i, lambda i=i: MotionSample(now_ns + i, 1.0, 0.0))
    got = list(items.drive(NEVER, silent_s=0.01))
    assert [item.t_ns - now_ns for item in got if isinstance(item, Scan)] == list(range(7, MOST_SCANS + 7))
    assert sum(isinstance(item, MotionSample) for item in got) == MOST_SCANS + 7
    assert items.account()["scans_left_out"] == 7


def test_a_message_that_is_none_is_named_and_left_out(caplog: pytest.LogCaptureFixture) -> None:
    items, now_ns = LiveItems([SCANS, "gnss"]), time.time_ns()
    cloud, fix = scan_message(scan(now_ns), "lidar"), fix_message(GnssFix(now_ns, 0.8, 0.1, 5.0, 1.0))
    items.put(SCANS, now_ns, lambda: scan_of_message("/points", cloud[: len(cloud) // 2]))
    items.put("gnss", now_ns, lambda: fix_of_message(fix[:30]))
    items.put("gnss", now_ns + 1, lambda: fix_of_message(fix))
    got = list(items.drive(NEVER, silent_s=0.01))
    assert [type(item) for item in got] == [GnssFix]
    assert items.account()["unreadable"] == {SCANS: 1, "gnss": 1}
    assert "/points: cut off" in caplog.text


@pytest.mark.parametrize(
    ("shift_ns", "message"),
    [
        (-BACK_NS - S, r"time went back by \d+\.\d s: .* start the agent again"),
        (400 * S, r"400 s ahead of this machine"),
    ],
)
def test_times_that_cannot_be_end_the_drive(shift_ns: int, message: str) -> None:
    items, now_ns = LiveItems([SCANS]), time.time_ns()
    items.put(SCANS, now_ns, lambda: scan(now_ns))
    items.put(SCANS, now_ns + shift_ns, lambda: scan(now_ns + shift_ns))
    with pytest.raises(LiveError, match=message):
        list(items.drive(NEVER, silent_s=1.0))


def test_clocks_that_differ_are_told_once(caplog: pytest.LogCaptureFixture) -> None:
    items, now_ns = LiveItems([SCANS, "odometry"]), time.time_ns()
    for i in range(5):
        items.put(SCANS, now_ns + i, lambda: None)
        items.put("odometry", now_ns + i - 3 * S, lambda: None)
    list(items.drive(NEVER, silent_s=0.01))
    assert len([r for r in caplog.records if "clocks are 3.00 s apart" in r.getMessage()]) == 1
    assert len([r for r in caplog.records if "odometry: stamps are 3.0 s behind" in r.getMessage()]) == 1
    assert items.account()["clock_offset_s"]["odometry"] == pytest.approx(-3.0, abs=0.5)


def test_scans_survive_as_they_are() -> None:
    one = scan(17 * S + 5)
    cloud = scan_message(one, "lidar")
    back = scan_of_message("here", cloud)
    assert back is not None
    assert back.t_ns == one.t_ns
    for name in ("points_m", "t_offset_ns", "ring"):
        assert np.array_equal(getattr(back, name), getattr(one, name))
    assert has_point_times("here", cloud)
    with pytest.raises(ImportDriveError):
        scan_of_message("here", motion_message(MotionSample(1, 0.0, 0.0), "base_link"))


def test_positions_have_the_receivers_sigma() -> None:
    fix = GnssFix(3 * S, 0.6227, 2.4391, 44.5, 1.75)
    back = fix_of_message(fix_message(fix))
    assert back is not None
    assert (back.t_ns, back.sigma_m, back.height_m) == (fix.t_ns, fix.sigma_m, fix.height_m)
    assert back.lat_rad == pytest.approx(fix.lat_rad, rel=1e-14)
    none = {"status": {"status": -1}, "latitude": 35.0, "longitude": 139.0}
    assert fix_of_message(encode(FIX, none)) is None
    unknown = fix_of_message(encode(FIX, {"latitude": 35.0, "longitude": 139.0}))
    assert unknown is not None
    assert unknown.sigma_m == 10.0


def test_a_gyro_that_is_turned_gives_the_rate_about_the_vehicles_vertical() -> None:
    upside_down = np.diag([1.0, -1.0, -1.0])
    motion = RosMotion(gyro=True, R_vehicle_imu=upside_down)
    rate = encode(IMU, {"header": header(2 * S, "imu"), "angular_velocity": {"x": 0.5, "z": -0.25}})
    assert motion.imu(rate) is None  # no speed yet
    assert motion.odometry(motion_message(MotionSample(S, 7.0, 9.9), "base_link")) is None
    assert motion.imu(rate) == MotionSample(2 * S, 7.0, 0.25)
    assert RosMotion(gyro=False).odometry(motion_message(MotionSample(S, 7.0, 0.1), "base_link")) == MotionSample(
        S, 7.0, 0.1
    )


def test_mounts_are_found_along_the_tree_of_frames() -> None:
    T = np.eye(4)
    T[:3, 3] = 1.0, 0.0, 0.5
    tree = {"sensors": ("base_link", T), "lidar": ("sensors", T), "imu": ("base_link", T)}
    found = T_between(tree, "base_link", "lidar")
    assert found is not None
    assert found[:3, 3].tolist() == [2.0, 0.0, 1.0]
    sideways = T_between(tree, "imu", "lidar")
    assert sideways is not None
    assert sideways[:3, 3].tolist() == [1.0, 0.0, 0.5]
    assert T_between(tree, "base_link", "camera") is None
    with pytest.raises(BadRosMessage, match="circle"):
        T_between({"a": ("b", T), "b": ("a", T)}, "c", "a")


def test_a_transform_without_rotation_is_refused() -> None:
    message = decode(TRANSFORMS, transform_message(1, "a", "b", np.eye(4)))
    message.transforms[0].transform.rotation.w = 0.0
    with pytest.raises(BadRosMessage, match="length 0"):
        list(stamped_transforms(message))


def test_an_unknown_field_is_refused() -> None:
    with pytest.raises(BadRosMessage, match="has no field lattitude"):
        encode(FIX, {"lattitude": 1.0})
