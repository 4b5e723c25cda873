"""Damaged recordings: what is read is what was written, or a DriveError of one line; never something in between."""

import random
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.drive import DriveHeader, GnssFix, MotionSample, ReferencePose, Scan
from gnd.schemas.drive_mcap import DriveWriter, drive_counts, load_track, read_drive, read_header
from gnd.schemas.errors import DriveError

T0_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A small drive with several chunks."""
    path = tmp_path_factory.mktemp("good") / "drive.mcap"
    rng = np.random.default_rng(0)
    header = DriveHeader("drive-1", "car-1", "VLP-16", LocalFrame(0.65, 2.2, 30.0), np.eye(4), "test")
    with DriveWriter(path, header) as writer:
        for k in range(4):
            t_ns = T0_NS + k * 100_000_000
            writer.motion(MotionSample(t_ns, 1.0 + k, 0.1))
            writer.gnss(GnssFix(t_ns, 0.65, 2.2, 30.0, 2.5))
            writer.reference(ReferencePose(t_ns, np.eye(4)))
            points = rng.normal(0, 9, (200, 3)).astype(np.float32)
            writer.scan(Scan(t_ns, points, np.arange(200, dtype=np.uint32)))
    return path.read_bytes()


def content(path: Path) -> list[bytes]:
    """Everything in a drive as bytes."""
    header = read_header(path)
    found = [repr((header.drive_id, header.anchor, header.source)).encode(), header.T_vehicle_lidar.tobytes()]
    for item in read_drive(path):
        if isinstance(item, Scan):
            found += [item.points_m.tobytes(), item.t_offset_ns.tobytes()]
        elif isinstance(item, ReferencePose):
            found.append(item.T_map_vehicle.tobytes())
        else:
            found.append(repr(item).encode())
    track = load_track(path)
    return [*found, *(column.tobytes() for part in track for column in part), repr(drive_counts(path)).encode()]


def outcome(path: Path, data: bytes) -> list[bytes] | str:
    """What a file with these bytes holds, or the error."""
    path.write_bytes(data)
    try:
        return content(path)
    except DriveError as error:
        return str(error)


def assert_refused_in_one_line(error: object, path: Path) -> None:
    assert isinstance(error, str)
    assert error.startswith(str(path))
    assert "\n" not in error
    assert len(error) < 400


def test_a_flipped_bit_is_noticed_or_harmless(good: bytes, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    whole = outcome(path, good)
    assert len(whole) > 20
    rng = random.Random(4)
    refused = 0
    for _ in range(400):
        data = bytearray(good)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        found = outcome(path, bytes(data))
        if found != whole:
            assert_refused_in_one_line(found, path)
            refused += 1
    assert refused > 250


def test_a_recording_that_is_cut_off_is_refused(good: bytes, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    for end in [*range(60), *range(60, len(good) - 60, 97), *range(len(good) - 60, len(good))]:
        found = outcome(path, good[:end])
        assert_refused_in_one_line(found, path)
        assert "cut off" in found


def test_bytes_lost_inside_or_put_in_are_noticed(good: bytes, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    rng = random.Random(5)
    for _ in range(100):
        at = rng.randrange(8, len(good) - 45)
        lost = good[:at] + good[at + rng.randint(1, 30) :]
        assert_refused_in_one_line(outcome(path, lost), path)
        more = good[:at] + rng.randbytes(rng.randint(1, 30)) + good[at:]
        assert_refused_in_one_line(outcome(path, more), path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", r"recording of 0 bytes is cut off"),
        (b"hello", r"not an MCAP file: it begins with b'hello'"),
        (b"\x89PNG\r\n\x1a\n" + bytes(1000), r"not an MCAP file"),
        (
            b"\x89MCAP0\r\n" + bytes(1000),
            r"recording is cut off \(no footer at its end\); restore it with `mcap recover`",
        ),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(data)
    for read in (read_header, load_track, drive_counts, lambda p: list(read_drive(p))):
        with pytest.raises(DriveError, match=message):
            read(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DriveError, match=r"absent\.mcap: no such drive"):
        read_header(tmp_path / "absent.mcap")
    with pytest.raises(DriveError, match="not a readable drive"):
        read_header(tmp_path)


def foreign(path: Path, topic: str) -> Path:
    """An MCAP file of someone else."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = register_schema(writer, LocationFix)
        channel = writer.register_channel(topic=topic, message_encoding="protobuf", schema_id=schema)
        writer.add_message(channel, T0_NS, LocationFix(latitude=37.5).SerializeToString(), T0_NS)
        writer.finish()
    return path


def test_a_foreign_recording_is_refused_with_what_to_do(tmp_path: Path) -> None:
    path = foreign(tmp_path / "other.mcap", "/fix")
    with pytest.raises(
        DriveError, match=r"without a metadata record 'gnd\.drive'; turn it into a drive with `gnd import auto"
    ):
        read_header(path)
    assert list(read_drive(path)) == []


def test_a_topic_of_ours_with_another_message_is_refused(tmp_path: Path) -> None:
    path = foreign(tmp_path / "other.mcap", "/lidar/points")
    with pytest.raises(DriveError, match=r"/lidar/points carries foxglove\.LocationFix, expected foxglove\.PointCloud"):
        list(read_drive(path))


def test_a_fix_without_covariance_is_refused(tmp_path: Path) -> None:
    path = foreign(tmp_path / "other.mcap", "/gnss")
    with pytest.raises(DriveError, match=r"GNSS fix at 0 ns has no known covariance \(0 of 9 values\)"):
        list(read_drive(path))


def test_a_chunk_that_would_unpack_to_too_much_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, good: bytes
) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(good)
    monkeypatch.setattr("gnd.schemas.limits.MAX_CHUNK_BYTES", 10_000)
    with pytest.raises(DriveError, match=r"chunk at byte \d+ unpacks to \d+ bytes, the limit is 10000"):
        list(read_drive(path))
