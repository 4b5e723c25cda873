"""Positions as RTKLIB writes them (`.pos`): latitude, longitude, height, quality and sigmas of each epoch."""

from datetime import datetime
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.localise.track_alignment import FixTable
from studies.frame.errors import RealDataError

I64 = NDArray[np.int64]

GPS_EPOCH: Final = datetime(1980, 1, 6)
WEEK_S: Final = 604_800
FIXED: Final = 1
"""Quality of a position whose ambiguities are integers."""
FLOOR_M: Final = 0.02
"""Least sigma that is believed."""
_FIRST: Final = 2  # column of the latitude


def gps_ns(week: float, second: float) -> int:
    """GPS time as nanoseconds since its epoch."""
    return int(week) * WEEK_S * 1_000_000_000 + round(second * 1e9)


def read_pos(path: Path) -> tuple[FixTable, I64]:
    """Fixes (times are GPS time) and the quality of each.

    Raises:
        RealDataError: the file cannot be read, or holds no such lines.
    """
    try:
        lines = [line.split() for line in path.read_text("ascii").splitlines() if line and not line.startswith("%")]
        t_ns = np.array([_time_ns(*line[:_FIRST]) for line in lines], np.int64)
        rows = np.array([line[_FIRST : _FIRST + 8] for line in lines], np.float64).reshape(-1, 8)
    except (OSError, ValueError, TypeError) as error:
        raise RealDataError(f"{path}: no positions of RTKLIB: {error}") from error
    if not len(rows):
        raise RealDataError(f"{path}: no positions")
    lat, lon, height, quality, _, north, east, up = rows.T
    sigma = np.maximum(np.hypot(north, east) / np.sqrt(2.0), FLOOR_M)
    table = FixTable(t_ns, np.radians(lat), np.radians(lon), height, sigma, np.maximum(up, FLOOR_M))
    return table, quality.astype(np.int64)


def _time_ns(first: str, second: str) -> int:
    """Of week and second, or of a date and a time of the day."""
    if "/" not in first:
        return gps_ns(float(first), float(second))
    clock, _, fraction = second.partition(".")
    since = datetime.strptime(f"{first} {clock}", "%Y/%m/%d %H:%M:%S") - GPS_EPOCH
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + int(fraction.ljust(9, "0"))
