"""Files of recordings: found where they lie, read whole, unpacked with a limit."""

import lzma
import os
from collections import Counter
from pathlib import Path
from typing import Any, Final

from gnd.vehicle_agent.errors import ImportDriveError

MAX_FILE_BYTES: Final = 1 << 26
"""One scan, unpacked: 4 million points of 16 bytes; a few packed bytes may unpack to any number."""
MAX_DEPTH: Final = 4
"""Folders below the one that was named that are looked into."""
MAX_DICTIONARY_BYTES: Final = 1 << 28
"""Memory that xz may ask for; `xz -9` needs 65 MiB, a file may name 4 GiB."""


def read_file(path: Path) -> bytes:
    """The bytes of a file, unpacked where its name ends in .xz.

    Raises:
        ImportDriveError: it cannot be read, is a pipe or a device (which may never end), is damaged or cut off, or
            unpacks to more than `MAX_FILE_BYTES`.
    """
    try:
        if path.exists() and not path.is_file():
            raise ImportDriveError(f"{path}: is no regular file")
        data = path.read_bytes()
    except OSError as error:
        raise ImportDriveError(f"{path}: cannot be read: {error.strerror or error}") from error
    return _unpacked(path, data) if path.suffix == ".xz" else data


def _unpacked(path: Path, data: bytes) -> bytes:
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=MAX_DICTIONARY_BYTES)
    try:
        out = unpacker.decompress(data, MAX_FILE_BYTES)
    except (lzma.LZMAError, EOFError) as error:
        raise ImportDriveError(f"{path}: {len(data)} bytes that are not xz: {error}") from error
    if unpacker.eof:
        return out
    if len(out) >= MAX_FILE_BYTES:
        raise ImportDriveError(f"{path}: unpacks to more than {MAX_FILE_BYTES} bytes")
    raise ImportDriveError(f"{path}: cut off after {len(data)} bytes ({len(out)} unpacked)")


def named_file(folder: Path, name: Any, named_by: Path) -> Path:
    """The file that a table of a recording names; it need not be there.

    Args:
        folder: that the name counts from, and that it must not leave.
        name: as the table has it.
        named_by: the table, for the error.

    Raises:
        ImportDriveError: the name is no text, is absolute, or leads out of the folder by `..` or by a link.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise ImportDriveError(f"{named_by}: {str(name)[:120]!r} is no name of a file")
    real = Path(os.path.realpath(folder / name))
    if not real.is_relative_to(os.path.realpath(folder)):
        raise ImportDriveError(
            f"{named_by}: names the file {name[:200]!r}, which lies outside of {folder}, at {real}: refused"
        )
    return folder / name


def files_of(folder: Path, *patterns: str) -> list[Path]:
    """Files in `folder` that match the first pattern that matches any, sorted by name."""
    for pattern in patterns:
        found = sorted(folder.glob(pattern))
        if found:
            return found
    return []


def files_below(folder: Path, *endings: str) -> list[Path]:
    """Files with one of these endings in `folder`, or else in the folder below it that holds most of them, sorted."""
    level = [folder]
    for _ in range(MAX_DEPTH):
        held = {place: _ending_so(place, endings) for place in level}
        most = max(level, key=lambda place: len(held[place]), default=None)
        if most is not None and held[most]:
            return held[most]
        level = sorted(below for place in level for below in place.iterdir() if below.is_dir())
    return []


def _ending_so(folder: Path, endings: tuple[str, ...]) -> list[Path]:
    """The files with the ending that is the most frequent: a file and its packed copy are not two scans."""
    names = [path for path in folder.iterdir() if path.is_file()]
    counts = Counter({ending: sum(path.name.endswith(ending) for path in names) for ending in endings})
    ending, n = counts.most_common(1)[0]
    return sorted(path for path in names if path.name.endswith(ending)) if n else []


def check_folder(folder: Path) -> None:
    """ImportDriveError unless `folder` is a folder."""
    if not folder.exists():
        raise ImportDriveError(f"{folder}: no such folder")
    if not folder.is_dir():
        raise ImportDriveError(f"{folder}: is a file; give the folder of the recording")
