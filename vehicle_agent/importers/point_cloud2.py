"""One ROS 2 message, `sensor_msgs/msg/PointCloud2`, out of CDR (OMG DDSI-RTPS 10.2, plain XCDR1).

The message has not changed since ROS 2 began, so it is read straight from its bytes; a decoder that follows the schema
in the file is the tests' oracle. Numbers are aligned to their size, counted from after the four bytes of encapsulation.
"""

import struct
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.fields import Field, unpack

SCHEMA: Final = "sensor_msgs/msg/PointCloud2"
MAX_FIELDS: Final = 64
_CODES: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField


@dataclass(frozen=True, slots=True, eq=False)
class DecodedCloud:
    """When it was stamped, in which frame, and its points (N,) with their fields."""

    stamp_ns: int
    frame_id: str
    points: NDArray[np.void]


class _Cdr:
    """Reads primitives one after the other."""

    def __init__(self, where: str, data: bytes) -> None:
        if len(data) < 4 or data[0] or data[1] > 1:
            raise ImportDriveError(f"{where}: no plain CDR: it begins with {data[:4]!r}")
        self.where, self.order = where, "<" if data[1] else ">"
        self._body, self._at = memoryview(data)[4:], 0

    def number(self, code: str) -> int:
        size = struct.calcsize(code)
        start = -(-self._at // size) * size
        return int(struct.unpack(self.order + code, self._take(start, size))[0])

    def text(self) -> str:
        return bytes(self.array()).rstrip(b"\0").decode("utf-8", "replace")

    def array(self) -> memoryview:
        """A sequence of bytes, length first."""
        return self._take_next(self.number("I"))

    def _take_next(self, size: int) -> memoryview:
        return self._take(self._at, size)

    def _take(self, start: int, size: int) -> memoryview:
        if start + size > len(self._body):
            raise ImportDriveError(f"{self.where}: cut off: {size} bytes wanted at {start} of {len(self._body)}")
        self._at = start + size
        return self._body[start : self._at]


def head_of(where: str, data: bytes) -> tuple[int, str]:
    """Only the header: time and frame."""
    cdr = _Cdr(where, data)
    return cdr.number("i") * 1_000_000_000 + cdr.number("I"), cdr.text()


def decode_cloud(where: str, data: bytes) -> DecodedCloud:
    """A cloud from the bytes of a message; `where` names it in errors.

    Raises:
        ImportDriveError: cut off, not this message, or fields that cannot be.
    """
    cdr = _Cdr(where, data)
    stamp, frame_id = cdr.number("i") * 1_000_000_000 + cdr.number("I"), cdr.text()
    height, width = cdr.number("I"), cdr.number("I")
    described = [_field(cdr) for _ in range(_few(cdr.number("I"), where))]
    order = ">" if cdr.number("B") else "<"
    fields = [Field(name, offset, order + code, count) for name, offset, code, count in described]
    step, row_step, packed = cdr.number("I"), cdr.number("I"), cdr.array()
    rows = _without_padding(where, packed, height, width * step, row_step)
    return DecodedCloud(stamp, frame_id, unpack(where, fields, step, rows, height * width))


def _few(n: int, where: str) -> int:
    if n > MAX_FIELDS:
        raise ImportDriveError(f"{where}: {n} fields, {MAX_FIELDS} are plenty: is this a PointCloud2?")
    return n


def _field(cdr: _Cdr) -> tuple[str, int, str, int]:
    name, offset, kind, count = cdr.text(), cdr.number("I"), cdr.number("B"), cdr.number("I")
    if kind not in _CODES or count > MAX_FIELDS:
        raise ImportDriveError(f"{cdr.where}: field {name!r} of type {kind} and count {count}")
    return name, offset, _CODES[kind], max(count, 1)


def _without_padding(where: str, data: memoryview, height: int, row: int, row_step: int) -> memoryview:
    """Rows of points one after the other; some drivers align rows."""
    if height <= 1 or row_step == row:
        return data
    if row_step < row or len(data) < height * row_step:
        raise ImportDriveError(
            f"{where}: {len(data)} bytes for {height} rows of {row_step} bytes, {row} of them points"
        )
    return memoryview(np.frombuffer(data, np.uint8, height * row_step).reshape(height, row_step)[:, :row].tobytes())
