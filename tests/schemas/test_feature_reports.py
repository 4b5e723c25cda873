"""Reports about feature layers: round trips of any value, frozen bytes, and refusals that say what is wrong."""

import random
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from feature_values import (
    FEATURE_GOLDEN,
    SIGN_M,
    SURE_COV_M2,
    any_feature_report,
    any_found,
    any_seen,
    changed_report,
    feature_change,
    feature_report,
    found,
    is_on_levels,
    seen,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from schema_values import EAST, GOLDEN, SHA, TILE, report
from test_schema_fuzz import disturb, mutated

from gnd.gnd_map.features import Existence, encode_features
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas import limits
from gnd.schemas.changes import ChangeReport
from gnd.schemas.errors import BadValue, Malformed, SchemaError, TooLarge, WrongVersion
from gnd.schemas.features import EVERY_CELL, FeatureChange, FeatureReport, Found, Seen, cell_of, split_features
from gnd.schemas.generated import change_report_pb2
from gnd.schemas.packed import PackedReport, decode_upload

GOLDEN_DIR = Path(__file__).parent / "golden_features"
REPORT = FEATURE_GOLDEN["FeatureReport-two_tiles"]


def as_message(value: FeatureReport) -> change_report_pb2.ChangeReport:
    return change_report_pb2.ChangeReport.FromString(value.encode())


# Round trips


@given(any_feature_report())
@settings(max_examples=60)
def test_any_report_survives_and_is_the_same_bytes_again(value: FeatureReport) -> None:
    data = value.encode()
    arrived = FeatureReport.decode(data)
    assert arrived == value.snapped() == decode_upload(data)
    assert arrived.encode() == data
    assert arrived.snapped() == arrived


@given(any_seen(5), any_found())
@settings(max_examples=60)
def test_what_arrives_is_near_what_was_meant(one: Seen, other: Found) -> None:
    for before, after in (
        (one.as_feature(), one.snapped().as_feature()),
        (other.as_feature(1), other.snapped().as_feature(1)),
    ):
        assert np.abs(before.points_m - after.points_m).max() <= 0.0005 + 1e-12
        assert np.abs(np.subtract(before.existence.exist, after.existence.exist)) <= 0.5001e-4
        if before.cov_m2.any():
            assert is_on_levels(after.cov_m2)
            assert after.cov_m2[[0, 3, 5]] == pytest.approx(before.cov_m2[[0, 3, 5]], rel=0.2, abs=2e-6)


@pytest.mark.parametrize("name", FEATURE_GOLDEN)
def test_golden_bytes_and_values_agree(name: str) -> None:
    data = (GOLDEN_DIR / f"{name}.bin").read_bytes()
    assert FeatureReport.decode(data) == FEATURE_GOLDEN[name]
    assert FEATURE_GOLDEN[name].encode() == data


def test_every_golden_file_has_its_value() -> None:
    assert {path.stem for path in GOLDEN_DIR.iterdir()} == set(FEATURE_GOLDEN)


def test_one_key_takes_reports_of_voxels_and_of_features() -> None:
    values = [report(), GOLDEN["PackedReport-three_tiles"], GOLDEN["PackedGaussians-some"], REPORT]
    assert [decode_upload(value.encode()) for value in values] == values


def test_a_report_is_split_into_one_a_tile() -> None:
    parts = split_features(REPORT)
    assert [tile for tile, _ in parts] == [TILE, EAST]
    for (tile, data), change in zip(parts, REPORT.tiles, strict=True):
        assert FeatureReport.decode(data) == changed_report(REPORT, tiles=(change,))
        assert change.tile == tile


def test_fifty_judged_and_measured_features_take_forty_bytes_each() -> None:
    many = tuple(seen(feature_id=2**60 + number, position_m=SIGN_M[0] + 0.001 * number) for number in range(50))
    full = changed_report(REPORT, tiles=(feature_change(seen=many, found=()),))
    bare = changed_report(REPORT, tiles=(feature_change(seen=(), found=()),))
    assert len(full.encode()) - len(bare.encode()) < 50 * 40
    tiles = [type(TILE)(TILE.district.first_morton + k) for k in range(100)]
    looked = changed_report(REPORT, tiles=tuple(feature_change(tile, seen=(), found=()) for tile in tiles))
    assert len(looked.encode()) < 70 + len(REPORT.vehicle + REPORT.sensor_model + REPORT.software) + 55 * len(tiles)


# Cells


def test_cells_count_from_the_south_west_in_rows() -> None:
    (south, west), (north, east) = TILE.south_west_rad, TILE.north_east_rad
    at = lambda row, column: (south + (row + 0.5) / 8 * (north - south), west + (column + 0.5) / 8 * (east - west))  # noqa: E731
    assert [cell_of(TILE, *at(row, column)) for row in range(8) for column in range(8)] == list(range(64))
    assert cell_of(TILE, *at(8, 0)) is None
    assert cell_of(TILE, *at(0, -1)) is None
    assert sum(1 << cell for cell in range(64)) == EVERY_CELL


# What cannot be


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: found(points_m=np.empty((0, 3))), "found feature: .* has 0 points"),
        (lambda: found(points_m=np.array([[1.0, np.nan, 3.0]])), "1 of 3 values are not finite"),
        (lambda: found(points_m=SIGN_M[:, :2]), r"expected shape \(N, 3\), got \(1, 2\)"),
        (lambda: found(cov_m2=np.array([np.inf, 0, 0, 1, 0, 1.0])), "not finite"),
        (lambda: found(cov_m2=np.array([0.01, 0.5, 0, 0.01, 0, 1.0])), "eigenvalue -0.49"),
        (lambda: found(cov_m2=SURE_COV_M2[:3]), r"expected shape \(6,\)"),
        (lambda: found(kind="Speed limit"), "kind 'Speed limit'"),
        (lambda: found(attributes=(("b", ""), ("a", ""))), "not sorted"),
        (lambda: found(hits=-1), "-1 hits"),
        (lambda: seen(cov_m2=None), "go together"),
        (lambda: seen(position_m=None), "go together"),
        (lambda: seen(position_m=SIGN_M), r"expected shape \(3,\), got \(1, 3\)"),
        (lambda: seen(feature_id=0), "feature id 0"),
        (lambda: seen(feature_id=2**63), "feature id 9223372036854775808"),
        (lambda: seen(cov_m2=np.zeros(5)), r"expected shape \(6,\), got \(5,\)"),
        (lambda: feature_change(viewed=2**64), "viewed cells of tile .* 18446744073709551616 is outside"),
        (lambda: feature_change(viewed=-1), "-1 is outside"),
        (lambda: feature_change(base_sha=SHA[:31]), "31 bytes"),
        (lambda: feature_change(base_version=0), "0 and empty go together"),
        (lambda: feature_change(base_version=0, base_sha=b""), "judges 2 map features without a map"),
        (lambda: feature_change(seen=(seen(), seen())), "judges feature 4611686018427387909 after 4611686018427387909"),
        (lambda: feature_change(seen=(seen(), seen(feature_id=4))), "ascending, none twice"),
        (lambda: feature_change(found=(found(points_m=SIGN_M + np.array([40.0, 0, 0])),)), "lies 2[0-9.]+ m outside"),
        (lambda: feature_change(seen=(seen(position_m=SIGN_M[0] + np.array([0, 200.0, 0])),)), "lies 17[0-9.]+ m outs"),
        (lambda: feature_change(found=(found(points_m=SIGN_M + np.array([0, 0, 20_000])),)), "lies at heights 20031"),
        (lambda: feature_change(found=(found(), found(points_m=SIGN_M + 1e-4))), "traffic_sign 1 is the same as 0"),
        (lambda: feature_report(layer="ndt"), "layer 'ndt' holds Gaussians"),
        (lambda: feature_report(layer="ndt_winter"), "holds Gaussians"),
        (lambda: feature_report(layer="No"), "layer 'No' does not match"),
        (lambda: feature_report(vehicle="a/b"), "vehicle"),
        (lambda: feature_report(report_id="1"), "report id"),
        (lambda: feature_report(first_ns=2, last_ns=1), "after its end"),
        (lambda: feature_report(tiles=()), "has no tiles"),
        (lambda: feature_report(tiles=(feature_change(EAST), feature_change(TILE))), "ascending, none twice"),
        (lambda: feature_report(tiles=(feature_change(TILE), feature_change(TILE))), "ascending, none twice"),
        (lambda: feature_report(district=type(TILE.district)("00000/00000/00000")), "is not in district"),
    ],
)  # fmt: skip
def test_values_that_cannot_be_are_refused(make: Any, reason: str) -> None:
    with pytest.raises(SchemaError, match=reason):
        make()


def test_a_loop_and_a_crossing_of_what_is_no_lane_are_no_fault() -> None:
    eight = np.array([[0.0, 0, 0], [2, 2, 0], [2, 0, 0], [0, 2, 0]])
    assert found(kind="outline", points_m=eight).points_m is eight
    with pytest.raises(SchemaError, match="found road_border crosses itself: segments 0 and 2 of 3 meet"):
        found(kind="road_border", points_m=eight)
    square = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [0, 0, 0]])
    assert len(found(kind="lane_boundary", points_m=square).points_m) == 5


# Too much


def test_too_many_features_are_refused_by_their_number() -> None:
    one = Seen(1, Existence(0.5, 0.0, 0.5))
    with pytest.raises(TooLarge, match="has 4097 map features judged, the limit is 4096"):
        FeatureChange(TILE, 1, SHA, 0, (one,) * 4097)
    many = tuple(Seen(number, one.existence) for number in range(1, 4097))
    tiles = tuple(type(TILE)(TILE.district.first_morton + k) for k in range(5))
    with pytest.raises(TooLarge, match="has 20480 features, the limit is 4096"):
        feature_report(tiles=tuple(FeatureChange(tile, 1, SHA, 0, many) for tile in tiles))
    lines = tuple(found(kind=f"outline{number}", points_m=np.zeros((4096, 3))) for number in range(17))
    with pytest.raises(TooLarge, match="has 69632 points, the limit is 32768"):
        feature_report(tiles=(feature_change(found=lines),))


def test_a_million_detections_in_one_message_are_refused_before_they_are_parsed() -> None:
    message = as_message(REPORT)
    change = message.features.tiles[0]
    change.seen_id.extend(range(1, 1_000_001))
    huge = message.SerializeToString()
    assert len(huge) > 7_900_000
    tracemalloc.start()
    for decode in (decode_upload, FeatureReport.decode):
        with pytest.raises(TooLarge, match=r"has [0-9]+ bytes, the limit is 1048576|exceeds the limit of"):
            decode(huge)
    assert tracemalloc.get_traced_memory()[1] < 20_000_000
    tracemalloc.stop()


def test_a_million_empty_tiles_are_refused_before_they_are_parsed() -> None:
    empties = b"\x4a\x00" * 500_000  # field 9, length 0
    data = b"\x08\x01\x6a" + varint(len(empties)) + empties
    with pytest.raises(TooLarge, match="FeatureReport of 1000000 bytes has more than 1088 fields"):
        decode_upload(data)


def test_many_reports_in_one_message_do_not_become_a_large_one() -> None:
    some = b"\x6a" + varint(2_000) + b"\x4a\x00" * 1_000
    with pytest.raises(TooLarge, match="ChangeReport has 2 reports of features, the limit is 1"):
        decode_upload(b"\x08\x01" + some * 400)


def test_a_report_larger_than_a_reader_takes_is_not_sent() -> None:
    long = found(attributes=tuple((f"{number:03}", f"{number:03}" * 300) for number in range(200)))
    tiles = tuple(type(TILE)(TILE.district.first_morton + k) for k in range(6))
    with pytest.raises(TooLarge, match="exceeds the limit of 1048576 bytes"):
        feature_report(tiles=tuple(feature_change(tile, found=(long,)) for tile in tiles)).encode()


def varint(number: int) -> bytes:
    out = bytearray()
    while number >= 0x80:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*out, number])


# Bytes


def test_a_reader_of_one_form_names_the_form_that_came() -> None:
    with pytest.raises(BadValue, match="only a whole report is read"):
        ChangeReport.decode(REPORT.encode())
    with pytest.raises(BadValue, match="no first half of a report but a FeatureReport"):
        PackedReport.decode(REPORT.encode())
    with pytest.raises(BadValue, match=r"are no FeatureReport but a ChangeReport of .*vehicle"):
        FeatureReport.decode(report().encode())


@pytest.mark.parametrize("field", ["report_id", "vehicle", "layer", "district", "packed"])
def test_two_forms_in_one_message_are_refused(field: str) -> None:
    both = as_message(REPORT)
    if field == "packed":
        both.packed.vehicle = "x"
    else:
        setattr(both, field, "x")
    for decode in (decode_upload, FeatureReport.decode):
        with pytest.raises(BadValue, match=f"also (features|{field})|ChangeReport of {field}"):
            decode(both.SerializeToString())


def test_another_major_version_is_refused() -> None:
    message = as_message(REPORT)
    message.major = 2
    with pytest.raises(WrongVersion, match="FeatureReport of major version 2"):
        decode_upload(message.SerializeToString())


def unmake(change: Any, field: str, value: Any) -> None:
    if isinstance(value, list):
        del getattr(change, field)[:]
        getattr(change, field).extend(value)
    else:
        setattr(change, field, value)


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("seen_id", [1], "1 map features judged, 1 of them measured, come with 6 masses"),
        ("seen_id", [9, 9], "judges feature 9 after 9"),
        ("seen_id", [0, 9], "feature id 0"),
        ("seen_masses", [1, 2, 3, 9000, 1001, 0], "masses 9000, 1001 and conflict 0 exceed 10000"),
        ("seen_masses", [1, 2, 3], "come with 3 masses"),
        ("seen_hits", [1, 2**31], "2147483648 hits"),
        ("measured", [2], r"measured features \[2\] are not ascending indices of the 2 judged"),
        ("measured_mm", [1, 2], "2 coordinates"),
        ("measured_mm", [2**31 - 1, 0, 0], "a point 2147484 m from its tile"),
        ("measured_levels", [1, 2, 3, 4, 5], "5 levels"),
        ("measured_levels", [256, 2, 3, 4, 5, 6], "levels .* of a covariance"),
        ("measured_levels", [1, 2, 3, 4, 5, -16_001], "levels .* of a covariance"),
        ("measured_levels", [255, 255, 255, 16_000, 16_000, 16_000], "exceeds 60000"),
        ("found", b"\x01", "encoded features: 1 bytes"),
        ("found", encode_features([found().snapped().as_feature(2)]), "not numbered 1, 2, 3"),
        ("found", encode_features([]), "0 features found"),
        ("tile", 2**39, "tile id"),
        ("base_sha", b"abc", "3 bytes"),
    ],
)
def test_columns_that_cannot_be_are_refused(field: str, value: Any, reason: str) -> None:
    message = as_message(REPORT)
    unmake(message.features.tiles[0], field, value)
    with pytest.raises(SchemaError, match=reason):
        decode_upload(message.SerializeToString())


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [("report_id", b"1", "1 bytes, expected 16"), ("district", "1/2", "no district"), ("length_ns", 2**63, "last_ns")],
)
def test_heads_that_cannot_be_are_refused(field: str, value: Any, reason: str) -> None:
    message = as_message(REPORT)
    setattr(message.features, field, value)
    with pytest.raises(SchemaError, match=reason):
        decode_upload(message.SerializeToString())


def accepted(data: bytes) -> bool:
    """Whether it is a report; whatever it is, nothing but a SchemaError may come of it."""
    try:
        value = decode_upload(data)
    except SchemaError:
        return False
    assert decode_upload(value.encode()) == value
    return True


@pytest.mark.parametrize("name", FEATURE_GOLDEN)
def test_every_truncation_is_refused(name: str) -> None:
    data = FEATURE_GOLDEN[name].encode()
    for end in range(3, len(data)):
        with pytest.raises(Malformed):
            decode_upload(data[:end])


@given(st.binary(max_size=300))
def test_random_bytes(data: bytes) -> None:
    accepted(data)
    accepted(b"\x08\x01\x6a" + varint(len(data)) + data)


@pytest.mark.parametrize("name", FEATURE_GOLDEN)
def test_mutated_bytes(name: str) -> None:
    rng = random.Random(name)
    data = FEATURE_GOLDEN[name].encode()
    assert accepted(data)
    refused = sum(not accepted(mutated(data, rng)) for _ in range(400))
    assert refused > 200


def test_sound_encodings_of_unsound_values() -> None:
    rng = random.Random(6)
    refused = 0
    for _ in range(300):
        message = as_message(REPORT)
        for _ in range(rng.randint(1, 2)):
            disturb(message.features, rng)
        refused += not accepted(message.SerializeToString())
    assert refused > 60, "the fuzz hardly disturbs anything"


def test_the_frame_of_a_report_is_that_of_its_tile() -> None:
    lat, lon, height = LocalFrame.of_tile(TILE).geodetic_from_enu(SIGN_M)
    cell = cell_of(TILE, float(lat[0]), float(lon[0]))
    assert cell == 2 * 8 + 5
    assert float(height[0]) == pytest.approx(31.062, abs=0.01)
    assert limits.MAX_FOUND_OUTSIDE_M < limits.MAX_SEEN_OUTSIDE_M
