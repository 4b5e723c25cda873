"""Packed points with named fields, as PointCloud2 and Foxglove clouds carry them, into scans.

Drivers agree on x, y, z and on little else: the time of a point is called, counted and measured in many ways.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.cleaning import RawScan

RING_FIELDS: Final = ("ring", "channel", "line", "laser_id")
TIME_FIELDS: Final = ("t_offset", "t", "time", "timestamp", "time_stamp", "offset_time", "timeOffset")
LONGEST_SWEEP_NS: Final = 1_000_000_000
"""Times that span more are something else (a counter, a stamp of another clock): the points count as simultaneous."""
MAX_POINT_BYTES: Final = 4096


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


def scan_of_fields(points: NDArray[np.void], t_ns: int) -> RawScan:
    """A scan of packed points (N,), times after the earliest of its points, ring where the cloud tells."""
    names = points.dtype.names or ()
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float32)
    time = next((name for name in TIME_FIELDS if name in names), None)
    ring = next((name for name in RING_FIELDS if name in names), None)
    offset = np.zeros(len(points), np.uint32) if time is None else offsets_ns(points[time])
    rings = None if ring is None or points[ring].ndim > 1 else _rings(points[ring])
    return RawScan(t_ns, np.ascontiguousarray(xyz), offset, rings)


def offsets_ns(values: NDArray[np.generic]) -> NDArray[np.uint32]:
    """(N,) times after the earliest in ns: integers count nanoseconds, floats seconds; zeros where they make no sense.

    Drivers stamp a cloud at its start or at its end and count from there; only differences within the cloud are used.
    """
    zeros = np.zeros(len(values), np.uint32)
    if values.ndim != 1 or not len(values) or not np.isfinite(values.astype(np.float64)).all():
        return zeros
    after = values - values.min()
    ns = np.round(after.astype(np.float64) * (1e9 if values.dtype.kind == "f" else 1.0))
    return ns.astype(np.uint32) if ns.max() <= LONGEST_SWEEP_NS else zeros


def _rings(values: NDArray[np.generic]) -> NDArray[np.uint16]:
    return np.asarray(np.clip(np.nan_to_num(values.astype(np.float64)), 0, 65_535).astype(np.uint16))
