"""Sweeps as planes of millimetres: points, times on an even rhythm, and what the INS gives."""

import lzma
from pathlib import Path

import numpy as np
import pytest
from recording_testing import scan_of

from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive_mcap import load_track, read_header
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import import_recording, open_recording
from gnd.vehicle_agent.importers.planes import scan_times

HEAD = "scan,t_s,lat_deg,lon_deg,alt_m,roll_rad,pitch_rad,yaw_rad,speed_mps\n"


def planes_folder(folder: Path, n: int = 6, poses: str | None = None, source: str = "") -> Path:
    (folder / "scans_xz").mkdir(parents=True)
    for k in range(n):
        millimetres = np.round(scan_of(k, 500) * 1e3).astype("<i4")
        data = np.ascontiguousarray(millimetres.T).tobytes()
        (folder / "scans_xz" / f"{k:06d}.xyz_mm.xz").write_bytes(lzma.compress(data, preset=0))
    if poses is not None:
        (folder / "poses.csv").write_text(poses)
    if source:
        (folder / "SOURCE.txt").write_text(source)
    return folder


def poses(n: int = 6, yaw_rate: float = 0.2) -> str:
    """10 m/s and turning across ±π; stamps cut off to 10 ms of a rhythm of 103.6 ms."""
    rows = []
    for k in range(n):
        t = np.floor((1_317_043_295.13 + 0.1036 * k) * 100) / 100
        yaw = np.pi - 0.05 + yaw_rate * (t - 1_317_043_295.13)
        rows.append(f"{k},{t:.3f},49.0{k},8.4,113.2,0,0,{(yaw + np.pi) % (2 * np.pi) - np.pi:.9f},{10 + k}\n")
    return HEAD + "".join(rows)


def test_points_are_those_of_the_files(tmp_path):
    recording = open_recording("auto", planes_folder(tmp_path / "a"))
    assert len(recording) == 6
    np.testing.assert_allclose(recording.read(3).points_m, scan_of(3, 500), atol=0.00051)
    assert np.diff(recording.t_ns).tolist() == [100_000_000] * 5
    assert (recording.mount, recording.deskew, recording.stamp) == ("assumed", "none", "middle")


def test_speed_yaw_rate_and_fixes_of_the_ins(tmp_path):
    recording = open_recording("planes", planes_folder(tmp_path / "a", poses=poses(), source="KITTI raw drive"))
    assert [sample.speed_mps for sample in recording.motion] == [10, 11, 12, 13, 14, 15]
    np.testing.assert_allclose([sample.yaw_rate_radps for sample in recording.motion], 0.2, rtol=1e-4)
    assert np.degrees(recording.gnss[2].lat_rad) == pytest.approx(49.02)
    assert recording.gnss[0].height_m == pytest.approx(113.2 - 0.93)  # the INS stands 0.93 m above the road
    np.testing.assert_allclose(recording.T_vehicle_lidar[:3, 3], [0.81, -0.32, 1.73])
    assert recording.mount == "given"


def test_rounded_stamps_become_an_even_rhythm_and_others_stay():
    true = 10**18 + np.arange(100, dtype=np.int64) * 103_600_000
    even, off = scan_times(true // 10_000_000 * 10_000_000)
    assert 0 < off <= 10_000_000
    assert np.abs(np.diff(even) - 103_600_000).max() < 100_000
    gap = np.delete(true, 40)
    assert scan_times(gap)[0] is gap
    assert scan_times(true[:2])[1] == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (poses(5), "5 lines for 6 scans"),
        (HEAD.replace("yaw_rad,", ""), "no column yaw_rad"),
        (poses().replace("49.02", "north"), "not rows of 9 numbers"),
        (poses().replace("49.02", "nan"), "all finite, is needed"),
    ],
)
def test_a_damaged_table_is_refused(tmp_path, text, message):
    with pytest.raises(ImportDriveError, match=message):
        open_recording("auto", planes_folder(tmp_path / "a", poses=text))


def test_a_damaged_scan_is_refused(tmp_path):
    folder = planes_folder(tmp_path / "a")
    (folder / "scans_xz" / "000002.xyz_mm.xz").write_bytes(lzma.compress(bytes(13)))
    with pytest.raises(ImportDriveError, match="13 bytes, which is no multiple of 12"):
        open_recording("auto", folder).read(2)


@pytest.mark.slow
def test_a_real_drive_of_kitti_gets_its_times(shared_data, tmp_path):
    """The fastest 24 scans: times from the azimuth, and a way that is the INS's."""
    folder = shared_data / "kitti_raw_0027"
    taken = tmp_path / "cut"
    (taken / "scans_xz").mkdir(parents=True)
    lines = (folder / "poses.csv").read_text().splitlines()
    (taken / "poses.csv").write_text("\n".join([lines[0], *lines[111:135]]))
    (taken / "SOURCE.txt").write_text((folder / "SOURCE.txt").read_text())
    for k in range(110, 134):
        (taken / "scans_xz" / f"{k:06d}.xyz_mm.xz").symlink_to(folder / "scans_xz" / f"{k:06d}.xyz_mm.xz")
    imported = import_recording("auto", taken, tmp_path / "a.mcap")
    header, track = read_header(tmp_path / "a.mcap"), load_track(tmp_path / "a.mcap")
    assert (header.deskew, header.mount) == ("reconstructed", "given")
    assert header.sweep_ns == pytest.approx(103_557_000, abs=300_000)
    assert any("clockwise" in note and "% thinner with these times" in note for note in imported.notes)
    T = track.reference.T_map_vehicle
    way_m = np.linalg.norm((T_inverse(T[0]) @ T[-1])[:3, 3])
    ins_m = np.interp(track.reference.t_ns[[0, -1]], track.motion.t_ns, np.cumsum(track.motion.speed_mps) * 0.10356)
    assert way_m == pytest.approx(ins_m[1] - ins_m[0], rel=0.01)
    turned = np.unwrap(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    ins = np.loadtxt(taken / "poses.csv", delimiter=",", skiprows=1)
    ins_yaw = np.interp(track.reference.t_ns * 1e-9 - ins[0, 1], ins[:, 1] - ins[0, 1], np.unwrap(ins[:, 7]))
    off_deg = np.degrees(np.angle(np.exp(1j * (turned - ins_yaw))))
    print(f"heading against the INS: {off_deg.std():.3f}°")
    assert off_deg.std() < 0.15
