"""Whose an upload is, seen on its first fields without parsing it: to serve vehicles in turn before anything is spent.

What it says is checked later (`upload_head`); a message that is no upload is nobody's.
"""

from typing import Final

MAX_FIELDS: Final = 24
"""So many fields are looked at: the names come first in each form."""
_VEHICLE_OF: Final = {11: 2, 13: 2, 15: 5}  # packed, features, survey: where they hold their vehicle
_GAUSSIANS: Final = 12
_VEHICLE: Final = 3
_LONGEST_NAME: Final = 128
_FIXED: Final = {1: 8, 5: 4}


def peek_upload(data: bytes) -> tuple[str, bytes]:
    """The vehicle ("" where it is not told) and the report id as short forms carry it (b"" in a whole report)."""
    for number, start, end in _fields(data, 0, len(data)):
        if number == _VEHICLE:
            return _text(data[start:end]), b""
        if number in _VEHICLE_OF:
            inner = {field: data[a:b] for field, a, b in _fields(data, start, end) if b - a <= _LONGEST_NAME}
            return _text(inner.get(_VEHICLE_OF[number], b"")), inner.get(1, b"")
        if number == _GAUSSIANS:
            return "", next((data[a:b] for field, a, b in _fields(data, start, end) if field == 1), b"")[:_LONGEST_NAME]
    return "", b""


def _text(data: bytes) -> str:
    return data[:_LONGEST_NAME].decode(errors="replace")


def _fields(data: bytes, at: int, end: int) -> list[tuple[int, int, int]]:
    """(number, start, end) of the first fields that have a length; what cannot be read ends the list."""
    found: list[tuple[int, int, int]] = []
    for _ in range(MAX_FIELDS):
        tag, at = _varint(data, at, end)
        kind = tag & 7
        if not 0 <= at < end:
            break
        if kind == 0:
            _, at = _varint(data, at, end)
        elif kind in _FIXED:
            at += _FIXED[kind]
        elif kind == 2:
            size, start = _varint(data, at, end)
            at = start + size if start >= 0 else -1
            if 0 <= at <= end:
                found.append((tag >> 3, start, at))
        else:
            at = -1
        if at < 0:
            break
    return found


def _varint(data: bytes, at: int, end: int) -> tuple[int, int]:
    """The number at a place, and the place behind it; -1 where there is none of at most five bytes."""
    value = 0
    for shift in range(0, 35, 7):
        if at >= end:
            return 0, -1
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    return 0, -1
