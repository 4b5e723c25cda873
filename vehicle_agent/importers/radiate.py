"""RADIATE: folders of 32-beam Velodyne scans (csv or csv.xz: x, y, z, intensity, ring) with GPS/IMU records.

The LiDAR's x points right and y forward. Scans are as fired: the time of a point follows from its azimuth. The GPS
clock runs 65.7 s ahead of the LiDAR's (seen from both starting together), and some of its stamps are off by 0.4 s;
records come in pairs at 20 Hz. Velocities are north, east, down.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnd.schemas.drive import GnssFix, MotionSample
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.files import check_folder, files_of, read_file
from gnd.vehicle_agent.importers.recording import GNSS_SIGMA_M, Recording, RecordingAnchor, mount

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

LIDAR_YAW_DEG = -90.97  # x right, y forward; the rest is its mean course in fog_6_0 against its axes
LIDAR_PITCH_DEG = 1.35  # the same, vertically
LIDAR_HEIGHT_M = 2.1  # the road lies this far below the sensor
OWN_VEHICLE_M = 2.6  # returns nearer than this come from the vehicle itself
PERIOD_NS = 100_085_000  # between the scans whose times are listed
SWEEP_NS = 100_000_000  # a turn of the sensor at 600 rpm
GPS_AHEAD_NS = 65_700_000_000
GPS_PERIOD_NS = 50_000_000


def open_radiate(folder: Path, anchor: RecordingAnchor | None) -> Recording:
    """A RADIATE folder. Its GPS gives its place; `anchor` only moves the origin of the map frame.

    Raises:
        ImportDriveError: no scans or no GPS records, or a file that is not what its name says.
    """
    check_folder(folder)
    files = files_of(folder / "velo_lidar_csv_xz", "*.csv.xz") or files_of(folder / "velo_lidar", "*.csv", "*.csv.xz")
    if not files:
        raise ImportDriveError(f"{folder}: no scans in velo_lidar (*.csv) or velo_lidar_csv_xz (*.csv.xz)")
    t_ns = _scan_times(folder, files)
    gps_ns, gps = _gps(folder)
    return Recording(
        name=folder.name,
        sensor_model="HDL-32E",
        source="RADIATE (Sheeny et al.), CC BY-NC-SA 4.0; GPS clock shifted by 65.7 s, track by LiDAR odometry",
        T_vehicle_lidar=mount(LIDAR_YAW_DEG, LIDAR_HEIGHT_M, LIDAR_PITCH_DEG),
        t_ns=t_ns,
        read=lambda i: _scan(files[i], int(t_ns[i])),
        anchor=anchor or RecordingAnchor(*map(float, gps[0, :3])),
        gnss=_fixes(gps_ns, gps),
        motion=_motion(gps_ns, gps),
        deskew="reconstructed",
        sweep_ns=SWEEP_NS,
    )


def _scan(path: Path, t_ns: int) -> RawScan:
    text = read_file(path).decode("ascii", "replace")
    try:
        rows = np.array([line.split(",") for line in text.split()], np.float64)
    except ValueError as error:
        raise ImportDriveError(f"{path}: not rows of x,y,z,intensity,ring: {error}") from error
    if rows.ndim != 2 or rows.shape[1] != 5:
        raise ImportDriveError(f"{path}: table of shape {rows.shape}; rows of x,y,z,intensity,ring are needed")
    kept = rows[np.linalg.norm(rows[:, :3], axis=1) >= OWN_VEHICLE_M]
    turned = np.unwrap(np.arctan2(rows[:, 0], rows[:, 1]))  # clockwise from forward, as the sensor turns
    offset = np.maximum(turned - turned[0], 0.0)[np.linalg.norm(rows[:, :3], axis=1) >= OWN_VEHICLE_M]
    return RawScan(
        t_ns,
        kept[:, :3].astype(np.float32),
        np.round(offset / (2 * np.pi) * SWEEP_NS).astype(np.uint32),
        kept[:, 4].astype(np.uint16),
    )


def _stamps(path: Path) -> dict[int, int]:
    """Frame number to time in ns, of lines such as 'Frame: 000018 Time: 1574859771.700975000'."""
    found = re.findall(r"Frame:\s*(\d+)\s+Time:\s*(\d+)\.(\d{9})", path.read_text()) if path.exists() else []
    return {int(frame): int(seconds) * 1_000_000_000 + int(nanoseconds) for frame, seconds, nanoseconds in found}


def _scan_times(folder: Path, files: list[Path]) -> I64:
    """Listed times; a scan that is not listed takes its place in the rhythm of the others."""
    listed = _stamps(folder / "velo_lidar.txt")
    if not listed:
        raise ImportDriveError(f"{folder / 'velo_lidar.txt'}: no lines 'Frame: … Time: …'; when were the scans taken?")
    numbers = [int(path.name.split(".")[0]) for path in files]
    known = np.array(sorted(listed))
    nearest = known[np.abs(known[:, None] - numbers).argmin(axis=0)]
    return np.array(
        [listed[int(k)] + (n - int(k)) * PERIOD_NS for n, k in zip(numbers, nearest, strict=True)], np.int64
    )


def _gps(folder: Path) -> tuple[I64, F64]:
    """Times (LiDAR clock) and records (latitude, longitude, height, ..., velocities, turn rates), one of each pair."""
    stamps = _stamps(folder / "GPS_IMU_Twist.txt")
    files = files_of(folder / "GPS_IMU_Twist", "*.txt")[::2]
    if not files or not stamps:
        raise ImportDriveError(f"{folder}: no GPS records (GPS_IMU_Twist/*.txt and GPS_IMU_Twist.txt)")
    records = np.array([np.array(re.split(r"[,\s]+", path.read_text().strip()), np.float64) for path in files])
    t = np.array([stamps[int(path.stem)] for path in files], np.int64) - GPS_AHEAD_NS
    raster = GPS_PERIOD_NS * np.arange(len(t), dtype=np.int64)
    raster += int(np.median(t - raster))
    return np.where(np.abs(t - raster) > GPS_PERIOD_NS // 2, raster, t), records


def _fixes(t_ns: I64, gps: F64) -> tuple[GnssFix, ...]:
    """Every second record; with the clocks as they are it is good to metres, not to the centimetres it states."""
    lat, lon = np.radians(gps[:, 0]), np.radians(gps[:, 1])
    return tuple(
        GnssFix(int(t_ns[i]), float(lat[i]), float(lon[i]), float(gps[i, 2]), GNSS_SIGMA_M)
        for i in range(0, len(t_ns), 2)
    )


def _motion(t_ns: I64, gps: F64) -> tuple[MotionSample, ...]:
    """Speed over ground, and the turn rate about the downward axis with its sign changed."""
    speed = np.hypot(gps[:, -6], gps[:, -5])
    return tuple(MotionSample(int(t), float(v), float(-w)) for t, v, w in zip(t_ns, speed, gps[:, -1], strict=True))
