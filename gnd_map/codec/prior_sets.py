"""Sets of tables by which the contexts of a tile's stream start: streets, motorways, gardens, real and simulated ones
differ. A tile names the set that it is written by.

`prior_sets.bin` was made by `studies/codec_study/learn.py`; its bytes are part of what codecs 8 to 10 mean, golden
messages of every set hold it.
"""

import zlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib import resources
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.codec.priors import CONTEXTS, WEIGHTS, Priors
from gnd.gnd_map.codec.voxel_kernels import MORE_VOXEL_CONTEXTS, MORE_VOXEL_WEIGHTS

FILE: Final = "prior_sets.bin"
LATTICES_WITH_SETS: Final = ("archive", "standard", "compact")
MOST_SETS: Final = 16
_PLACES: Final = CONTEXTS + MORE_VOXEL_CONTEXTS
_WEIGHTS: Final = (WEIGHTS + MORE_VOXEL_WEIGHTS, 5)
_PLACES_BYTES: Final = 4 * _PLACES
_SET_BYTES: Final = _PLACES_BYTES + 4 * _WEIGHTS[0] * _WEIGHTS[1]


def sets_of(lattice: str) -> tuple[Priors, ...]:
    """The sets of a lattice by their numbers."""
    return _frozen(lattice)


@lru_cache(maxsize=len(LATTICES_WITH_SETS))
def _frozen(lattice: str) -> tuple[Priors, ...]:
    """Only those of one lattice: a vehicle's map has one, and those of all take 4 MB."""
    return unpack(resources.files("gnd.gnd_map.codec").joinpath(FILE).read_bytes(), (lattice,))[lattice]


def pack(sets: Mapping[str, Sequence[Priors]]) -> bytes:
    """The file's bytes: by lattice how many sets (1 byte), then each as integers of four bytes, places and weights;
    those after the first as differences from it, byte plane after byte plane; deflated.
    """
    parts = []
    for name in LATTICES_WITH_SETS:
        raw = [np.concatenate([one.places, one.weight.ravel()]).astype("<i4") for one in sets[name]]
        rows = np.stack([raw[0], *(one ^ raw[0] for one in raw[1:])])
        parts += [bytes([len(rows)]), rows.view(np.uint8).reshape(len(rows), -1, 4).transpose(0, 2, 1).tobytes()]
    return zlib.compress(b"".join(parts), 9)


def unpack(data: bytes, wanted: Sequence[str] = LATTICES_WITH_SETS) -> dict[str, tuple[Priors, ...]]:
    """The sets of `pack`, of the lattices that are wanted."""
    raw, at, found = zlib.decompress(data), 0, {}
    for name in LATTICES_WITH_SETS:
        n, at = raw[at], at + 1
        if name in wanted:
            planes = np.frombuffer(raw, np.uint8, n * _SET_BYTES, at).reshape(n, 4, -1)
            rows = np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<i4").reshape(n, -1).astype(np.int32)
            rows[1:] ^= rows[0]
            found[name] = tuple(map(_priors, rows))
        at += n * _SET_BYTES
    return found


def _priors(row: npt.NDArray[np.int32]) -> Priors:
    return Priors(row[:_PLACES].copy(), row[_PLACES:].astype(np.int64).reshape(_WEIGHTS))
