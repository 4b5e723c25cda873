"""Counts the fields of an encoded message without parsing it.

Protobuf makes an object of a hundred bytes and more of every two bytes of empty submessages: 8 MiB of them take 600 MB.
So the messages that hold many submessages are counted before they are parsed.
"""

from collections.abc import Iterator
from typing import Final

from gnd.schemas.errors import Malformed, TooLarge

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_FIXED_BYTES: Final = {_FIXED64: 8, _FIXED32: 4}
_MAX_VARINT_BYTES: Final = 10


def check_field_count(name: str, data: bytes, limit: int) -> None:
    """Refuse a message with more than `limit` fields on its top level.

    Raises:
        TooLarge: more fields.
        Malformed: the bytes are not fields.
    """
    for _ in _fields(name, data, limit):
        pass


def submessages(name: str, data: bytes, number: int, limit: int) -> Iterator[bytes]:
    """The bytes of each submessage `number` on the top level, where there are at most `limit` fields.

    Raises:
        TooLarge: more fields, of any number.
        Malformed: the bytes are not fields.
    """
    for tag, start, end in _fields(name, data, limit):
        if tag == number << 3 | _BYTES:
            yield data[start:end]


def _fields(name: str, data: bytes, limit: int) -> Iterator[tuple[int, int, int]]:
    """Tag of each field, where its content begins and ends; `TooLarge` before the one that is too many is read."""
    at = count = 0
    while at < len(data):
        count += 1
        if count > limit:
            raise TooLarge(f"{name} of {len(data)} bytes has more than {limit} fields")
        tag, at = _varint(name, data, at)
        start, at = _skip_field(name, data, at, tag & 7)
        yield tag, start, at
    if at > len(data):
        raise Malformed(f"{name} of {len(data)} bytes is truncated: its last field ends at byte {at}")


def _skip_field(name: str, data: bytes, at: int, kind: int) -> tuple[int, int]:
    """Where the content at byte `at` of a field begins and ends; may lie behind the end of the data."""
    if kind in _FIXED_BYTES:
        return at, at + _FIXED_BYTES[kind]
    if kind not in (_VARINT, _BYTES):
        raise Malformed(f"{name} has a field of wire type {kind} at byte {at}")
    value, after = _varint(name, data, at)
    return (after, after + value) if kind == _BYTES else (at, after)


def _varint(name: str, data: bytes, at: int) -> tuple[int, int]:
    """Little-endian base 128 number at byte `at`, and where it ends."""
    value = 0
    for shift, byte in enumerate(data[at : at + _MAX_VARINT_BYTES]):
        value |= (byte & 0x7F) << (7 * shift)
        if byte < 0x80:
            return value, at + shift + 1
    raise Malformed(f"{name} of {len(data)} bytes is truncated: no number at byte {at}")
