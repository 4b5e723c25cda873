"""Files in a folder in memory: how bytes reach the readers that take a path."""

import shutil
import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

_MEMORY = Path("/dev/shm")
_MADE: list[Path] = []


@cache
def folder(name: str) -> Path:
    """An empty folder of this process."""
    made = Path(tempfile.mkdtemp(prefix=f"gnd-fuzz-{name}-", dir=_MEMORY if _MEMORY.is_dir() else None))
    _MADE.append(made)
    return made


def clean() -> None:
    """Remove all of them."""
    for made in _MADE:
        shutil.rmtree(made, ignore_errors=True)
    _MADE.clear()
    folder.cache_clear()


def on_file(name: str, read: Callable[[Path], Any]) -> Callable[[bytes], object]:
    """Give bytes to a reader of one file of this name; what it yields is read to its end."""

    def call(data: bytes) -> object:
        path = folder(name) / name
        path.write_bytes(data)
        found = read(path)
        return list(found) if hasattr(found, "__next__") else found

    return call


def in_recording(
    target: str, files: Callable[[], Mapping[str, bytes]], at: str, read: Callable[[Path], Any]
) -> Callable[[bytes], object]:
    """Give bytes to a reader of a folder as the file `at`, among other files that are good."""

    def call(data: bytes) -> object:
        place = folder(target)
        if not any(place.iterdir()):
            for name, content in files().items():
                (place / name).parent.mkdir(parents=True, exist_ok=True)
                (place / name).write_bytes(content)
        (place / at).write_bytes(data)
        return read(place)

    return call
