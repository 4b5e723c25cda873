"""Tables with a header: CSV, exports of an INS (Applanix, NovAtel, OxTS, Septentrio), RTKLIB's .pos.

Columns are known by their names, whatever their order; units stand in the names (`_deg`, `(rad)`, `[m]`) or follow from
the values. A heading or azimuth counts clockwise from north with roll and pitch of forward-right-down axes, a yaw
counter-clockwise from east with those of forward-left-up axes; where the vehicle moves, the way it goes decides.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import R_from_quaternion_xyzw, exp_so3
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.trajectories.clocks import ns_of_date, ns_of_gps, ns_of_number
from gnd.vehicle_agent.importers.trajectories.guesses import coordinates_of, forward
from gnd.vehicle_agent.importers.trajectories.pose_table import Coordinates, PoseTable

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

NAMES: Final[Mapping[str, tuple[str, ...]]] = {
    "t": ("t", "time", "timestamp", "stamp", "unixtime", "utc", "utctime", "datetime", "gpst", "sec", "secs", "seconds",
          "isotime", "gpstime", "timens", "timestampns"),
    "week": ("gpsweek", "week", "weekno"),
    "tow": ("gpstow", "tow", "weekseconds", "gpsseconds", "secondsofweek", "sow", "gpssow"),
    "lat": ("lat", "latitude"),
    "lon": ("lon", "lng", "long", "longitude"),
    "h": ("alt", "altitude", "height", "h", "ellipsoidheight", "ellipsoidalheight", "hell", "elevation", "ele", "hae",
          "altitudehae"),
    "x": ("x", "px", "posx", "positionx", "tx", "easting", "east", "e", "utmx", "utme", "localx", "posepositionx"),
    "y": ("y", "py", "posy", "positiony", "ty", "northing", "north", "n", "utmy", "utmn", "localy", "posepositiony"),
    "z": ("z", "pz", "posz", "positionz", "tz", "up", "u", "localz", "posepositionz"),
    "ex": ("ecefx", "xecef"), "ey": ("ecefy", "yecef"), "ez": ("ecefz", "zecef"),
    "qx": ("qx", "quatx", "orientationx", "rotationx", "poseorientationx"),
    "qy": ("qy", "quaty", "orientationy", "rotationy", "poseorientationy"),
    "qz": ("qz", "quatz", "orientationz", "rotationz", "poseorientationz"),
    "qw": ("qw", "quatw", "orientationw", "rotationw", "poseorientationw"),
    "roll": ("roll",), "pitch": ("pitch",), "yaw": ("yaw",),
    "heading": ("heading", "azimuth", "hdg", "trueheading"),
    "sn": ("sdn", "sdnorth", "stdnorth", "northstd", "sigman", "latitudestd", "latstd"),
    "se": ("sde", "sdeast", "stdeast", "eaststd", "sigmae", "longitudestd", "lonstd"),
}  # fmt: skip
_LONGEST_NAME: Final = 80
_UNIT: Final = re.compile(r"[(\[]\s*([^)\]]*)\s*[)\]]|[_ ](deg|rad|m|s|ns|us|ms|sec)$", re.IGNORECASE)
_HEADING_OFF_RAD: Final = np.radians(30.0)


@dataclass(frozen=True, slots=True)
class _Table:
    """Words of a file by what their columns are, and the unit that stands in the column's name."""

    path: Path
    words: dict[str, list[str]]
    units: dict[str, str]
    gps_time: bool

    def numbers(self, key: str) -> F64:
        try:
            return np.array(self.words[key], np.float64)
        except ValueError as error:
            raise ImportDriveError(f"{self.path}: column {key}: {error}") from None


def columns_of(names: Sequence[str]) -> dict[str, tuple[int, str]]:
    """Which of the columns is what, and the unit in its name (lower case; empty where there is none)."""
    found: dict[str, tuple[int, str]] = {}
    for k, name in enumerate(names):
        if len(name) > _LONGEST_NAME:  # prose: searching it for a unit takes the square of its length
            continue
        unit = _UNIT.search(name.strip())
        plain = re.sub(r"[^a-z]", "", (name[: unit.start()] if unit else name).lower())
        for key, known in NAMES.items():
            if plain in known and key not in found:
                found[key] = k, ((unit[1] or unit[2]) if unit else "").lower().strip()
    return found


def is_header(names: Sequence[str]) -> bool:
    """Whether these words name the columns of a table of positions."""
    found = columns_of(names)
    return {"lat", "lon"} <= found.keys() or {"x", "y"} <= found.keys() or {"ex", "ey"} <= found.keys()


def table_of_columns(
    path: Path, names: Sequence[str], rows: Sequence[Sequence[str]], *, gps: bool = False
) -> PoseTable:
    """Poses or positions of a table with a header.

    Args:
        path: for messages.
        names: of the columns.
        rows: words of each line.
        gps: dates and times are GPS time, not UTC.

    Raises:
        ImportDriveError: rows of another length, words that are no numbers, no times, no positions.
    """
    found = columns_of(names)
    odd = next((k for k, row in enumerate(rows) if len(row) != len(names)), None)
    if odd is not None:
        raise ImportDriveError(f"{path}: row {odd + 1} has {len(rows[odd])} columns, the header {len(names)}")
    table = _Table(
        path,
        {key: [row[k].strip() for row in rows] for key, (k, _) in found.items()},
        {key: unit for key, (_, unit) in found.items()},
        gps or "gpst" in re.sub(r"[^a-z ]", "", " ".join(names).lower()).split(),
    )
    t_ns = _times(table)
    p, coordinates = _positions(table)
    R, notes = _rotations(table, p, coordinates)
    sigma = (
        np.sqrt(0.5 * (table.numbers("sn") ** 2 + table.numbers("se") ** 2)) if {"sn", "se"} <= found.keys() else None
    )
    return PoseTable(f"table {path}", t_ns, p, R, coordinates, sigma_m=sigma, notes=notes)


def _times(table: _Table) -> I64:
    words = table.words
    if {"week", "tow"} <= words.keys():
        weeks = table.numbers("week").astype(int).tolist()
        return np.array([ns_of_gps(w, s) for w, s in zip(weeks, words["tow"], strict=True)], np.int64)
    if "t" not in words:
        missing = "seconds of the GPS week without its number" if "tow" in words else "no column of times"
        raise ImportDriveError(f"{table.path}: {missing} (t, time, timestamp; GPS week and seconds)")
    if any(sign in words["t"][0][1:] for sign in ":-/T"):
        return np.array([ns_of_date(word, gps=table.gps_time) for word in words["t"]], np.int64)
    per = {"ns": 9, "us": 6, "ms": 3}.get(table.units["t"], 0)
    if per:
        return np.array([round(float(word) * 10 ** (9 - per)) if "." in word else int(word) * 10 ** (9 - per)
                         for word in words["t"]], np.int64)  # fmt: skip
    return np.array([ns_of_number(word) for word in words["t"]], np.int64)


def _positions(table: _Table) -> tuple[F64, Coordinates]:
    found = table.words.keys()
    if {"lat", "lon"} <= found:
        if "h" not in found:
            raise ImportDriveError(f"{table.path}: latitude and longitude without a height above the ellipsoid")
        angles = [table.numbers(key) if table.units[key] == "rad" else np.radians(table.numbers(key))
                  for key in ("lat", "lon")]  # fmt: skip
        return np.column_stack([*angles, table.numbers("h")]), "geodetic"
    if {"ex", "ey", "ez"} <= found:
        return np.column_stack([table.numbers(key) for key in ("ex", "ey", "ez")]), "ecef"
    up = "z" if "z" in found else "h"
    if not {"x", "y", up} <= found:
        raise ImportDriveError(
            f"{table.path}: no columns x, y, z or latitude, longitude, height among its {len(found)}"
        )
    p = np.column_stack([table.numbers(key) for key in ("x", "y", up)])
    return p, coordinates_of(p)


def _rotations(table: _Table, p: F64, coordinates: Coordinates) -> tuple[F64 | None, tuple[str, ...]]:
    found = table.words.keys()
    if {"qx", "qy", "qz", "qw"} <= found:
        q = np.column_stack([table.numbers(key) for key in ("qx", "qy", "qz", "qw")])
        if not (np.abs(np.linalg.norm(q, axis=1) - 1.0) < 1e-2).all():
            raise ImportDriveError(f"{table.path}: quaternions that are not of length 1")
        return R_from_quaternion_xyzw(q), ()
    turn = "heading" if "heading" in found else "yaw"
    if not {"roll", "pitch", turn} <= found:
        return None, (f"{table.path}: no roll, pitch and heading or quaternion: positions only",)
    if coordinates == "ecef":
        raise ImportDriveError(f"{table.path}: ECEF positions with angles; give latitude, longitude and height instead")
    angles = [_angle(table, key) for key in ("roll", "pitch", turn)]
    ways = {"heading": R_of_heading(*angles), "yaw": R_of_yaw(*angles)}
    level = _level_positions(p, coordinates)
    went = {name: forward(level, R) for name, R in ways.items()}
    fits = {name: bool(np.hypot(*way[1:]) < np.tan(_HEADING_OFF_RAD) * way[0]) for name, way in went.items()}
    other = "yaw" if turn == "heading" else "heading"
    if not fits[turn] and fits[other]:
        how = {"heading": "clockwise from north", "yaw": "counter-clockwise from east"}[other]
        return ways[other], (f"{table.path}: by the way it goes, column {turn} counts {how}: taken so",)
    if not fits[turn] and np.abs(went[turn]).max() > 0.5:
        x, y, z = went[turn]
        note = f"warning: {table.path}: the body mostly moves along ({x:.2f}, {y:.2f}, {z:.2f}) of its own axes, not x"
        return ways[turn], (note,)
    return ways[turn], ()


def _angle(table: _Table, key: str) -> F64:
    """In radians; degrees unless the name or all of roll, pitch and heading say otherwise."""
    unit, values = table.units[key], table.numbers(key)
    if unit.startswith(("rad", "deg")):
        return values if unit.startswith("rad") else np.radians(values)
    largest = max(float(np.abs(table.numbers(one)).max()) for one in ("roll", "pitch", "yaw", "heading")
                  if one in table.words)  # fmt: skip
    return values if largest <= 2.0 * np.pi else np.radians(values)


def _level_positions(p: F64, coordinates: Coordinates) -> F64:
    """Positions in metres, axes east, north, up (or the local frame's)."""
    if coordinates != "geodetic":
        return p
    return LocalFrame(*p[0].tolist()).enu_from_geodetic(p[:, 0], p[:, 1], p[:, 2])


def R_of_heading(roll: F64, pitch: F64, heading: F64) -> F64:
    """(N, 3, 3) R_enu_body (forward, left, up) of angles in north-east-down with a body of forward, right, down."""
    swap, turn = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.diag([1.0, -1.0, -1.0])
    return np.asarray(swap @ R_of_yaw(roll, pitch, heading) @ turn)


def R_of_yaw(roll: F64, pitch: F64, yaw: F64) -> F64:
    """(N, 3, 3) R_z(yaw) R_y(pitch) R_x(roll)."""
    zero = np.zeros_like(yaw)
    about = [(zero, zero, yaw), (zero, pitch, zero), (roll, zero, zero)]
    z, y, x = (exp_so3(np.column_stack(one)) for one in about)
    return np.asarray(z @ y @ x)
