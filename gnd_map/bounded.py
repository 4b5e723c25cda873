"""JSON, TOML, arrays and packed bytes of others, read within bounds: whatever is wrong with them is a ValueError.

The libraries alone do not do that: texts that nest deeply give a RecursionError, and a few packed bytes unpack to
gigabytes before anybody has looked at them.
"""

import json
import tomllib
import zipfile
import zlib
from typing import IO, Any, Final

import numpy as np
import zstandard
from numpy.typing import NDArray

MAX_WINDOW_BYTES: Final = 1 << 27
"""What Zstandard uses up to level 19; a frame may ask for more than a machine has."""


def json_value(text: str | bytes) -> Any:
    """The value of a JSON text; ValueError: it is none, or nests too deeply."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError(f"JSON of {len(text)} characters nests too deeply") from None


def toml_table(text: str) -> dict[str, Any]:
    """The table of a TOML text; ValueError: it is none, or nests too deeply."""
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"TOML of {len(text)} characters nests too deeply") from None


def inflated(packed: bytes, most_bytes: int) -> bytes:
    """The bytes of a zlib stream; ValueError: it is damaged, cut off or followed by more, or unpacks to more."""
    unpacker = zlib.decompressobj()
    try:
        plain = unpacker.decompress(packed, most_bytes + 1)
    except zlib.error as error:
        raise ValueError(f"{len(packed)} bytes are no zlib stream: {error}") from None
    if len(plain) > most_bytes:
        raise ValueError(f"{len(packed)} bytes unpack to more than {most_bytes}")
    if not unpacker.eof or unpacker.unused_data:
        raise ValueError(f"a zlib stream of {len(packed)} bytes is cut off, or has bytes behind its end")
    return plain


def zstd_unpacked(packed: bytes, most_bytes: int) -> bytes:
    """The bytes of one Zstandard frame; ValueError: it is damaged, cut off or followed by more, or unpacks to more."""
    try:
        said = zstandard.get_frame_parameters(packed)
        known = said.content_size not in (zstandard.CONTENTSIZE_UNKNOWN, zstandard.CONTENTSIZE_ERROR)
        if known and said.content_size > most_bytes:  # the library would make room for all of it
            raise ValueError(f"a Zstandard frame of {said.content_size} bytes, at most {most_bytes} are read")
        unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
        return unpacker.decompress(packed, max_output_size=most_bytes, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise ValueError(f"{len(packed)} bytes are no Zstandard frame of at most {most_bytes}: {error}") from None


def npz_arrays(stream: IO[bytes], most_bytes: int) -> dict[str, NDArray[Any]]:
    """The arrays of a file of `np.savez` by name, none of objects.

    Raises:
        ValueError: they unpack to more than `most_bytes`.
        What else numpy, zipfile and zlib raise: it is damaged.
    """
    with zipfile.ZipFile(stream) as archive:  # reads no more of a member than it says here
        size = sum(member.file_size for member in archive.infolist())
    if size > most_bytes:
        raise ValueError(f"arrays that unpack to {size} bytes, at most {most_bytes} are read")
    stream.seek(0)
    with np.load(stream, allow_pickle=False) as file:
        return dict(file)
