"""Apollo: a folder of PCD files with `poses.txt` in UTM, beside a map whose folders tell the zone.

`pcds/poses.txt` has a line a scan, `number t x y z qx qy qz qw`: GPS seconds, easting, northing, ellipsoidal height,
and the LiDAR's attitude (x forward) against the grid's east and north. The grid's north is not true north, so attitudes
are turned by the convergence. The scans carry times of points, but are freed of motion distortion already: they lie
better on Apollo's own map as they are than deskewed.
"""

import re
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import R_from_quaternion_xyzw, T_from_R_t, exp_so3
from gnd.gnd_map.utm import convergence_rad, geodetic_from_utm
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.damage import number_table
from gnd.vehicle_agent.importers.files import check_folder, files_of
from gnd.vehicle_agent.importers.pcd import read_scan, scan_number
from gnd.vehicle_agent.importers.recording import Recording, RecordingAnchor

F64 = NDArray[np.float64]

GPS_EPOCH_S: Final = 315_964_800
LEAP_SECONDS: Final = 18
"""GPS time less UTC since 2017."""
COLUMNS: Final = 9


def is_apollo(folder: Path) -> bool:
    """Whether a folder holds scans with poses and a map that tells the UTM zone."""
    return bool(files_of(folder / "pcds", "poses.txt")) and bool(zone_folders(folder))


def zone_folders(folder: Path) -> list[Path]:
    """The folders MAP/map/RESOLUTION/north|south/ZONE below a recording."""
    return sorted(path for path in folder.glob("*/map/*/*/*") if re.fullmatch(r"\d{1,2}", path.name) and path.is_dir())


def open_apollo(folder: Path, anchor: RecordingAnchor | None) -> Recording:
    """An Apollo folder. Its poses give its place; `anchor` only moves the origin of the map frame.

    Raises:
        ImportDriveError: no scans, no poses, no zone, or poses that do not fit the scans.
    """
    check_folder(folder)
    files = sorted(files_of(folder / "pcds", "*.pcd", "*.pcd.xz"), key=scan_number)
    zone, southern = utm_zone(folder)
    t_ns, T_utm = _poses(folder / "pcds" / "poses.txt", len(files))
    place = anchor or anchor_of(T_utm[0, :3, 3], zone, southern)
    return Recording(
        name=folder.name,
        sensor_model="HDL-64E",
        source=f"Apollo, scans of {folder.name}; poses of the recording",
        T_vehicle_lidar=np.eye(4),
        t_ns=t_ns,
        read=lambda i: read_scan(files[i], int(t_ns[i])),
        anchor=place,
        deskew="compensated",
        mount="assumed",
        track=Trajectory(t_ns, poses_from_utm(T_utm, zone, southern, place.frame)),
    )


def utm_zone(folder: Path) -> tuple[int, bool]:
    """Zone, and whether it is one of the southern half, of the map beside the scans.

    Raises:
        ImportDriveError: no map, or maps of several zones.
    """
    found = {(int(path.name), path.parent.name == "south") for path in zone_folders(folder)}
    if len(found) != 1:
        raise ImportDriveError(f"{folder}: maps of {len(found)} UTM zones (*/map/*/north/ZONE); exactly 1 is needed")
    return found.pop()


def anchor_of(p_utm_m: F64, zone: int, southern: bool) -> RecordingAnchor:
    """The place of a position (easting, northing, height)."""
    lat, lon = geodetic_from_utm(p_utm_m[0], p_utm_m[1], zone, southern=southern)
    return RecordingAnchor(float(np.degrees(lat)), float(np.degrees(lon)), float(p_utm_m[2]))


def poses_from_utm(T_utm: F64, zone: int, southern: bool, frame: LocalFrame) -> F64:
    """(N, 4, 4) poses in an ENU frame of poses (N, 4, 4) against the grid of a zone."""
    lat, lon = geodetic_from_utm(T_utm[:, 0, 3], T_utm[:, 1, 3], zone, southern=southern)
    turn = -convergence_rad(lat, lon, zone)  # anticlockwise from east, an azimuth is clockwise from north
    R = exp_so3(np.column_stack([np.zeros((len(turn), 2)), turn])) @ T_utm[:, :3, :3]
    here = T_from_R_t(R, np.zeros((len(R), 3)))
    upright = [
        frame.T_self_other(LocalFrame(*place)) for place in zip(lat.tolist(), lon.tolist(), T_utm[:, 2, 3], strict=True)
    ]
    return np.asarray(np.stack(upright) @ here)


def _poses(path: Path, n: int) -> tuple[NDArray[np.int64], F64]:
    rows = number_table(path)
    if rows.shape != (n, COLUMNS):
        raise ImportDriveError(f"{path}: table of shape {rows.shape} for {n} scans; a line a scan of 9 is needed")
    whole = np.floor(rows[:, 1])
    utc_s = whole.astype(np.int64) + GPS_EPOCH_S - LEAP_SECONDS
    t_ns = utc_s * 1_000_000_000 + np.round((rows[:, 1] - whole) * 1e9).astype(np.int64)
    return t_ns, T_from_R_t(R_from_quaternion_xyzw(rows[:, 5:9]), rows[:, 2:5])
