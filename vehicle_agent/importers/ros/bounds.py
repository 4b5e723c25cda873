"""Bounds for what `rosbags` reads of a bag: it makes room for whatever a file announces, and unpacks to any size.

It has no setting for that. Its table of decompressors, its exact read and the Zstandard of single messages are replaced
by ones that are bounded, in this process.
"""

from functools import cache
from io import SEEK_END
from typing import IO, Any, Final

from gnd.gnd_map.bounded import zstd_unpacked
from gnd.vehicle_agent.importers.optional import library

MAX_UNPACKED_BYTES: Final = 1 << 28
"""Of a chunk or of a message: as of a chunk of a drive."""


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
    """The library's module, with a bounded `decompress` of messages."""

    def __init__(self, module: Any) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)

    def decompress(self, data: bytes) -> bytes:
        """Of one message."""
        return zstd_unpacked(data, MAX_UNPACKED_BYTES)


def _lz4(data: bytes, size: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]  # rosbags brings it

    return bytes(LZ4FrameDecompressor().decompress(data, _checked(size) + 1))


def _checked(size: int) -> int:
    if not 0 <= size <= MAX_UNPACKED_BYTES:
        raise ValueError(f"a chunk that unpacks to {size} bytes (0 ... {MAX_UNPACKED_BYTES})")
    return size
