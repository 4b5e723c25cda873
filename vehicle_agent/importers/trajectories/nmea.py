"""NMEA 0183: positions of GGA, dates of RMC or ZDA, sigmas of GST; lines whose checksum is wrong are counted."""

from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Final

import numpy as np

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.trajectories.pose_table import PoseTable

UERE_M: Final = {1: 3.0, 2: 1.0, 3: 1.0, 4: 0.02, 5: 0.4, 6: 10.0}
"""Standard deviation of a range by GGA's quality (single, differential, PPS, RTK fixed, RTK float, dead reckoning),
times HDOP: what receivers of cars reach, where they do not tell (GST)."""

_Row = tuple[int, float, float, float, float, str]
"""Time, latitude, longitude, height, sigma by quality, the clock as text: GST names it."""


def is_nmea(line: str) -> bool:
    """Whether a line is a sentence."""
    return len(line) > 7 and line[0] == "$" and line[6] == "," and line[1:6].isalnum()


def table_of_nmea(path: Path, text: str) -> PoseTable:
    """Positions with the date of the last RMC or ZDA before them.

    Raises:
        ImportDriveError: no position with a date.
    """
    reader = _Reader()
    for line in text.splitlines():
        reader.take(line.strip())
    if len(reader.rows) < 2:
        raise ImportDriveError(
            f"{path}: {len(reader.rows)} dated positions in it ({reader.undated} without a date: RMC or ZDA gives it,"
            f" {reader.no_fix} without a fix, {reader.damaged} damaged lines)"
        )
    left_out = (
        (reader.damaged, "damaged lines"),
        (reader.undated, "positions without a date"),
        (reader.no_fix, "no fix"),
    )
    notes = tuple(f"{path.name}: {n} {what}: left out" for n, what in left_out if n)
    return _table(path, reader.rows, reader.sigma_m, notes)


class _Reader:
    """What the sentences so far said."""

    def __init__(self) -> None:
        self.rows: list[_Row] = []
        self.sigma_m: dict[str, float] = {}
        self.damaged = self.undated = self.no_fix = 0
        self._day: datetime | None = None

    def take(self, line: str) -> None:
        """One line."""
        sentence, _, checksum = line.partition("*")
        if not is_nmea(line):
            return
        if checksum and _checksum(sentence) != checksum[:2].upper():
            self.damaged += 1
            return
        words = sentence[1:].split(",")
        take = {"RMC": self._rmc, "ZDA": self._zda, "GST": self._gst, "GGA": self._gga}.get(words[0][2:])
        try:
            if take is not None:
                take(words)
        except (ValueError, IndexError):
            self.damaged += 1

    def _rmc(self, words: list[str]) -> None:
        if words[9]:
            self._day = datetime.strptime(words[9], "%d%m%y").replace(tzinfo=UTC)

    def _zda(self, words: list[str]) -> None:
        if words[4]:
            self._day = datetime(int(words[4]), int(words[3]), int(words[2]), tzinfo=UTC)

    def _gst(self, words: list[str]) -> None:
        if words[6] and words[7]:
            self.sigma_m[words[1]] = float(np.hypot(float(words[6]), float(words[7])) / np.sqrt(2.0))

    def _gga(self, words: list[str]) -> None:
        if words[6] in ("", "0"):
            self.no_fix += 1
        elif self._day is None:
            self.undated += 1
        else:
            self.rows.append((_ns(self._day, words[1]), *_place(words), _sigma_m(words), words[1]))


def _table(path: Path, rows: list[_Row], sigma: dict[str, float], notes: tuple[str, ...]) -> PoseTable:
    t_ns = np.array([row[0] for row in rows], np.int64)
    day = 86_400 * 1_000_000_000
    t_ns += day * np.cumsum(np.diff(t_ns, prepend=t_ns[:1]) < -day // 2)  # midnight before the next RMC
    p = np.array([row[1:4] for row in rows])
    sigmas = np.array([sigma.get(row[5], row[4]) for row in rows])
    keep = np.r_[True, np.diff(t_ns) > 0]
    return PoseTable(f"NMEA {path}", t_ns[keep], p[keep], None, "geodetic", sigma_m=sigmas[keep], notes=notes)


def _checksum(sentence: str) -> str:
    return f"{reduce(xor, sentence[1:].encode('latin-1', 'replace'), 0):02X}"


def _ns(day: datetime, clock: str) -> int:
    whole, _, fraction = clock.partition(".")
    moment = day + timedelta(hours=int(whole[:2]), minutes=int(whole[2:4]), seconds=int(whole[4:6]))
    return int(moment.timestamp()) * 1_000_000_000 + int((fraction + "000000000")[:9])


def _place(words: list[str]) -> tuple[float, float, float]:
    """Latitude, longitude, height above the ellipsoid: above the geoid plus the geoid's own."""
    lat = int(words[2][:2]) + float(words[2][2:]) / 60.0
    lon = int(words[4][:3]) + float(words[4][3:]) / 60.0
    height = float(words[9]) + float(words[11] or 0.0)
    return np.radians(-lat if words[3] == "S" else lat), np.radians(-lon if words[5] == "W" else lon), height


def _sigma_m(words: list[str]) -> float:
    return UERE_M.get(int(words[6]), 3.0) * float(words[8] or 1.0)
