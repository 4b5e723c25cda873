import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.gnd_map.geodesy import LocalFrame
from studies.pcd import PcdCodecError, PcdError, PcdMap, PcdReport
from studies.pcd.points import cells_of
from studies.pcd.report import CODECS

GOLDEN = {
    "points": (
        "5043523100030000000200000002000000030000001500000000000000000000000000000028b52ffd200c61000007000000"
        "0100000024010000000080400000a0400000c03f000084400000a0400000c03f0000003f0000003f0000003f000000400000"
        "4040000080bf"
    ),
    "indexed": (
        "5043523101030000000200000002000000030000001500000000000000000000000000000028b52ffd200c61000007000000"
        "0100000024010000000080400000a0400000c03f000084400000a0400000c03f0000000002000000"
    ),
    "compact": (
        "504352310203000000020000000200000003000000150000002c000000390000001900000028b52ffd200c61000007000000"
        "01000000240100001b00000028b52ffd20129100000000020000000000000000000f030d0d000028b52ffd20084100000000"
        "000002000000"
    ),
}


def same(a: PcdReport, b: PcdReport) -> bool:
    return np.array_equal(a.deleted_index, b.deleted_index) and np.array_equal(a.observed, b.observed)


@pytest.mark.parametrize("codec", CODECS)
def test_reports_come_back(codec, cloud, reports):
    report = reports[0]
    back = PcdReport.decode(report.encode(codec, cloud), cloud)
    assert same(back, report)
    if codec != "compact":
        np.testing.assert_array_equal(back.new_points, report.new_points)
        return
    grid = cloud.grid_frame
    cells = [np.unique(cells_of(r.new_points.astype(float), grid), axis=0) for r in (back, report)]
    np.testing.assert_array_equal(*cells)
    order = [np.lexsort(np.round(r.new_points, 1).T) for r in (back, report)]
    assert len(order[0]) == len(order[1])
    distance = np.linalg.norm(back.new_points[:, None] - report.new_points[None, :2000], axis=2).min(axis=0)
    assert distance.max() < 0.006


def test_bytes_are_what_they_are_said_to_be(cloud, reports):
    r = reports[0]
    size = {codec: len(r.encode(codec, cloud)) for codec in CODECS}
    assert size["points"] - size["indexed"] == 8 * len(r.deleted_index)
    bare = PcdReport(r.new_points[:0], r.deleted_index[:0], r.observed, r.map_size)
    assert size["points"] - len(bare.encode()) == 12 * (len(r.new_points) + len(r.deleted_index))
    assert size["compact"] < size["indexed"] / 2


@pytest.mark.parametrize("codec", CODECS)
def test_bytes_written_once_stay_readable(codec):
    frame = LocalFrame(np.radians(37.5597), np.radians(127.04), 30.0)
    tiny = PcdMap(np.array([[0.5, 0.5, 0.5], [1.5, 0.25, 0.75], [2.0, 3.0, -1.0]], np.float32), frame)
    report = PcdReport.decode(bytes.fromhex(GOLDEN[codec]), tiny)
    np.testing.assert_allclose(report.new_points, [[4.0, 5.0, 1.5], [4.125, 5.0, 1.5]], atol=0.004)
    assert (report.deleted_index.tolist(), report.observed.tolist()) == ([0, 2], [7, 8, 300])
    if codec != "compact":
        assert report.encode(codec, tiny)[:29] == bytes.fromhex(GOLDEN[codec])[:29]


@pytest.mark.parametrize("codec", CODECS)
def test_an_empty_report_comes_back(codec, cloud):
    nothing = np.empty(0, np.int32)
    empty = PcdReport(np.empty((0, 3), np.float32), nothing, nothing, len(cloud))
    assert same(PcdReport.decode(empty.encode(codec, cloud), cloud), empty)


@pytest.mark.parametrize("codec", CODECS)
def test_every_truncation_is_refused(codec, cloud, reports):
    data = reports[0].encode(codec, cloud)
    for end in np.linspace(0, len(data) - 1, 60).astype(int):
        with pytest.raises(PcdCodecError):
            PcdReport.decode(data[:end], cloud)


@pytest.fixture(scope="module")
def encoded(cloud, reports):
    """A tenth of a report in each codec."""
    r = reports[1]
    few = PcdReport(r.new_points[::10], r.deleted_index[::10], r.observed[::10], r.map_size)
    return {codec: few.encode(codec, cloud) for codec in CODECS}


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_bytes_are_refused_or_read_as_a_valid_report(cloud, encoded, data):
    whole = bytearray(encoded[data.draw(st.sampled_from(CODECS))])
    whole[data.draw(st.integers(0, min(200, len(whole) - 1)))] ^= data.draw(st.integers(1, 255))
    try:
        PcdReport.decode(bytes(whole), cloud)
    except PcdCodecError:
        return


def test_what_unpacks_to_more_than_it_says_is_not_unpacked(cloud):
    nothing = np.empty(0, np.int32)
    data = PcdReport(np.empty((0, 3), np.float32), nothing, np.arange(4, dtype=np.int32), len(cloud)).encode()
    bomb = zstandard.ZstdCompressor(level=1).compress(bytes(10_000_000))
    head = bytearray(data[: len(data) - len(zstandard.ZstdCompressor(level=12).compress(bytes(16)))])
    with pytest.raises(PcdCodecError):
        PcdReport.decode(bytes(head) + bomb, cloud)


def test_a_report_about_another_map_is_refused(cloud, reports):
    other = PcdMap(cloud.points_m[:-1], cloud.frame)
    with pytest.raises(PcdCodecError, match=str(len(other))):
        PcdReport.decode(reports[0].encode(), other)
    with pytest.raises(PcdError, match="needs the map"):
        reports[0].encode("points", other)
    with pytest.raises(PcdError, match="unknown codec"):
        reports[0].encode("zip")  # type: ignore[arg-type]


def test_numbers_out_of_order_are_refused(cloud):
    empty, nothing = np.empty((0, 3), np.float32), np.empty(0, np.int32)
    with pytest.raises(PcdError, match="increase"):
        PcdReport(empty, np.array([3, 3], np.int32), nothing, 10)
    with pytest.raises(PcdError, match="increase"):
        PcdReport(empty, np.array([10], np.int32), nothing, 10)
