"""Where the contexts start: probabilities, how much they count, and mixing weights, learnt once and frozen.

`priors.bin` was made by `python -m studies.codec_priors` at 9b4197d; its hash is part of what the codecs mean, a test
holds it.
"""

import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import I32, I64
from gnd.gnd_map.codec import kernels as k
from gnd.gnd_map.codec.voxel_kernels import (
    MORE_VOXEL_CONTEXTS,
    MORE_VOXEL_WEIGHTS,
    VOXEL_CONTEXTS,
    VOXEL_WEIGHTS,
)

_PLAIN: Final = 70
FLAG_CONTEXTS: Final = k.BLOCK_CONTEXTS + k.CELL_CONTEXTS + k.KIND_CONTEXTS
FLAG_WEIGHTS: Final = 8

# Contexts of a stream, one part after the other.
NUMBERS_AT: Final = 0  # four plain numbers
MASK_AT: Final = NUMBERS_AT + 4 * _PLAIN
FLAGS_AT: Final = MASK_AT + 8 * 4
VOXELS_AT: Final = FLAGS_AT + FLAG_CONTEXTS
CONTEXTS: Final = VOXELS_AT + VOXEL_CONTEXTS
VOXEL_WEIGHTS_AT: Final = FLAG_WEIGHTS
WEIGHTS: Final = FLAG_WEIGHTS + VOXEL_WEIGHTS

_FIRST_WEIGHT: Final = 24_000
_FIRST_WEIGHT_OF_5: Final = 16_000


def number_at(which: int) -> int:
    """First context of plain number 0 … 3."""
    return NUMBERS_AT + which * _PLAIN


def mask_at(which: int) -> int:
    """First of the eight contexts of mask 0 … 3."""
    return MASK_AT + which * 8


@dataclass(frozen=True, slots=True)
class Priors:
    """How a stream's contexts start.

    Attributes:
        places: (CONTEXTS,) int32 probability of a 1, of 65536, << 8 | how many decisions it stands for.
        weight: (WEIGHTS, 3) int64 mixing weights, of 65536.
    """

    places: I32
    weight: I64

    @classmethod
    def flat(cls) -> "Priors":
        """Nothing is known."""
        return cls(
            np.full(CONTEXTS, 1 << 23, np.int32),
            np.full((WEIGHTS, 3), _FIRST_WEIGHT, np.int64),
        )

    @classmethod
    def flat_5(cls) -> "Priors":
        """The same of a stream that mixes five contexts."""
        weight = np.full((WEIGHTS + MORE_VOXEL_WEIGHTS, 5), _FIRST_WEIGHT_OF_5, np.int64)
        weight[: VOXEL_WEIGHTS_AT + 2] = [_FIRST_WEIGHT] * 3 + [0, 0]
        return cls(np.full(CONTEXTS + MORE_VOXEL_CONTEXTS, 1 << 23, np.int32), weight)

    def copies(self) -> tuple[I32, I64]:
        """Arrays for a stream to learn in."""
        return self.places.copy(), self.weight.copy()

    def frozen(self, trust: int) -> "Priors":
        """The same, to count as at most `trust` decisions."""
        seen = np.minimum(self.places & 0xFF, trust)
        return Priors((self.places >> 8 << 8 | seen).astype(np.int32), self.weight.copy())


STREAMS: Final = (
    "tile-archive", "tile-standard", "tile-compact", "delta-archive", "delta-standard", "delta-compact",
    "flags", "measured", "tiles", "mask",
)  # fmt: skip
FILE: Final = "priors.bin"


@lru_cache(maxsize=1)
def _frozen() -> dict[str, Priors]:
    return unpack(resources.files("gnd.gnd_map.codec").joinpath(FILE).read_bytes())


_learning: ContextVar[dict[str, "Learning"] | None] = ContextVar("learning", default=None)


def priors_of(stream: str) -> Priors:
    """How the contexts of a stream of this kind start."""
    learning = _learning.get()
    return _frozen()[stream] if learning is None else learning[stream]


@dataclass(frozen=True, slots=True)
class Learning(Priors):
    """Priors that go on learning from stream to stream instead of starting anew: how the frozen ones are made."""

    def copies(self) -> tuple[I32, I64]:
        """The arrays themselves."""
        return self.places, self.weight


@contextmanager
def learning(start: Mapping[str, Priors] | None = None) -> Iterator[dict[str, Learning]]:
    """Within it, every stream starts where the last of its kind ended; from `start`, or from nothing."""
    states = {name: Learning(*(start[name] if start else Priors.flat()).copies()) for name in STREAMS}
    token = _learning.set(states)
    try:
        yield states
    finally:
        _learning.reset(token)


def pack(priors: Mapping[str, Priors]) -> bytes:
    """The file's bytes: places and weights, stream after stream; deflated."""
    parts = []
    for name in STREAMS:
        one = priors[name]
        parts += [one.places.astype("<i4").tobytes(), one.weight.astype("<i4").tobytes()]
    return zlib.compress(b"".join(parts), 9)


def unpack(data: bytes) -> dict[str, Priors]:
    """The priors of `pack`."""
    raw, at, found = zlib.decompress(data), 0, {}
    for name in STREAMS:
        places = np.frombuffer(raw, "<i4", CONTEXTS, at).astype(np.int32)
        weight = np.frombuffer(raw, "<i4", 3 * WEIGHTS, at + 4 * CONTEXTS).astype(np.int64).reshape(WEIGHTS, 3)
        found[name] = Priors(places, weight)
        at += 4 * CONTEXTS + 12 * WEIGHTS
    return found
