"""Point-cloud formats that the traffic study writes."""

import struct
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.gnd_map.tile_id import TileId
from studies.frame.errors import ReproduceError
from studies.traffic_study import clouds
from studies.traffic_study.clouds import (
    cloud_sizes,
    draco,
    laz,
    lzf_compress,
    lzf_decompress,
    pcd_binary,
    pcd_compressed,
)


def some_points(n: int = 500) -> Any:
    rng = np.random.default_rng(1)
    return (rng.uniform(0.0, 30.0, (n, 3)) * [1.0, 1.0, 0.01]).astype(np.float32)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(min_size=0, max_size=60), max_size=12), st.integers(1, 40))
def test_lzf_gives_back_what_it_packed(parts: list[bytes], times: int) -> None:
    data = b"".join(parts) * times
    assert lzf_decompress(lzf_compress(data), len(data)) == data


@pytest.mark.parametrize("data", [b"", b"a", bytes(100_000), bytes(range(256)) * 40, b"ab" * 20 + bytes(range(31))])
def test_lzf_packs_long_and_short_runs(data: bytes) -> None:
    packed = lzf_compress(data)
    assert lzf_decompress(packed, len(data)) == data
    assert len(packed) <= len(data) + len(data) // 32 + 2


def test_lzf_is_that_of_the_library() -> None:
    """Bytes that LibLZF 3.6's decompressor is specified to read: a literal run, a copy of 3, a copy of more than 8."""
    assert lzf_decompress(b"\x02abc\x20\x02", 6) == b"abcabc"
    assert lzf_decompress(b"\x00a\xe0\x03\x00", 13) == b"a" * 13
    assert lzf_decompress(lzf_compress(b"a" * 13), 13) == b"a" * 13


def test_pcd_files_hold_the_points() -> None:
    points = some_points()
    head, body = pcd_binary(points).split(b"DATA binary\n", 1)
    assert f"POINTS {len(points)}".encode() in head
    assert np.array_equal(np.frombuffer(body, "<f4").reshape(-1, 3), points)
    head, body = pcd_compressed(points).split(b"DATA binary_compressed\n", 1)
    packed, size = struct.unpack_from("<II", body)
    assert len(body) == packed + 8
    columns = np.frombuffer(lzf_decompress(body[8:], size), "<f4").reshape(3, -1)
    assert np.array_equal(columns.T, points)


def test_a_missing_library_leaves_a_row_that_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("laspy", "DracoPy"):
        monkeypatch.setitem(sys.modules, name, None)
    sizes = cloud_sizes({TileId(5): some_points()})
    assert sizes["pcd"] == len(pcd_binary(some_points()))
    assert "laspy" in str(sizes["laz"])
    assert "DracoPy" in str(sizes["draco"])
    with pytest.raises(ReproduceError, match="peers"):
        laz(some_points())


def test_laz_and_draco_hold_the_points_to_a_centimetre() -> None:
    laspy, draco_py = pytest.importorskip("laspy"), pytest.importorskip("DracoPy")
    pytest.importorskip("lazrs")
    import io

    points = some_points()
    with laspy.open(io.BytesIO(laz(points))) as file:
        read = file.read().xyz
    assert np.abs(read - points).max() <= clouds.LAZ_STEP_M / 2 + 1e-6
    body = draco(points)
    found = np.asarray(draco_py.decode(body).points)
    step_m = np.ptp(points, axis=0).max() / (2**clouds.DRACO_BITS - 1)
    assert len(found) == len(points)
    assert np.abs(np.sort(found, axis=0) - np.sort(points, axis=0)).max() <= step_m
    assert len(body) < len(pcd_binary(points)) / 2
