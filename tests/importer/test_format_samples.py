"""Formats of data sets and sensors, made as their documents say or taken from real recordings."""

import json
import shutil
from pathlib import Path

import laspy
import numpy as np
import pyarrow as pa
import pytest
from ouster_testing import write_pcap
from pyarrow import feather
from recording_testing import scan_of, true_pose, write_bin

from gnd.extras import MissingExtra
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import exp_so3, quaternion_xyzw_from_R
from gnd.schemas.drive_mcap import load_track
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import FORMATS, import_recording, open_recording
from gnd.vehicle_agent.importers import optional
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.fields import FieldChoice
from gnd.vehicle_agent.importers.recording import RecordingAnchor

ANCHOR = RecordingAnchor(35.6586, 139.7454, 40.0)
SECOND = 1_000_000_000
FEW = scan_of(0, 500).astype(np.float32)


def bins(folder: Path, width: int, names=("000000.bin", "000001.bin", "000002.bin")) -> Path:
    folder.mkdir(parents=True)
    for k, name in enumerate(names):
        rows = np.zeros((500, width), np.float32)
        rows[:, :3], rows[:, 3], rows[:, -1] = FEW + k, np.linspace(0, 1, 500), np.arange(500) % 32
        (folder / name).write_bytes(rows.tobytes())
    return folder


@pytest.mark.parametrize("width", [4, 5])
def test_bins_of_any_sensor_are_no_kitti(tmp_path, width):
    """RELLIS has four values a row, nuScenes five: neither is an HDL-64E in Karlsruhe."""
    folder = bins(tmp_path / "os1_cloud_node_kitti_bin", width)
    assert format_of(folder) == "bin"
    recording = open_recording("auto", folder)
    assert (recording.sensor_model, recording.mount, recording.placed) == ("unknown", "assumed", False)
    scan = recording.read(1)
    np.testing.assert_array_equal(scan.points_m, FEW + 1)
    if width == 5:
        assert scan.ring.tolist() == (np.arange(500) % 32).tolist()


def test_bins_take_times_of_their_names_and_poses_of_a_file(tmp_path):
    folder = bins(tmp_path / "sweeps", 4, [f"{1_700_000_000 + k}_{500_000_000:09d}.bin" for k in range(3)])
    recording = open_recording("auto", folder)
    assert recording.timed
    assert (recording.t_ns - 1_700_000_000 * SECOND).tolist() == [k * SECOND + SECOND // 2 for k in range(3)]
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    assert any("--poses" in one.why for one in open_recording("auto", folder).entries)


@pytest.mark.parametrize("content", [b"\0\1\2" * 400, np.full(400, 1e30, np.float32).tobytes(), b"hello world" * 100])
def test_a_bin_that_is_no_scan_is_refused(tmp_path, content):
    for k in range(2):
        (tmp_path / f"{k}.bin").write_bytes(content)
    with pytest.raises(ImportDriveError, match="rows of neither 4"):
        open_recording("auto", tmp_path)


def test_kitti_is_known_by_what_lies_beside_the_scans(kitti_folder, shared_data):
    assert format_of(kitti_folder) == "kitti"
    for name in ("kitti00_start16", "kitti_raw_0060"):
        assert format_of(shared_data / name) == "kitti"
    shutil.rmtree(kitti_folder / "velodyne")
    bins(kitti_folder / "velodyne", 5)
    assert format_of(kitti_folder) == "bin"  # five values a row are no KITTI, whatever lies beside them


def oxts(lat: float, lon: float, speed: float) -> str:
    row = [0.0] * 30
    row[0], row[1], row[2], row[8], row[22], row[23] = lat, lon, 41.0, speed, 0.1, 0.05
    return " ".join(f"{value:.12f}" for value in row)


def kitti_raw(drive: Path, oxts_folder: Path) -> Path:
    (drive / "velodyne_points" / "data").mkdir(parents=True)
    (oxts_folder / "data").mkdir(parents=True)
    frame, stamps = LocalFrame(np.radians(49.0), np.radians(8.4), 41.0), []
    for k in range(8):
        write_bin(drive / "velodyne_points" / "data" / f"{k:010d}.bin", scan_of(k))
        lat, lon, _ = frame.geodetic_from_enu(true_pose(k)[:3, 3])
        (oxts_folder / "data" / f"{k:010d}.txt").write_text(oxts(float(np.degrees(lat)), float(np.degrees(lon)), 5.0))
        stamps.append(f"2011-09-26 13:02:2{5 + k // 10}.{k % 10}00000000")
    for path in (drive / "velodyne_points" / "timestamps.txt", oxts_folder / "timestamps.txt"):
        path.write_text("\n".join(stamps) + "\n")
    return drive


def test_kitti_raw(tmp_path):
    drive = kitti_raw(tmp_path / "2011_09_26" / "drive_sync", tmp_path / "2011_09_26" / "drive_sync" / "oxts")
    calibration = "R: 1 0 0 0 1 0 0 0 1\nT: -0.81 0.32 -0.80\n"
    (drive.parent / "calib_imu_to_velo.txt").write_text(calibration)
    assert format_of(drive) == "kitti-raw"
    recording = open_recording("auto", drive)
    np.testing.assert_allclose(recording.T_vehicle_lidar[:3, 3], [0.81, -0.32, 1.73])
    assert recording.t_ns[0] == 1_317_042_145 * SECOND  # 2011-09-26 13:02:25 UTC
    assert (recording.placed, len(recording.gnss), recording.gnss[0].sigma_m) == (True, 8, 0.05)
    assert recording.anchor.lat_deg == pytest.approx(49.0)
    assert {sample.speed_mps for sample in recording.motion} == {5.0}
    (drive / "velodyne_points" / "timestamps.txt").write_text("2011-09-26 13:02:25.1\n")
    with pytest.raises(ImportDriveError, match="1 stamps, scan 7"):
        open_recording("auto", drive)


def test_kitti_360(tmp_path):
    """The INS lies in another branch, its axes are forward, right, down."""
    drive = kitti_raw(tmp_path / "data_3d_raw" / "drive", tmp_path / "data_poses" / "drive" / "oxts")
    (tmp_path / "calibration").mkdir()
    T_pose_camera = "0 0 1 1.5 1 0 0 0 0 1 0 -0.9"  # camera: right, down, forward; INS: forward, right, down
    T_lidar_camera = "0 0 1 0 -1 0 0 0 0 -1 0 0"
    (tmp_path / "calibration" / "calib_cam_to_pose.txt").write_text(f"image_00: {T_pose_camera}\n")
    (tmp_path / "calibration" / "calib_cam_to_velo.txt").write_text(T_lidar_camera)
    recording = open_recording("auto", drive)
    np.testing.assert_allclose(recording.T_vehicle_lidar[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(recording.T_vehicle_lidar[:3, 3], [1.5, 0.0, 0.9 + 0.93], atol=1e-12)
    assert len(recording.gnss) == 8


def nuscenes(root: Path, scenes=("scene-0061",)) -> Path:
    """The data set's tables with the fields that its documents name; 2 km east and 1 km north of the map's origin."""
    (root / "v1.0-mini").mkdir(parents=True)
    (root / "sweeps" / "LIDAR_TOP").mkdir(parents=True)
    tables = {name: [] for name in ("sample_data", "ego_pose", "calibrated_sensor", "sensor", "sample", "scene", "log")}
    tables["sensor"] += [{"token": "s", "channel": "LIDAR_TOP"}, {"token": "c", "channel": "CAM_FRONT"}]
    rotation = [0.7077955119163518, -0.006492242056004365, 0.010646214713995808, -0.7063073142877817]
    tables["calibrated_sensor"].append(
        {"token": "cs", "sensor_token": "s", "translation": [0.943713, 0.0, 1.84023], "rotation": rotation}
    )
    tables["calibrated_sensor"].append(
        {"token": "cc", "sensor_token": "c", "translation": [0] * 3, "rotation": rotation}
    )
    tables["log"].append({"token": "l", "location": "boston-seaport"})
    for number, name in enumerate(scenes):
        tables["scene"].append({"token": name, "name": name, "log_token": "l", "nbr_samples": 1})
        tables["sample"].append({"token": f"sample{name}", "scene_token": name})
        for k in range(8):
            t_us = 1_532_402_927_647_951 + number * 10**8 + k * 50_000
            file = f"sweeps/LIDAR_TOP/n008__LIDAR_TOP__{t_us}.pcd.bin"
            rows = np.zeros((500, 5), np.float32)
            rows[:, :3], rows[:, 3], rows[:, 4] = FEW, 7.0, np.arange(500) % 32
            (root / file).write_bytes(rows.tobytes())
            x, y, z, w = quaternion_xyzw_from_R(exp_so3([0, 0, 0.3]))
            pose = {
                "token": f"e{t_us}",
                "timestamp": t_us,
                "translation": [2000.0 + k, 1000.0, 0.0],
                "rotation": [w, x, y, z],
            }
            tables["ego_pose"].append(pose)
            tables["sample_data"].append(
                {"token": f"d{t_us}", "sample_token": f"sample{name}", "ego_pose_token": f"e{t_us}",
                 "calibrated_sensor_token": "cs", "timestamp": t_us, "filename": file}
            )  # fmt: skip
    for name, rows in tables.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return root


def test_nuscenes(tmp_path):
    recording = open_recording("auto", nuscenes(tmp_path / "nuscenes"))
    assert (len(recording), recording.sensor_model, recording.mount) == (8, "HDL-32E", "given")
    np.testing.assert_allclose(recording.T_vehicle_lidar[:3, 3], [0.943713, 0.0, 1.84023])
    assert recording.t_ns[0] == 1_532_402_927_647_951_000
    assert recording.read(0).ring.max() == 31
    # the devkit's own formula, written out for 2000 m east, 1000 m north
    assert recording.anchor.lat_deg == pytest.approx(42.336849 + np.degrees(1000 / 6.378137e6), abs=5e-6)
    assert recording.anchor.lon_deg == pytest.approx(
        -71.057854 + np.degrees(2000 / 6.378137e6) / np.cos(np.radians(42.3458)), abs=5e-6
    )
    way = recording.track.T_dst_vehicle[-1, :3, 3] - recording.track.T_dst_vehicle[0, :3, 3]
    np.testing.assert_allclose(way, [7.0, 0.0, 0.0], atol=0.05)
    forward = recording.track.T_dst_vehicle[0, :3, 0]
    assert np.degrees(np.arctan2(forward[1], forward[0])) == pytest.approx(np.degrees(0.3), abs=0.01)


def test_nuscenes_with_several_scenes_asks_which(tmp_path):
    root = nuscenes(tmp_path / "nuscenes", ("scene-0061", "scene-0103"))
    with pytest.raises(ImportDriveError, match=r"2 scenes \(scene-0061, scene-0103\); choose one with --topic"):
        open_recording("auto", root)
    assert open_recording("auto", root, topic="scene-0103").name == "scene-0103"
    (root / "v1.0-mini" / "log.json").write_text("[]")
    with pytest.raises(ImportDriveError, match="tables that do not fit each other"):
        open_recording("auto", root, topic="scene-0103")


def test_argoverse_real_log(shared_data, tmp_path):
    """Two sweeps of Pittsburgh: place by the city's origin, poses as given, points in the LiDAR's axes."""
    log = shared_data / "av2_pit_overlap" / "7fab2350"
    recording = open_recording("auto", log)
    assert (len(recording), recording.deskew, recording.mount) == (2, "compensated", "given")
    np.testing.assert_allclose(recording.T_vehicle_lidar[:3, 3], [1.35018, 0.0, 1.64042])
    rows = feather.read_table(log / "sensors" / "lidar" / "315966265259836000.feather")
    p_ego = np.column_stack([rows[name].to_numpy() for name in "xyz"]).astype(np.float64)
    found = recording.read(0).points_m @ recording.T_vehicle_lidar[:3, :3].T + recording.T_vehicle_lidar[:3, 3]
    np.testing.assert_allclose(found, p_ego, atol=1e-4)
    # Pittsburgh's origin is 583710, 4477260 in zone 17 (av2-api's own test); poses are relative to it
    import pyproj

    table = feather.read_table(log / "city_SE3_egovehicle.feather").slice(0, 1).to_pylist()[0]
    lon, lat = pyproj.Proj("EPSG:32617")(583710 + table["tx_m"], 4477260 + table["ty_m"], inverse=True)
    assert recording.anchor.lat_deg == pytest.approx(lat, abs=1e-7)
    assert recording.anchor.lon_deg == pytest.approx(lon, abs=1e-7)
    imported = import_recording("auto", log, tmp_path / "a.mcap")
    assert imported.scans == 2
    reference = load_track(tmp_path / "a.mcap").reference
    assert len(reference.t_ns) > 2  # all poses around the sweeps, as they are
    with pytest.raises(ImportDriveError, match="Argoverse 2 is named by its folder"):
        open_recording("auto", shared_data / "av2_pit_overlap" / "3bffdcff")  # a log without sweeps


def test_argoverse_without_a_city_has_no_place(shared_data, tmp_path):
    log = tmp_path / "log"
    shutil.copytree(shared_data / "av2_pit_overlap" / "7fab2350", log, ignore=shutil.ignore_patterns("map"))
    recording = open_recording("auto", log)
    assert not recording.placed
    with pytest.raises(ImportDriveError, match="nothing says where on the Earth"):
        import_recording("auto", log, tmp_path / "a.mcap")


def las_folder(folder: Path, shift: float = 0.0, ending: str = "las", adjusted: bool = True) -> Path:
    folder.mkdir()
    for k in range(3):
        header = laspy.LasHeader(point_format=1, version="1.2")
        header.scales, header.offsets = [1e-4] * 3, [shift, shift, 0.0]
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType(int(adjusted))
        las = laspy.LasData(header)
        las.x, las.y, las.z = FEW[:, 0] + shift, FEW[:, 1] + shift, FEW[:, 2]
        las.gps_time = 373_090_052.0 + 0.1 * k + np.linspace(0, 0.0999, len(FEW))  # adjusted GPS seconds
        las.write(folder / f"{k}.{ending}")
    return folder


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_las_sweeps_with_times(tmp_path, ending):
    recording = open_recording("auto", las_folder(tmp_path / "a", ending=ending))
    scan = recording.read(2)
    np.testing.assert_allclose(scan.points_m, FEW, atol=1e-4)
    gps_s = 1_000_000_000 + 373_090_052  # as the header's flag says; 18 s ahead of UTC in 2023
    assert recording.t_ns[0] == pytest.approx((315_964_800 + gps_s - 18) * SECOND, abs=1_000)
    np.testing.assert_allclose(np.diff(recording.t_ns), SECOND // 10, atol=1_000)
    assert int(scan.t_offset_ns[-1]) == pytest.approx(99_900_000, abs=1_000)


def test_las_of_a_map_and_a_damaged_one(tmp_path):
    with pytest.raises(ImportDriveError, match="a piece of a map, no sweep of a sensor"):
        open_recording("auto", las_folder(tmp_path / "a", shift=450_000.0)).read(0)
    damaged = las_folder(tmp_path / "b") / "1.las"
    damaged.write_bytes(damaged.read_bytes()[:200])
    recording = open_recording("auto", tmp_path / "b")
    assert len(recording) == 2
    assert "1.las: no readable LAS" in recording.notes[0]
    with pytest.raises(ImportDriveError, match=r"1\.las: no readable LAS"):
        open_recording("auto", tmp_path / "b", choices=Choices(strict=True))
    (tmp_path / "b" / "0.las").write_bytes(b"no LAS at all")
    with pytest.raises(ImportDriveError, match="which is no LAS"):
        open_recording("auto", tmp_path / "b")


def pcd(path: Path, fields: str, sizes: str, types: str, rows: np.ndarray) -> None:
    n, width = len(rows), len(fields.split())
    head = f"VERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {' '.join('1' * width)}\nWIDTH {n}\n"
    path.write_bytes((head + f"HEIGHT 1\nPOINTS {n}\nDATA binary\n").encode() + rows.tobytes())


def test_pcd_with_times_and_stamps_as_names(tmp_path):
    begin = 1_713_492_677_464_078_412
    for k in range(3):
        rows = np.zeros(500, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
        for axis, name in enumerate("xyz"):
            rows[name] = FEW[:, axis]
        rows["t"] = np.linspace(0, 99_900, 500)  # microseconds
        pcd(tmp_path / f"{begin + k * SECOND // 10}.pcd", "x y z t", "4 4 4 4", "F F F U", rows)
    recording = open_recording("auto", tmp_path)
    assert recording.t_ns.tolist() == [begin + k * SECOND // 10 for k in range(3)]
    assert int(recording.read(0).t_offset_ns[-1]) == 99_900_000
    assert "t, against the stamp, in us" in recording.entries[0].detail
    plain = open_recording("auto", tmp_path, choices=Choices(fields=FieldChoice("none")))
    assert not plain.read(0).t_offset_ns.any()


def test_a_file_of_another_sensor_among_pcds_is_named(tmp_path):
    for k in range(4):
        names = ("x", "y", "z", "ring") if k == 2 else ("x", "y", "z", "t")
        rows = np.zeros(500, [(name, "<f4") for name in names])
        for axis, name in enumerate("xyz"):
            rows[name] = scan_of(k)[:500, axis]
        pcd(tmp_path / f"{k}.pcd", " ".join(names), "4 4 4 4", "F F F F", rows)
    recording = open_recording("auto", tmp_path)
    with pytest.raises(
        ImportDriveError, match=r"2\.pcd: fields x, y, z, ring; the others have x, y, z, t: another sensor"
    ):
        recording.read(2)
    assert len(recording.read(3)) == 500


def test_a_damaged_first_bin_does_not_decide(tmp_path):
    folder = bins(tmp_path / "a", 5)
    (folder / "000000.bin").write_bytes(b"\0\1\2")
    recording = open_recording("auto", folder)
    assert recording.read(1).ring is not None
    with pytest.raises(ImportDriveError, match="3 bytes, which is no multiple of 20"):
        recording.read(0)


def test_velodyne_captures(shared_data):
    """Real packets of a VLP-16 and an HDL-32E: turns of 0.1 s with a ring and a time for each point."""
    vlp16 = open_recording("auto", shared_data / "captures_a" / "sample_velodyne_vlp16_gps.pcap", ANCHOR)
    assert len(vlp16) == 4
    np.testing.assert_allclose(np.diff(vlp16.t_ns), 0.1 * SECOND, rtol=0.03)
    scan = vlp16.read(1)
    assert (int(scan.ring.max()), len(scan)) == (15, 18_701)
    assert 95_000_000 < scan.t_offset_ns.max() < 105_000_000
    assert vlp16.t_ns[0] // SECOND == 1_453_364_282
    hdl32 = open_recording("auto", shared_data / "captures_a" / "sample_velodyne_hdl32.pcap", ANCHOR)
    assert (int(hdl32.read(0).ring.max()), len(hdl32)) == (31, 2)
    assert any("cut off by the capture" in note for note in hdl32.notes)


def test_a_damaged_capture_says_that_the_rest_is_left_out(shared_data, tmp_path):
    """A packet that says it is of another model."""
    data = bytearray((shared_data / "captures_a" / "sample_velodyne_vlp16_gps.pcap").read_bytes())
    damaged, end = tmp_path / "a.pcap", 24
    while end < 0.9 * len(data) or data[end - 1] != 0x22:  # a VLP-16's packets end so
        end += 16 + int.from_bytes(data[end + 8 : end + 12], "little")
    data[end - 1] = 0xEB
    damaged.write_bytes(data)
    recording = open_recording("auto", damaged, ANCHOR)
    assert 2 <= len(recording) < 4
    assert any(note.startswith("damaged after") for note in recording.notes)
    with pytest.raises(ImportDriveError, match=r"a\.pcap: "):
        open_recording("auto", damaged, ANCHOR, choices=Choices(strict=True))


def test_a_capture_of_another_sensor_says_what_to_do(shared_data, tmp_path):
    unknown = write_pcap(tmp_path / "b.pcap", [(10**18 + k, "10.0.0.1", 2368, b"\0" * 1234) for k in range(5)])
    with pytest.raises(ImportDriveError, match=r"no packets of a Velodyne .* or an Ouster but 5 of 1234 bytes.*driver"):
        open_recording("auto", unknown)
    with pytest.raises(ImportDriveError, match=r"1 whole frame of OS-0-128; a drive needs at least 2"):
        open_recording("auto", shared_data / "captures_a" / "OS-0-128-U1_v2.3.0_1024x10.pcap")
    (tmp_path / "a.pcap").write_bytes(b"\xd4\xc3\xb2\xa1" + b"\0" * 9)
    with pytest.raises(ImportDriveError, match=r"a\.pcap"):
        open_recording("auto", tmp_path / "a.pcap")


REFUSED = {
    "a.bag": (b"#ROSBAG V2.0\n", "rosbags-convert"),
    "b.ply": (b"ply\n", "pdal translate"),
    "c.tfrecord": (b"\0" * 10, "export sweeps"),
    "d.npy": (b"\x93NUMPY", "arrays without names"),
    "e.csv": (b"x,y,z\n", "tables of points"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_read_is_refused_with_what_to_do(tmp_path, name):
    content, message = REFUSED[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ImportDriveError, match=message):
        open_recording("auto", tmp_path)


def test_a_name_that_lies_is_found_out(tmp_path, shared_data):
    """Recognised by content, never by ending alone."""
    shutil.copy(shared_data / "captures_a" / "sample_velodyne_vlp16_gps.pcap", tmp_path / "drive.dat")
    assert format_of(tmp_path / "drive.dat") == "pcap"
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "0.pcd").write_bytes(b"\x89PNG....")
    with pytest.raises(ImportDriveError, match="which is no PCD"):
        format_of(tmp_path / "folder")


@pytest.mark.parametrize(("kind", "module"), [("argoverse", "pyarrow"), ("las", "laspy"), ("pcap", "dpkt")])
def test_without_its_library_a_format_says_which_extra(tmp_path, shared_data, monkeypatch, kind, module):
    place = {
        "argoverse": lambda: shared_data / "av2_pit_overlap" / "7fab2350",
        "las": lambda: las_folder(tmp_path / "a"),
        "pcap": lambda: shared_data / "captures_a" / "sample_velodyne_vlp16_gps.pcap",
    }[kind]()

    def missing(name: str):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(optional, "import_module", missing)
    with pytest.raises(
        MissingExtra, match=rf"{module} is not installed; it comes with: pip install 'gnd-fleet\[import\]'"
    ):
        open_recording("auto", place)


def test_every_format_has_a_reader_and_nothing_imports_its_library_before():
    assert set(FORMATS) == {
        "kitti", "radiate", "pcd", "mcap", "planes", "apollo", "ros", "bin", "kitti-raw", "nuscenes", "argoverse",
        "las", "pcap",
    }  # fmt: skip
    import subprocess
    import sys

    heavy = "{'rosbags', 'laspy', 'pyarrow', 'velodyne_decoder', 'dpkt'}"
    code = f"import sys, gnd.vehicle_agent.importer; print(sorted({heavy} & set(sys.modules)))"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"


def test_a_table_of_arrow_that_lacks_a_column(shared_data, tmp_path):
    log = tmp_path / "log"
    shutil.copytree(shared_data / "av2_pit_overlap" / "7fab2350", log)
    feather.write_feather(pa.table({"x": [1.0]}), log / "sensors" / "lidar" / "315966265259836000.feather")
    recording = open_recording("auto", log)
    with pytest.raises(ImportDriveError, match="no table with x, y, z, laser_number"):
        recording.read(0)
