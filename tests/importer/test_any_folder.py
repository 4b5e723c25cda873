"""Any folder of scans: the format is found, every encoding gives the same points, and what is no scan is told."""

import io
import lzma
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from cloud_testing import SECOND, message_of, packed, write_clouds, write_ros
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from hypothesis import given, settings
from hypothesis import strategies as st
from lzf_testing import lzf_compress
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema
from mcap_ros2.decoder import DecoderFactory
from recording_testing import scan_of, true_pose, write_bin

from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import load_track, read_drive, read_header
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import import_recording, open_recording
from gnd.vehicle_agent.importer_cli import import_drives
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.point_cloud2 import decode_cloud
from gnd.vehicle_agent.importers.recording import RecordingAnchor

ANCHOR = RecordingAnchor(37.56, 127.03, 30.0)
START = 1_700_000_000 * SECOND
FEW = scan_of(0, 50).astype(np.float32)


def pcd(points: np.ndarray, data: str) -> bytes:
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
    head += f"POINTS {len(points)}\nDATA {data}\n"
    if data == "ascii":
        text = io.StringIO()
        np.savetxt(text, points, fmt="%.9g")
        return (head + text.getvalue()).encode()
    if data == "binary":
        return head.encode() + points.tobytes()
    columns = np.ascontiguousarray(points.T).tobytes()
    compressed = lzf_compress(columns)
    return head.encode() + np.array([len(compressed), len(columns)], "<u4").tobytes() + compressed


def pcd_folder(folder: Path, data: str, ending: str) -> Path:
    folder.mkdir()
    for k in range(3):
        content = pcd(FEW + np.float32(k), data)
        (folder / f"{k}{ending}").write_bytes(lzma.compress(content, preset=0) if ending.endswith("xz") else content)
    return folder


def kitti(folder: Path, ending: str) -> Path:
    below = folder / "sequence" / "bin_xz"
    below.mkdir(parents=True)
    for k in range(3):
        content = np.column_stack([FEW + np.float32(k), np.ones(len(FEW))]).astype(np.float32).tobytes()
        (below / f"{k}{ending}").write_bytes(lzma.compress(content, preset=0) if ending.endswith("xz") else content)
    return folder


def ros(path: Path, stamps: tuple[float, ...] = (0.0, 0.1, 0.2), topics: tuple[str, ...] = ("/points",)) -> Path:
    clouds = [
        (topic, START + k, message_of(packed(FEW + np.float32(k)), START + round(t * SECOND)))
        for k, t in enumerate(stamps)
        for topic in topics
    ]
    return write_ros(path, clouds)


MAKERS = {
    "bin": lambda p: kitti(p / "a", ".bin"),
    "bin.xz": lambda p: kitti(p / "a", ".bin.xz"),
    "pcd ascii": lambda p: pcd_folder(p / "a", "ascii", ".pcd"),
    "pcd binary": lambda p: pcd_folder(p / "a", "binary", ".pcd"),
    "pcd compressed": lambda p: pcd_folder(p / "a", "binary_compressed", ".pcd"),
    "pcd.xz": lambda p: pcd_folder(p / "a", "binary_compressed", ".pcd.xz"),
    "ros 2 file": lambda p: ros(p / "a.mcap"),
    "ros 2 folder": lambda p: ros(p / "a.mcap").parent,
}


@pytest.mark.parametrize("name", MAKERS)
def test_every_format_is_found_and_gives_the_same_points(tmp_path, name):
    recording = open_recording("auto", MAKERS[name](tmp_path), ANCHOR)
    assert len(recording) == 3
    for k in range(3):
        np.testing.assert_allclose(recording.read(k).points_m, FEW + np.float32(k), rtol=1e-6)


def test_times_and_rings_of_a_ros_cloud(tmp_path):
    scan = open_recording("mcap", ros(tmp_path / "a.mcap")).read(1)
    assert scan.t_ns == pytest.approx(
        START + SECOND // 10 - SECOND // 20, abs=2
    )  # times of points count from the stamp, here its middle
    assert scan.t_offset_ns[0] == 0
    assert int(scan.t_offset_ns[-1]) == pytest.approx(SECOND // 10, abs=100)
    assert scan.ring.tolist()[:17] == [*range(16), 0]


def test_a_ros_recording_becomes_a_drive(tmp_path):
    """The way as it was driven, found from clouds alone."""
    clouds = []
    for k in range(4):
        points = packed(scan_of(k))
        points["time"] = 0.0
        clouds.append(("/points", START + k, message_of(points, START + k * SECOND // 10)))
    path = write_ros(tmp_path / "a.mcap", clouds)
    result = CliRunner().invoke(
        import_drives, ["auto", str(path), "-o", str(tmp_path / "b.mcap"), "--nowhere"], catch_exceptions=False
    )
    assert "4 scans" in result.output
    reference = load_track(tmp_path / "b.mcap").reference
    np.testing.assert_allclose(reference.T_map_vehicle[3, :2, 3], true_pose(3)[:2, 3], atol=0.03)


@settings(max_examples=60, deadline=None)
@given(
    kinds=st.lists(st.sampled_from(["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]), max_size=5),
    order=st.sampled_from("<>"),
    height=st.sampled_from([1, 2, 5]),
    padding=st.integers(0, 9),
    seed=st.integers(0, 99),
)
def test_point_cloud2_agrees_with_foxgloves_decoder(kinds, order, height, padding, seed):
    names = [("x", "f4"), ("y", "f4"), ("z", "f4"), *((f"f{i}", kind) for i, kind in enumerate(kinds))]
    dtype = np.dtype([(name, order + kind) for name, kind in names])
    points = np.frombuffer(np.random.default_rng(seed).bytes(10 * dtype.itemsize), dtype)
    data = bytes_of(message_of(points, START + 7, height, padding))
    cloud = decode_cloud("test", data[0])
    assert (cloud.stamp_ns, cloud.frame_id) == (START + 7, "velodyne")
    assert cloud.points.tobytes() == points.tobytes()
    assert data[1].width * data[1].height == len(cloud.points)
    assert [field.name for field in data[1].fields] == list(cloud.points.dtype.names)


def bytes_of(message: dict) -> tuple[bytes, object]:
    """A message's CDR bytes, and what Foxglove's decoder makes of them."""
    stream = io.BytesIO()
    write_clouds(stream, [("/points", 1, message)])
    stream.seek(0)
    raw = next(iter(make_reader(stream).iter_messages()))[2].data
    stream.seek(0)
    return raw, next(iter(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()))[3]


CLOUD = bytes_of(message_of(packed(FEW[:5]), START))[0]


@given(st.integers(0, len(CLOUD) - 2))
def test_a_cloud_cut_off_anywhere_is_refused(n):
    with pytest.raises(ImportDriveError, match="test: "):
        decode_cloud("test", CLOUD[:n])


@given(st.integers(4, len(CLOUD) - 1), st.integers(0, 255))
def test_a_cloud_with_a_wrong_byte_never_breaks_the_reader(at, value):
    damaged = bytearray(CLOUD)
    damaged[at] = value
    try:
        decode_cloud("test", bytes(damaged))
    except ImportDriveError as error:
        assert "\n" not in str(error)  # noqa: PT017


def test_stamps_out_of_order_and_twice_are_put_right_and_told(tmp_path):
    recording = open_recording("auto", ros(tmp_path / "a.mcap", (0.0, 0.2, 0.1, 0.2, 0.3)))
    assert ((recording.t_ns - START) / SECOND).round(3).tolist() == [-0.05, 0.05, 0.15, 0.25]  # stamps are the middle
    np.testing.assert_allclose(recording.read(1).points_m, FEW + np.float32(2), rtol=1e-6)
    assert recording.notes == (
        "1 clouds were not in the order of their stamps: sorted",
        "1 clouds have the stamp of another: left out",
    )


def test_points_that_are_none_and_empty_scans_are_counted(kitti_folder, tmp_path):
    points = scan_of(3)
    points[:5] = np.nan
    points[5:7] = 2000.0
    write_bin(kitti_folder / "velodyne" / "000003.bin", points)
    write_bin(kitti_folder / "velodyne" / "000004.bin", np.full((7, 3), np.inf))
    (kitti_folder / "velodyne" / "000005.bin").write_bytes(b"")
    imported = import_recording("auto", kitti_folder, tmp_path / "a.mcap", anchor=ANCHOR)
    assert (imported.scans, imported.empty_scans) == (6, 2)
    assert (imported.points_not_finite, imported.points_too_far) == (12, 2)
    assert any("no times of points, not deskewed" in note for note in imported.skipped)
    assert imported.skipped[-3:] == (
        "2 scans without a usable point: left out",
        "12 points that are no numbers: left out",
        "2 points beyond 500 m: left out",
    )
    scans = [item for item in read_drive(tmp_path / "a.mcap") if isinstance(item, Scan)]
    assert [len(scan) for scan in scans] == [48_000] * 3 + [47_993] + [48_000] * 2


def test_nothing_but_empty_scans(tmp_path):
    for k in range(3):
        (tmp_path / f"{k}.bin").write_bytes(b"")
    with pytest.raises(ImportDriveError, match="0 scans with usable points; a track needs 2"):
        import_recording("auto", tmp_path, tmp_path / "a.mcap", anchor=ANCHOR)


def foxglove(path: Path) -> Path:
    """Clouds as another program writes them: float64 coordinates, a topic of its own."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = register_schema(writer, PointCloud)
        channel = writer.register_channel("/cloud", "protobuf", schema)
        for k in range(3):
            cloud = PointCloud(point_stride=24, data=(FEW + np.float32(k)).astype("<f8").tobytes())
            cloud.timestamp.FromNanoseconds(START + k * SECOND // 10)
            for i, name in enumerate("xyz"):
                cloud.fields.add(name=name, offset=8 * i, type=PackedElementField.FLOAT64)
            writer.add_message(channel, START + k, cloud.SerializeToString(), START + k)
        writer.finish()
    return path


def test_clouds_of_foxglove(tmp_path):
    recording = open_recording("auto", foxglove(tmp_path / "a.mcap"))
    assert (recording.t_ns - START).tolist() == [0, SECOND // 10, SECOND // 5]
    np.testing.assert_allclose(recording.read(2).points_m, FEW + np.float32(2), rtol=1e-6)


def test_a_drive_of_ours_keeps_what_it_holds(kitti_folder, tmp_path):
    import_recording("kitti", kitti_folder, tmp_path / "a.mcap", anchor=ANCHOR)
    recording = open_recording("auto", tmp_path / "a.mcap")
    header, track = read_header(tmp_path / "a.mcap"), load_track(tmp_path / "a.mcap")
    assert (recording.sensor_model, len(recording), len(recording.gnss)) == ("HDL-64E", 8, 8)
    np.testing.assert_array_equal(recording.track.T_dst_vehicle, track.reference.T_map_vehicle)
    np.testing.assert_array_equal(recording.T_vehicle_lidar, header.T_vehicle_lidar)
    assert recording.anchor.lat_deg == pytest.approx(37.56)
    np.testing.assert_array_equal(recording.read(5).points_m, scan_of(5).astype(np.float32))


def test_several_topics_need_a_choice(tmp_path):
    path = ros(tmp_path / "a.mcap", topics=("/front", "/rear"))
    with pytest.raises(ImportDriveError, match=r"2 topics \(/front, /rear\); choose one with --topic"):
        open_recording("auto", path)
    with pytest.raises(ImportDriveError, match=r"topic /top: .* clouds: /front, /rear"):
        open_recording("auto", path, topic="/top")
    assert len(open_recording("auto", path, topic="/rear")) == 3


def cut(path: Path, n: int) -> Path:
    path.write_bytes(path.read_bytes()[:-n])
    return path


def broken(tmp_path: Path, what: str) -> Path:
    if what == "xz":
        return cut(kitti(tmp_path / "a", ".bin.xz") / "sequence" / "bin_xz" / "1.bin.xz", 9).parents[2]
    if what == "no xz":
        kitti(tmp_path / "a", ".bin.xz").joinpath("sequence", "bin_xz", "1.bin.xz").write_bytes(b"this is not xz..")
    if what == "pcd":
        cut(pcd_folder(tmp_path / "a", "binary", ".pcd") / "1.pcd", 9)
    if what == "mixed":
        pcd_folder(tmp_path / "a", "binary", ".pcd")
        (tmp_path / "a" / "0.bin").write_bytes(bytes(16))
    if what == "file":
        (tmp_path / "a").write_bytes(bytes(16))
    if what == "empty":
        (tmp_path / "a").mkdir()
    return tmp_path / "a"


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("xz", "1.bin.xz: cut off after"),
        ("no xz", "1.bin.xz: 16 bytes that are not xz"),
        ("pcd", "1.pcd: 591 bytes of points, 600 announced"),
        ("mixed", "files 1 of bin and 3 of pcd: name the format"),
        ("file", "no single file of a kind that is read"),
        ("empty", "no scans (.bin, .bin.xz, .pcd, .pcd.xz, "),
        ("nothing", "no such file or folder"),
    ],
)
def test_what_is_wrong_is_told_with_the_file(tmp_path, what, message):
    with pytest.raises(ImportDriveError) as caught:
        import_recording(
            "auto", broken(tmp_path, what), tmp_path / "out.mcap", anchor=ANCHOR, choices=Choices(strict=True)
        )
    assert message in str(caught.value)
    assert not (tmp_path / "out.mcap").exists()


def test_a_damaged_mcap_and_one_without_clouds(tmp_path):
    with pytest.raises(ImportDriveError, match=r"no readable bag: passed over: a\.mcap: .*`mcap recover`"):
        open_recording("auto", cut(ros(tmp_path / "a.mcap"), 50))
    with pytest.raises(ImportDriveError, match="topics with clouds: none"):
        open_recording("auto", write_ros(tmp_path / "b.mcap", []))
    assert format_of(tmp_path) == "mcap"
