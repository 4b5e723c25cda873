"""KITTI: folders of HDL-64E scans (.bin or .bin.xz), as in the odometry benchmark or the raw recordings.

Files give no times of points, and lie ring by ring. Scans of the benchmark are said to be freed of motion distortion,
raw recordings are not; the import finds out. A scan's time is when the laser looks forward, the middle of its sweep.
The ground truth of the benchmark drifts against the LiDAR (a metre over the first 13 m of sequence 00), so it gives
the GNSS fixes only; the reference track is LiDAR odometry. The benchmark does not tell the place: unless told otherwise
it is a nominal one in Karlsruhe.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import GnssFix
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.damage import MAX_NUMBER, named_damage, number_table
from gnd.vehicle_agent.importers.files import check_folder, files_below, files_of, read_file
from gnd.vehicle_agent.importers.recording import GNSS_SIGMA_M, NOMINAL, Recording, RecordingAnchor, mount

F64 = NDArray[np.float64]

LIDAR_HEIGHT_M = 1.73  # KITTI's sensor setup
PERIOD_NS = 103_600_000  # where no times are given: the LiDAR turned at 9.65 Hz
START_NS = 1_317_000_000_000_000_000  # times in the files count from 0: put them in autumn 2011
SCAN_FOLDERS = ("velodyne", "velodyne_xz", "velodyne_points/data", "velodyne_points_xz", "data", ".")
TIME_FILES = ("times.txt", "*_times.txt")
RECORD_BYTES = 16

# Velodyne to camera 0 of 2011_10_03 (sequences 00-02), used where the folder has no calib.txt.
T_CAMERA_LIDAR_2011_10_03 = np.array(
    [
        [4.276802385584e-04, -9.999672484946e-01, -8.084491683471e-03, -1.198459927713e-02],
        [-7.210626507497e-03, 8.081198471645e-03, -9.999413164504e-01, -5.403984729748e-02],
        [9.999738645903e-01, 4.859485810390e-04, -7.206933692422e-03, -2.921968648686e-01],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def open_kitti(folder: Path, anchor: RecordingAnchor | None) -> Recording:
    """A KITTI folder; `anchor`: where its first pose is put, heading east.

    Raises:
        ImportDriveError: no scans, or a file that is not what its name says.
    """
    check_folder(folder)
    files = _scan_files(folder)
    t_ns = _times(folder, len(files))
    T_vehicle_lidar = mount(0.0, LIDAR_HEIGHT_M)
    place = anchor or NOMINAL
    return Recording(
        name=folder.name,
        sensor_model="HDL-64E",
        source="KITTI (Geiger et al.), CC BY-NC-SA 3.0; nominal place, track by LiDAR odometry",
        T_vehicle_lidar=T_vehicle_lidar,
        t_ns=t_ns,
        read=lambda i: _scan(files[i], int(t_ns[i])),
        anchor=place,
        gnss=_fixes(folder, t_ns, T_vehicle_lidar, place),
        stamp="middle",
        placed=anchor is not None,
        timed=bool(files_of(folder, *TIME_FILES)),
        notes=("times count from the first scan: the day is made up",) if files_of(folder, *TIME_FILES) else (),
    )


def _scan_files(folder: Path) -> list[Path]:
    for name in SCAN_FOLDERS:
        files = files_of(folder / name, "*.bin", "*.bin.xz")
        if files:
            return files
    if files := files_below(folder, ".bin", ".bin.xz"):
        return files
    raise ImportDriveError(f"{folder}: no .bin or .bin.xz scans there or in the folders below it")


def _scan(path: Path, t_ns: int) -> RawScan:
    """float32 x, y, z, reflectance of every point, in the file's order."""
    data = read_file(path)
    if len(data) % RECORD_BYTES:
        raise ImportDriveError(f"{path}: {len(data)} bytes, which is no multiple of {RECORD_BYTES}")
    points = np.frombuffer(data, np.float32).reshape(-1, 4)[:, :3]
    return RawScan(t_ns, np.ascontiguousarray(points), np.zeros(len(points), np.uint32))


def _times(folder: Path, n: int) -> NDArray[np.int64]:
    files = files_of(folder, *TIME_FILES)
    if not files:
        return START_NS + PERIOD_NS * np.arange(n, dtype=np.int64)
    seconds = number_table(files[0])[:, 0]
    if len(seconds) < n:
        raise ImportDriveError(f"{files[0]}: {len(seconds)} times for {n} scans")
    return START_NS + np.round(seconds[:n] * 1e9).astype(np.int64)


def _fixes(folder: Path, t_ns: NDArray[np.int64], T_vehicle_lidar: F64, anchor: RecordingAnchor) -> tuple[GnssFix, ...]:
    """Positions of the ground truth, where there is one."""
    files = files_of(folder, "poses.txt", "*_gt.txt")
    if not files:
        return ()
    rows = number_table(files[0])
    if rows.shape[1] != 12 or len(rows) < len(t_ns):
        raise ImportDriveError(f"{files[0]}: {rows.shape} numbers for {len(t_ns)} scans; 12 a scan are needed")
    T_camera = np.tile(np.eye(4), (len(t_ns), 1, 1))
    T_camera[:, :3] = rows[: len(t_ns)].reshape(-1, 3, 4)
    calibrated = calibration_of(folder)
    T_camera_lidar = T_CAMERA_LIDAR_2011_10_03 if calibrated is None else calibrated
    T_camera_vehicle = T_camera_lidar @ T_inverse(T_vehicle_lidar)
    p_map = (T_inverse(T_camera_vehicle) @ T_inverse(T_camera[0]) @ T_camera @ T_camera_vehicle)[:, :3, 3]
    lat, lon, height = anchor.frame.geodetic_from_enu(p_map @ anchor.T_map_start[:3, :3].T)
    return tuple(
        GnssFix(int(t), float(a), float(o), float(h), GNSS_SIGMA_M)
        for t, a, o, h in zip(t_ns, lat, lon, height, strict=True)
    )


def calibration_of(folder: Path) -> F64 | None:
    """(4, 4) T_camera_lidar of a folder's calib.txt; None where there is none.

    Raises:
        ImportDriveError: the file lacks it.
    """
    path = folder / "calib.txt"
    if not path.exists():
        return None
    with named_damage(path):
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith("Tr:"):
                row = np.array(line.split()[1:], np.float64).reshape(3, 4)
                if not (np.abs(row) <= MAX_NUMBER).all():
                    raise ImportDriveError(f"{path}: numbers that are not finite, or beyond {MAX_NUMBER:g}")
                return np.vstack([row, [0.0, 0.0, 0.0, 1.0]])
    raise ImportDriveError(f"{path}: no line 'Tr:' with the pose of the LiDAR before the camera")
