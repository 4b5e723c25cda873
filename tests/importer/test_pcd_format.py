"""PCD files in all three encodings, and files that only claim to be."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lzf_testing import lzf_compress

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.pcd_format import _lzf_decompress, read_pcd

HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z intensity stamp
SIZE 4 4 4 1 8
TYPE F F F U F
COUNT 1 1 1 1 1
WIDTH {n}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {n}
DATA {data}
"""
DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("stamp", "<f8")])
POINTS = np.array([(1.5, -2.25, 0.125, 7, 1223328152.25), (0.0, 3.0, -1.0, 255, 0.5), (9.0, 9.0, 9.0, 0, -1.0)], DTYPE)


def body(data: str, points: np.ndarray = POINTS) -> bytes:
    if data == "ascii":
        return "".join(" ".join(repr(value.item()) for value in point) + "\n" for point in points).encode()
    if data == "binary":
        return points.tobytes()
    columns = b"".join(points[name].tobytes() for name in points.dtype.names)
    packed = lzf_compress(columns)
    return np.array([len(packed), len(columns)], "<u4").tobytes() + packed


def write(path, data="binary", header=HEADER, content=None):
    path.write_bytes(header.format(n=len(POINTS), data=data).encode() + (body(data) if content is None else content))
    return path


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_every_encoding_gives_the_same_points(tmp_path, data):
    np.testing.assert_array_equal(read_pcd(write(tmp_path / "a.pcd", data)), POINTS)


@given(
    st.one_of(st.binary(max_size=300), st.lists(st.sampled_from([b"ab", b"aaaa", b"\0" * 40, b"xyz"])).map(b"".join))
)
def test_lzf_gives_back_what_was_compressed(data):
    out = np.zeros(len(data), np.uint8)
    packed = np.frombuffer(lzf_compress(data), np.uint8)
    assert _lzf_decompress(packed, out) == len(data)
    assert out.tobytes() == data


@given(st.binary(min_size=1, max_size=200))
def test_lzf_of_anything_stays_inside_its_buffers(data):
    out = np.zeros(64, np.uint8)
    assert -1 <= _lzf_decompress(np.frombuffer(data, np.uint8), out) <= 64


def test_lzf_golden_bytes():
    """'a' once, then 263 bytes copied from one back: control 0xE0, length 254 + 9, offset 0."""
    out = np.zeros(264, np.uint8)
    packed = np.array([0x00, ord("a"), 0xE0, 254, 0x00], np.uint8)
    assert _lzf_decompress(packed, out) == 264
    assert out.tobytes() == b"a" * 264


def test_fields_with_a_count_keep_their_shape(tmp_path):
    header = HEADER.replace("COUNT 1 1 1 1 1", "COUNT 1 1 1 3 1").replace("intensity", "rgb")
    dtype = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "u1", (3,)), ("stamp", "<f8")])
    points = np.zeros(3, dtype)
    points["rgb"] = np.arange(9).reshape(3, 3)
    for data in ("binary", "binary_compressed"):
        found = read_pcd(write(tmp_path / f"{data}.pcd", data, header, body(data, points)))
        np.testing.assert_array_equal(found, points)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no header at all\n" * 3, "no line DATA"),
        (b"FIELDS x y z\nDATA ascii\n1 2 3\n", "without a usable 'SIZE'"),
        (HEADER.format(n=-1, data="ascii").encode(), "POINTS -1"),
        (HEADER.format(n=30_000_000, data="binary").encode(), "POINTS 30000000"),
        (HEADER.format(n=3, data="zip").encode(), "DATA zip"),
        (HEADER.format(n=3, data="binary").encode() + b"short", "5 bytes of points, 63 announced"),
        (HEADER.format(n=3, data="ascii").encode() + b"1 2 3 4 5\n", "1 points, 3 announced"),
        (HEADER.format(n=3, data="ascii").encode() + b"1 2 x 4 5\n", "could not convert"),
        (HEADER.format(n=3, data="binary_compressed").encode() + b"1234", "ends before"),
        (HEADER.format(n=3, data="binary_compressed").encode() + bytes(8), "0 uncompressed, 63 announced"),
        (HEADER.replace("SIZE 4", "SIZE 3").format(n=3, data="ascii").encode(), "TYPE F of SIZE 3"),
    ],
)
def test_broken_files_are_named_with_numbers(tmp_path, content, message):
    path = tmp_path / "broken.pcd"
    path.write_bytes(content)
    with pytest.raises(ImportDriveError, match=r"broken\.pcd") as caught:
        read_pcd(path)
    assert message in str(caught.value)


def test_damaged_compressed_points_are_told(tmp_path):
    content = bytearray(body("binary_compressed"))
    content[8] = 0xFF  # a copy from before the beginning
    with pytest.raises(ImportDriveError, match="damaged"):
        read_pcd(write(tmp_path / "a.pcd", "binary_compressed", content=bytes(content)))


def test_a_real_file_reads(shared_data):
    points = read_pcd(shared_data / "apollo_ndt" / "pcds" / "1.pcd")
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1)
    assert len(points) == 99_305
    assert np.isfinite(xyz).all()
    assert 20.0 < np.abs(xyz).max() < 120.0
    assert np.corrcoef(np.arange(len(points)), points["timestamp"])[0, 1] > 0.999  # firing order
