"""`gnd import` from folder to drive: track, frames, halves, and every way in which a folder can be wrong."""

import lzma
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from recording_testing import STEP_M, scan_of, true_pose, write_bin

from gnd.gnd_map.errors import GndError
from gnd.gnd_map.se3 import T_inverse, exp_so3, log_so3
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import drive_counts, load_track, read_drive, read_header
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import fit_heading_and_position, import_recording, open_recording
from gnd.vehicle_agent.importer_cli import import_drives
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.recording import RecordingAnchor
from gnd.vehicle_agent.importers.splits import chosen_scans

ANCHOR = RecordingAnchor(37.56, 127.03, 30.0)
STAND_INS = Choices(stand_ins=True)
STRICT = Choices(strict=True)


def scans_of(path: Path) -> list[Scan]:
    return [item for item in read_drive(path) if isinstance(item, Scan)]


def test_lidar_odometry_finds_how_the_vehicle_moved(kitti_folder, tmp_path):
    """The reference track against the truth by construction, to 2 cm after 3.5 m."""
    assert import_recording("kitti", kitti_folder, tmp_path / "a.mcap", anchor=ANCHOR).scans == 8
    reference = load_track(tmp_path / "a.mcap").reference
    found = T_inverse(reference.T_map_vehicle[0]) @ reference.T_map_vehicle
    for k in range(8):
        np.testing.assert_allclose(found[k, :3, 3], true_pose(k)[:3, 3], atol=0.02)
        assert np.degrees(np.linalg.norm(log_so3(found[k, :3, :3].T @ true_pose(k)[:3, :3]))) < 0.1


def test_what_a_drive_holds(kitti_folder, tmp_path):
    import_recording("kitti", kitti_folder, tmp_path / "a.mcap", anchor=ANCHOR, vehicle="v1", choices=STAND_INS)
    header, counts, track = (f(tmp_path / "a.mcap") for f in (read_header, drive_counts, load_track))
    assert (header.vehicle, header.sensor_model, header.drive_id) == ("v1", "HDL-64E", "sequence-all")
    assert np.degrees(header.anchor.lat_rad) == pytest.approx(37.56)
    assert header.T_vehicle_lidar[2, 3] == pytest.approx(1.73)
    assert (counts.scans, counts.gnss, counts.reference) == (8, 8, 8)
    np.testing.assert_allclose(track.motion.speed_mps, STEP_M / 0.1, rtol=0.05)
    np.testing.assert_allclose(track.motion.yaw_rate_radps, 0.1, atol=0.02)
    lat, lon, height = (getattr(track.gnss, name) for name in ("lat_rad", "lon_rad", "height_m"))
    p = header.anchor.enu_from_geodetic(lat, lon, height)
    np.testing.assert_allclose(p[-1] - p[0], true_pose(7)[:3, 3], atol=1e-3)


def test_points_come_through_bit_for_bit_in_file_order(kitti_folder, tmp_path):
    import_recording("kitti", kitti_folder, tmp_path / "a.mcap", anchor=ANCHOR)
    for k, scan in enumerate(scans_of(tmp_path / "a.mcap")):
        np.testing.assert_array_equal(scan.points_m, scan_of(k).astype(np.float32))
        assert not scan.t_offset_ns.any()


def test_both_halves_lie_in_one_frame(kitti_folder, tmp_path):
    for half in ("even", "odd"):
        import_recording("kitti", kitti_folder, tmp_path / f"{half}.mcap", scans=half, anchor=ANCHOR)
    even, odd = (load_track(tmp_path / f"{half}.mcap").reference for half in ("even", "odd"))
    common = np.intersect1d(even.t_ns, odd.t_ns)
    assert len(common) >= 6
    for t in common:
        np.testing.assert_array_equal(even.T_map_vehicle[even.t_ns == t], odd.T_map_vehicle[odd.t_ns == t])
    assert not {s.t_ns for s in scans_of(tmp_path / "even.mcap")} & {s.t_ns for s in scans_of(tmp_path / "odd.mcap")}


def test_items_come_in_time_order(kitti_folder, tmp_path):
    import_recording("kitti", kitti_folder, tmp_path / "a.mcap", anchor=ANCHOR, choices=STAND_INS)
    times = [item.t_ns for item in read_drive(tmp_path / "a.mcap")]
    assert times == sorted(times)


def test_compressed_scans_without_times_poses_or_calibration(tmp_path):
    folder = tmp_path / "drive"
    folder.mkdir()
    for k in range(3):
        points = np.column_stack([scan_of(k), np.ones(48_000)]).astype(np.float32)
        (folder / f"{k:03d}.bin.xz").write_bytes(lzma.compress(points.tobytes(), preset=0))
    out = tmp_path / "a.mcap"
    imported = import_recording("kitti", folder, out, anchor=ANCHOR)
    assert imported.scans == 3
    assert (drive_counts(out).gnss, drive_counts(out).motion, read_header(out).stand_ins) == (0, 0, ())
    assert any("no GNSS and no speed and yaw rate measured: the drive has none" in note for note in imported.notes)
    marked = import_recording("kitti", folder, out, anchor=ANCHOR, choices=STAND_INS)
    assert (drive_counts(out).gnss, read_header(out).stand_ins) == (3, ("gnss", "motion"))
    assert any("computed from the poses" in note for note in marked.notes)


def write_pcds(folder: Path, poses: str) -> Path:
    folder.mkdir()
    for k in range(10, 13):
        points = scan_of(k - 10).astype(np.float32)
        head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
        (folder / f"{k}.pcd").write_bytes((head + f"POINTS {len(points)}\nDATA binary\n").encode() + points.tobytes())
    (folder / "9.pcd").write_bytes((folder / "10.pcd").read_bytes())
    if poses:
        (folder / "poses.txt").write_text(poses)
    return folder


POSES = "".join(f"{k} {100 + k / 10} {500 + k} 700 3 0 0 0.7071068 0.7071068\n" for k in range(4))


@pytest.mark.parametrize("columns", [slice(0, None), slice(1, None)])
def test_pcd_folder_with_poses(tmp_path, columns):
    poses = "".join(" ".join(line.split()[columns]) + "\n" for line in POSES.splitlines())
    folder = write_pcds(tmp_path / "pcds", poses)
    assert import_recording("pcd", folder, tmp_path / "a.mcap", anchor=ANCHOR).scans == 4
    reference = load_track(tmp_path / "a.mcap").reference
    header = read_header(tmp_path / "a.mcap")
    lidar = reference.T_map_vehicle @ header.T_vehicle_lidar
    np.testing.assert_allclose(lidar[:, 0, 3], [0, 1, 2, 3], atol=1e-9)
    np.testing.assert_allclose(lidar[0, :3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-6)
    assert header.mount == "estimated"
    assert header.T_vehicle_lidar[2, 3] == pytest.approx(1.73, abs=0.03)
    assert reference.t_ns[0] == 100_000_000_000
    first = scans_of(tmp_path / "a.mcap")[0]
    np.testing.assert_array_equal(first.points_m, scan_of(0).astype(np.float32))  # 9.pcd comes before 10.pcd


def test_pcd_folder_without_poses_takes_lidar_odometry(tmp_path):
    folder = write_pcds(tmp_path / "pcds", "")
    (folder / "9.pcd").unlink()
    import_recording("pcd", folder, tmp_path / "a.mcap", anchor=ANCHOR)
    reference = load_track(tmp_path / "a.mcap").reference
    np.testing.assert_allclose(reference.T_map_vehicle[2, :3, 3], true_pose(2)[:3, 3], atol=0.02)


def radiate_folder(folder: Path) -> Path:
    """Scans 3 ... 6 of which 5 and 6 are listed; x right, y forward; GPS at 20 Hz in pairs, one stamp 0.4 s off."""
    (folder / "velo_lidar").mkdir(parents=True)
    (folder / "GPS_IMU_Twist").mkdir()
    for k in range(4):
        p = scan_of(k, 6_000)
        turned = np.column_stack([-p[:, 1], p[:, 0], p[:, 2]])
        own = np.array([[0.5, 0.5, 0.0], [-1.0, 0.3, -0.4]])
        rows = np.concatenate([own, turned])
        rows = rows[np.argsort((np.arctan2(rows[:, 0], rows[:, 1]) + 1.0) % (2 * np.pi))]
        rows = np.column_stack([rows, np.ones(len(rows)), np.arange(len(rows)) % 32])
        np.savetxt(folder / "velo_lidar" / f"{k + 3:06d}.csv", rows, delimiter=",", fmt="%.5f,%.5f,%.5f,%d,%d")
    second = 1_574_859_771
    (folder / "velo_lidar.txt").write_text(
        f"Frame: 000005 Time: {second}.200000000\nFrame: 000006 Time: {second}.300085000\n"
    )
    stamps = []
    for n in range(1, 17):
        t = second + 65.7 + (n - 1) // 2 * 0.05 - (0.41 if n in (9, 10) else 0.0)
        stamps.append(f"Frame: {n:06d} Time: {int(t)}.{round((t % 1) * 1e9):09d}")
        heading = [f"55.{890000 + n},-3.32,209.5", *["0,0,0"] * 3, "0,0,0,1", "0,0,0.1", "0,0,0", *["0,0,0"] * 6]
        (folder / "GPS_IMU_Twist" / f"{n:06d}.txt").write_text("\n".join([*heading, "3,4,0.1", "0,0,-0.1"]) + "\n")
    (folder / "GPS_IMU_Twist.txt").write_text("\n".join(stamps))
    return folder


def test_radiate_times_axes_and_own_vehicle(tmp_path):
    folder = radiate_folder(tmp_path / "fog")
    recording = open_recording("radiate", folder)
    np.testing.assert_allclose(np.diff(recording.t_ns), 100_085_000, atol=1)
    scan = recording.read(0)
    assert np.linalg.norm(scan.points_m, axis=1).min() >= 2.6
    assert (np.diff(scan.t_offset_ns.astype(np.int64)) >= -1_000_000).all()
    assert 95_000_000 < scan.t_offset_ns.max() <= 100_000_000
    forward = recording.T_vehicle_lidar[:3, :3] @ [0.0, 1.0, 0.0]
    assert forward[0] > 0.99
    assert recording.motion[0].speed_mps == pytest.approx(5.0)
    assert recording.motion[0].yaw_rate_radps == pytest.approx(0.1)
    np.testing.assert_allclose(np.diff([m.t_ns for m in recording.motion]), 50_000_000, atol=2_000)  # stamp repaired
    assert recording.motion[0].t_ns == pytest.approx(1_574_859_771_000_000_000, abs=2_000)


def test_heading_and_position_are_found_by_least_squares():
    rng = np.random.default_rng(0)
    p = rng.normal(size=(40, 3)) * [20, 20, 1]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = exp_so3([0.0, 0.0, 2.3]), [100.0, -50.0, 7.0]
    found = fit_heading_and_position(p, p @ T[:3, :3].T + T[:3, 3])
    np.testing.assert_allclose(found, T, atol=1e-9)


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("all", [0, 1, 2, 3, 4, 5, 6]),
        ("even", [0, 2, 4, 6]),
        ("odd", [1, 3, 5]),
        ("first-half", [0, 1, 2]),
        ("second-half", [3, 4, 5, 6]),
        ("2:5", [2, 3, 4]),
        (":2", [0, 1]),
        ("5:", [5, 6]),
    ],
)
def test_splits(rule, expected):
    assert chosen_scans(rule, 7).tolist() == expected


@pytest.mark.parametrize(
    ("rule", "message"), [("third", "expected all, even"), ("3:4", "leaves 1 of 7"), ("-2:", "expected")]
)
def test_splits_that_make_no_drive_are_refused(rule, message):
    with pytest.raises(ImportDriveError, match=message):
        chosen_scans(rule, 7)


def no_scans(folder: Path, keep: int = 0) -> None:
    for path in sorted((folder / "velodyne").iterdir())[keep:]:
        path.unlink()


def cut_off(folder: Path) -> None:
    path = folder / "velodyne" / "000003.bin"
    path.write_bytes(path.read_bytes()[:-5])


BREAK = {
    "no scans": no_scans,
    "one scan": lambda folder: no_scans(folder, keep=1),
    "cut off": cut_off,
    "few times": lambda folder: (folder / "times.txt").write_text("0.0\n0.1\n"),
    "odd poses": lambda folder: (folder / "poses.txt").write_text("1 2 3\n" * 8),
    "no Tr": lambda folder: (folder / "calib.txt").write_text("P0: 1\n"),
    "time goes back": lambda folder: (folder / "times.txt").write_text("0\n.1\n.2\n.1\n.4\n.5\n.6\n.7\n"),
    "another place": lambda folder: write_bin(
        folder / "velodyne" / "000004.bin", np.random.default_rng(0).uniform(-60, 60, (48_000, 3))
    ),
}


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("no scans", "no .bin or .bin.xz scans"),
        ("one scan", "1 scans; a drive needs at least 2"),
        ("cut off", "767995 bytes, which is no multiple of 16"),
        ("few times", "2 times for 8 scans"),
        ("odd poses", "12 a scan are needed"),
        ("no Tr", "no line 'Tr:'"),
        ("time goes back", "scan 3 is not later"),
        ("another place", r"scan 4 shares \d+% of its points"),
    ],
)
def test_a_wrong_folder_is_told_in_one_line_and_leaves_nothing(kitti_folder, tmp_path, what, message):
    BREAK[what](kitti_folder)
    with pytest.raises(ImportDriveError) as caught:
        import_recording("kitti", kitti_folder, tmp_path / "a.mcap", anchor=ANCHOR, choices=STRICT)
    assert re.search(message, str(caught.value))
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.glob("*.mcap*"))
    assert not list(tmp_path.glob(".*.partial"))


def test_a_folder_that_is_none(kitti_folder, tmp_path):
    for path, message in ((tmp_path / "nowhere", "no such folder"), (kitti_folder / "times.txt", "is a file")):
        with pytest.raises(ImportDriveError, match=message):
            import_recording("kitti", path, tmp_path / "a.mcap")


def test_other_formats_tell_what_they_miss(tmp_path):
    (tmp_path / "empty").mkdir()
    for kind, message in (
        ("radiate", "no scans in velo_lidar"),
        ("pcd", r"no \.pcd or \.pcd\.xz files"),
        ("rosbag", "known are kitti"),
    ):
        with pytest.raises(ImportDriveError, match=message):
            import_recording(kind, tmp_path / "empty", tmp_path / "a.mcap")
    folder = write_pcds(tmp_path / "pcds", "1 2 3\n")
    with pytest.raises(ImportDriveError, match="1 lines of 3 numbers for 4 scans"):
        import_recording("pcd", folder, tmp_path / "a.mcap", anchor=ANCHOR)


def test_command_line(kitti_folder, tmp_path):
    out = tmp_path / "a.mcap"
    arguments = ["kitti", str(kitti_folder), "-o", str(out), "--scans", "1:4", "--anchor", "37.56,127.03,30"]
    result = CliRunner().invoke(import_drives, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert f"{out}: 3 scans" in result.output
    assert drive_counts(out).scans == 3


@pytest.mark.parametrize("anchor", ["37.56", "a,b,c", "1,2,3,4,5", "1,2,nan", "91,0,0"])
def test_command_line_refuses_an_anchor_that_is_none(kitti_folder, tmp_path, anchor):
    arguments = ["kitti", str(kitti_folder), "-o", str(tmp_path / "a.mcap"), "--anchor", anchor]
    result = CliRunner().invoke(import_drives, arguments)
    assert isinstance(result.exception, GndError)
    assert "LAT,LON,HEIGHT" in str(result.exception) or "latitude -90" in str(result.exception)


def test_real_pcd_folder(shared_data, tmp_path):
    import_recording(
        "pcd", shared_data / "apollo_ndt" / "pcds", tmp_path / "a.mcap", anchor=RecordingAnchor(37.41, -122.0, -30.0)
    )
    reference = load_track(tmp_path / "a.mcap").reference
    assert np.linalg.norm(reference.T_map_vehicle[1, :3, 3]) == pytest.approx(0.803, abs=0.001)
    assert drive_counts(tmp_path / "a.mcap").scans == 2
