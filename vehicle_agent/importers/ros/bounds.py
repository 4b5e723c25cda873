"""Bounds for what `rosbags` reads of a bag: it makes room for whatever a file announces, and unpacks to any size.

It has no setting for that. Its table of decompressors, its exact read and the Zstandard of single messages and of whole
files are replaced by ones that are bounded, in this process. A file that is packed as a whole (`compression_mode:
FILE`) is unpacked into the system's folder for temporary files before anything of it is read.
"""

import os
import shutil
import tempfile
from functools import cache
from io import SEEK_END
from types import TracebackType
from typing import IO, Any, Final, Self

import zstandard

from gnd.gnd_map.bounded import zstd_unpacked
from gnd.vehicle_agent.importers.optional import library

MAX_UNPACKED_BYTES: Final = 1 << 28
"""Of a chunk or of a message: as of a chunk of a drive."""
MAX_FILE_BYTES: Final = 1 << 36
"""Of one file of a bag that is packed as a whole."""
MOST_OF_A_BYTE: Final = 100
"""Bytes that one packed byte of such a file may become; bags of LiDARs reach 2 to 4."""
ALWAYS_BYTES: Final = 1 << 28
"""So much may come of a few packed bytes: SQLite keeps empty pages, and a bag may hold the same message again."""
KEPT_FREE: Final = 0.05
"""Share of the disk that stays free."""
_LOOKED_EVERY: Final = 1 << 26
"""Bytes after which the disk is looked at again: others write to it, too."""
_HEAD_BYTES: Final = 18
"""The longest head of a Zstandard frame."""


@cache
def bound_rosbags(extra: str) -> None:
    """Once a process, before the first bag is opened.

    Raises:
        MissingExtra: rosbags is not installed.
    """
    storage = library("rosbags.rosbag2.storage_mcap", extra)
    storage.DECOMPRESSORS.update(lz4=_lz4, zstd=lambda data, size: zstd_unpacked(data, _checked(size)))
    exact = storage.read_exact

    def read_exact(bio: IO[bytes], size: int) -> Any:
        at = bio.tell()
        left = bio.seek(0, SEEK_END) - at
        bio.seek(at)
        if not 0 <= size <= left:
            raise ValueError(f"{size} bytes wanted at {at}, {left} are left")
        return exact(bio, size)

    storage.read_exact = read_exact
    library("rosbags.rosbag2.reader", extra).zstd = _Zstd(library("rosbags.rosbag2.reader", extra).zstd)


class _Zstd:
    """The library's module, with a bounded `decompress` of messages and `open` of whole files."""

    def __init__(self, module: Any) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)

    def decompress(self, data: bytes) -> bytes:
        """Of one message."""
        return zstd_unpacked(data, MAX_UNPACKED_BYTES)

    def open(self, packed: IO[bytes], mode: str) -> "_BoundedFile":
        """A file of a bag, to be unpacked."""
        return _BoundedFile(packed, self._module.open(packed, mode))


class _BoundedFile:
    """A packed file that is read until it becomes more than is allowed.

    Raises:
        ValueError: it says, or turns out, to be more; before that is written.
    """

    def __init__(self, packed: IO[bytes], plain: IO[bytes]) -> None:
        self._plain = plain
        self._packed_bytes = os.fstat(packed.fileno()).st_size
        self._read = self._looked_at = 0
        said = _said_bytes(packed)
        if said is not None:
            self._check(said, "says that it unpacks to")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._plain.close()

    def read(self, size: int) -> bytes:
        """The next bytes."""
        data = self._plain.read(size)
        self._read += len(data)
        if self._read - self._looked_at >= _LOOKED_EVERY or self._read > self._most():
            self._check(self._read, "unpacks to more than")
            self._looked_at = self._read
        return data

    def _most(self) -> int:
        return min(MAX_FILE_BYTES, max(ALWAYS_BYTES, MOST_OF_A_BYTE * self._packed_bytes))

    def _check(self, size: int, what: str) -> None:
        folder = tempfile.gettempdir()
        disk = shutil.disk_usage(folder)
        left = self._read if size == self._read else 0  # already written, so no longer free
        free = max(0, disk.free + left - int(KEPT_FREE * disk.total))
        if size > self._most():
            raise ValueError(
                f"{self._packed_bytes} packed bytes: {what} {size} bytes, at most {self._most()} are"
                f" ({MOST_OF_A_BYTE} times as many, {ALWAYS_BYTES} at least, {MAX_FILE_BYTES} at most)"
            )
        if size > free:
            raise ValueError(f"{what} {size} bytes, {free} are free in {folder} (TMPDIR names another folder)")


def _said_bytes(packed: IO[bytes]) -> int | None:
    """What the first frame says of its size; None: nothing. The place in the file stays."""
    head = packed.read(_HEAD_BYTES)
    packed.seek(-len(head), os.SEEK_CUR)
    try:
        size = zstandard.get_frame_parameters(head).content_size
    except zstandard.ZstdError as error:
        raise ValueError(f"no Zstandard: {error}") from None
    return None if size in (zstandard.CONTENTSIZE_UNKNOWN, zstandard.CONTENTSIZE_ERROR) else int(size)


def _lz4(data: bytes, size: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]  # rosbags brings it

    return bytes(LZ4FrameDecompressor().decompress(data, _checked(size) + 1))


def _checked(size: int) -> int:
    if not 0 <= size <= MAX_UNPACKED_BYTES:
        raise ValueError(f"a chunk that unpacks to {size} bytes (0 ... {MAX_UNPACKED_BYTES})")
    return size
