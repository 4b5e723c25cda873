"""Folders of LAS or LAZ files, a sweep each, in the axes of the sensor.

`gps_time` is a point's time: seconds since 1970 where it is that large, adjusted GPS time (less 1e9 s, as the file's
header says) or seconds of the GPS week otherwise; of the last only differences are used. Files in the coordinates of a
map (UTM, a projection) are pieces of a map, no sweeps, and are refused with what to do.
"""

from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.cleaning import MAX_RANGE_M, RawScan
from gnd.vehicle_agent.importers.fields import LONGEST_SWEEP_NS
from gnd.vehicle_agent.importers.files import check_folder, files_below
from gnd.vehicle_agent.importers.las_header import check_las
from gnd.vehicle_agent.importers.optional import library
from gnd.vehicle_agent.importers.pcd import PERIOD_NS, START_NS, scan_number
from gnd.vehicle_agent.importers.recording import NOMINAL, Entry, Recording, RecordingAnchor
from gnd.vehicle_agent.importers.stamps import stamps_of_names
from gnd.vehicle_agent.importers.trajectories.clocks import GPS_EPOCH_S, leap_seconds

EXTRA: Final = "import"
ENDINGS: Final = (".las", ".laz")
SECOND_NS: Final = 1_000_000_000
UNIX_S: Final = 1.2e9
"""Times from here on count from 1970 (2008); adjusted GPS times reach it in 2049."""
ADJUSTED_S: Final = 1_000_000_000


def open_las(folder: Path, anchor: RecordingAnchor | None, choices: Choices | None = None) -> Recording:
    """A folder of sweeps; `anchor` says where on the Earth the first pose lies.

    Raises:
        ImportDriveError: no files, damaged files, points in the coordinates of a map.
        MissingExtra: laspy (or lazrs, for LAZ) is not installed.
    """
    check_folder(folder)
    files = sorted(files_below(folder, *ENDINGS), key=scan_number)
    if not files:
        raise ImportDriveError(f"{folder}: no .las or .laz files there or in the folders below it")
    begins, bad = dict[Path, int | None](), list[str]()
    for path in files:
        try:
            begins[path] = _begin_ns(_read(path))
        except ImportDriveError as error:
            if choices is not None and choices.strict:
                raise
            bad.append(f"passed over: {error}")
    if len(begins) < 2:
        raise ImportDriveError(f"{folder}: {len(begins)} of {len(files)} files can be read: {'; '.join(bad[:3])}")
    files = list(begins)
    t_ns, how = _times(files, list(begins.values()))
    return Recording(
        name=folder.name,
        sensor_model="unknown",
        source=f"LAS files of {folder.name}",
        T_vehicle_lidar=np.eye(4),
        t_ns=t_ns,
        read=lambda i: _scan(files[i], int(t_ns[i])),
        anchor=anchor or NOMINAL,
        mount="assumed",
        placed=anchor is not None,
        timed=how != "none",
        notes=tuple(bad),
        entries=(Entry(files[0].parent.name, "LAS sweeps", len(files), f"times: {how}", "scans"),),
    )


def _read(path: Path) -> Any:
    laspy = library("laspy", EXTRA)
    check_las(path)
    try:
        return laspy.read(path)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # a panic of lazrs is no Exception
        raise ImportDriveError(f"{path}: no readable LAS: {' '.join(str(error).split())[:200]}") from error


def _begin_ns(las: Any) -> int | None:
    """When the first point was measured, UTC; None where the file does not tell the day."""
    if "gps_time" not in las.point_format.dimension_names or not len(las.points):
        return None
    first = float(np.min(las.gps_time))
    if first > UNIX_S:
        return round(first * SECOND_NS)
    if las.header.global_encoding.gps_time_type.value == 1:  # adjusted standard GPS time
        gps_ns = round(first * SECOND_NS) + (ADJUSTED_S + GPS_EPOCH_S) * SECOND_NS
        return gps_ns - leap_seconds(gps_ns // SECOND_NS) * SECOND_NS
    return None


def _times(files: list[Path], begins: list[int | None]) -> tuple[NDArray[np.int64], str]:
    known = [begin for begin in begins if begin is not None]
    if len(known) == len(files) and all(a < b for a, b in pairwise(known)):
        return np.array(known, np.int64), "gps_time"
    named = stamps_of_names(files)
    if named is not None:
        return named, "file names"
    return START_NS + PERIOD_NS * np.arange(len(files), dtype=np.int64), "none"


def _scan(path: Path, t_ns: int) -> RawScan:
    las = _read(path)
    points = np.column_stack([las.x, las.y, las.z]).astype(np.float64)
    if len(points) and np.abs(np.median(points, axis=0)).max() > MAX_RANGE_M:
        middle = ", ".join(f"{value:.0f}" for value in np.median(points, axis=0))
        raise ImportDriveError(
            f"{path}: points around {middle}: a piece of a map, no sweep of a sensor; export sweeps in the sensor's"
            " axes (one file each, with gps_time)"
        )
    offset = np.zeros(len(points), np.uint32)
    if "gps_time" in las.point_format.dimension_names and len(points):
        after = (np.asarray(las.gps_time, np.float64) - float(np.min(las.gps_time))) * SECOND_NS
        if after.max() <= LONGEST_SWEEP_NS:
            offset = np.round(after).astype(np.uint32)
    return RawScan(t_ns, np.ascontiguousarray(points, np.float32), offset)
