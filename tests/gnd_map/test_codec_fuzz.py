"""A million damaged messages: every one gives a `CodecError` or Gaussians that can be encoded again, nothing else."""

import struct
import tracemalloc
from collections import deque
from random import Random

import numpy as np
import pytest
from codec_fuzzing import FORGED, TILE, Decoder, damaged, decoders, foreign_messages, refused, resealed
from codec_samples import ARCTIC, EQUATOR, SEOUL

from gnd.gnd_map.codec import CODEC_STANDARD_SUMS, CODECS, MAX_VOXELS, Codec
from gnd.gnd_map.codec import kernels as k
from gnd.gnd_map.codec.coding import Coder
from gnd.gnd_map.codec.priors import number_at, priors_of
from gnd.gnd_map.codec.zstd_columns import seal
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId

DECODERS = {decoder.name: decoder for decoder in decoders()}
FOREIGN = foreign_messages(list(DECODERS.values()))
REPAIRED = {  # messages whose checksum is right again: they reach the entropy decoder and the checks of values
    "float32 columns": 130_000, "float32 columns, Zstandard": 30_000,
    "archive, range coded": 8_000, "standard, range coded": 8_000, "compact, range coded": 8_000,
    "archive, columns, Zstandard": 12_000, "standard, columns, Zstandard": 12_000,
    "compact, columns, Zstandard": 12_000,
    "archive, range coded by sets": 2_000, "standard, range coded by sets": 4_000,
    "compact, range coded by sets": 2_000,
    "archive, by sums": 4_000, "standard, by sums": 8_000, "compact, by sums": 4_000,
    "delta": 1_500, "flags": 8_000, "measured": 800, "tiles": 60_000, "mask": 110_000,
}  # fmt: skip
LEFT_WRONG = {  # messages whose checksum stays as the damage leaves it; float32 columns have none
    "float32 columns, Zstandard": 120_000,
    "archive, range coded": 25_000, "standard, range coded": 25_000, "compact, range coded": 25_000,
    "archive, columns, Zstandard": 80_000, "standard, columns, Zstandard": 80_000,
    "compact, columns, Zstandard": 80_000,
    "archive, range coded by sets": 8_000, "standard, range coded by sets": 8_000,
    "compact, range coded by sets": 8_000,
    "archive, by sums": 8_000, "standard, by sums": 8_000, "compact, by sums": 8_000,
    "delta": 8_000, "flags": 10_000, "measured": 6_000, "tiles": 60_000, "mask": 90_000,
}  # fmt: skip
BOUND_BYTES = 64 << 20


def test_a_million_messages_are_tried() -> None:
    assert set(REPAIRED) == set(DECODERS) == {*LEFT_WRONG, "float32 columns"}
    assert sum(REPAIRED.values()) + sum(LEFT_WRONG.values()) >= 10**6


@pytest.mark.slow
@pytest.mark.parametrize(("name", "rounds"), LEFT_WRONG.items())
def test_damage_is_named(name: str, rounds: int) -> None:
    decoder, rng = DECODERS[name], Random(f"left wrong: {name}")
    found = sum(refused(decoder, damaged(rng, decoder.messages, FOREIGN)) for _ in range(rounds))
    assert 0.5 * rounds < found < rounds


@pytest.mark.slow
@pytest.mark.parametrize(("name", "rounds"), REPAIRED.items())
def test_damage_with_a_right_checksum_is_named_or_gives_gaussians(name: str, rounds: int) -> None:
    decoder, rng, found = DECODERS[name], Random(f"repaired: {name}"), 0
    accepted: deque[bytes] = deque(maxlen=50)
    for _ in range(rounds):
        body = decoder.repaired(damaged(rng, decoder.messages, FOREIGN))
        if refused(decoder, body):
            found += 1
        else:
            accepted.append(body)
    assert 0 < found < rounds
    _check_accepted(decoder, accepted)


def _check_accepted(decoder: Decoder, bodies: deque[bytes]) -> None:
    """What a tile's codec accepts, it can write and read again."""
    for codec in CODECS.values():
        if codec.name == decoder.name:
            for body in bodies:
                g = codec.decode(TILE, body)
                assert codec.decode(TILE, codec.encode(TILE, g)) == g


@pytest.mark.parametrize("name", DECODERS)
def test_every_prefix_of_a_message_is_refused(name: str) -> None:
    decoder = DECODERS[name]
    for message in decoder.messages[:4]:
        for length in range(len(message)):
            assert refused(decoder, message[:length]), f"{length} of {len(message)} bytes"


# --- sizes that are lies ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("claimed", FORGED)
@pytest.mark.parametrize("codec", [CODECS[i] for i in (0, 1, 5, 6, 7)], ids=lambda codec: codec.name)
def test_forty_bytes_that_claim_many_voxels(codec: Codec, claimed: int) -> None:
    body = struct.pack("<I", claimed).ljust(40, b"\1") if codec.codec_id == 0 else _claiming(codec, claimed)
    assert _peak_bytes(codec, SEOUL, body) < BOUND_BYTES


def _claiming(codec: Codec, claimed: int) -> bytes:
    """With a right checksum, and a Zstandard frame that says it holds as much as is claimed."""
    frame = bytes.fromhex("28b52ffd") + b"\xe0" + struct.pack("<Q", 21 * claimed) + bytes(19)
    return seal(codec.codec_id, SEOUL, claimed, frame)


@pytest.mark.parametrize("codec", [CODECS[i] for i in (2, 3, 4, 12)], ids=lambda codec: codec.name)
@pytest.mark.parametrize("floors", [1, 2, 3_000, 100_000, 2**31 - 1])
@pytest.mark.parametrize("lowest", [-(2**31) + 1, -(10**5), 0, 10**5, 2**31 - 1])
@pytest.mark.parametrize("tile", [SEOUL, ARCTIC, EQUATOR], ids=str)
def test_a_few_bytes_that_claim_many_floors(codec: Codec, floors: int, lowest: int, tile: TileId) -> None:
    assert codec.lattice is not None
    coder = Coder.writing(priors_of(f"tile-{codec.lattice.name}"), 64)
    k.code_bit(coder.state, number_at(0) + 69, 1)  # there are voxels
    coder.number(number_at(0), lowest)
    coder.number(number_at(3), floors - 1)
    for more in (b"", b"\xff" * 30, bytes(range(30))):
        body = coder.stream() + more
        body = bytes([len(body)]) + body + bytes(40) if codec.codec_id == CODEC_STANDARD_SUMS else body
        assert _peak_bytes(codec, tile, resealed(body + b"..")) < BOUND_BYTES


def _peak_bytes(codec: Codec, tile: TileId, body: bytes) -> int:
    """Most memory in use while a body is refused."""
    tracemalloc.start()
    try:
        with pytest.raises(CodecError):
            codec.decode(tile, body)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("codec", CODECS.values(), ids=lambda codec: codec.name)
def test_more_voxels_than_a_tile_may_hold_are_not_written(codec: Codec) -> None:
    n = MAX_VOXELS + 1
    g = Gaussians(
        np.arange(n, dtype=np.int32),
        np.full(n, 20, np.int32),
        np.full(n, 20, np.int32),
        np.zeros((n, 3), np.float32),
        np.zeros((n, 6), np.float32),
    )
    with pytest.raises(CodecError, match=str(n)):
        codec.encode(SEOUL, g)
