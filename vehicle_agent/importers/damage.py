"""Whatever a reader of somebody else's files meets in them becomes one error that names the file."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from gnd.vehicle_agent.errors import ImportDriveError

DAMAGE: Final = (
    ValueError, TypeError, KeyError, IndexError, AttributeError, ArithmeticError, RecursionError, MemoryError, OSError,
    struct.error, DecodeError,
)  # fmt: skip
"""What readers and their libraries raise when a file is not what its name says."""
MAX_NUMBER: Final = 1e15
"""No time in seconds, coordinate or matrix of a recording holds a larger one; squares of it are finite."""


@contextmanager
def named_damage(place: Path) -> Iterator[None]:
    """Errors of the project pass; what damaged files lead to otherwise becomes an `ImportDriveError`.

    Numbers that overflow on the way do not warn: what comes out is checked to be finite.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except DAMAGE as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise ImportDriveError(f"{place}: damaged, or not what its name says: {reason}") from error


def number_table(path: Path) -> NDArray[np.float64]:
    """(N, M) numbers of a text file, N >= 1; lines that begin with # are comments.

    Raises:
        ImportDriveError: it cannot be read, is empty, holds anything else, or numbers beyond 10^15.
    """
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.split("#")[0].strip()]
        if not lines:
            raise ImportDriveError(f"{path}: no numbers in it")
        table = np.loadtxt(lines, ndmin=2)
    except (OSError, ValueError) as error:
        raise ImportDriveError(f"{path}: no table of numbers: {error}") from error
    if not (np.abs(table) <= MAX_NUMBER).all():  # NaN fails, too
        row = int(np.argmin((np.abs(table) <= MAX_NUMBER).all(axis=1)))
        raise ImportDriveError(f"{path}: row {row + 1} holds a number that is not finite or beyond {MAX_NUMBER:g}")
    return table
