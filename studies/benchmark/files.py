"""Files that appear complete or not at all: folders, tables, and point clouds that any program reads."""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F32
from gnd.gnd_map.bounded import json_value
from studies.benchmark.errors import BenchmarkError

_CHUNK: Final = 1 << 20


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Give a folder to fill, which takes its name when the block ends without an error.

    Raises:
        BenchmarkError: it cannot be written.
    """
    partial = path.with_name(f".{path.name}.part")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        yield partial
        partial.rename(path)
    except OSError as error:
        raise BenchmarkError(f"cannot write {path}: {error}") from error


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write plain values; the file appears complete or not at all."""
    partial = path.with_name(f".{path.name}.part")
    partial.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    partial.replace(path)


def write_table(path: Path, head: Sequence[str], columns: Sequence[Iterable[Any]], formats: Sequence[str]) -> None:
    """Write columns (N,) as CSV with a line of names."""
    lines = [",".join(head)]
    lines += [",".join(f % value for f, value in zip(formats, row, strict=True)) for row in zip(*columns, strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_cloud(path: Path, points_m: F32) -> None:
    """Write points (N, 3) as binary PCD."""
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {len(points_m)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points_m)}\nDATA binary\n"
    )
    path.write_bytes(head.encode() + np.ascontiguousarray(points_m, "<f4").tobytes())


def read_cloud(path: Path) -> F32:
    """Read points (N, 3) that `write_cloud` wrote.

    Raises:
        BenchmarkError: the file is missing or damaged.
    """
    try:
        head, _, body = path.read_bytes().partition(b"DATA binary\n")
        number = int(head.split(b"POINTS ")[1].split()[0])
        return np.frombuffer(body, "<f4").reshape(number, 3).copy()
    except (OSError, ValueError, IndexError) as error:
        raise BenchmarkError(f"cannot read the point cloud {path}: {error}") from error


def read_json(path: Path, make: Callable[[Any], Any] = dict) -> Any:
    """Read plain values.

    Raises:
        BenchmarkError: the file is missing or damaged.
    """
    try:
        return make(json_value(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise BenchmarkError(f"cannot read {path}: {error}") from error


def sha_of(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(_CHUNK):
            digest.update(part)
    return digest.hexdigest()
