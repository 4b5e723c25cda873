"""The sizes that a Feather file declares, checked before pyarrow makes room for them: it believes what each packed
buffer says that it unpacks to.

Layout: Apache Arrow columnar format 1.5, "IPC file format", with File.fbs and Message.fbs: a footer that names the
batches, a head a batch that names its buffers; a packed buffer begins with its unpacked length, or -1 where it is not
packed. Heads are tables of FlatBuffers.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.files import read_file

MAX_BYTES: Final = 128 << 20
"""Of all columns of a table, unpacked; a sweep of Argoverse 2 has 3 MB."""
_MAGIC: Final = b"ARROW1"
_DICTIONARIES, _BATCHES = 2, 3  # fields of the footer
_HEADER_TYPE, _HEADER = 1, 2  # of a message
_DICTIONARY_TYPE, _DICTIONARY_DATA = 2, 1
_BUFFERS, _COMPRESSION = 2, 3  # of a batch
_BLOCK: Final = struct.Struct("<qi4xq")  # where the head of a batch begins, its length, that of the body behind it
_BUFFER: Final = struct.Struct("<qq")  # from where in the body, how long
_CONTINUES: Final = 0xFFFFFFFF


def read_feather(path: Path) -> bytes:
    """The bytes of a file whose columns unpack to no more than `MAX_BYTES`.

    Raises:
        ImportDriveError: it cannot be read, is no Feather of version 2, is damaged, or declares more.
    """
    data = read_file(path)
    if not data.startswith(_MAGIC) or not data.endswith(_MAGIC):
        raise ImportDriveError(f"{path}: {len(data)} bytes that are no Feather of version 2")
    try:
        size = sum(_unpacked_bytes(data))
    except (struct.error, IndexError, ValueError) as error:
        raise ImportDriveError(f"{path}: no readable Feather: {error}") from error
    if size > MAX_BYTES:
        raise ImportDriveError(f"{path}: columns that unpack to {size} bytes; a table has at most {MAX_BYTES}")
    return data


def _unpacked_bytes(data: bytes) -> Iterator[int]:
    """The bytes that each buffer of each batch takes in memory."""
    end = len(data) - len(_MAGIC) - 4
    footer = data[end - _number("<i", data, end) : end]
    root = _number("<I", footer, 0)
    for kind in (_DICTIONARIES, _BATCHES):
        for block in _vector(footer, root, kind, _BLOCK):
            yield from _of_batch(data, *block)


def _of_batch(data: bytes, start: int, head_bytes: int, body_bytes: int) -> Iterator[int]:
    if start < 0 or head_bytes < 8 or body_bytes < 0 or start + head_bytes + body_bytes > len(data):
        raise ValueError(f"a batch of {head_bytes} and {body_bytes} bytes from byte {start} of {len(data)}")
    head, body = data[start : start + head_bytes], data[start + head_bytes : start + head_bytes + body_bytes]
    head = head[8 if _number("<I", head, 0) == _CONTINUES else 4 :]
    message = _number("<I", head, 0)
    kind, at = _field(head, message, _HEADER_TYPE), _field(head, message, _HEADER)
    batch = _follow(head, at)
    if kind and head[kind] == _DICTIONARY_TYPE:
        batch = _follow(head, _field(head, batch, _DICTIONARY_DATA))
    packed = _field(head, batch, _COMPRESSION) != 0
    for begin, length in _vector(head, batch, _BUFFERS, _BUFFER):
        if begin < 0 or length < 0 or begin + length > len(body):
            raise ValueError(f"a buffer of {length} bytes from byte {begin} of {len(body)}")
        size = _number("<q", body, begin) if packed and length else -1
        if size < -1:
            raise ValueError(f"a buffer that unpacks to {size} bytes")
        yield length if size == -1 else size


def _number(form: str, data: bytes, at: int) -> int:
    if at < 0:
        raise ValueError(f"a place before the first byte: {at}")
    return int(struct.unpack_from(form, data, at)[0])


def _follow(data: bytes, at: int) -> int:
    """Where the table lies to which the field at `at` points."""
    if not at:
        raise ValueError("a table is missing")
    return at + _number("<I", data, at)


def _field(data: bytes, table: int, number: int) -> int:
    """Where a field of a table lies; 0: the table does not have it."""
    layout = table - _number("<i", data, table)
    slot = 4 + 2 * number
    offset = _number("<H", data, layout + slot) if slot + 2 <= _number("<H", data, layout) else 0
    return table + offset if offset else 0


def _vector(data: bytes, table: int, number: int, form: struct.Struct) -> Iterator[tuple[int, ...]]:
    """The entries of a field that is a vector of structures."""
    if not (at := _field(data, table, number)):
        return
    start = _follow(data, at)
    n = _number("<I", data, start)
    if start + 4 + n * form.size > len(data):
        raise ValueError(f"{n} entries of {form.size} bytes from byte {start} of {len(data)}")
    yield from form.iter_unpack(data[start + 4 : start + 4 + n * form.size])
