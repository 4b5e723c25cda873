"""Trajectories as text for other programs: TUM and KITTI, which `evo` reads, written whole or not at all.

| format | a line | |
|---|---|---|
| TUM | `t x y z qx qy qz qw` | seconds UTC with nine digits, metres, unit quaternion with qw >= 0 |
| KITTI | `r11 r12 r13 x r21 r22 r23 y r31 r32 r33 z` | upper three rows of the pose; times in a file of their own |
| times | `t` | seconds UTC, one line a pose of the KITTI file |

Metres and rotations have nine digits: a nanometre. Lines that begin with # are comments, in TUM files only.
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import R_from_quaternion_xyzw, T_from_R_t, quaternion_xyzw_from_R
from gnd.schemas.drive import check_rigid
from gnd.schemas.errors import SchemaError, TrajectoryError

_NS: Final = 1_000_000_000
_TIME: Final = re.compile(r"(\d{1,10})(?:\.(\d*))?")
_UNIT_TOLERANCE: Final = 1e-3
_ROTATION_TOLERANCE: Final = 1e-3
"""What other programs write has few digits; rotations are made orthonormal when they are read."""
_MAX_NUMBER: Final = 1e15
_ValueT = TypeVar("_ValueT")


def write_tum(path: Path | str, poses: Trajectory, comment: str = "") -> None:
    """Write poses as TUM; `comment` becomes lines that begin with #. `TrajectoryError` when the file cannot be."""
    write_text(path, tum_text(poses, comment))


def read_tum(path: Path | str) -> Trajectory:
    """The poses of a TUM file.

    Raises:
        TrajectoryError: no such file, a line that is no pose, times that do not increase.
    """
    return _reading(path, lambda text: _tum_poses(_lines(text)))


def write_kitti(path: Path | str, poses: Trajectory) -> None:
    """Write poses as KITTI, without times; `TrajectoryError` when the file cannot be written."""
    write_text(path, kitti_text(poses))


def write_times(path: Path | str, t_ns: I64) -> None:
    """Write the times (N,) int ns UTC that belong to a KITTI file; `TrajectoryError` when the file cannot be."""
    write_text(path, times_text(t_ns))


def read_kitti(path: Path | str, times: Path | str) -> Trajectory:
    """The poses of a KITTI file with its file of times.

    Raises:
        TrajectoryError: no such file, a line that is no pose or no time, another number of times than of poses.
    """
    T = _reading(path, _kitti_poses)
    t_ns = _reading(times, _times)
    if len(T) != len(t_ns):
        raise TrajectoryError(f"{path} has {len(T)} poses, {times} has {len(t_ns)} times")
    with _named(Path(times)):
        return _trajectory(t_ns, T)


def tum_text(poses: Trajectory, comment: str = "") -> str:
    """The content of a TUM file."""
    quaternions = quaternion_xyzw_from_R(poses.T_dst_vehicle[:, :3, :3])
    rows = np.concatenate([poses.T_dst_vehicle[:, :3, 3], quaternions], axis=1)
    head = [f"# {line}" for line in comment.splitlines()]
    return _joined([*head, *(f"{seconds(t)} {_numbers(row)}" for t, row in zip(poses.t_ns, rows, strict=True))])


def kitti_text(poses: Trajectory) -> str:
    """The content of a KITTI file."""
    return _joined(_numbers(T[:3].ravel()) for T in poses.T_dst_vehicle)


def times_text(t_ns: I64) -> str:
    """The content of a file of times."""
    return _joined(seconds(t) for t in t_ns)


def seconds(t_ns: int) -> str:
    """Int ns as seconds with nine digits: no float, so nothing is lost."""
    return f"{int(t_ns) // _NS}.{int(t_ns) % _NS:09d}"


def nanoseconds(text: str) -> int:
    """The int ns of seconds as text; `TrajectoryError` when it is none. An exponent is read as a float is."""
    match = _TIME.fullmatch(text)
    if match is not None:
        return int(match[1]) * _NS + int((match[2] or "")[:9].ljust(9, "0"))
    t_s = _number(text)
    if not 0 <= t_s < 2**33:
        raise TrajectoryError(f"time {text[:40]!r} is not between 0 and {2**33} s")
    return round(t_s * _NS)


def write_text(path: Path | str, text: str) -> None:
    """Write a whole file or nothing of it; `TrajectoryError` when the system refuses."""
    target = Path(path)
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        partial.write_text(text, encoding="utf-8", newline="\n")
        partial.replace(target)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise TrajectoryError(f"{target}: cannot write: {error.strerror or error}") from None


def _numbers(row: F64) -> str:
    return " ".join(f"{value:.9f}" for value in np.round(row, 9) + 0.0)  # + 0.0: no -0.000000000


def _joined(lines: Iterable[str]) -> str:
    return "".join(f"{line}\n" for line in lines)


def _reading(path: Path | str, parse: Callable[[str], _ValueT]) -> _ValueT:
    """What `parse` makes of a file; whatever goes wrong names the file."""
    with _named(Path(path)):
        return parse(Path(path).read_text(encoding="utf-8"))


@contextmanager
def _named(path: Path) -> Iterator[None]:
    try:
        yield
    except TrajectoryError as error:
        raise TrajectoryError(f"{path}: {error}") from error
    except FileNotFoundError:
        raise TrajectoryError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise TrajectoryError(f"{path}: cannot read: {error}") from error


def _lines(text: str) -> Iterator[tuple[int, list[str]]]:
    """Number and words of each line that is neither empty nor a comment."""
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if words and not words[0].startswith("#"):
            yield number, words


def _tum_poses(lines: Iterator[tuple[int, list[str]]]) -> Trajectory:
    t_ns, rows = [], []
    for number, words in lines:
        with _at_line(number):
            rows.append(_row(words, 8, "a time and 7 numbers")[1:])
            t_ns.append(nanoseconds(words[0]))
            _check_unit(rows[-1][3:])
    row = np.array(rows).reshape(-1, 7)
    return _trajectory(np.array(t_ns, np.int64), T_from_R_t(R_from_quaternion_xyzw(row[:, 3:]), row[:, :3]))


def _kitti_poses(text: str) -> F64:
    poses = []
    for number, words in _lines(text):
        with _at_line(number):
            poses.append(_rigid(_row(words, 12, "12 numbers")))
    return np.array(poses).reshape(-1, 4, 4)


def _times(text: str) -> I64:
    t_ns = []
    for number, words in _lines(text):
        with _at_line(number):
            _row(words, 1, "one number")
            t_ns.append(nanoseconds(words[0]))
    return np.array(t_ns, np.int64)


def _trajectory(t_ns: I64, T: F64) -> Trajectory:
    late = np.flatnonzero(np.diff(t_ns) <= 0)
    if len(late):
        raise TrajectoryError(f"pose {late[0] + 2} of {len(t_ns)} is not later than the one before")
    return Trajectory(t_ns, T)


@contextmanager
def _at_line(number: int) -> Iterator[None]:
    try:
        yield
    except SchemaError as error:
        raise TrajectoryError(f"line {number}: {error}") from error


def _row(words: list[str], n: int, expected: str) -> F64:
    if len(words) != n:
        raise TrajectoryError(f"expected {expected}, found {len(words)} words")
    return np.array([_number(word) for word in words])


def _number(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        raise TrajectoryError(f"{word[:40]!r} is no number") from None
    if not abs(value) <= _MAX_NUMBER:  # NaN fails, too
        raise TrajectoryError(f"{word[:40]!r} is not finite, or beyond {_MAX_NUMBER:g}")
    return value


def _check_unit(quaternion: F64) -> None:
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > _UNIT_TOLERANCE:
        raise TrajectoryError(f"quaternion has length {length:.6g}, expected 1 within {_UNIT_TOLERANCE}")


def _rigid(row: F64) -> F64:
    """(4, 4) of the 12 numbers, its rotation made orthonormal."""
    R = row.reshape(3, 4)[:, :3]
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > _ROTATION_TOLERANCE:
        raise TrajectoryError(f"rotation is off by {off:.3g} from orthonormal, {_ROTATION_TOLERANCE} is allowed")
    u, _, vt = np.linalg.svd(R)
    T = T_from_R_t(u @ vt, row.reshape(3, 4)[:, 3])
    check_rigid("pose", T)
    return T
