"""A folder of PCD files, with or without poses.

Poses come from `poses.txt` (in the folder or the one above), one line a scan in the order of the files' numbers:
`number t x y z qx qy qz qw`, `t x y z qx qy qz qw` (TUM) or twelve numbers of a 3 x 4 matrix (KITTI; 10 Hz then). They
are poses of the LiDAR, x forward, in axes east, north, up; the place of the first one must be given. Without poses
LiDAR odometry finds the track. A field with the times of points is read where there is one, file names that are stamps
give the times of scans; a scan's time is taken as the beginning of its sweep. The mount is not known.
"""

import contextlib
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import R_from_quaternion_xyzw, T_from_R_t
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.damage import number_table
from gnd.vehicle_agent.importers.fields import ANY_FIELD, FieldChoice, TimeRule, scan_of_fields, time_rule, xyz_of
from gnd.vehicle_agent.importers.files import check_folder, files_below, files_of
from gnd.vehicle_agent.importers.pcd_format import read_pcd
from gnd.vehicle_agent.importers.recording import NOMINAL, Entry, Recording, RecordingAnchor
from gnd.vehicle_agent.importers.rigid import orthonormal
from gnd.vehicle_agent.importers.stamps import stamps_of_names

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

PERIOD_NS = 100_000_000
START_NS = 1_000_000_000_000_000_000  # where no times are given
SCAN_FOLDERS = (".", "pcds", "pcd", "scans", "velodyne")


def open_pcd(folder: Path, anchor: RecordingAnchor | None, choices: Choices | None = None) -> Recording:
    """A folder of PCD files; `anchor` says where on the Earth the first pose lies.

    Raises:
        ImportDriveError: no scans, poses that do not fit the scans.
    """
    check_folder(folder)
    files = _scan_files(folder)
    t_ns, track = _track(files[0].parent, files)
    rule, fields = _time_rule(files, choices.fields if choices else ANY_FIELD)
    return Recording(
        name=folder.name,
        sensor_model="unknown",
        source=f"PCD files of {folder.name}; motion from the track",
        T_vehicle_lidar=np.eye(4),
        t_ns=t_ns,
        read=lambda i: scan_of_fields(_points(files[i], fields), int(t_ns[i]), rule),
        anchor=anchor or NOMINAL,
        track=track,
        mount="assumed",
        placed=anchor is not None,
        timed=int(t_ns[0]) != START_NS,
        entries=(Entry(files[0].parent.name, "PCD files", len(files), f"{', '.join(fields)}; {rule.said}", "scans"),),
    )


def _scan_files(folder: Path) -> list[Path]:
    for name in SCAN_FOLDERS:
        if files := files_of(folder / name, "*.pcd", "*.pcd.xz"):
            return sorted(files, key=scan_number)
    if files := files_below(folder, ".pcd", ".pcd.xz"):
        return sorted(files, key=scan_number)
    raise ImportDriveError(f"{folder}: no .pcd or .pcd.xz files there or in the folders below it")


def scan_number(path: Path) -> tuple[int, str]:
    """2.pcd before 10.pcd."""
    digits = re.findall(r"\d+", path.name.split(".")[0])
    return int(digits[-1]) if digits else -1, path.name


def read_scan(path: Path, t_ns: int) -> RawScan:
    """The points of one file, all at the time of the sweep."""
    points = _points(path)
    xyz = xyz_of(points)
    return RawScan(t_ns, xyz, np.zeros(len(xyz), np.uint32))


def _points(path: Path, fields: tuple[str, ...] = ()) -> NDArray[np.void]:
    """The points of a file, whose fields must be those of the others where these are given."""
    points = read_pcd(path)
    missing = {"x", "y", "z"} - set(points.dtype.names or ())
    if missing:
        raise ImportDriveError(f"{path}: no field {', '.join(sorted(missing))}")
    if any(points.dtype[axis].shape for axis in "xyz"):
        raise ImportDriveError(f"{path}: several numbers for x, y or z of a point")
    if fields and points.dtype.names != fields:
        held = ", ".join(points.dtype.names or ())
        raise ImportDriveError(f"{path}: fields {held}; the others have {', '.join(fields)}: another sensor?")
    return points


def _time_rule(files: list[Path], choice: FieldChoice) -> tuple[TimeRule, tuple[str, ...]]:
    """How the times of points are read and which fields there are, from the first file that can be read."""
    for path in files[:5]:
        with contextlib.suppress(ImportDriveError):
            points = _points(path)
            return time_rule(points, choice), points.dtype.names or ()
    return TimeRule(None), ()


def _track(folder: Path, scans: list[Path]) -> tuple[I64, Trajectory | None]:
    """Scan times and poses, the first pose's position taken as origin."""
    files = files_of(folder, "poses.txt") or files_of(folder.parent, "poses.txt")
    n = len(scans)
    if not files:
        named = stamps_of_names(scans)
        return (START_NS + PERIOD_NS * np.arange(n, dtype=np.int64) if named is None else named), None
    rows = number_table(files[0])
    if len(rows) != n or rows.shape[1] not in (8, 9, 12):
        raise ImportDriveError(
            f"{files[0]}: {len(rows)} lines of {rows.shape[1]} numbers for {n} scans; one line a scan of 8 (t,"
            " position, quaternion), 9 (number first) or 12 (matrix) is needed"
        )
    t_ns, T = _poses(rows)
    T[:, :3, 3] -= T[0, :3, 3]
    if rows.shape[1] == 12 and (named := stamps_of_names(scans)) is not None:
        t_ns = named
    return t_ns, Trajectory(t_ns, T)


def _poses(rows: F64) -> tuple[I64, F64]:
    if rows.shape[1] == 12:
        T, _ = orthonormal(rows.reshape(-1, 3, 4), "poses.txt")
        return START_NS + PERIOD_NS * np.arange(len(rows), dtype=np.int64), T
    t_s, position, quaternion = rows[:, -8], rows[:, -7:-4], rows[:, -4:]
    return np.round(t_s * 1e9).astype(np.int64), T_from_R_t(R_from_quaternion_xyzw(quaternion), position)
