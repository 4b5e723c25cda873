"""Folders of sweeps as planes of millimetres (`scans_xz/NUMBER.xyz_mm.xz`), with or without an INS (`poses.csv`).

A file is xz of little-endian int32, all x, then all y, then all z, in millimetres of the LiDAR frame; no times of
points. `poses.csv` has a header and a line a scan: t_s, lat_deg, lon_deg, alt_m, roll_rad, pitch_rad, yaw_rad (from
east, counter-clockwise), speed_mps. The INS gives fixes, speed and yaw rate; the track is LiDAR odometry, because an
INS is good to some centimetres between two scans and to a metre over minutes.

Its stamps lie on the INS's own raster (KITTI: 10 ms), the scans do not: a LiDAR turns evenly, so scans get the even
rhythm that is closest to the stamps. A stamp is the *middle* of a sweep (KITTI: the laser looks forward).
"""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.schemas.drive import GnssFix, MotionSample
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.files import check_folder, files_below, read_file
from gnd.vehicle_agent.importers.recording import GNSS_SIGMA_M, NOMINAL, Recording, RecordingAnchor, mount

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

ENDINGS: Final = (".xyz_mm", ".xyz_mm.xz")
POINT_BYTES: Final = 12
PERIOD_NS: Final = 100_000_000
START_NS: Final = 1_000_000_000_000_000_000  # where no times are given
EVEN_NS: Final = 10_000_000
"""Stamps this near to an even rhythm are taken to be rounded; scans farther from it are stamped as they are."""
COLUMNS: Final = ("t_s", "lat_deg", "lon_deg", "alt_m", "yaw_rad", "speed_mps")

KITTI_LIDAR_M: Final = (0.81, -0.32, 1.73)
"""The HDL-64E of KITTI's car from the place on the road beneath its INS (Geiger et al. 2013, Fig. 1 and 3)."""
KITTI_INS_HEIGHT_M: Final = 0.93


def open_planes(folder: Path, anchor: RecordingAnchor | None) -> Recording:
    """A folder of planes. Its INS gives its place, else `anchor` (or a nominal one) does.

    Raises:
        ImportDriveError: no scans, or a file that is not what its name says.
    """
    check_folder(folder)
    files = files_below(folder, *ENDINGS)
    if not files:
        raise ImportDriveError(f"{folder}: no {' or '.join(ENDINGS)} scans there or in the folders below it")
    kitti = _is_kitti(folder)
    ins_ns, ins = _ins(folder / "poses.csv", len(files))
    if kitti:
        ins["alt_m"] = ins["alt_m"] - KITTI_INS_HEIGHT_M
    t_ns, rounded = scan_times(ins_ns)
    return Recording(
        name=folder.name,
        sensor_model="HDL-64E" if kitti else "unknown",
        source=f"planes of {folder.name}{', KITTI raw (Geiger et al.), CC BY-NC-SA 3.0' if kitti else ''};"
        " fixes, speed and yaw rate of its INS, track by LiDAR odometry",
        T_vehicle_lidar=_kitti_mount() if kitti else np.eye(4),
        t_ns=t_ns,
        read=lambda i: _scan(files[i], int(t_ns[i])),
        anchor=anchor or _place(ins),
        gnss=_fixes(ins_ns, ins),
        motion=_motion(ins_ns, ins),
        stamp="middle",
        timed=bool(len(ins["lat_deg"])),
        placed=anchor is not None or bool(len(ins["lat_deg"])),
        mount="given" if kitti else "assumed",
        notes=(f"stamps lie up to {rounded * 1e-6:.1f} ms off an even rhythm: scans take the rhythm",)
        if rounded
        else (),
    )


def _is_kitti(folder: Path) -> bool:
    """Whether what lies beside the scans says that KITTI's car took them."""
    said = folder / "SOURCE.txt"
    return said.is_file() and "KITTI raw" in said.read_text(errors="replace")


def _kitti_mount() -> F64:
    T = mount(0.0, KITTI_LIDAR_M[2])
    T[:2, 3] = KITTI_LIDAR_M[:2]
    return T


def _scan(path: Path, t_ns: int) -> RawScan:
    data = read_file(path)
    if len(data) % POINT_BYTES:
        raise ImportDriveError(f"{path}: {len(data)} bytes, which is no multiple of {POINT_BYTES}")
    points = np.frombuffer(data, "<i4").reshape(3, -1).T * 1e-3
    return RawScan(t_ns, np.ascontiguousarray(points, dtype=np.float32), np.zeros(len(points), np.uint32))


def _ins(path: Path, n: int) -> tuple[I64, dict[str, F64]]:
    """Stamps (N,) and columns of the INS; an even rhythm and empty columns where there is none."""
    if not path.is_file():
        return START_NS + PERIOD_NS * np.arange(n, dtype=np.int64), {name: np.zeros(0) for name in COLUMNS}
    head, *lines = path.read_text().splitlines()
    names = [name.strip() for name in head.split(",")]
    missing = set(COLUMNS) - set(names)
    if missing:
        raise ImportDriveError(f"{path}: no column {', '.join(sorted(missing))}")
    try:
        rows = np.array([line.split(",") for line in lines if line], np.float64).reshape(-1, len(names))
    except ValueError as error:
        raise ImportDriveError(f"{path}: not rows of {len(names)} numbers: {error}") from error
    if len(rows) != n or not np.isfinite(rows).all():
        raise ImportDriveError(f"{path}: {len(rows)} lines for {n} scans; one line a scan, all finite, is needed")
    table = {name: rows[:, names.index(name)] for name in COLUMNS}
    return np.round(table["t_s"] * 1e3).astype(np.int64) * 1_000_000, table


def scan_times(stamps_ns: I64) -> tuple[I64, int]:
    """Times (N,) of scans: the even rhythm closest to their stamps, and by how much those are off it (0: left alone).

    A rhythm with a scan missing, or a sensor that does not turn evenly, is no even one: then the stamps stay.
    """
    if len(stamps_ns) < 3:
        return stamps_ns, 0
    k = np.arange(len(stamps_ns))
    slope, begin = np.polyfit(k, (stamps_ns - stamps_ns[0]).astype(np.float64), 1)
    even = stamps_ns[0] + np.round(begin + slope * k).astype(np.int64)
    off = int(np.abs(even - stamps_ns).max())
    return (even, off) if 0 < off <= EVEN_NS else (stamps_ns, 0)


def _place(ins: dict[str, F64]) -> RecordingAnchor:
    if not len(ins["lat_deg"]):
        return NOMINAL
    return RecordingAnchor(*(float(ins[name][0]) for name in ("lat_deg", "lon_deg", "alt_m")))


def _fixes(t_ns: I64, ins: dict[str, F64]) -> tuple[GnssFix, ...]:
    lat, lon = np.radians(ins["lat_deg"]), np.radians(ins["lon_deg"])
    return tuple(
        GnssFix(int(t), float(a), float(o), float(h), GNSS_SIGMA_M)
        for t, a, o, h in zip(t_ns, lat, lon, ins["alt_m"], strict=False)
    )


def _motion(t_ns: I64, ins: dict[str, F64]) -> tuple[MotionSample, ...]:
    """Forward speed as it is, yaw rate from the yaw of the samples before and after."""
    if len(ins["yaw_rad"]) < 2:
        return ()
    rate = np.gradient(np.unwrap(ins["yaw_rad"]), (t_ns - t_ns[0]) * 1e-9)
    return tuple(MotionSample(int(t), float(v), float(w)) for t, v, w in zip(t_ns, ins["speed_mps"], rate, strict=True))
