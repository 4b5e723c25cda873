"""Where the sums of a tile start and the distributions that they choose among, learnt once and frozen.

`rans_tables.bin` was made by `studies/codec_study/learn_rans.py`; its bytes are part of what codecs 11 to 13 mean,
golden messages hold it.
"""

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from importlib import resources
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import I32, I64, check_array
from gnd.gnd_map.codec import rans_kernels as k
from gnd.gnd_map.codec.rans_kernels import U16

FILE: Final = "rans_tables.bin"
LATTICES_WITH_SUMS: Final = ("archive", "standard", "compact")


_MOVES: Final = (
    ((k.ODDS,), np.uint16),
    ((k.SCALES,), np.int64),
    ((k.SCALES, k.OFFS), np.int32),
    ((k.SCALES, k.OFFS), np.int32),
    ((k.SCALES,), np.int64),
)
_SUMS: Final = (
    ((k.CONTEXTS, k.SAYS), np.int32),
    ((k.DISTRIBUTIONS, k.SYMBOLS + 1), np.uint16),
    ((k.AXIS_CONTEXTS, 4), np.uint16),
)


@dataclass(frozen=True, slots=True, eq=False)
class Moves:
    """How sums are read and learn, for all lattices; see `rans_kernels.SumCoding`."""

    odds: U16
    """(ODDS,)"""
    inverse: I64
    """(SCALES,)"""
    place_moves: I32
    """(SCALES, OFFS)"""
    scale_moves: I32
    """(SCALES, OFFS)"""
    plain_bits: I64
    """(SCALES,)"""

    def __post_init__(self) -> None:
        _check(self, _MOVES)


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """How a tile of one lattice starts."""

    says: I32
    """(CONTEXTS, SAYS)"""
    shares: U16
    """(DISTRIBUTIONS, SYMBOLS + 1) where the symbols of each distribution begin, from 0 to ONE"""
    axes: U16
    """(AXIS_CONTEXTS, 4) likewise of the axes"""

    def __post_init__(self) -> None:
        _check(self, _SUMS)


def _check(tables: "Moves | Sums", kinds: tuple[tuple[tuple[int, ...], type[np.generic]], ...]) -> None:
    for field, (shape, dtype) in zip(fields(tables), kinds, strict=True):
        check_array(field.name, getattr(tables, field.name), dtype, shape)


def moves() -> Moves:
    """The tables of all lattices."""
    return _frozen()[0]


def sums_of(lattice: str) -> Sums:
    """How the sums of a lattice start."""
    return _frozen()[1][lattice]


@lru_cache(maxsize=1)
def _frozen() -> tuple[Moves, dict[str, Sums]]:
    return unpack(resources.files("gnd.gnd_map.codec").joinpath(FILE).read_bytes())


def pack(common: Moves, sums: Mapping[str, Sums]) -> bytes:
    """The file's bytes: the columns one after the other, little-endian, those of each lattice last; deflated."""
    tables: list[Moves | Sums] = [common, *(sums[name] for name in LATTICES_WITH_SUMS)]
    arrays = [getattr(one, field.name) for one in tables for field in fields(one)]
    return zlib.compress(b"".join(x.astype(x.dtype.newbyteorder("<")).tobytes() for x in arrays), 9)


def unpack(data: bytes) -> tuple[Moves, dict[str, Sums]]:
    """The tables of `pack`."""
    raw, at, found = zlib.decompress(data), 0, list[NDArray[Any]]()
    for shape, dtype in (*_MOVES, *_SUMS * len(LATTICES_WITH_SUMS)):
        column = np.frombuffer(raw, np.dtype(dtype).newbyteorder("<"), math.prod(shape), at)
        found.append(column.reshape(shape).astype(dtype))
        at += column.nbytes
    common, rest = Moves(*found[: len(_MOVES)]), found[len(_MOVES) :]
    return common, {name: Sums(*rest[3 * i : 3 * i + 3]) for i, name in enumerate(LATTICES_WITH_SUMS)}
