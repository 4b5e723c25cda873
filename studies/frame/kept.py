"""Results in files: each is used again only under the key of the programs and options that made it."""

import dataclasses
import hashlib
import importlib.resources
import json
import types
import typing
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, TypeVar, Union

import numpy as np

from gnd.schemas.errors import SchemaError
from studies.frame.errors import FolderError

SIMULATOR: Final = ("fleet_sim", "gnd_map", "schemas")
"""Packages and files that a simulated drive depends on; they begin the sources of a study."""
LOCALISER: Final = (
    *SIMULATOR,
    "vehicle_agent/localise",
    *(f"vehicle_agent/{name}.py" for name in ("local_map", "pipeline", "place", "scans", "surroundings")),
    "vehicle_agent/tiles_at_hand.py",
)
_SUFFIXES: Final = (".py", ".json", ".npz", ".toml")
_DECIDE_NOTHING: Final = ("cli.py", "pictures.py", "ellipsoids.py", "evaluate.py", "insert.py", "insert_drive.py")
"""Files of the simulator that no drive and no truth depends on."""
_DAMAGED: Final = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error, SchemaError)
T = TypeVar("T")


@lru_cache
def sources_sha(parts: tuple[str, ...]) -> str:
    """Return the SHA-256, hexadecimal, over the programs and tables of packages, folders and files of this project.

    Raises:
        FileNotFoundError: one of them is not there: what it was would decide a result and no key.
    """
    digest = hashlib.sha256()
    for part in parts:
        for path in _files(part):
            digest.update(f"{part}/{path.name}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def _files(part: str) -> Iterable[Path]:
    package, _, inside = part.partition("/")
    name = package if package == "studies" else f"gnd.{package}"
    path = Path(str(importlib.resources.files(name))) / inside
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise FileNotFoundError(f"{path}, which results depend on, is not there")
    return sorted(p for p in path.rglob("*") if p.suffix in _SUFFIXES and p.name not in _DECIDE_NOTHING)


def key_of(**what: Any) -> str:
    """Return a short hash, hexadecimal, of plain values that decide a result."""
    text = json.dumps(what, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


@dataclasses.dataclass(frozen=True, slots=True)
class Kept:
    """A result in a file: where it lies, what it is, and the key, which is part of the file's name."""

    home: Path
    name: str
    key: str

    @property
    def path(self) -> Path:
        """The file."""
        return self.home / f"{self.name}-{self.key}.npz"

    @property
    def done(self) -> bool:
        """Whether it is there (files appear complete or not at all)."""
        return self.path.is_file()

    def write(self, value: object) -> None:
        """Write a value: dataclasses, arrays, bytes, plain values, and tuples, lists and tables of these."""
        self.home.mkdir(parents=True, exist_ok=True)
        write_value(self.path, value)

    def read(self, kind: type[T]) -> T:
        """Read a value of this type.

        Raises:
            FolderError: it is missing, damaged, or of another kind.
        """
        return read_value(self.path, kind)


def write_value(path: Path, value: object) -> None:
    """See `Kept.write`."""
    arrays: list[Any] = []
    plain = _packed(value, arrays)
    write_npz(path, {"head": np.array(json.dumps(plain)), **{f"a{i}": array for i, array in enumerate(arrays)}})


def read_value(path: Path, kind: type[T]) -> T:
    """See `Kept.read`."""
    data = read_npz(path)
    try:
        value: T = _unpacked(kind, json.loads(str(data["head"])), data)
    except _DAMAGED as error:
        raise FolderError(f"{path} is damaged: it lacks {error}; delete it and start again") from error
    return value


def write_npz(path: Path, arrays: Mapping[str, Any], *, compressed: bool = True) -> None:
    """Write arrays; the file appears complete or not at all."""
    partial = path.with_name(f".{path.name}.part")
    with partial.open("wb") as file:
        (np.savez_compressed if compressed else np.savez)(file, **arrays)
    partial.replace(path)


def read_npz(path: Path) -> dict[str, Any]:
    """Read arrays, each with its checksum compared.

    Raises:
        FolderError: they are missing or damaged.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return dict(arrays)
    except _DAMAGED as error:
        raise FolderError(f"cannot read {path}: {error}; delete it and start again") from error


def _packed(value: Any, arrays: list[Any]) -> Any:
    """Plain values; arrays and bytes are put aside and stand as their number."""
    if isinstance(value, np.ndarray | bytes):
        arrays.append(np.frombuffer(value, np.uint8) if isinstance(value, bytes) else value)
        return len(arrays) - 1
    if dataclasses.is_dataclass(value):
        return {field.name: _packed(getattr(value, field.name), arrays) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: _packed(one, arrays) for key, one in value.items()}
    return [_packed(one, arrays) for one in value] if isinstance(value, tuple | list) else value


def _unpacked(hint: Any, plain: Any, data: Mapping[str, Any]) -> Any:
    """A value of the type `hint` from plain values."""
    origin, of = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        return None if plain is None else _unpacked(next(x for x in of if x is not type(None)), plain, data)
    if hint is bytes or hint is np.ndarray or origin is np.ndarray:
        array = data[f"a{plain}"]
        return array.tobytes() if hint is bytes else array
    if dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint)
        return hint(**{f.name: _unpacked(hints[f.name], plain[f.name], data) for f in dataclasses.fields(hint)})  # type: ignore[operator]
    if origin is not None and issubclass(origin, Mapping):
        return {of[0](key): _unpacked(of[1], one, data) for key, one in plain.items()}
    if origin in (tuple, list):
        kinds = of if origin is tuple and of[-1] is not Ellipsis else of[:1] * len(plain)
        return origin(_unpacked(kind, one, data) for kind, one in zip(kinds, plain, strict=True))
    return plain
