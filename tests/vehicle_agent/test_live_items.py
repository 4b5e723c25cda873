"""Live measurements: in the order of their stamps, bounded, and refused where their times cannot be."""

import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.recording import GNSS_SIGMA_M
from gnd.vehicle_agent.importers.ros.small_messages import TWIST, TWIST_COVARIANCE
from gnd.vehicle_agent.sources.live import BACK_NS, MOST_SCANS, SCANS, LiveError, LiveItems
from gnd.vehicle_agent.sources.ros2_items import RosMotion, RosScans, fix_of_message
from gnd.vehicle_agent.sources.ros2_messages import (
    FIX,
    IMU,
    ODOMETRY,
    BadRosMessage,
    cloud_message,
    encode,
    fix_message,
    header,
    motion_message,
    scan_message,
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
    items.put(SCANS, now_ns, lambda: RosScans("/points", cloud).scan(cloud[: len(cloud) // 2]))
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


def test_a_clock_that_nobody_has_set_ends_the_drive() -> None:
    items = LiveItems([SCANS])
    items.put(SCANS, 12 * S, lambda: scan(12 * S))
    with pytest.raises(LiveError, match=r"stamped 12\.000 s after 1970: nobody has set its clock"):
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
    cloud = scan_message(one, "/lidar")
    scans = RosScans("/points", cloud)
    back = scans.scan(cloud)
    assert back is not None
    assert back.t_ns == one.t_ns
    for name in ("points_m", "t_offset_ns", "ring"):
        assert np.array_equal(getattr(back, name), getattr(one, name))
    assert (scans.frame, scans.rule.field, scans.shift_ns) == ("lidar", "t", 0)
    with pytest.raises(ImportDriveError):
        scans.scan(motion_message(MotionSample(1, 0.0, 0.0), "base_link"))


def test_a_cloud_stamped_at_its_end_begins_before_its_stamp() -> None:
    """A driver that counts back from the end, as Velodyne's does when it is told to."""
    points = np.zeros(100, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("time", "<f4")])
    points["x"], points["time"] = np.arange(1, 101), np.linspace(-0.1, 0.0, 100)
    cloud = cloud_message(5 * S, "lidar", points)
    scans = RosScans("/points", cloud)
    back = scans.scan(cloud)
    assert back is not None
    assert scans.shift_ns == pytest.approx(-0.1 * S, abs=10)
    assert back.t_ns == 5 * S + scans.shift_ns


def test_positions_have_the_receivers_sigma() -> None:
    fix = GnssFix(3 * S, 0.6227, 2.4391, 44.5, 1.75)
    back = fix_of_message(fix_message(fix))
    assert back is not None
    assert (back.t_ns, back.sigma_m, back.height_m) == (fix.t_ns, fix.sigma_m, fix.height_m)
    assert back.lat_rad == pytest.approx(fix.lat_rad, rel=1e-14)
    here = {"header": header(3 * S, "gnss"), "latitude": 35.0, "longitude": 139.0}
    assert fix_of_message(encode(FIX, here | {"status": {"status": -1}})) is None
    unknown = fix_of_message(encode(FIX, here))
    assert unknown is not None
    assert unknown.sigma_m == GNSS_SIGMA_M


def test_a_gyro_that_is_turned_gives_the_rate_about_the_vehicles_vertical() -> None:
    motion = RosMotion(ODOMETRY, np.diag([1.0, -1.0, -1.0]))  # upside down

    def rate(t_ns: int, z: float) -> bytes:
        return encode(IMU, {"header": header(t_ns, "imu"), "angular_velocity": {"x": 0.5, "z": z}})

    def speed(t_ns: int) -> bytes:
        return motion_message(MotionSample(t_ns, 7.0, 9.9), "base_link")

    ms = S // 1000
    assert motion.twist(speed(S)) is None
    assert motion.gyro(rate(S + 10 * ms, -0.25)) is None  # no rate is known before the speed's time
    assert motion.twist(speed(S + 15 * ms)) is None
    sample = motion.gyro(rate(S + 20 * ms, -0.35))
    assert sample is not None
    assert (sample.t_ns, sample.speed_mps) == (S + 15 * ms, 7.0)
    assert sample.yaw_rate_radps == pytest.approx(0.3)
    assert motion.twist(speed(S + 25 * ms)) is None
    assert motion.gyro(rate(S + 900 * ms, -0.35)) is None  # a gap
    plain = RosMotion(ODOMETRY)
    assert plain.twist(speed(S)) == MotionSample(S, 7.0, 9.9)


def test_an_odometry_without_speeds_ends_the_drive() -> None:
    """Some drivers fill the pose alone: a vehicle that believed them would stand."""

    def at(x: float, speed: float) -> bytes:
        values = {"header": header(S, "odom"), "pose": {"pose": {"position": {"x": x}}}}
        return encode(ODOMETRY, values | {"twist": {"twist": {"linear": {"x": speed}}}})

    motion = RosMotion(ODOMETRY)
    assert motion.twist(at(5.0, 0.0)) == MotionSample(S, 0.0, 0.0)
    assert motion.twist(at(5.9, 0.0)) == MotionSample(S, 0.0, 0.0)
    with pytest.raises(LiveError, match=r"twist is zero although its poses have moved by 1\.1 m.*live\.speed"):
        motion.twist(at(6.1, 0.0))
    drives = RosMotion(ODOMETRY)
    drives.twist(at(0.0, 3.0))
    assert drives.twist(at(9.0, 0.0)) == MotionSample(S, 0.0, 0.0)


@pytest.mark.parametrize(
    ("kind", "twist"),
    [(TWIST, {"linear": {"x": 3.0}, "angular": {"z": 0.5}}),
     (TWIST_COVARIANCE, {"twist": {"linear": {"x": 3.0}, "angular": {"z": 0.5}}})],
)  # fmt: skip
def test_twists_are_motion_too(kind: str, twist: dict[str, object]) -> None:
    message = encode(kind, {"header": header(S, "base_link"), "twist": twist})
    assert RosMotion(kind).twist(message) == MotionSample(S, 3.0, 0.5)


def test_an_unknown_field_is_refused() -> None:
    with pytest.raises(BadRosMessage, match="has no field lattitude"):
        encode(FIX, {"lattitude": 1.0})
