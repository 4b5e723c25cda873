"""Folders of `.bin` sweeps of any sensor: rows of little-endian float32, x, y, z, intensity, with or without a ring.

Nothing in such a file says what wrote it, so how many values a row has is found from the values: of KITTI and RELLIS
four, of nuScenes five, the last a whole number (the ring). Sensor, mount, times and place are not known; `times.txt`
beside them gives times, file names that are stamps do as well.
"""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.cleaning import MAX_RANGE_M, RawScan
from gnd.vehicle_agent.importers.files import check_folder, files_below, files_of, read_file
from gnd.vehicle_agent.importers.pcd import PERIOD_NS, START_NS, scan_number
from gnd.vehicle_agent.importers.recording import NOMINAL, Entry, Recording, RecordingAnchor
from gnd.vehicle_agent.importers.stamps import stamps_of_names
from gnd.vehicle_agent.importers.trajectories.clocks import ns_of_number

F32 = NDArray[np.float32]

WIDTHS: Final = (4, 5)
MOST_RINGS: Final = 128
GOOD: Final = 0.99
LOOKED_AT: Final = 5
KITTI_NAMES: Final = ("KITTI", "kitti")


def looks_like_kitti(folder: Path) -> bool:
    """Whether what lies in or beside a folder says that KITTI's car took the scans, and not only `.bin` in a name."""
    for place in (folder, folder.parent):
        calibration = place / "calib.txt"
        if calibration.is_file() and any(key in calibration.read_text(errors="replace") for key in ("Tr:", "P0:")):
            return True
        if files_of(place, "calib_velo_to_cam.txt"):
            return True
    if (folder / "velodyne_points").is_dir() or files_of(folder, "KITTI*_gt.txt"):
        return True
    source = folder / "SOURCE.txt"
    return source.is_file() and any(name in source.read_text(errors="replace") for name in KITTI_NAMES)


def width_of(path: Path, data: bytes) -> int:
    """How many values a row of a file has.

    Raises:
        ImportDriveError: bytes that are rows of neither width.
    """
    fits = [width for width in WIDTHS if len(data) % (4 * width) == 0 and _plausible(data, width)]
    if fits:
        return fits[-1]
    raise ImportDriveError(
        f"{path}: {len(data)} bytes that are rows of neither 4 (x y z intensity) nor 5 (x y z intensity ring) float32"
    )


def has_rings(path: Path) -> bool:
    """Whether a file holds rows of five values, as nuScenes's do; False for what cannot be read."""
    try:
        return width_of(path, read_file(path)) == WIDTHS[1]
    except ImportDriveError:
        return False


def _plausible(data: bytes, width: int) -> bool:
    values = np.frombuffer(data, "<f4").reshape(-1, width)[:20_000]
    if not len(values):
        return width == WIDTHS[0]
    with np.errstate(invalid="ignore", over="ignore"):
        near = (np.abs(values[:, :3]) < MAX_RANGE_M).all(axis=1) | ~np.isfinite(values[:, :3]).all(axis=1)
        tiny = (values[:, :3] != 0.0) & (np.abs(values[:, :3]) < 1e-12)  # counts or bytes read as floats
        strength = (values[:, 3] >= 0.0) & (values[:, 3] <= 65_535.0)
    if near.mean() < GOOD or tiny.any(axis=1).mean() > 1.0 - GOOD or strength.mean() < GOOD:
        return False
    rings = values[:, -1]
    return width == WIDTHS[0] or bool(((rings == np.round(rings)) & (rings >= 0) & (rings < MOST_RINGS)).all())


def open_bins(folder: Path, anchor: RecordingAnchor | None) -> Recording:
    """A folder of sweeps; `anchor` says where on the Earth the first pose lies.

    Raises:
        ImportDriveError: no files, or files that are no such rows.
    """
    check_folder(folder)
    files = sorted(files_below(folder, ".bin", ".bin.xz"), key=scan_number)
    if not files:
        raise ImportDriveError(f"{folder}: no .bin or .bin.xz scans there or in the folders below it")
    width = _width_of_files(files)
    t_ns, how = _times(folder, files)
    fields = "x y z intensity ring" if width == 5 else "x y z intensity"
    return Recording(
        name=folder.name,
        sensor_model="unknown",
        source=f".bin files of {folder.name}",
        T_vehicle_lidar=np.eye(4),
        t_ns=t_ns,
        read=lambda i: read_bin(files[i], int(t_ns[i]), width),
        anchor=anchor or NOMINAL,
        mount="assumed",
        placed=anchor is not None,
        timed=how != "none",
        entries=(
            Entry(files[0].parent.name, ".bin scans", len(files), f"float32 {fields}; times: {how}", "scans"),
            *(
                Entry(path.name, "poses?", 1, "", "", f"--poses {path} takes them")
                for path in files_of(folder, "poses.txt")
            ),
        ),
    )


def _width_of_files(files: list[Path]) -> int:
    """Of the first file that holds points and is not damaged; the damaged ones are named when they are read."""
    first: ImportDriveError | None = None
    for path in files[:LOOKED_AT]:
        try:
            if data := read_file(path):
                return width_of(path, data)
        except ImportDriveError as error:
            first = first or error
    if first is not None:
        raise first
    return WIDTHS[0]


def read_bin(path: Path, t_ns: int, width: int) -> RawScan:
    """The points of one file, all at the time of the sweep."""
    data = read_file(path)
    if len(data) % (4 * width):
        raise ImportDriveError(f"{path}: {len(data)} bytes, which is no multiple of {4 * width}")
    rows = np.frombuffer(data, "<f4").reshape(-1, width)
    rings = None if width == WIDTHS[0] else np.clip(np.nan_to_num(rows[:, 4]), 0, 65_535).astype(np.uint16)
    return RawScan(t_ns, np.ascontiguousarray(rows[:, :3], np.float32), np.zeros(len(rows), np.uint32), rings)


def _times(folder: Path, files: list[Path]) -> tuple[NDArray[np.int64], str]:
    n = len(files)
    for path in (*files_of(folder, "times.txt"), *files_of(files[0].parent.parent, "times.txt")):
        words = path.read_text(errors="replace").split()
        if len(words) >= n:
            return START_NS + np.array([ns_of_number(word) for word in words[:n]], np.int64), path.name
    named = stamps_of_names(files)
    if named is not None:
        return named, "file names"
    return START_NS + PERIOD_NS * np.arange(n, dtype=np.int64), "none"
