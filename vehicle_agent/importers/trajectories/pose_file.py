"""A file of poses or positions of any kind, recognised by what is in it."""

from pathlib import Path
from typing import Final

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.damage import named_damage
from gnd.vehicle_agent.importers.files import read_file
from gnd.vehicle_agent.importers.trajectories.columns import is_header, table_of_columns
from gnd.vehicle_agent.importers.trajectories.geojson import table_of_geojson
from gnd.vehicle_agent.importers.trajectories.matrices import table_of_words
from gnd.vehicle_agent.importers.trajectories.nmea import is_nmea, table_of_nmea
from gnd.vehicle_agent.importers.trajectories.pose_table import PoseTable

KNOWN: Final = "TUM, KITTI (3x4 matrices), CSV or INS export with a header, RTKLIB .pos, GeoJSON, NMEA"
COMMENTS: Final = ("#", "%", "//")
HEADER_LINES: Final = 60
"""Lines of prose before the columns are named, at most."""


def read_poses(path: Path) -> PoseTable:
    """The poses or positions of a file.

    Raises:
        ImportDriveError: no such file, none of the known kinds, or damaged; with the line.
    """
    with named_damage(path):
        return _read(path)


def _read(path: Path) -> PoseTable:
    if not path.is_file():
        raise ImportDriveError(f"{path}: no such file of poses")
    data = read_file(path)
    if b"\0" in data[:4096]:
        raise ImportDriveError(f"{path}: binary, no trajectory as text; known are {KNOWN}")
    text = data.decode("utf-8-sig", "replace")
    stripped = text.lstrip()
    if not stripped:
        raise ImportDriveError(f"{path}: empty")
    if stripped.startswith("{"):
        return table_of_geojson(path, text)
    lines = stripped.splitlines()
    if any(is_nmea(line) for line in lines[:HEADER_LINES]):
        return table_of_nmea(path, text)
    return _table(path, lines)


def _table(path: Path, lines: list[str]) -> PoseTable:
    """A table: with a header if one of the first lines names its columns, else numbers alone."""
    for k, line in enumerate(lines[:HEADER_LINES]):
        bare = line.strip().lstrip("#%/ ").strip()
        names = _words(bare)
        if is_header(names):
            rows = [row for row in (_words(one) for one in lines[k + 1 :] if not _comment(one)) if row]
            return _with_dates(path, names, rows)
    rows = [row for row in (_words(one) for one in lines if not _comment(one)) if row]
    if not rows or not all(_number(word) for word in rows[0]):
        raise ImportDriveError(f"{path}: line 1 is {lines[0][:60]!r}: no trajectory of a known kind ({KNOWN})")
    return table_of_words(path, rows)


def _with_dates(path: Path, names: list[str], rows: list[list[str]]) -> PoseTable:
    """Tables of words between blanks have a date and a time (or GPS week and seconds) where the header has one name;
    some have a line of units.
    """
    gps = names[0].upper() == "GPST"
    if rows and gps and len(rows[0]) == len(names) + 1 and rows[0][0].isdigit():
        return table_of_columns(path, ["GPS week", "GPS TOW", *names[1:]], rows, gps=gps)
    if rows and len(rows[0]) == len(names) + 1:
        rows = [[f"{row[0]} {row[1]}", *row[2:]] for row in rows]
    if rows and not any(_number(word) for word in rows[0]):
        rows = rows[1:]  # a line of units
    return table_of_columns(path, names, rows, gps=gps)


def _words(line: str) -> list[str]:
    for separator in (",", ";", "\t"):
        if separator in line:
            return [word.strip() for word in line.split(separator)]
    return line.split()


def _comment(line: str) -> bool:
    return line.strip().startswith(COMMENTS)


def _number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
