"""Packed points with named fields, as PointCloud2 and Foxglove clouds carry them, into scans.

Drivers agree on x, y, z and on little else: the time of a point is called, counted and measured in many ways.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, F64
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.cleaning import RawScan

RING_FIELDS: Final = ("ring", "channel", "line", "laser_id", "laser_number")
TIME_FIELDS: Final = (
    "t_offset", "t", "time", "timestamp", "time_stamp", "timeStamp", "offset_time", "timeOffset", "offset_ns",
    "gps_time",
)  # fmt: skip
UNITS_NS: Final = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
ABSOLUTE_FROM: Final = {"ns": 1e17, "us": 1e14, "ms": 1e11, "s": 1e8}
"""Times from these on count from 1970; in seconds that is from 1973."""
SWEEP_S: Final = (0.01, 1.0)
"""A sweep lasts so long: of the units only one lies within, as they are a thousand apart."""
LONGEST_SWEEP_NS: Final = 1_000_000_000
"""Times that span more are something else (a counter, a stamp of another clock): the points count as simultaneous."""
MAX_POINT_BYTES: Final = 4096


@dataclass(frozen=True, slots=True)
class FieldChoice:
    """Which field is the time of a point, "none" for no field, and its unit; None: found out."""

    time: str | None = None
    unit: str | None = None


ANY_FIELD: Final = FieldChoice()


@dataclass(frozen=True, slots=True)
class TimeRule:
    """How the times of points are read: their field (None: there is none), ns a count, whether from 1970 on."""

    field: str | None
    ns: float = 1.0
    absolute: bool = False

    @property
    def said(self) -> str:
        """In words."""
        if self.field is None:
            return "no times of points"
        unit = next((unit for unit, ns in UNITS_NS.items() if ns == self.ns), "?")
        return f"times of points: {self.field}, {'since 1970' if self.absolute else 'against the stamp'}, in {unit}"


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a packed point: its name, byte offset, numpy type code with byte order, and how many of it."""

    name: str
    offset: int
    code: str
    count: int = 1


def unpack(where: str, fields: Sequence[Field], step: int, data: bytes | memoryview, n: int) -> NDArray[np.void]:
    """(N,) structured array over packed points of `step` bytes.

    Raises:
        ImportDriveError: fields that do not fit into a point, no x, y, z, or fewer bytes than points.
    """
    ends = [field.offset + field.count * np.dtype(field.code).itemsize for field in fields]
    if not 0 < step <= MAX_POINT_BYTES or max(ends, default=0) > step:
        raise ImportDriveError(f"{where}: fields end at byte {max(ends, default=0)} of points of {step} bytes")
    missing = {"x", "y", "z"} - {field.name for field in fields}
    if missing:
        raise ImportDriveError(f"{where}: no field {', '.join(sorted(missing))}")
    several = [field.name for field in fields if field.name in ("x", "y", "z") and field.count != 1]
    if several:
        raise ImportDriveError(f"{where}: several numbers for {', '.join(several)} of a point")
    if len(data) < n * step:
        raise ImportDriveError(f"{where}: {len(data)} bytes of points, {n * step} announced")
    return np.frombuffer(data, _dtype(where, fields, step), n)


def _dtype(where: str, fields: Sequence[Field], step: int) -> np.dtype[np.void]:
    described: dict[str, list[Any]] = {
        "names": [field.name for field in fields],
        "formats": [field.code if field.count == 1 else (field.code, (field.count,)) for field in fields],
        "offsets": [field.offset for field in fields],
    }
    try:
        return np.dtype({**described, "itemsize": step})  # type: ignore[call-overload, no-any-return]
    except (TypeError, ValueError) as error:
        raise ImportDriveError(f"{where}: impossible fields: {error}") from error


def time_rule(points: NDArray[np.void], choice: FieldChoice = ANY_FIELD) -> TimeRule:
    """How the times of points (N,) of a sweep are read; from its own values, where the choice leaves it open.

    Drivers count seconds, milliseconds, microseconds or nanoseconds, since 1970 or against the stamp (Velodyne: `time`
    in s; Ouster: `t` in ns; Hesai and RoboSense: `timestamp` in s since 1970; Livox: `timestamp` in ns since 1970).

    Raises:
        ImportDriveError: the field that was chosen is not there.
    """
    names = points.dtype.names or ()
    if choice.time == "none":
        return TimeRule(None)
    if choice.time is not None and choice.time not in names:
        raise ImportDriveError(f"--time-field {choice.time}: no such field; fields are {', '.join(names)}")
    field = choice.time or next((name for name in TIME_FIELDS if name in names), None)
    if field is None or points[field].ndim > 1:
        return TimeRule(None)
    values = _floats(points[field])
    values = values[np.isfinite(values)]
    if not len(values):
        return TimeRule(field, UNITS_NS[choice.unit or "s"])
    largest, span = float(np.abs(values).max()), float(values.max() - values.min())
    since_1970 = next((unit for unit, least in ABSOLUTE_FROM.items() if largest >= least), None)
    if since_1970 is not None and span < 0.5 * largest:
        unit = choice.unit or since_1970
        return TimeRule(field, UNITS_NS[unit], absolute=largest >= ABSOLUTE_FROM[unit])
    fits = [unit for unit, ns in UNITS_NS.items() if SWEEP_S[0] <= span * ns * 1e-9 <= SWEEP_S[1]]
    usual = "s" if points[field].dtype.kind == "f" else "ns"
    return TimeRule(field, UNITS_NS[choice.unit or (fits[0] if fits else usual)])


def scan_of_fields(points: NDArray[np.void], t_ns: int, rule: TimeRule | None = None) -> RawScan:
    """A scan of packed points (N,) stamped t_ns: times after the earliest of its points, ring where the cloud tells.

    The sweep begins with its earliest point: before the stamp where the driver stamps the end and counts backwards.
    """
    names = points.dtype.names or ()
    xyz = xyz_of(points)
    rule = time_rule(points) if rule is None else rule
    ring = next((name for name in RING_FIELDS if name in names), None)
    begin_ns, offset = t_ns, np.zeros(len(points), np.uint32)
    if rule.field is not None and rule.field in names:
        begin_ns, offset = times_of(points[rule.field], t_ns, rule)
    rings = None if ring is None or points[ring].ndim > 1 else _rings(points[ring])
    return RawScan(begin_ns, xyz, offset, rings)


def xyz_of(points: NDArray[np.void]) -> F32:
    """(N, 3) float32 of packed points (N,) with x, y, z; what float32 cannot hold is infinite."""
    # without a warning, which a NaN that signals gives as well
    with np.errstate(invalid="ignore", over="ignore"):
        return np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float32)


def _floats(values: NDArray[np.generic]) -> F64:
    with np.errstate(invalid="ignore", over="ignore"):
        return values.astype(np.float64)


def times_of(values: NDArray[np.generic], t_ns: int, rule: TimeRule) -> tuple[int, NDArray[np.uint32]]:
    """When the earliest point was measured, and (N,) times after it in ns.

    The stamp where the points count by another clock; zeros where the times make no sense: a sweep of more than
    `LONGEST_SWEEP_NS`, or values that are no numbers.
    """
    zeros = np.zeros(len(values), np.uint32)
    if values.ndim != 1 or not len(values) or not np.isfinite(_floats(values)).all():
        return t_ns, zeros
    first = values.min()
    if (float(values.max()) - float(first)) * rule.ns > 2.0 * LONGEST_SWEEP_NS:  # may not fit into their own type
        return t_ns, zeros
    after = np.round((values - first).astype(np.float64) * rule.ns)
    if after.max() > LONGEST_SWEEP_NS:
        return t_ns, zeros
    if rule.absolute:  # as integers: a double holds times since 1970 to 0.2 us, nanoseconds as float not at all
        begin_ns = int(first) * int(rule.ns) + round((float(first) - int(first)) * rule.ns)
        return (begin_ns if abs(begin_ns - t_ns) <= LONGEST_SWEEP_NS else t_ns), after.astype(np.uint32)
    begin_ns = round(float(first) * rule.ns)
    return t_ns + (begin_ns if abs(begin_ns) <= LONGEST_SWEEP_NS else 0), after.astype(np.uint32)


def _rings(values: NDArray[np.generic]) -> NDArray[np.uint16]:
    return np.asarray(np.clip(np.nan_to_num(_floats(values)), 0, 65_535).astype(np.uint16))
