"""Recorded drives: what is written is read back, in time order, in little memory, and opens as Foxglove expects."""

import contextlib
import itertools
import resource
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, MotionSample, ReferencePose, Scan
from gnd.schemas.drive_mcap import DriveWriter, drive_counts, load_track, read_drive, read_header
from gnd.schemas.drive_messages import cloud_of, scan_of
from gnd.schemas.errors import BadValue, DriveError, TooLarge

T0_NS = 1_700_000_000_000_000_000
S = 1_000_000_000
ANCHOR = LocalFrame(0.6555, 2.2172, 30.25)


def pose(x_m: float, yaw_rad: float = 0.3) -> np.ndarray:
    return T_from_R_t(exp_so3([0.01, -0.02, yaw_rad]), [x_m, -2.0, 0.5])


HEADER = DriveHeader("drive-1", "car-1", "VLP-16", ANCHOR, pose(0.7, -1.5), "made by a test; CC0")


def scan(t_ns: int, n: int = 500, seed: int = 0, ring: bool = True) -> Scan:
    rng = np.random.default_rng(seed)
    return Scan(
        t_ns,
        rng.normal(0, 20, (n, 3)).astype(np.float32),
        np.sort(rng.integers(0, 10**8, n)).astype(np.uint32),
        rng.integers(0, 16, n).astype(np.uint16) if ring else None,
    )


def items(seconds: int = 3) -> list[DriveItem]:
    """A drive of some seconds: scans at 10 Hz, motion at 50 Hz, GNSS and poses at 5 Hz, in the order of time."""
    found: list[DriveItem] = []
    for k in range(seconds * 50):
        t_ns = T0_NS + k * S // 50
        found.append(MotionSample(t_ns, 10.0 + k / 7, -0.01 * k))
        if k % 5 == 0:
            found.append(scan(t_ns + 1, seed=k))
        if k % 10 == 0:
            found.append(GnssFix(t_ns + 2, 0.65 + k * 1e-7, 2.2 - k * 1e-7, 31.5, 2.5))
            found.append(ReferencePose(t_ns + 3, pose(k / 5, k / 100)))
    return found


def write(path: Path, content: list[DriveItem], header: DriveHeader = HEADER) -> Path:
    with DriveWriter(path, header) as writer:
        for item in content:
            writer.add(item)
    return path


def assert_same(found: DriveItem, expected: DriveItem) -> None:
    assert type(found) is type(expected)
    assert found.t_ns == expected.t_ns
    if isinstance(found, Scan) and isinstance(expected, Scan):
        assert np.array_equal(found.points_m, expected.points_m)
        assert np.array_equal(found.t_offset_ns, expected.t_offset_ns)
        assert (found.ring is None) == (expected.ring is None)
        assert found.ring is None or np.array_equal(found.ring, expected.ring)
    elif isinstance(found, ReferencePose) and isinstance(expected, ReferencePose):
        np.testing.assert_allclose(found.T_map_vehicle, expected.T_map_vehicle, atol=1e-14)
    elif isinstance(found, GnssFix) and isinstance(expected, GnssFix):
        assert found.lat_rad == pytest.approx(expected.lat_rad, abs=1e-15)
        assert found.lon_rad == pytest.approx(expected.lon_rad, abs=1e-15)
        assert (found.height_m, found.sigma_m) == (expected.height_m, expected.sigma_m)
    else:
        assert found == expected


def test_a_drive_is_read_back_in_time_order(tmp_path: Path) -> None:
    content = items()
    path = write(tmp_path / "drive.mcap", content)
    found = list(read_drive(path))
    assert len(found) == len(content)
    for one, expected in zip(found, content, strict=True):
        assert_same(one, expected)


def test_items_written_late_are_read_in_time_order(tmp_path: Path) -> None:
    content = items(25)
    late = sorted(content, key=lambda item: item.t_ns + (2 * S if isinstance(item, GnssFix) else 0))
    assert [i.t_ns for i in late] != [i.t_ns for i in content]
    found = list(read_drive(write(tmp_path / "drive.mcap", late)))
    assert [i.t_ns for i in found] == [i.t_ns for i in content]


def test_the_header_is_read_back(tmp_path: Path) -> None:
    header = read_header(write(tmp_path / "drive.mcap", items(1)))
    np.testing.assert_allclose(header.T_vehicle_lidar, HEADER.T_vehicle_lidar, atol=1e-15)
    assert (header.drive_id, header.vehicle, header.sensor_model) == ("drive-1", "car-1", "VLP-16")
    assert (header.anchor, header.source) == (ANCHOR, HEADER.source)


def test_a_drive_without_items_has_a_header_and_nothing_else(tmp_path: Path) -> None:
    path = write(tmp_path / "drive.mcap", [])
    assert read_header(path).drive_id == "drive-1"
    assert list(read_drive(path)) == []
    assert [len(track.t_ns) for track in load_track(path)] == [0, 0, 0]
    assert load_track(path).reference.T_map_vehicle.shape == (0, 4, 4)


def test_the_track_holds_what_the_items_hold(tmp_path: Path) -> None:
    content = items()
    track = load_track(write(tmp_path / "drive.mcap", content))
    motion = [i for i in content if isinstance(i, MotionSample)]
    gnss = [i for i in content if isinstance(i, GnssFix)]
    reference = [i for i in content if isinstance(i, ReferencePose)]
    assert track.motion.t_ns.tolist() == [m.t_ns for m in motion]
    assert track.motion.speed_mps.tolist() == [m.speed_mps for m in motion]
    assert track.motion.yaw_rate_radps.tolist() == [m.yaw_rate_radps for m in motion]
    assert track.gnss.t_ns.tolist() == [g.t_ns for g in gnss]
    np.testing.assert_allclose(track.gnss.lat_rad, [g.lat_rad for g in gnss], atol=1e-15)
    assert track.gnss.sigma_m.tolist() == [2.5] * len(gnss)
    np.testing.assert_allclose(track.reference.T_map_vehicle, [r.T_map_vehicle for r in reference], atol=1e-14)


def test_the_counts_come_from_the_summary(tmp_path: Path) -> None:
    counts = drive_counts(write(tmp_path / "drive.mcap", items(3)))
    assert counts[:4] == (30, 150, 15, 15)
    assert counts.first_ns == T0_NS
    assert counts.last_ns == T0_NS + 149 * S // 50


def test_reading_the_track_unpacks_no_scan(tmp_path: Path) -> None:
    path = write(tmp_path / "drive.mcap", [s for k in range(40) for s in (scan(T0_NS + k * S, 50_000, k),)] + items(2))
    assert path.stat().st_size > 20_000_000
    tracemalloc.start()
    load_track(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 3_000_000


def test_reading_holds_a_few_scans_at_a_time(tmp_path: Path) -> None:
    path = write(tmp_path / "drive.mcap", [scan(T0_NS + k * S // 10, 50_000, k) for k in range(60)])
    tracemalloc.start()
    seen = sum(len(item) for item in read_drive(path) if isinstance(item, Scan))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert seen == 3_000_000
    assert peak < 12_000_000  # a scan is 0.9 MB; the whole drive 54 MB


@given(st.integers(0, 2**62), st.integers(0, 3000), st.booleans())
@settings(max_examples=30)
def test_any_scan_survives(t_ns: int, n: int, ring: bool) -> None:
    value = scan(t_ns, n, seed=n, ring=ring)
    assert_same(scan_of(PointCloud.FromString(cloud_of(value).SerializeToString())), value)


def test_points_are_rows_of_their_own_in_firing_order() -> None:
    found = scan_of(cloud_of(scan(T0_NS)))
    for array in (found.points_m, found.t_offset_ns, found.ring):
        assert array is not None
        assert array.flags.c_contiguous
        assert array.flags.aligned
    assert np.array_equal(found.points_m, scan(T0_NS).points_m)


# As others see it


def decoded(path: Path) -> Iterator[tuple[str, str, Any]]:
    """Topic, schema and message, decoded from the schemas in the file itself, as Foxglove does."""
    with path.open("rb") as stream:
        for schema, channel, _, message in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            assert schema is not None
            yield channel.topic, schema.name, message


def test_the_file_describes_itself_with_foxgloves_schemas(tmp_path: Path) -> None:
    found = {(topic, schema) for topic, schema, _ in decoded(write(tmp_path / "drive.mcap", items(1)))}
    assert found == {
        ("/lidar/points", "foxglove.PointCloud"),
        ("/vehicle/motion", "gnd.v1.VehicleMotion"),
        ("/gnss", "foxglove.LocationFix"),
        ("/reference/pose", "foxglove.PoseInFrame"),
        ("/tf", "foxglove.FrameTransform"),
        ("/tf_static", "foxglove.FrameTransform"),
    }


def test_another_reader_finds_the_same_points_positions_and_frames(tmp_path: Path) -> None:
    first = {}
    for topic, _, message in decoded(write(tmp_path / "drive.mcap", items(1))):
        first.setdefault(topic, message)
    cloud, expected = first["/lidar/points"], scan(T0_NS + 1, seed=0)
    assert [(f.name, f.offset, f.type) for f in cloud.fields] == [
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("t_offset", 12, 5), ("ring", 16, 3)
    ]  # fmt: skip
    assert (cloud.frame_id, cloud.point_stride, len(cloud.data)) == ("lidar", 18, 500 * 18)
    assert np.frombuffer(cloud.data[:12], "<f4").tolist() == expected.points_m[0].tolist()
    assert (cloud.timestamp.seconds, cloud.timestamp.nanos) == (1_700_000_000, 1)
    fix = first["/gnss"]
    assert fix.latitude == pytest.approx(np.degrees(0.65), abs=1e-12)
    assert (fix.position_covariance[0], fix.position_covariance_type) == (6.25, 2)
    mount, tf = first["/tf_static"], first["/tf"]
    assert (mount.parent_frame_id, mount.child_frame_id) == ("vehicle", "lidar")
    assert (tf.parent_frame_id, tf.child_frame_id) == ("map", "vehicle")
    truth = first["/reference/pose"].pose
    assert (tf.translation.x, tf.translation.y, tf.translation.z) == (truth.position.x, -2.0, 0.5)
    assert (tf.rotation.z, tf.rotation.w) == (truth.orientation.z, truth.orientation.w)


def test_points_that_are_not_finite_are_left_out_when_a_foreign_cloud_is_read() -> None:
    whole = scan(T0_NS, seed=0)
    cloud = cloud_of(whole)
    packed = np.frombuffer(cloud.data, [("xyz", "<f4", 3), ("t_offset", "<u4"), ("ring", "<u2")]).copy()
    packed["xyz"][7, 1], packed["xyz"][9, 0] = np.nan, np.inf
    cloud.data = packed.tobytes()
    read = scan_of(cloud)
    kept = np.delete(np.arange(len(whole)), [7, 9])
    assert np.array_equal(read.points_m, whole.points_m[kept])
    assert np.array_equal(read.t_offset_ns, whole.t_offset_ns[kept])


def test_the_time_line_of_the_file_is_that_of_the_drive(tmp_path: Path) -> None:
    with write(tmp_path / "drive.mcap", items(1)).open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages()]
    assert times == sorted(times)
    assert times[0] == T0_NS
    assert times[-1] < T0_NS + S


# Written whole or not at all


def break_off(path: Path) -> None:
    with DriveWriter(path, HEADER) as writer:
        writer.scan(scan(T0_NS))
        raise RuntimeError("the sensor is gone")


def test_a_failed_recording_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="the sensor is gone"):
        break_off(tmp_path / "drive.mcap")
    assert list(tmp_path.iterdir()) == []


@contextlib.contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """The operating system refuses to let any file grow further, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("count", [1, 40], ids=["noticed at the end", "noticed on the way"])
def test_a_full_disk_is_named_and_leaves_nothing_behind(tmp_path: Path, count: int) -> None:
    scans = [scan(T0_NS + k * S, 10_000, k) for k in range(count)]
    with files_of_at_most(100_000), pytest.raises(DriveError, match=r"drive\.mcap: cannot write drive: File too large"):
        write(tmp_path / "drive.mcap", scans)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_a_recording_has_its_name_only_when_it_is_whole(tmp_path: Path) -> None:
    path = write(tmp_path / "drive.mcap", items(1))
    before = path.read_bytes()
    with DriveWriter(path, HEADER) as writer:
        for item in items(2):
            writer.add(item)
        assert path.read_bytes() == before
    assert drive_counts(path).scans == 20
    assert [p.name for p in tmp_path.iterdir()] == ["drive.mcap"]


def test_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DriveError, match=r"absent/drive\.mcap: cannot write drive: No such file or directory"):
        DriveWriter(tmp_path / "absent" / "drive.mcap", HEADER)


# Values and messages that cannot be


def test_values_of_a_drive_check_themselves() -> None:
    points, offset = np.zeros((3, 3), np.float32), np.zeros(3, np.uint32)
    with pytest.raises(BadValue, match=r"points_m: expected dtype float32, got float64"):
        Scan(0, points.astype(np.float64), offset)  # type: ignore[arg-type]
    with pytest.raises(BadValue, match=r"t_offset_ns: expected shape \(3,\), got \(2,\)"):
        Scan(0, points, offset[:2])
    with pytest.raises(BadValue, match=r"1 of 9 values are not finite"):
        Scan(0, np.where(np.arange(9).reshape(3, 3) == 4, np.nan, points).astype(np.float32), offset)
    with pytest.raises(BadValue, match=r"scan time -1 is outside"):
        Scan(-1, points, offset)
    with pytest.raises(BadValue, match="motion at 5 ns: nan m/s"):
        MotionSample(5, float("nan"), 0.0)
    with pytest.raises(BadValue, match=r"GNSS fix at 5 ns: latitude 37\.5 rad lies beyond a pole; are these degrees"):
        GnssFix(5, 37.5, 127.0, 0.0, 1.0)
    with pytest.raises(BadValue, match=r"sigma -1\.0 m"):
        GnssFix(5, 0.5, 2.0, 0.0, -1.0)


@pytest.mark.parametrize(
    "T", [np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.0, 1.0, 1.01, 1.0]), np.eye(4) + np.eye(4)[[3, 0, 1, 2]] * 0.1]
)
def test_poses_that_are_not_rigid_are_refused(T: np.ndarray) -> None:
    with pytest.raises(BadValue, match="is not a rigid transform: off by"):
        ReferencePose(0, T)


def cloud(**changes: Any) -> PointCloud:
    message = cloud_of(scan(T0_NS, 10))
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def test_point_clouds_that_cannot_be_used_are_refused_with_what_is_wrong() -> None:
    with pytest.raises(BadValue, match="179 bytes of points are no multiple of the 18 bytes of a point"):
        scan_of(cloud(data=bytes(179)))
    with pytest.raises(BadValue, match="points of 4 bytes with fields x, y, z, t_offset, ring"):
        scan_of(cloud(point_stride=4))
    with pytest.raises(BadValue, match="points of 0 bytes"):
        scan_of(cloud(point_stride=0))
    without_time = cloud()
    del without_time.fields[3]
    with pytest.raises(BadValue, match="points lack t_offset; deskewing needs the time of each point"):
        scan_of(without_time)
    doubles = cloud(point_stride=32)
    doubles.fields[0].type = 8
    with pytest.raises(BadValue, match=r"point field 'x' is float64 at byte 0, expected <f4 at byte 0"):
        scan_of(doubles)
    unknown = cloud()
    unknown.fields[4].type = 0
    with pytest.raises(BadValue, match="point field 'ring' has an unknown numeric type"):
        scan_of(unknown)
    moved = cloud()
    moved.pose.position.x = 1.0
    with pytest.raises(BadValue, match="has a pose of its own in frame 'lidar'"):
        scan_of(moved)
    with pytest.raises(TooLarge, match="has 4000001 points, the limit is 4000000"):
        scan_of(cloud(data=bytes(18 * 4_000_001)))


def test_a_cloud_with_more_fields_and_padding_is_understood() -> None:
    plain = scan(T0_NS, 50)
    message = cloud_of(plain)
    packed = np.frombuffer(message.data, np.uint8).reshape(50, 18)
    message.data = np.hstack([packed, np.full((50, 6), 7, np.uint8)]).tobytes()
    message.point_stride = 24
    message.fields.add(name="intensity", offset=20, type=7)
    assert_same(scan_of(message), plain)


def test_every_kind_of_item_can_be_added(tmp_path: Path) -> None:
    kinds = {type(item) for item in read_drive(write(tmp_path / "drive.mcap", items(1)))}
    assert kinds == {Scan, MotionSample, GnssFix, ReferencePose}
    assert all(a is not b for a, b in itertools.pairwise(kinds))
