"""Opening an MCAP file so that damage is noticed: what is read is what was written, or a `DriveError` of one line."""

import io
import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final

import zstandard
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from gnd.gnd_map.errors import GndError
from gnd.schemas import limits
from gnd.schemas.errors import DriveError

# Magic, then the footer record: opcode, length, summary start, summary offset start, summary CRC.
_TAIL: Final = struct.Struct("<BQQQI8s")
_CRC_AND_MAGIC_BYTES: Final = 12

# What the mcap library lets through from damaged bytes, beside its own errors.
_DAMAGE: Final = (
    McapError,
    GndError,
    DecodeError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    EOFError,
    OverflowError,
    MemoryError,
    OSError,
)


@contextmanager
def drive_errors(path: Path) -> Iterator[None]:
    """Everything that goes wrong inside becomes a `DriveError` of one line that names the file."""
    try:
        yield
    except DriveError as error:
        raise DriveError(f"{path}: {error}") from error
    except FileNotFoundError as error:
        raise DriveError(f"{path}: no such drive") from error
    except _DAMAGE as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise DriveError(f"{path}: not a readable drive: {reason}") from error


@contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """What the operating system refuses becomes a `DriveError` of one line."""
    try:
        yield
    except OSError as error:
        raise DriveError(f"{path}: cannot write drive: {error.strerror or error}") from error


@contextmanager
def open_mcap(path: Path) -> Iterator[tuple[SeekingReader, Summary]]:
    """A reader that checks the CRC of every chunk, and the file's summary, which is checked here.

    Raises:
        DriveError: no such file, not MCAP, cut off, damaged.
    """
    with drive_errors(path), _Within(path.open("rb", buffering=0)) as stream:
        _check_summary(stream)
        stream.seek(0)
        reader = SeekingReader(stream, validate_crcs=True, record_size_limit=limits.MAX_CHUNK_BYTES)
        summary = reader.get_summary()
        if summary is None:
            raise DriveError("recording has no summary; restore it with `mcap recover`")
        for chunk in summary.chunk_indexes:
            if max(chunk.uncompressed_size, chunk.compressed_size) > limits.MAX_CHUNK_BYTES:
                raise DriveError(
                    f"chunk at byte {chunk.chunk_start_offset} unpacks to {chunk.uncompressed_size} bytes, "
                    f"the limit is {limits.MAX_CHUNK_BYTES}"
                )
        yield reader, summary


class _Within(io.BufferedReader):
    """A file of which no more is asked for than there is: the library reads names as long as the file says, and Python
    makes room for what is asked for.
    """

    def __init__(self, raw: io.FileIO) -> None:
        super().__init__(raw)
        self._size = os.fstat(raw.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """As a file's."""
        left = max(self._size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))


def _check_summary(stream: IO[bytes]) -> None:
    """The library trusts the summary; a flipped bit there would lose messages without a word."""
    start_of_file = stream.read(len(MCAP0_MAGIC))
    if not MCAP0_MAGIC.startswith(start_of_file):
        raise DriveError(f"not an MCAP file: it begins with {start_of_file!r}")
    size = stream.seek(0, os.SEEK_END)
    if size < _TAIL.size:
        raise DriveError(f"recording of {size} bytes is cut off; restore it with `mcap recover`")
    stream.seek(size - _TAIL.size)
    opcode, length, start, _, crc, magic = _TAIL.unpack(stream.read(_TAIL.size))
    if (opcode, length) != (2, 20) or magic != MCAP0_MAGIC:
        raise DriveError("recording is cut off (no footer at its end); restore it with `mcap recover`")
    if start and crc and crc != _crc(stream, start, size - _CRC_AND_MAGIC_BYTES):
        raise DriveError(f"summary is damaged (CRC {crc:#010x} does not match); restore it with `mcap recover`")


def _crc(stream: IO[bytes], start: int, end: int) -> int:
    if not 0 < end - start <= limits.MAX_CHUNK_BYTES:
        raise DriveError(f"summary from byte {start} to {end} cannot be")
    stream.seek(start)
    return zlib.crc32(stream.read(end - start))
