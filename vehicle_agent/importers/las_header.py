"""The sizes that a LAS or LAZ file declares, checked before its libraries make room for them.

Layout: LAS 1.4 R15, table 3 (public header block); LAZ: the eight bytes before the points say where the table of chunks
lies, which begins with a version and its number of chunks (laszip specification).
"""

import struct
from pathlib import Path
from typing import Final

from gnd.vehicle_agent.errors import ImportDriveError

MAX_POINTS: Final = 4_000_000
MAX_BYTES: Final = 128 << 20
"""Of all points of a sweep, unpacked."""
_SHORTEST: Final = 227
_WITH_LONG_COUNT: Final = 375
_VLR_BYTES: Final = 54
_COMPRESSED: Final = 0x80
_FIELDS: Final = struct.Struct("<HIIBHI")  # from byte 94: header size, first point, records, format, length, points


def check_las(path: Path) -> None:
    """`ImportDriveError` unless the file can hold what its header declares, and that is no more than a sweep has."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImportDriveError(f"{path}: cannot be read: {error.strerror or error}") from error
    if data[:4] != b"LASF" or len(data) < _SHORTEST:
        raise ImportDriveError(f"{path}: no readable LAS: {len(data)} bytes")
    header, first, records, form, length, points = _FIELDS.unpack_from(data, 94)
    if data[25] >= 4 and len(data) >= _WITH_LONG_COUNT:
        points = max(points, struct.unpack_from("<Q", data, 247)[0])
        _check_extended(path, data)
    if not header <= first <= len(data) or records * _VLR_BYTES > first:
        raise ImportDriveError(f"{path}: no readable LAS: {records} records, points from byte {first} of {len(data)}")
    if points > MAX_POINTS or points * length > MAX_BYTES:
        raise ImportDriveError(
            f"{path}: {points} points of {length} bytes; a sweep has at most {MAX_POINTS} and {MAX_BYTES} bytes"
        )
    if form & _COMPRESSED:
        _check_chunks(path, data, first, points)
    elif first + points * length > len(data):
        raise ImportDriveError(
            f"{path}: no readable LAS: {len(data)} bytes, {points} points of {length} bytes announced"
        )


def _check_extended(path: Path, data: bytes) -> None:
    start, records = struct.unpack_from("<QI", data, 235)
    if records and not 0 < start <= len(data) - 60 * min(records, len(data)):
        raise ImportDriveError(f"{path}: no readable LAS: {records} extended records from byte {start} of {len(data)}")


def _check_chunks(path: Path, data: bytes, first: int, points: int) -> None:
    if first + 8 > len(data):
        raise ImportDriveError(f"{path}: no readable LAS: cut off before its points")
    at = struct.unpack_from("<q", data, first)[0]
    if at == -1:  # written without going back: the last eight bytes say it
        at = struct.unpack_from("<q", data, len(data) - 8)[0]
    if not first + 8 <= at <= len(data) - 8:
        raise ImportDriveError(f"{path}: no readable LAS: table of chunks at byte {at} of {len(data)}")
    chunks = struct.unpack_from("<I", data, at + 4)[0]
    if chunks > points:
        raise ImportDriveError(f"{path}: no readable LAS: {chunks} chunks of {points} points")
