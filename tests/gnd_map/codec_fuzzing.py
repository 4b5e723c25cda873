"""Damaged messages for every decoder of `gnd.gnd_map.codec`: seeded, with checksums left wrong or made right again.

For longer runs than the tests', and for compiled code that checks its indices:

    NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=$(mktemp -d) PYTHONPATH=src python tests/gnd_map/codec_fuzzing.py ROUNDS SEED
"""

import struct
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random

import numpy as np
from codec_samples import ARCTIC, changed, gaussians_of, ids_in, street

from gnd.gnd_map.codec import (
    CODECS,
    LATTICES,
    REPORT,
    Flags,
    decode_delta,
    decode_flags,
    decode_mask,
    decode_measured,
    decode_tiles,
    encode_delta,
    encode_flags,
    encode_gaussians,
    encode_mask,
    encode_measured,
    encode_tiles,
    snap,
)
from gnd.gnd_map.codec.coding import CHECK_BYTES, checksum
from gnd.gnd_map.codec.zstd_columns import seal
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId

TILE = ARCTIC  # one voxel wide, 39 long: small boxes, so that a million messages take a minute
FORGED = (0, 1, 199_999, 200_000, 200_001, 10**9, 2**31 - 1, 2**31, 2**32 - 1)
MASK_LENGTH = 40


@dataclass(frozen=True)
class Decoder:
    """One decoder, messages that it reads, and how to give a damaged one a right checksum."""

    name: str
    decode: Callable[[bytes], object]
    messages: Sequence[bytes]
    repaired: Callable[[bytes], bytes]


def decoders() -> list[Decoder]:
    """All of them, with small messages."""
    made = states()
    tiles = [_tile_decoder(codec_id, made) for codec_id in CODECS]
    return [*tiles, _delta_decoder(made), _flags_decoder(made), _measured_decoder(made), *_lists()]


def states() -> list[Gaussians]:
    """States of one tile: nothing, one voxel, some, the same later, many floors."""
    rng = np.random.default_rng(5)
    one = gaussians_of(ids_in(TILE, rng, 1), np.array([50]), np.zeros((1, 3)), np.diag([0.08, 0.08, 1e-4])[None])
    some = street(TILE, rng, 7)
    return [Gaussians.empty(), one, some, changed(some, TILE, rng, 0.5), street(TILE, rng, 10)]


def _tile_decoder(codec_id: int, states: Sequence[Gaussians]) -> Decoder:
    codec = CODECS[codec_id]
    fitting = [s if codec.lattice is None else snap(s, codec.lattice) for s in states]

    def decode(body: bytes) -> object:
        return codec.decode(TILE, body)

    def zstd_repaired(body: bytes) -> bytes:
        return seal(codec_id, TILE, struct.unpack_from("<I", body.ljust(4, b"\0"))[0], body[8:])

    repaired = {0: bytes, **dict.fromkeys((2, 3, 4, *range(8, 14)), resealed)}.get(codec_id, zstd_repaired)
    return Decoder(codec.name, decode, [codec.encode(TILE, s) for s in fitting], repaired)


def resealed(body: bytes) -> bytes:
    """A range-coded message with the right checksum."""
    data = body[:-CHECK_BYTES]
    return data + checksum(data)


def _delta_decoder(states: Sequence[Gaussians]) -> Decoder:
    snapped = [snap(s, LATTICES[name]) for name in LATTICES for s in states[1:]]
    pairs = [(a, b) for a in snapped for b in snapped if a is not b][::7]
    chosen = _Turns([a for a, _ in pairs])
    messages = [encode_delta(TILE, a, b) for a, b in pairs]
    messages.append(encode_delta(TILE, states[2], states[3]))

    def decode(body: bytes) -> object:
        return decode_delta(TILE, chosen.next(), body)

    return Decoder("delta", decode, messages, lambda body: body[:1] + resealed(body[1:]))


class _Turns:
    """One after the other, again and again: most messages meet a base that is not theirs."""

    def __init__(self, items: Sequence[Gaussians]) -> None:
        self._items, self._at = items, 0

    def next(self) -> Gaussians:
        self._at = (self._at + 1) % len(self._items)
        return self._items[self._at]


def _flags_decoder(states: Sequence[Gaussians]) -> Decoder:
    other = TileId(TILE.morton + 4)
    bases, chosen = list(states), _Turns(states)

    def decode(body: bytes) -> object:
        return decode_flags([(TILE, chosen.next()), (other, states[1])], body)

    rng, messages = np.random.default_rng(6), []
    for base in bases:
        flags = [Flags(tile, b, *flagged(b, tile, rng)) for tile, b in ((TILE, base), (other, states[1]))]
        messages.append(encode_flags(flags))
    return Decoder("flags", decode, messages, resealed)


def flagged(base: Gaussians, tile_id: TileId, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Some voxels of the base modified or deleted, some others new."""
    ids = np.union1d(base.voxel_id[rng.random(len(base)) < 0.4], ids_in(tile_id, rng, 4)).astype(np.int32)
    classes = np.where(np.isin(ids, base.voxel_id), rng.integers(2, 4, len(ids)), 1)
    return ids, classes.astype(np.uint8)


def _measured_decoder(states: Sequence[Gaussians]) -> Decoder:
    measured = snap(states[2], REPORT)
    chosen = _Turns(states)
    messages = [encode_measured([(TILE, base, measured)]) for base in states]

    def decode(body: bytes) -> object:
        return decode_measured([(TILE, chosen.next(), measured.voxel_id)], body)

    return Decoder("measured", decode, messages, resealed)


def _lists() -> list[Decoder]:
    entries = ([], [(0, 1)], [(3, 1), (4, 1), (900, 2**31 - 1)], [(i, 1 + i % 3) for i in range(0, 1024, 37)])
    masks = [np.arange(MASK_LENGTH) % k == 0 for k in (1, 2, 7, 50)]
    return [
        Decoder("tiles", decode_tiles, [encode_tiles(e) for e in entries], resealed),
        Decoder("mask", lambda body: decode_mask(body, MASK_LENGTH), [encode_mask(m) for m in masks], resealed),
    ]


# --- damage -----------------------------------------------------------------------------------------------------------


def damaged(rng: Random, own: Sequence[bytes], foreign: Sequence[bytes]) -> bytes:
    """A message cut, lengthened, flipped, overwritten, spliced, with a forged size, of another decoder, or noise."""
    body = bytearray(rng.choice(own))
    kind = rng.randrange(8) if rng.randrange(20) else 8
    if kind == 0:
        del body[rng.randrange(len(body) + 1) :]
    elif kind == 1:
        body += rng.randbytes(rng.randrange(1, 9))
    elif kind <= 3:
        for _ in range(kind):
            body[rng.randrange(len(body))] ^= 1 << rng.randrange(8)
    elif kind == 4:
        body[rng.randrange(len(body))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF))
    elif kind == 5:
        at = rng.randrange(max(1, min(len(body), 16)))
        body[at : at + 4] = rng.choice(FORGED).to_bytes(4, "little")
    elif kind == 6:
        other = rng.choice(own)
        return bytes(body[: rng.randrange(len(body) + 1)]) + other[rng.randrange(len(other) + 1) :]
    elif kind == 7:
        return rng.randbytes(rng.randrange(64))
    else:
        return rng.choice(foreign)
    return bytes(body)


def refused(decoder: Decoder, body: bytes) -> bool:
    """Whether the decoder names what is wrong; anything but a `CodecError` comes out."""
    try:
        decoder.decode(body)
    except CodecError:
        return True
    return False


def foreign_messages(all_decoders: Sequence[Decoder]) -> list[bytes]:
    """What other decoders read."""
    return [body for decoder in all_decoders for body in decoder.messages] + [encode_gaussians(Gaussians.empty())]


def main() -> None:
    """Try so many messages with right checksums on each decoder."""
    rounds, seed = (int(argument) for argument in sys.argv[1:3])
    found = decoders()
    foreign = foreign_messages(found)
    for decoder in found:
        rng = Random(seed)
        n = sum(refused(decoder, decoder.repaired(damaged(rng, decoder.messages, foreign))) for _ in range(rounds))
        print(f"{decoder.name}: {n} of {rounds} refused")


if __name__ == "__main__":
    main()
