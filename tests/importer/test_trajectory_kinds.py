"""Trajectories of every kind against each other and against pyproj, and what is wrong with them."""

import json
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.gnd_map.geodesy import LocalFrame, ecef_from_geodetic
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, exp_so3, log_so3, quaternion_xyzw_from_R
from gnd.gnd_map.utm import convergence_rad
from gnd.schemas.drive_mcap import drive_counts, load_track, read_header
from gnd.schemas.trajectory_files import tum_text
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import import_recording, open_recording
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.quality import quality_of
from gnd.vehicle_agent.importers.recording import RecordingAnchor
from gnd.vehicle_agent.importers.trajectories.clocks import leap_seconds, ns_of_date, ns_of_gps, ns_of_number
from gnd.vehicle_agent.importers.trajectories.frames import ecef_poses, in_map, with_frame
from gnd.vehicle_agent.importers.trajectories.pose_file import read_poses

from recording_testing import true_pose  # isort: skip

ANCHOR = RecordingAnchor(35.6586, 139.7454, 40.0, 90.0)
START = 1_317_000_000_000_000_000
SECOND = 1_000_000_000


def way() -> np.ndarray:
    """(8, 4, 4) poses in an ENU frame, tilted a little, the truth of the room's scans."""
    T = np.stack([true_pose(k) for k in range(8)])
    T[:, :3, :3] = T[:, :3, :3] @ exp_so3([0.01, -0.02, 0.0])
    return T


T_NS = START + np.arange(8) * SECOND // 10


def laid(path: Path, frame: str = "auto", near: RecordingAnchor | None = None) -> np.ndarray:
    """Poses of a file in the frame of the anchor."""
    table, zone, southern = with_frame(read_poses(path), frame, near)
    return in_map(*ecef_poses(table, zone, southern, ANCHOR), ANCHOR.frame)


def write_tum(path: Path, T: np.ndarray) -> Path:
    path.write_text(tum_text(Trajectory(T_NS, T), "made by a test"))
    return path


def write_kitti(path: Path, T: np.ndarray, digits: int = 6) -> Path:
    path.write_text("".join(" ".join(f"{v:.{digits}f}" for v in one[:3].ravel()) + "\n" for one in T))
    return path


def geodetic_of(T: np.ndarray) -> np.ndarray:
    """(N, 3) degrees, degrees, metres."""
    lat, lon, height = ANCHOR.frame.geodetic_from_enu(T[:, :3, 3])
    return np.column_stack([np.degrees(lat), np.degrees(lon), height])


def angles(T: np.ndarray) -> np.ndarray:
    """(N, 3) roll, pitch, yaw of poses against ENU at the anchor, degrees."""
    R = T[:, :3, :3]
    pitch, yaw = -np.arcsin(R[:, 2, 0]), np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return np.degrees(np.column_stack([np.arctan2(R[:, 2, 1], R[:, 2, 2]), pitch, yaw]))


def write_ins(path: Path, T: np.ndarray) -> Path:
    """As an INS exports it: heading from north, pitch nose-up."""
    roll, pitch, yaw = angles(T).T
    head = "Time (s),Latitude (deg),Longitude (deg),Height (m),Roll (deg),Pitch (deg),Heading (deg)\n"
    rows = zip(T_NS / 1e9, *geodetic_of(T).T, roll, -pitch, 90.0 - yaw, strict=True)
    path.write_text(head + "".join(",".join(f"{v:.12f}" for v in row) + "\n" for row in rows))
    return path


def write_utm(path: Path, T: np.ndarray) -> Path:
    """By pyproj, grid's north as axis."""
    lat, lon, height = geodetic_of(T).T
    east, north = pyproj.Proj("EPSG:32654")(lon, lat)
    turn = np.column_stack([np.zeros((8, 2)), convergence_rad(np.radians(lat), np.radians(lon), 54)])
    q = quaternion_xyzw_from_R(exp_so3(turn) @ T[:, :3, :3])
    rows = zip(T_NS / 1e9, east, north, height, *q.T, strict=True)
    path.write_text("".join(" ".join(f"{v:.9f}" for v in row) + "\n" for row in rows))
    return path


def write_ecef(path: Path, T: np.ndarray) -> Path:
    """By pyproj."""
    lat, lon, height = geodetic_of(T).T
    p = np.column_stack(pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(lat, lon, height))
    q = quaternion_xyzw_from_R(ANCHOR.frame.R_ecef_enu @ T[:, :3, :3])
    rows = np.column_stack([p, q])
    text = "timestamp_ns,ecef_x,ecef_y,ecef_z,qx,qy,qz,qw\n"
    path.write_text(
        text + "".join(f"{t}," + ",".join(f"{v:.9f}" for v in row) + "\n" for t, row in zip(T_NS, rows, strict=True))
    )
    return path


def write_csv(path: Path, T: np.ndarray) -> Path:
    """Other order, another separator, ISO dates."""
    q = quaternion_xyzw_from_R(T[:, :3, :3])
    rows = zip(T[:, :3, 3], q, T_NS, strict=True)
    text = "z; x; y; qw; qx; qy; qz; time\n"
    for p, (qx, qy, qz, qw), t in rows:
        date = np.datetime64(int(t), "ns")
        text += f"{p[2]:.9f}; {p[0]:.9f}; {p[1]:.9f}; {qw:.9f}; {qx:.9f}; {qy:.9f}; {qz:.9f}; {date}Z\n"
    path.write_text(text)
    return path


def write_geojson(path: Path, T: np.ndarray) -> Path:
    q = quaternion_xyzw_from_R(T[:, :3, :3])
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [lon, lat, h]},
            "properties": {"timestamp_ns": int(t), "qx": x, "qy": y, "qz": z, "qw": w, "name": "drive"},
        }
        for (lat, lon, h), (x, y, z, w), t in zip(geodetic_of(T), q, T_NS, strict=True)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


KINDS = {
    "tum": (write_tum, "auto", 1e-6), "kitti": (write_kitti, "auto", 1e-5), "ins": (write_ins, "auto", 1e-6),
    "utm": (write_utm, "utm:54", 1e-6), "ecef": (write_ecef, "auto", 1e-6), "csv": (write_csv, "auto", 1e-6),
    "geojson": (write_geojson, "auto", 1e-6),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_gives_the_same_poses(tmp_path, kind):
    write, frame, tolerance = KINDS[kind]
    found = laid(write(tmp_path / "poses", way()), frame)
    np.testing.assert_allclose(found[:, :3, 3], way()[:, :3, 3], atol=max(tolerance, 1e-6))
    turn = np.linalg.norm(log_so3(np.swapaxes(found[:, :3, :3], 1, 2) @ way()[:, :3, :3]), axis=1)
    assert np.degrees(turn).max() < 1e-3
    if kind != "kitti":
        np.testing.assert_allclose(read_poses(tmp_path / "poses").t_ns, T_NS, atol=300)


@pytest.mark.parametrize(("kind", "whose"), [*zip(KINDS, ["lidar", "vehicle"] * 4, strict=False), ("kitti", "lidar")])
def test_poses_in_are_poses_of_the_drive(kitti_folder, tmp_path, kind, whose):
    """To 1 mm and 0.001°: read back from the written drive, mount and all."""
    write, frame, _ = KINDS[kind]
    choices = Choices(poses=str(write(tmp_path / "poses", way())), poses_frame=frame, poses_of=whose, anchor=ANCHOR)
    imported = import_recording("auto", kitti_folder, tmp_path / "a.mcap", choices=choices)
    header, reference = read_header(tmp_path / "a.mcap"), load_track(tmp_path / "a.mcap").reference
    assert imported.quality.posed == 1.0
    found = reference.T_map_vehicle @ (header.T_vehicle_lidar if whose == "lidar" else np.eye(4))
    assert np.linalg.norm(found[:, :3, 3] - way()[:, :3, 3], axis=1).max() < 1e-3
    turn = np.linalg.norm(log_so3(np.swapaxes(found[:, :3, :3], 1, 2) @ way()[:, :3, :3]), axis=1)
    assert np.degrees(turn).max() < 1e-3


def test_a_heading_turns_a_local_frame(tmp_path):
    path = write_tum(tmp_path / "poses", way())
    north = RecordingAnchor(ANCHOR.lat_deg, ANCHOR.lon_deg, ANCHOR.height_m, 0.0)
    found = in_map(*ecef_poses(read_poses(path), 0, False, north), north.frame)
    np.testing.assert_allclose(found[:, :2, 3], way()[:, :2, 3] @ [[0.0, 1.0], [-1.0, 0.0]], atol=1e-8)


def test_poses_of_a_camera_are_turned_with_its_calibration(kitti_folder, tmp_path):
    """The benchmark's own ground truth, made by the fixture with a calibration of its own."""
    choices = Choices(poses=str(kitti_folder / "poses.txt"), anchor=ANCHOR)
    recording = open_recording("auto", kitti_folder, choices=choices)
    lidar = recording.track.T_dst_vehicle @ recording.T_vehicle_lidar
    np.testing.assert_allclose(lidar, np.stack([true_pose(k) for k in range(8)]), atol=1e-6)
    assert any("poses of a camera" in note and "calibrated" in note for note in recording.notes)


def nmea(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode()):02X}\n"


def write_nmea(path: Path, n: int = 8) -> Path:
    """East of the anchor, 1 m each tenth of a second, through midnight; one damaged line, one without a fix."""
    text = nmea("GPRMC,235959.00,A,,,,,,,250911,,") + nmea("GPGGA,235959.00,,,,,0,,,,M,,M,,") + "$GPGGA,garbage*00\n"
    for k in range(n):
        lat, lon = geodetic_of(np.stack([np.eye(4)]))[0, :2]
        lon_at = lon + np.degrees(k / (6.378e6 * np.cos(np.radians(lat))))
        minutes = (f"{int(lat):02d}{(lat % 1) * 60:010.7f}", f"{int(lon_at):03d}{(lon_at % 1) * 60:010.7f}")
        clock = f"2359{59 + k * 0.1:05.2f}" if k < 10 else f"0000{(k - 10) * 0.1:05.2f}"
        text += nmea(f"GPGST,{clock},1,1,1,0,0.3,0.4,0.9")
        text += nmea(f"GPGGA,{clock},{minutes[0]},N,{minutes[1]},E,1,9,0.9,3.5,M,36.5,M,,")
    path.write_text(text)
    return path


def test_nmea(tmp_path):
    table = read_poses(write_nmea(tmp_path / "log.nmea", 14))
    assert table.R is None
    assert table.t_ns[0] == ns_of_date("2011-09-25T23:59:59")
    np.testing.assert_allclose(np.diff(table.t_ns), SECOND // 10, atol=1)  # through midnight
    np.testing.assert_allclose(table.sigma_m, np.sqrt((0.3**2 + 0.4**2) / 2), rtol=1e-9)
    p = ANCHOR.frame.enu_from_geodetic(*table.p.T)
    np.testing.assert_allclose(p[:, 0], np.arange(14), atol=0.02)
    np.testing.assert_allclose(p[:, 2], 0.0, atol=1e-3)  # 3.5 m above the geoid, which lies 36.5 m above the ellipsoid
    assert [note.split(": ", 1)[1] for note in table.notes] == ["1 damaged lines: left out", "1 no fix: left out"]


def test_positions_become_fixes_and_give_the_place(kitti_folder, tmp_path):
    (kitti_folder / "times.txt").write_text("\n".join(str(0.1 * k - 4_801.0) for k in range(8)))
    (kitti_folder / "poses.txt").unlink()
    path = write_nmea(tmp_path / "log.nmea")
    # KITTI's times count from a made-up day; shift the log onto it
    scans = open_recording("auto", kitti_folder).t_ns
    table = read_poses(path)
    assert abs(int(scans[0] - table.t_ns[0])) < SECOND
    imported = import_recording("auto", kitti_folder, tmp_path / "a.mcap", choices=Choices(poses=str(path)))
    header = read_header(tmp_path / "a.mcap")
    assert not header.nowhere
    assert np.degrees(header.anchor.lat_rad) == pytest.approx(ANCHOR.lat_deg, abs=1e-6)
    assert drive_counts(tmp_path / "a.mcap").gnss == 8
    assert imported.quality.gnss_sigma_m == pytest.approx(0.3536, abs=1e-3)


def test_gps_time_counts_leap_seconds():
    assert (leap_seconds(1_700_000_000), leap_seconds(1_317_000_000), leap_seconds(400_000_000)) == (18, 15, 2)
    assert ns_of_gps(2270, "194670.2") == ns_of_date("2023-07-11T06:04:12.2")
    assert ns_of_date("2023/07/11 06:04:30.200", gps=True) == ns_of_gps(2270, "194670.2")
    assert ns_of_date("2023-07-11T08:04:12.2+02:00") == ns_of_date("2023-07-11T06:04:12.2Z")


@given(st.integers(10**17 + 1, 4 * 10**18))
def test_times_of_any_unit_are_the_same_time(t_ns):
    assert ns_of_number(str(t_ns)) == t_ns
    assert ns_of_number(f"{t_ns // SECOND}.{t_ns % SECOND:09d}") == t_ns
    assert ns_of_number(str(t_ns // 1000)) == t_ns // 1000 * 1000


def test_the_real_reference_of_an_ins_agrees_with_its_own_ecef_columns(shared_data):
    """MatRTKLIB's reference: latitude, longitude and height against the ECEF columns beside them, heading, GPS time."""
    path = shared_data / "gnss_nagoya" / "reference.csv"
    table = read_poses(path)
    rows = np.genfromtxt(path, delimiter=",", skip_header=1)
    np.testing.assert_allclose(ecef_from_geodetic(*table.p.T), rows[:, 5:8], atol=2e-3)
    assert table.t_ns[0] == ns_of_date("2023-07-11T06:04:12")
    speed = rows[:, 11:13]
    fast = np.linalg.norm(speed, axis=1) > 5.0
    x = table.R[fast][:, :2, 0]
    cosine = (x * speed[fast]).sum(axis=1) / np.linalg.norm(speed[fast], axis=1)
    assert np.median(cosine) > 0.999  # it drives where its x axis points


@pytest.mark.parametrize(
    ("name", "n", "sigma_m"),
    [("rover_1Hz_spp.pos", 550, 3.70), ("rover_rtk.pos", 5986, None), ("reference_1Hz.pos", 1231, None)],
)
def test_real_rtklib_solutions(shared_data, name, n, sigma_m):
    path = shared_data / "gnss_nagoya" / name
    table = read_poses(path)
    lines = [line for line in path.read_text().splitlines() if line and not line.startswith("%")]
    assert (len(table), table.R is None, table.coordinates) == (len(lines), True, "geodetic")
    reference = read_poses(shared_data / "gnss_nagoya" / "reference.csv")
    frame = LocalFrame(*reference.p[0])
    at = np.searchsorted(reference.t_ns, table.t_ns[0])
    off = frame.enu_from_geodetic(*table.p[0]) - frame.enu_from_geodetic(*reference.p[min(at, len(reference) - 1)])
    assert np.linalg.norm(off[:2]) < 30.0
    if sigma_m is not None:
        assert table.sigma_m[0] == pytest.approx(sigma_m, abs=0.01)


def test_the_real_poses_of_a_slam_and_of_kitti(shared_data):
    slam = read_poses(shared_data / "flexmap_georef" / "route1_pose_kitti.txt")
    assert (len(slam), slam.camera, slam.t_ns) == (1208, False, None)
    kitti = read_poses(shared_data / "kitti00_start16" / "KITTI_00_gt.txt")
    assert (len(kitti), kitti.camera, len(kitti.t_ns)) == (16, True, 16)
    assert any("off by up to 2.1e-07" in note for note in kitti.notes)


def test_the_way_is_that_of_the_scans_not_of_longer_poses(kitti_folder, tmp_path):
    """Poses of 100 m before and after the scans are no way that was scanned."""
    T, t_ns = way(), START + np.arange(8) * SECOND // 10
    before, after = T[:1].copy(), T[-1:].copy()
    before[0, 0, 3] -= 100.0
    after[0, 0, 3] += 100.0
    longer = Trajectory(np.r_[t_ns[0] - SECOND // 2, t_ns, t_ns[-1] + SECOND // 2], np.concatenate([before, T, after]))
    (tmp_path / "poses").write_text(tum_text(longer))
    choices = Choices(poses=str(tmp_path / "poses"), anchor=ANCHOR, poses_of="vehicle")
    recording = open_recording("auto", kitti_folder, choices=choices)
    assert len(recording) == 8
    quality = quality_of(recording, recording.track)
    assert quality.way_m == pytest.approx(float(np.linalg.norm(T[-1, :3, 3] - T[0, :3, 3])), abs=0.2)


def test_gaps_and_scans_without_a_pose_are_named(kitti_folder, tmp_path):
    (kitti_folder / "times.txt").write_text("\n".join(str(k) for k in (0, 0.1, 0.2, 1.5, 1.6, 3.0, 3.1, 4.0)))
    T, t_ns = way(), START + (np.array([0, 0.1, 0.2, 0.3, 0.4, 2.9, 3.0, 3.1]) * SECOND).astype(np.int64)
    (tmp_path / "poses").write_text(tum_text(Trajectory(t_ns, T)))
    recording = open_recording("auto", kitti_folder, ANCHOR, choices=Choices(poses=str(tmp_path / "poses")))
    assert (len(recording), recording.posed) == (5, 5 / 8)
    assert any("gap of 2.5 s 0.4 s after the first scan, 2 scans in it" in note for note in recording.notes)
    assert any("3 of 8 scans without a pose: left out" in note for note in recording.notes)
    np.testing.assert_array_equal(recording.read(3).t_ns, recording.t_ns[3])


def test_poses_that_lie_elsewhere_than_the_fixes_are_refused(kitti_folder, tmp_path):
    T = way()
    T[:, 0, 3] += 5_000.0
    write_utm(tmp_path / "poses", T)
    choices = Choices(poses=str(tmp_path / "poses"), poses_frame="utm:54", anchor=ANCHOR)
    with pytest.raises(ImportDriveError, match=r"poses lie 5,0\d\d\.\d m \(median\) from the GNSS fixes"):
        import_recording("auto", kitti_folder, tmp_path / "a.mcap", choices=choices)
    choices = Choices(poses=str(write_utm(tmp_path / "poses", way())), poses_frame="utm:33", anchor=ANCHOR)
    with pytest.raises(ImportDriveError, match=r"poses lie [\d,.]+ m .* another UTM zone"):
        import_recording("auto", kitti_folder, tmp_path / "a.mcap", choices=choices)


WRONG = {
    "empty": ("", "empty"),
    "prose": ("hello world\n", "no trajectory of a known kind"),
    "seven numbers": ("1 2 3 4 5 6 7\n" * 3, "line 1 has 7 numbers"),
    "ragged": ("1 2 3 4 0 0 0 1\n1 2 3\n", "line 2 has 3 numbers"),
    "no quaternion": ("1 0 0 0 0 0 0 2\n2 0 0 0 0 0 0 2\n", "quaternion of pose 1 has length 2"),
    "reversed": ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "pose 2 of 2 is earlier than the one before"),
    "equal": ("2 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", "pose 2 of 2 has the time of the one before"),
    "mirrored": ("1 0 0 0 0 -1 0 0 0 0 1 0\n" * 2, "mirrors"),
    "scaled": ("2 0 0 0 0 2 0 0 0 0 2 0\n" * 2, "off by 3 from orthonormal"),
    "one": ("1 0 0 0 0 0 0 1\n", "1 poses; at least 2"),
    "nan": ("1 0 0 nan 0 0 0 1\n2 0 0 0 0 0 0 1\n", "not finite"),
    "no height": ("time,lat,lon\n1,2,3\n2,2,3\n", "without a height"),
    "no time": ("lat,lon,alt\n1,2,3\n2,2,3\n", "no column of times"),
    "a word": ("time,lat,lon,alt\n1,2,3,x\n2,2,3,4\n", "column h"),
    "json": ("{]", "no JSON"),
    "geojson without points": ('{"type": "FeatureCollection", "features": []}', "0 points"),
    "binary": ("\0\0\0", "binary"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_no_trajectory_is_refused_with_the_reason(tmp_path, what):
    text, message = WRONG[what]
    (tmp_path / "poses").write_text(text)
    with pytest.raises(ImportDriveError, match=message) as caught:
        read_poses(tmp_path / "poses")
    assert "\n" not in str(caught.value)


def test_utm_without_a_zone_asks_for_it(tmp_path):
    path = write_utm(tmp_path / "poses", way())
    with pytest.raises(ImportDriveError, match=r"look like UTM: give\s+--poses-frame utm:ZONE"):
        laid(path)
    np.testing.assert_allclose(laid(path, near=ANCHOR), way(), atol=1e-6)
    for frame, message in (("utm:61", "zones are 1 ... 60"), ("mars", "expected auto"), ("geodetic", "no latitude")):
        with pytest.raises(ImportDriveError, match=message):
            laid(path, frame)


def test_a_yaw_that_counts_from_north_is_found_by_the_way(tmp_path):
    path = write_ins(tmp_path / "poses", way())
    path.write_text(path.read_text().replace("Heading", "Yaw"))
    np.testing.assert_allclose(laid(path), way(), atol=1e-5)
    assert "column yaw counts clockwise from north" in read_poses(path).notes[0]
    assert np.linalg.norm(T_inverse(laid(path)[0]) @ way()[0] - np.eye(4)) < 1e-5
