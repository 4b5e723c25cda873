"""Codec 0: golden bytes, round trips, and bytes that are none; content hashes."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gnd.gnd_map.codec import CODECS, MAX_VOXELS, codec_of, decode_gaussians, encode_gaussians
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile, content_sha
from gnd.gnd_map.tile_id import TileId

GOLDEN = bytes.fromhex(
    "02000000"  # two voxels
    "a4fdffff" "5c020000"  # voxel ids -604, 604
    "19000000" "e8030000"  # counts 25, 1000
    "14000000" "2a000000"  # cells 20, 42
    "0000003e" "000000bf"  # mean x 0.125, -0.5
    "000080be" "00000000"  # mean y -0.25, 0
    "0000003f" "0000803e"  # mean z 0.5, 0.25
    "0000803d" "0000803c"  # xx 0.0625, 0.015625
    "00000000" "000000bc"  # xy 0, -0.0078125
    "00000000" "00000000"  # xz
    "0000803d" "0000803c"  # yy
    "00000000" "00000000"  # yz
    "0000803a" "0000803d"  # zz 0.0009765625, 0.0625
)  # fmt: skip
GOLDEN_SHA = "a1a514b34c48f02fbca53ec439588af2b114f9cbdba0eab35ceab59224148e19"


def golden_gaussians() -> Gaussians:
    return Gaussians(
        np.array([-604, 604], np.int32),
        np.array([25, 1000], np.int32),
        np.array([20, 42], np.int32),
        np.array([[0.125, -0.25, 0.5], [-0.5, 0.0, 0.25]], np.float32),
        np.array([[0.0625, 0, 0, 0.0625, 0, 0.0009765625], [0.015625, -0.0078125, 0, 0.015625, 0, 0.0625]], np.float32),
    )


@st.composite
def gaussians(draw: st.DrawFn) -> Gaussians:
    ids = sorted(draw(st.sets(st.integers(-(2**31), 2**31 - 1), max_size=20)))
    n = len(ids)
    count = draw(hnp.arrays(np.int32, n, elements=st.integers(1, 2**31 - 1)))
    cells = draw(hnp.arrays(np.int32, n, elements=st.integers(0, 1000)))
    mean = draw(hnp.arrays(np.float32, (n, 3), elements=st.floats(-2.0, 2.0, width=32)))
    cov = draw(hnp.arrays(np.float32, (n, 6), elements=st.floats(-8.0, 8.0, width=32)))
    cov[:, [0, 3, 5]] = np.abs(cov[:, [0, 3, 5]])
    return Gaussians(np.array(ids, dtype=np.int32), count, cells, mean, cov)


def test_golden_bytes() -> None:
    assert encode_gaussians(golden_gaussians()) == GOLDEN
    assert decode_gaussians(GOLDEN) == golden_gaussians()


@given(gaussians())
def test_decoding_gives_back_every_bit(g: Gaussians) -> None:
    body = encode_gaussians(g)
    assert decode_gaussians(body) == g
    assert encode_gaussians(decode_gaussians(body)) == body
    assert len(body) == 4 + 48 * len(g)


def test_nothing_is_four_bytes() -> None:
    assert encode_gaussians(Gaussians.empty()) == b"\0\0\0\0"
    assert decode_gaussians(b"\0\0\0\0") == Gaussians.empty()


def test_decoded_columns_are_own_writable_contiguous_arrays() -> None:
    for column in decode_gaussians(GOLDEN).columns:
        assert column.flags.writeable
        assert column.flags.c_contiguous


def test_negative_zero_is_written_as_zero() -> None:
    g = golden_gaussians()
    g.mean_m[1, 1] = -0.0
    assert encode_gaussians(g) == GOLDEN


@pytest.mark.parametrize("length", range(len(GOLDEN)))
def test_truncated_bytes_are_refused(length: int) -> None:
    with pytest.raises(CodecError, match=str(length)):
        decode_gaussians(GOLDEN[:length])


def test_bytes_too_many_are_refused() -> None:
    with pytest.raises(CodecError, match="101 bytes, expected 100 for 2 voxels"):
        decode_gaussians(GOLDEN + b"\0")


def test_a_head_that_promises_too_much_is_refused_before_anything_is_read() -> None:
    with pytest.raises(CodecError, match=f"4294967295 voxels are more than the {MAX_VOXELS}"):
        decode_gaussians(b"\xff\xff\xff\xff")


@pytest.mark.parametrize(
    ("offset", "value", "message"),
    [
        (28, struct.pack("<f", np.nan), "not finite"),
        (28, struct.pack("<f", np.inf), "not finite"),
        (28, struct.pack("<f", 3.0), "means beyond"),
        (8, struct.pack("<i", -604), "strictly increasing"),
        (12, struct.pack("<i", -5), "negative counts"),
        (52, struct.pack("<f", -0.1), "negative variances"),
    ],
)
def test_values_that_are_no_gaussians_are_refused(offset: int, value: bytes, message: str) -> None:
    with pytest.raises(CodecError, match=message):
        decode_gaussians(GOLDEN[:offset] + value + GOLDEN[offset + 4 :])


@given(st.binary(max_size=200))
def test_noise_gives_gaussians_or_a_codec_error(noise: bytes) -> None:
    try:
        g = decode_gaussians(noise)
    except CodecError:
        return
    assert len(noise) == 4 + 48 * len(g)


def test_codecs_are_found_by_id() -> None:
    assert codec_of(0) is CODECS[0]
    assert codec_of(0).decode(TileId(0), codec_of(0).encode(TileId(0), golden_gaussians())) == golden_gaussians()
    with pytest.raises(CodecError, match="codec 14 is unknown; known: 0"):
        codec_of(14)


def test_the_content_hash_depends_on_tile_and_voxels_only() -> None:
    tile = Tile(TileId(497353963154), 1, golden_gaussians())
    assert tile.sha.hex() == GOLDEN_SHA
    assert Tile(tile.tile_id, 7, golden_gaussians()).sha == tile.sha
    assert Tile(TileId(497353963155), 1, golden_gaussians()).sha != tile.sha
    assert content_sha(tile.tile_id, golden_gaussians().take([0])) != tile.sha
