"""A map that was drawn in the frame of a local track onto the Earth, with that track, by GNSS.

The track is georeferenced as a drive is (`georeference_untimed`); every point of the map moves as the poses
around it do (`Placement`). Heights stay the track's own: fixes without heights give none.
"""

from pathlib import Path
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import MotionError, ShapeError
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.tile_store.feature_io.placement import Placement
from gnd.vehicle_agent.errors import ImportDriveError, LocaliseError
from gnd.vehicle_agent.importers.damage import number_table
from gnd.vehicle_agent.localise.path_association import Untimed, georeference_untimed

SIGMA_M: Final = 0.5
"""Of an axis of a fix, whose recording does not state it."""
STEP_NS: Final = 1_000_000_000
"""Between two poses of a track without times."""


def placement_by_track(poses: Path, fixes: Path, sigma_m: float = SIGMA_M) -> Placement:
    """Where the local coordinates of a map lie that was drawn over a track.

    Args:
        poses: T_local_vehicle, a row-major 3 x 4 matrix a line (KITTI's format).
        fixes: latitude and longitude in degrees a line, in the order of driving, without times.
        sigma_m: of an axis of a fix.

    Raises:
        LocaliseError: a file that is no such table, or fixes and track that do not fit.
    """
    track, found_fixes = read_track(poses), read_fixes(fixes, sigma_m)
    found, _ = georeference_untimed(track, found_fixes)
    moved = found.track.T_dst_vehicle @ T_inverse(track.T_dst_vehicle)
    return Placement(found.frame, np.ascontiguousarray(track.T_dst_vehicle[:, :3, 3]), moved, height_known=False)


def read_track(path: Path) -> Trajectory:
    """The poses of a file in KITTI's format, one a second."""
    rows = _table(path, 12)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = rows.reshape(-1, 3, 4)
    try:
        return Trajectory(STEP_NS * np.arange(len(T), dtype=np.int64), T)
    except (MotionError, ShapeError) as error:
        raise LocaliseError(f"{path}: no track of poses: {error}") from None


def read_fixes(path: Path, sigma_m: float = SIGMA_M) -> Untimed:
    """The fixes of a file of latitudes and longitudes, heights unknown."""
    degrees = _table(path, 2)
    if not (np.abs(degrees) <= (90.0, 180.0)).all():
        row = int(np.argmin((np.abs(degrees) <= (90.0, 180.0)).all(axis=1)))
        raise LocaliseError(f"{path}: line {row + 1}: {degrees[row].tolist()} is no latitude and longitude in degrees")
    lat, lon = np.radians(degrees).T
    return Untimed(lat, lon, np.full(len(lat), np.nan), sigma_m)


def _table(path: Path, columns: int) -> F64:
    try:
        rows = number_table(path)
    except ImportDriveError as error:
        raise LocaliseError(str(error)) from None
    if len(rows) < 2 or rows.shape[1] != columns:
        raise LocaliseError(f"{path}: {len(rows)} lines of {rows.shape[1]} columns; at least 2 of {columns} are needed")
    return rows
