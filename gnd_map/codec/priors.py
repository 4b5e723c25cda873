"""Where the contexts start: probabilities, how much they count, and mixing weights, learnt once and frozen.

`priors.bin` is made by `python -m benchmarks codec-priors`; its hash is part of the codecs' meaning and held by a test.
"""

import zlib
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Final

import numpy as np

from gnd_map.arrays import I32, I64
from gnd_map.codec import kernels as k

_PLAIN: Final = 70
FLAG_CONTEXTS: Final = k.BLOCK_CONTEXTS + k.CELL_CONTEXTS + k.KIND_CONTEXTS
FLAG_WEIGHTS: Final = 8

# Contexts of a stream, one part after the other.
NUMBERS_AT: Final = 0  # four plain numbers
MASK_AT: Final = NUMBERS_AT + 4 * _PLAIN
FLAGS_AT: Final = MASK_AT + 8 * 4
VOXELS_AT: Final = FLAGS_AT + FLAG_CONTEXTS
CONTEXTS: Final = VOXELS_AT + k.VOXEL_CONTEXTS
VOXEL_WEIGHTS_AT: Final = FLAG_WEIGHTS
WEIGHTS: Final = FLAG_WEIGHTS + k.VOXEL_WEIGHTS

_FIRST_WEIGHT: Final = 24_000


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
        prob: (CONTEXTS,) int32 probability of a 1, of 65536.
        seen: (CONTEXTS,) int32 how many decisions that probability stands for.
        weight: (WEIGHTS, 3) int64 mixing weights, of 65536.
    """

    prob: I32
    seen: I32
    weight: I64

    @classmethod
    def flat(cls) -> "Priors":
        """Nothing is known."""
        return cls(
            np.full(CONTEXTS, 1 << 15, np.int32),
            np.zeros(CONTEXTS, np.int32),
            np.full((WEIGHTS, 3), _FIRST_WEIGHT, np.int64),
        )

    def copies(self) -> tuple[I32, I32, I64]:
        """Arrays for a stream to learn in."""
        return self.prob.copy(), self.seen.copy(), self.weight.copy()


STREAMS: Final = (
    "tile-archive", "tile-standard", "tile-compact", "delta-archive", "delta-standard", "delta-compact",
    "flags", "measured", "tiles", "mask",
)  # fmt: skip
FILE: Final = "priors.bin"


@lru_cache(maxsize=1)
def _all() -> dict[str, Priors]:
    data = resources.files("gnd_map.codec").joinpath(FILE)
    return unpack(data.read_bytes()) if data.is_file() else {}


def priors_of(stream: str) -> Priors:
    """How the contexts of a stream of this kind start."""
    return _all().get(stream) or Priors.flat()


def pack(priors: dict[str, Priors]) -> bytes:
    """The file's bytes: probabilities of 8 bits (in the logistic domain), counts, weights; deflated."""
    parts = []
    for name in STREAMS:
        one = priors[name]
        parts += [one.prob.astype("<u2").tobytes(), one.seen.astype("u1").tobytes(), one.weight.astype("<i4").tobytes()]
    return zlib.compress(b"".join(parts), 9)


def unpack(data: bytes) -> dict[str, Priors]:
    """The priors of `pack`."""
    raw, at, found = zlib.decompress(data), 0, {}
    for name in STREAMS:
        prob = np.frombuffer(raw, "<u2", CONTEXTS, at).astype(np.int32)
        seen = np.frombuffer(raw, "u1", CONTEXTS, at + 2 * CONTEXTS).astype(np.int32)
        weight = np.frombuffer(raw, "<i4", 3 * WEIGHTS, at + 3 * CONTEXTS).astype(np.int64).reshape(WEIGHTS, 3)
        found[name] = Priors(prob, seen, weight)
        at += 3 * CONTEXTS + 12 * WEIGHTS
    return found
