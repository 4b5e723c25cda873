"""Codecs 1, 5, 6, 7: their layout by hand, and frames that lie."""

import struct
import zlib

import numpy as np
import pytest
import zstandard
from codec_samples import KARLSRUHE, SEOUL, street

from gnd.gnd_map.codec import CODECS, LATTICES, snap
from gnd.gnd_map.codec.lattice import integers_of
from gnd.gnd_map.codec.zstd_columns import MAX_WINDOW_BYTES, seal
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.gaussian import Gaussians

FLOATS = CODECS[1]
STREET = street(SEOUL, np.random.default_rng(11), 60)
N = len(STREET)


FLOATS_CONTENT = zstandard.ZstdDecompressor().decompressobj().decompress(FLOATS.encode(SEOUL, STREET)[8:])


def planes_of(body: bytes, width: int) -> np.ndarray:
    """(width, N) uint8 by nothing but the documented layout."""
    n, _ = struct.unpack_from("<II", body)
    content = zstandard.ZstdDecompressor().decompressobj().decompress(body[8:])
    return np.frombuffer(content, np.uint8).reshape(width, n)


def unzigzag(values: np.ndarray) -> np.ndarray:
    return np.where(values % 2 == 0, values // 2, -(values + 1) // 2)


def test_the_layout_of_float_columns_is_as_documented() -> None:
    body = FLOATS.encode(SEOUL, STREET)
    n, checksum = struct.unpack_from("<II", body)
    head = bytes([1]) + SEOUL.morton.to_bytes(8, "little") + struct.pack("<I", n)
    assert checksum == zlib.crc32(head + body[8:])
    columns = [planes_of(body, 48)[at : at + 4].T.tobytes() for at in range(0, 48, 4)]
    steps = np.frombuffer(columns[0], "<u4").astype(np.int64)
    ids = np.cumsum(np.concatenate([unzigzag(steps[:1]), steps[1:]]))
    assert np.array_equal(ids, STREET.voxel_id)
    assert np.array_equal(np.frombuffer(columns[1], "<i4"), STREET.count)
    assert np.array_equal(np.frombuffer(columns[2], "<i4"), STREET.cells)
    floats = np.stack([np.frombuffer(column, "<f4") for column in columns[3:]], axis=1)
    assert np.array_equal(floats, np.hstack([STREET.mean_m, STREET.cov_m2]))


@pytest.mark.parametrize(("codec_id", "name"), [(5, "archive"), (6, "standard"), (7, "compact")])
def test_the_layout_of_lattice_columns_is_as_documented(codec_id: int, name: str) -> None:
    g = snap(STREET, LATTICES[name])
    q, rows = integers_of(g, LATTICES[name]), planes_of(CODECS[codec_id].encode(SEOUL, g), 21).astype(np.int64)
    assert np.array_equal(rows[4], q.axis)
    assert np.array_equal(rows[5:8].T, q.level)
    wide = unzigzag(rows[8:20:2] + 256 * rows[9:20:2])
    assert np.array_equal(wide[:3].T, q.slope)
    assert np.array_equal(wide[3:].T, q.step)
    assert np.array_equal(rows[20], q.count)


def test_voxel_ids_at_both_ends() -> None:
    ids = np.array([-(2**31), -1, 0, 2**31 - 1], np.int32)
    _, count, cells, mean, cov = STREET.take([0, 1, 2, 3]).columns
    g = Gaussians(ids, count, cells, mean, cov)
    assert FLOATS.decode(KARLSRUHE, FLOATS.encode(KARLSRUHE, g)) == g


def test_negative_zero_is_written_as_zero() -> None:
    g, negative = (STREET.take([0]) for _ in range(2))
    g.mean_m[0, 0], negative.mean_m[0, 0] = 0.0, -0.0
    assert FLOATS.encode(SEOUL, g) == FLOATS.encode(SEOUL, negative)


@pytest.mark.parametrize("codec_id", [1, 5, 6, 7])
def test_bytes_of_another_codec_are_refused(codec_id: int) -> None:
    for other in {0, 1, 2, 3, 4, 5, 6, 7} - {codec_id}:
        codec = CODECS[other]
        body = codec.encode(SEOUL, snap(STREET, codec.lattice) if codec.lattice else STREET)
        with pytest.raises(CodecError):
            CODECS[codec_id].decode(SEOUL, body)


# --- frames that lie, under a right checksum --------------------------------------------------------------------------


def refusal(n: int, frame: bytes) -> str:
    with pytest.raises(CodecError) as caught:
        FLOATS.decode(SEOUL, seal(1, SEOUL, n, frame))
    return str(caught.value)


def test_a_bomb_is_not_unpacked() -> None:
    said = zstandard.ZstdCompressor(level=19).compress(bytes(50_000_000))
    assert f"frame of 50000000 bytes, expected {48 * N}" in refusal(N, said)
    unsaid = zstandard.ZstdCompressor(level=19, write_content_size=False).compress(bytes(50_000_000))
    assert len(unsaid) < 5_000
    assert "did not decompress full frame" in refusal(N, unsaid)


def test_a_frame_that_holds_less_is_refused() -> None:
    frame = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(48 * (N - 1)))
    assert f"frame of {48 * (N - 1)} bytes, expected {48 * N}" in refusal(N, frame)


def test_what_follows_a_frame_is_refused() -> None:
    frame = zstandard.ZstdCompressor().compress(FLOATS_CONTENT)
    assert refusal(N, frame + b"x")
    assert refusal(N, frame + frame)
    assert "2 bytes follow a head of 0 voxels" in refusal(0, b"xy")


def test_a_window_beyond_the_limit_is_refused() -> None:
    wide = zstandard.ZstdCompressionParameters(window_log=27, write_content_size=0)
    streamed = zstandard.ZstdCompressor(compression_params=wide).compressobj()
    frame = streamed.compress(FLOATS_CONTENT) + streamed.flush()
    assert f"window of {1 << 27} bytes, at most {MAX_WINDOW_BYTES}" in refusal(N, frame)


def test_frames_that_are_none_are_refused() -> None:
    for noise in (b"", b"\x28\xb5\x2f\xfd", b"\0" * 40, b"\x50\x2a\x4d\x18\x04\0\0\0abcd", FLOATS_CONTENT[:100]):
        assert "Zstandard frame" in refusal(N, noise)


@pytest.mark.parametrize(
    ("rows", "value", "message"),
    [
        (slice(0, 4), 0, "do not increase"),  # differences of ids
        (3, 255, "do not increase within 32 bits"),
        (7, 255, "negative counts"),
        (15, 0x7F, "not finite|means beyond"),  # mean x
        (27, 0xFF, "not finite|negative variances"),  # cov xx
    ],
)
def test_values_that_are_no_gaussians_are_refused(rows: int | slice, value: int, message: str) -> None:
    planes = np.frombuffer(FLOATS_CONTENT, np.uint8).reshape(48, N).copy()
    planes[rows, 1:] = value
    with pytest.raises(CodecError, match=message):
        FLOATS.decode(SEOUL, seal(1, SEOUL, N, zstandard.ZstdCompressor().compress(planes.tobytes())))
