"""Argoverse 2 sensor logs: sweeps in the vehicle's axes, freed of motion, with poses in city coordinates.

`sensors/lidar/STAMP.feather` (x, y, z, intensity, laser_number, offset_ns), `city_SE3_egovehicle.feather` and
`calibration/egovehicle_SE3_sensor.feather`. Points are put back into the axes of the upper LiDAR, so that rays begin
where they did. City coordinates are UTM less a city's origin; the datum of heights is not told. Stamps are not the day
of the drive: Argo's clock begins in 1980.
"""

from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.se3 import R_from_quaternion_xyzw, T_from_R_t, T_inverse, transform
from gnd.gnd_map.utm import utm_from_geodetic
from gnd.tile_store.feature_io.argoverse import CITIES, city_of
from gnd.tile_store.feature_io.errors import NeedsGeoreference
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.attached_poses import with_table
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.feather_header import read_feather
from gnd.vehicle_agent.importers.files import check_folder, files_of
from gnd.vehicle_agent.importers.optional import library
from gnd.vehicle_agent.importers.recording import NOMINAL, Entry, Recording, RecordingAnchor
from gnd.vehicle_agent.importers.trajectories.pose_table import PoseTable

F64 = NDArray[np.float64]

EXTRA: Final = "import"
POSES: Final = "city_SE3_egovehicle.feather"
MOUNTS: Final = Path("calibration", "egovehicle_SE3_sensor.feather")
QUATERNION: Final = ("qx", "qy", "qz", "qw")
PLACE: Final = ("tx_m", "ty_m", "tz_m")


def is_argoverse(folder: Path) -> bool:
    """Whether a folder is a log with sweeps."""
    return (folder / POSES).is_file() and bool(files_of(folder / "sensors" / "lidar", "*.feather"))


def open_argoverse(folder: Path, anchor: RecordingAnchor | None, choices: Choices | None = None) -> Recording:
    """A log. The city in the name of its map's file tells the place; without one `anchor` is the origin of the poses.

    Raises:
        ImportDriveError: no sweeps, or tables that lack a column.
        MissingExtra: pyarrow is not installed.
    """
    check_folder(folder)
    files = sorted(files_of(folder / "sensors" / "lidar", "*.feather"), key=lambda path: int(path.stem))
    if not files:
        raise ImportDriveError(f"{folder}: no sweeps in sensors/lidar (the log has poses and a map alone)")
    t_ns = np.array([int(path.stem) for path in files], np.int64)
    T = _mount(folder)
    recording = Recording(
        name=folder.name,
        sensor_model="2 x VLP-32C",
        source="Argoverse 2 (Wilson et al.), CC BY-NC-SA 4.0",
        T_vehicle_lidar=T,
        t_ns=t_ns,
        read=lambda i: _scan(files[i], int(t_ns[i]), T),
        anchor=anchor or NOMINAL,
        deskew="compensated",
        placed=anchor is not None,
        entries=(Entry("sensors/lidar", "sweeps", len(files), "free of motion", "scans"),),
    )
    rows = _columns(folder / POSES, ("timestamp_ns", *QUATERNION, *PLACE))
    p, R = _values(rows, PLACE), R_from_quaternion_xyzw(_values(rows, QUATERNION))
    source, stamps = f"{POSES} of {folder.name}", rows["timestamp_ns"].astype(np.int64)
    kept = np.r_[True, np.diff(stamps) > 0]
    zone, frame, note = _city(folder)
    p = p + frame
    table = PoseTable(source, stamps[kept], p[kept], R[kept], "utm" if zone else "local", notes=note)
    taken = Choices(anchor=anchor, poses_frame=f"utm:{zone}" if zone else "local", poses_of="vehicle",
                    nowhere=bool(choices and choices.nowhere) and anchor is None)  # fmt: skip
    if not zone and anchor is None:
        taken = Choices(poses_frame="local", poses_of="vehicle", nowhere=True)
    return with_table(recording, folder, taken, table)


def _city(folder: Path) -> tuple[int, F64, tuple[str, ...]]:
    """UTM zone (0: not known), what city coordinates lack of UTM's, and notes."""
    for path in files_of(folder / "map", "log_map_archive_*.json"):
        try:
            city = city_of(path.name)
        except NeedsGeoreference:
            continue
        east, north = utm_from_geodetic(np.radians(city.lat_deg), np.radians(city.lon_deg), city.zone)
        return city.zone, np.array([float(east), float(north), 0.0]), ("heights are those of the city's frame: their"
                                                                       " datum is not told",)  # fmt: skip
    return 0, np.zeros(3), (f"no map that names the city ({', '.join(CITIES)}): poses in a local frame",)


def _columns(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    feather = library("pyarrow.feather", EXTRA)
    data = read_feather(path)
    try:
        table = feather.read_table(BytesIO(data))
        table.validate(full=True)  # what a column holds lies within its buffers
        return {name: table[name].to_numpy() for name in names}
    except Exception as error:
        raise ImportDriveError(
            f"{path}: no table with {', '.join(names)}: {' '.join(str(error).split())[:200]}"
        ) from error


def _values(columns: dict[str, NDArray[Any]], names: tuple[str, ...]) -> F64:
    return np.column_stack([columns[name] for name in names]).astype(np.float64)


def _mount(folder: Path) -> F64:
    rows = _columns(folder / MOUNTS, ("sensor_name", *QUATERNION, *PLACE))
    up = np.flatnonzero(rows["sensor_name"] == "up_lidar")
    if len(up) != 1:
        raise ImportDriveError(f"{folder / MOUNTS}: {len(up)} sensors called up_lidar")
    return T_from_R_t(R_from_quaternion_xyzw(_values(rows, QUATERNION)[up[0]]), _values(rows, PLACE)[up[0]])


def _scan(path: Path, t_ns: int, T_vehicle_lidar: F64) -> RawScan:
    """One sweep. Times of points are given, but the points lie where they were at the stamp."""
    rows = _columns(path, ("x", "y", "z", "laser_number"))
    points = transform(T_inverse(T_vehicle_lidar), _values(rows, ("x", "y", "z")))
    ring = rows["laser_number"].astype(np.uint16)
    return RawScan(t_ns, np.ascontiguousarray(points, np.float32), np.zeros(len(points), np.uint32), ring)
