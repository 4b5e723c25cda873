"""TUM and KITTI: a pose a line, in numbers alone."""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.se3 import R_from_quaternion_xyzw
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.rigid import orthonormal
from gnd.vehicle_agent.importers.trajectories.clocks import ns_of_number
from gnd.vehicle_agent.importers.trajectories.guesses import coordinates_of, looks_like_camera
from gnd.vehicle_agent.importers.trajectories.pose_table import PoseTable

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

COLUMNS: Final = (8, 9, 12, 13, 16, 17)
"""TUM; with a number first; 3x4 matrix; with number or time first; 4x4 matrix; with number or time first."""
UNIT: Final = 1e-2


def table_of_words(path: Path, lines: list[list[str]]) -> PoseTable:
    """Poses of lines of numbers.

    Raises:
        ImportDriveError: another count of numbers, quaternions or matrices that are none, times that do not increase.
    """
    n = len(lines[0]) if lines else 0
    odd = next((k for k, words in enumerate(lines) if len(words) != n), None)
    if odd is not None or n not in COLUMNS:
        where = f"line {(odd or 0) + 1} has {len(lines[odd or 0]) if lines else 0} numbers"
        raise ImportDriveError(
            f"{path}: {where}; TUM has 8 (t x y z qx qy qz qw), KITTI 12 (3x4 matrix), or 9, 13 with a number first"
        )
    try:
        rows = np.array(lines, np.float64)
    except ValueError as error:
        raise ImportDriveError(f"{path}: {error}") from None
    return _quaternions(path, lines, rows) if n in (8, 9) else _matrices(path, lines, rows)


def _quaternions(path: Path, lines: list[list[str]], rows: F64) -> PoseTable:
    length = np.linalg.norm(rows[:, -4:], axis=1)
    if (np.abs(length - 1.0) > UNIT).any():
        bad = int(np.argmax(np.abs(length - 1.0) > UNIT))
        raise ImportDriveError(
            f"{path}: quaternion of pose {bad + 1} has length {length[bad]:.4g}, 1 within {UNIT} is needed (order:"
            " qx qy qz qw)"
        )
    t_ns = np.array([ns_of_number(words[-8]) for words in lines], np.int64)
    p, R = rows[:, -7:-4], R_from_quaternion_xyzw(rows[:, -4:])
    return PoseTable(f"TUM {path}", t_ns, p, R, coordinates_of(p), camera=looks_like_camera(p, R))


def _matrices(path: Path, lines: list[list[str]], rows: F64) -> PoseTable:
    first = rows.shape[1] % 4
    T, off = orthonormal(rows[:, first : first + 12].reshape(-1, 3, 4), str(path))
    p, R = np.ascontiguousarray(T[:, :3, 3]), np.ascontiguousarray(T[:, :3, :3])
    notes = (f"{path}: rotations off by up to {off:.1e} from orthonormal: made so",) if off > 1e-9 else ()
    times = _times_beside(path, len(rows))
    if first and _is_time(rows[:, 0]):
        times = np.array([ns_of_number(words[0]) for words in lines], np.int64)
    camera = looks_like_camera(p, R)
    return PoseTable(f"KITTI {path}", times, p, R, coordinates_of(p), camera=camera, notes=notes)


def _is_time(column: F64) -> bool:
    return not np.array_equal(column, np.round(column)) or bool((column > 1e8).all())


def _times_beside(path: Path, n: int) -> I64 | None:
    """Times of `times.txt` or NAME_times.txt, where there is one with as many lines."""
    for name in (f"{path.stem}_times.txt", "times.txt"):
        beside = path.with_name(name)
        if beside.is_file():
            words = beside.read_text(errors="replace").split()
            if len(words) == n:
                return np.array([ns_of_number(word) for word in words], np.int64)
    return None
