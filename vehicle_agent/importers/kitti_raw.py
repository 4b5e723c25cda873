"""KITTI raw and KITTI-360 drives: sweeps with stamps, and the INS beside them (OxTS RT3003).

A drive holds `velodyne_points/data/*.bin` with `timestamps.txt` (or `timestamps_start.txt` and `timestamps_end.txt`),
and `oxts/data/*.txt` with `oxts/timestamps.txt`; of KITTI-360 the INS lies in `data_poses/DRIVE/oxts`. The INS gives
fixes with their accuracy, speed and yaw rate; the track is LiDAR odometry. Sweeps are as measured.
"""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.se3 import T_from_R_t, T_inverse
from gnd.schemas.drive import GnssFix, MotionSample
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.bins import read_bin
from gnd.vehicle_agent.importers.files import check_folder, files_below, files_of
from gnd.vehicle_agent.importers.planes import KITTI_INS_HEIGHT_M, KITTI_LIDAR_M
from gnd.vehicle_agent.importers.recording import NOMINAL, Entry, Recording, RecordingAnchor, mount
from gnd.vehicle_agent.importers.rigid import orthonormal
from gnd.vehicle_agent.importers.trajectories.clocks import ns_of_date

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

OXTS_COLUMNS: Final = 30
LAT, LON, ALT, FORWARD, YAW_RATE, ACCURACY = 0, 1, 2, 8, 22, 23
"""Of the columns of OxTS's records (dataformat.txt of the raw data): vf and wu are about the vehicle's axes."""


def is_kitti_raw(folder: Path) -> bool:
    """Whether a folder is a drive of the raw recordings or of KITTI-360, with stamps."""
    return (
        bool(files_of(folder / "velodyne_points", "timestamps*.txt")) and (folder / "velodyne_points" / "data").is_dir()
    )


def open_kitti_raw(folder: Path, anchor: RecordingAnchor | None) -> Recording:
    """A drive. Its INS gives its place; `anchor` only moves the origin of the map frame.

    Raises:
        ImportDriveError: no scans, stamps that do not fit them, an INS record that is none.
    """
    check_folder(folder)
    files = files_below(folder / "velodyne_points" / "data", ".bin", ".bin.xz")
    if not files:
        raise ImportDriveError(f"{folder}: no .bin scans in velodyne_points/data")
    t_ns = _times(folder / "velodyne_points", files)
    ins_ns, ins = _ins(_oxts_folder(folder))
    T = _mount(folder)
    ins_entry = Entry("oxts", "INS records", len(ins_ns), "OxTS", "place, motion") if len(ins_ns) else None
    return Recording(
        name=folder.name,
        sensor_model="HDL-64E",
        source="KITTI (Geiger et al.; Liao et al.), CC BY-NC-SA 3.0; track by LiDAR odometry",
        T_vehicle_lidar=T,
        t_ns=t_ns,
        read=lambda i: read_bin(files[i], int(t_ns[i]), 4),
        anchor=anchor or _place(ins),
        gnss=_fixes(ins_ns, ins),
        motion=tuple(
            MotionSample(int(t), float(row[FORWARD]), float(row[YAW_RATE])) for t, row in zip(ins_ns, ins, strict=True)
        ),
        stamp="middle",
        placed=anchor is not None or bool(len(ins)),
        entries=(
            Entry("velodyne_points", ".bin scans", len(files), "HDL-64E", "scans"),
            *((ins_entry,) if ins_entry else ()),
        ),
    )


def _times(folder: Path, files: list[Path]) -> I64:
    """Middles of the sweeps in `files`, by their numbers: drives lack some."""
    begin, end, middle = (folder / f"timestamps{part}.txt" for part in ("_start", "_end", ""))
    if begin.is_file() and end.is_file():
        stamps = [(ns_of_date(a) + ns_of_date(b)) // 2 for a, b in zip(_lines(begin), _lines(end), strict=True)]
    else:
        stamps = [ns_of_date(line) for line in _lines(middle)]
    numbers = [int(path.name.split(".")[0]) for path in files]
    if max(numbers) >= len(stamps):
        raise ImportDriveError(f"{folder}: {len(stamps)} stamps, scan {max(numbers)}")
    return np.array([stamps[number] for number in numbers], np.int64)


def _lines(path: Path) -> list[str]:
    if not path.is_file():
        raise ImportDriveError(f"{path}: no such file; when were the scans taken?")
    return [line for line in path.read_text(errors="replace").splitlines() if line.strip()]


def _oxts_folder(folder: Path) -> Path:
    """Of the drive; of KITTI-360 (data_3d_raw/DRIVE) the one in data_poses/DRIVE."""
    own = folder / "oxts"
    return own if own.is_dir() else folder.parent.parent / "data_poses" / folder.name / "oxts"


def _ins(folder: Path) -> tuple[I64, F64]:
    """Times and records (N, 30), of a vehicle that has them."""
    files = files_of(folder / "data", "*.txt")
    if not files:
        return np.zeros(0, np.int64), np.zeros((0, OXTS_COLUMNS))
    t_ns = np.array([ns_of_date(line) for line in _lines(folder / "timestamps.txt")], np.int64)
    try:
        rows = np.array([path.read_text().split()[:OXTS_COLUMNS] for path in files], np.float64)
        t_ns = t_ns[[int(path.stem) for path in files]]
    except (ValueError, IndexError) as error:
        raise ImportDriveError(
            f"{folder}: records that are no {OXTS_COLUMNS} numbers with a stamp each: {error}"
        ) from None
    kept = np.r_[True, np.diff(t_ns) > 0]
    return t_ns[kept], rows[kept]


def _fixes(t_ns: I64, ins: F64) -> tuple[GnssFix, ...]:
    """At the vehicle's origin, on the road beneath the INS."""
    rows = zip(t_ns, np.radians(ins[:, LAT]), np.radians(ins[:, LON]), ins[:, ALT] - KITTI_INS_HEIGHT_M, strict=True)
    sigma = np.maximum(ins[:, ACCURACY], 0.01)
    return tuple(
        GnssFix(int(t), float(a), float(o), float(h), float(s)) for (t, a, o, h), s in zip(rows, sigma, strict=True)
    )


def _place(ins: F64) -> RecordingAnchor:
    return RecordingAnchor(*map(float, ins[0, :3])) if len(ins) else NOMINAL


def _mount(folder: Path) -> F64:
    """(4, 4) T_vehicle_lidar, the vehicle's origin on the road beneath the INS: calibrated, else by KITTI's papers."""
    raw = files_of(folder, "calib_imu_to_velo.txt") or files_of(folder.parent, "calib_imu_to_velo.txt")
    camera, pose = (
        folder.parent.parent / "calibration" / name for name in ("calib_cam_to_velo.txt", "calib_cam_to_pose.txt")
    )
    if raw:
        T_imu_lidar = T_inverse(_matrix(raw[0], "R:", "T:"))
    elif camera.is_file() and pose.is_file():
        T_imu_lidar = _matrix(pose, "image_00:") @ T_inverse(_matrix(camera))
        if T_imu_lidar[2, 2] < 0.0:  # KITTI-360's INS has x forward, y right, z down
            T_imu_lidar = np.diag([1.0, -1.0, -1.0, 1.0]) @ T_imu_lidar
    else:
        T = mount(0.0, KITTI_LIDAR_M[2])
        T[:2, 3] = KITTI_LIDAR_M[:2]
        return T
    T_imu_lidar[2, 3] += KITTI_INS_HEIGHT_M
    return np.asarray(T_imu_lidar)


def _matrix(path: Path, *keys: str) -> F64:
    """(4, 4) of the lines with these keys (rotation, then translation; or twelve numbers), or of a file of twelve."""
    lines = {line.split()[0]: line.split()[1:] for line in _lines(path)}
    words = [lines.get(key, []) for key in keys] if keys else [path.read_text().split()]
    try:
        values = [np.array(one, np.float64) for one in words]
        rows = values[0].reshape(3, 4) if len(values) == 1 else np.column_stack([values[0].reshape(3, 3), values[1]])
    except ValueError as error:
        raise ImportDriveError(f"{path}: no calibration: {error}") from None
    T, _ = orthonormal(rows[None], str(path))
    return T_from_R_t(T[0, :3, :3], T[0, :3, 3])
