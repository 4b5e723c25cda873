"""Features: existence against plain enumeration, lattice, codec, deltas, polylines cut and joined."""

import zlib
from contextlib import suppress
from itertools import product

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gnd.gnd_map.errors import CodecError, DeltaError, FeatureError
from gnd.gnd_map.features import (
    CUT_END,
    CUT_START,
    VACUOUS,
    Existence,
    Feature,
    FeatureTile,
    apply_features,
    check_simple_polyline,
    combine,
    cut_polyline,
    decode_feature_delta,
    decode_features,
    diff_features,
    encode_feature_delta,
    encode_features,
    feature_id_of,
    full_covariance,
    geodetic_in_tile,
    hit,
    is_feature_layer,
    join_pieces,
    miss,
    pieces_of,
    points_in_tile,
    prior,
    six_of,
    snapped,
    snapped_covariance,
)
from gnd.gnd_map.features.covariance import covariance_of, levels_of
from gnd.gnd_map.tile_id import TILE_RAD, TileId

TILE = TileId.from_path("13033/03021/23031/22102")
COV = np.array([0.04, 0.01, 0.0, 0.09, 0.0, 1e4])
HYPOTHESES = (frozenset("E"), frozenset("A"), frozenset("EA"))


def sign(number: int = 1, x: float = 1.2344, **more: object) -> Feature:
    values: dict[str, object] = {
        "feature_id": feature_id_of("sign", number),
        "kind": "traffic_sign",
        "points_m": np.array([[x, -3.5, 31.25]]),
        "cov_m2": COV,
        "existence": hit(0.9),
        "attributes": (("type", "274-50"), ("värde", "50 km/h")),
        "hits": 17,
        "vehicles": 3,
    }
    return Feature(**(values | more))  # type: ignore[arg-type]


masses = st.tuples(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1)).filter(lambda m: sum(m) > 0.1)


def existence(m: tuple[float, float, float]) -> Existence:
    total = sum(m)
    return Existence(m[0] / total, m[1] / total, 1 - m[0] / total - m[1] / total)


def enumerated(one: Existence, other: Existence) -> tuple[float, float, float, float]:
    """Eq. (6)-(7) of SLAMCU over the power set, word for word."""
    a = dict(zip(HYPOTHESES, (one.exist, one.absent, one.unknown), strict=True))
    b = dict(zip(HYPOTHESES, (other.exist, other.absent, other.unknown), strict=True))
    conjunctive: dict[frozenset[str], float] = {}
    for left, right in product(HYPOTHESES, HYPOTHESES):
        conjunctive[left & right] = conjunctive.get(left & right, 0.0) + a[left] * b[right]
    phi = conjunctive.get(frozenset(), 0.0)
    assume(phi <= 0.999)  # of a conflict that is all but total nothing is left to share out
    return (*(conjunctive[h] / (1 - phi) for h in HYPOTHESES), phi)  # type: ignore[return-value]


@given(masses, masses)
def test_dempsters_rule_equals_enumeration_of_the_power_set(one: tuple[float, ...], other: tuple[float, ...]) -> None:
    a, b = existence(one), existence(other)  # type: ignore[arg-type]
    exist, absent, unknown, phi = enumerated(a, b)
    combined = a.combined(b)
    assert (combined.exist, combined.absent, combined.unknown) == pytest.approx((exist, absent, unknown), abs=1e-9)
    assert combined.conflict == pytest.approx(phi, abs=1e-12)


@given(st.lists(st.booleans(), max_size=20))
def test_the_order_of_looks_does_not_matter(looks: list[bool]) -> None:
    def fused(order: list[bool]) -> Existence:
        state = VACUOUS
        for seen in order:
            state = state.combined(hit(0.6) if seen else miss(0.6))
        return state

    one, other = fused(looks), fused(sorted(looks))
    assert (one.exist, one.absent, one.conflict) == pytest.approx((other.exist, other.absent, other.conflict), abs=1e-9)


def test_a_map_feature_that_is_not_seen_becomes_absent_and_back() -> None:
    state = prior(0.95)
    assert state.state == "exist"
    for _ in range(3):
        state = state.combined(miss(0.9))
    assert state.state == "absent"
    assert state.conflict > 0.8
    for _ in range(5):
        state = state.combined(hit(0.9))
    assert state.state == "exist"
    assert VACUOUS.state == "unknown"


def test_combine_takes_many_at_once() -> None:
    rows = combine(np.array([[0.5, 0.2, 0.3, 0.0], [0.0, 0.0, 1.0, 0.1]]), np.array([0.9, 0.0, 0.1, 0.0]))
    for row, start in zip(rows, (Existence(0.5, 0.2, 0.3), Existence(0.0, 0.0, 1.0, 0.1)), strict=True):
        one = start.combined(hit(0.9))
        assert row.tolist() == pytest.approx([one.exist, one.absent, one.unknown, one.conflict])


def test_discounting_moves_mass_to_the_unknown() -> None:
    weaker = Existence(0.8, 0.1, 0.1).discounted(0.5)
    assert (weaker.exist, weaker.absent, weaker.unknown) == pytest.approx((0.4, 0.05, 0.55))
    with pytest.raises(FeatureError, match="reliability"):
        VACUOUS.discounted(1.5)


def test_certain_contradiction_is_refused_and_so_are_masses_that_do_not_sum_to_one() -> None:
    with pytest.raises(FeatureError, match="contradict"):
        Existence(1.0, 0.0, 0.0).combined(Existence(0.0, 1.0, 0.0))
    with pytest.raises(FeatureError, match="sum to"):
        Existence(0.5, 0.2, 0.2)


# The lattice

factors = st.lists(st.floats(-3, 3), min_size=6, max_size=6)


def covariance(values: list[float]) -> np.ndarray:
    L = np.zeros((3, 3))
    L[np.tril_indices(3)] = values
    return six_of(L @ L.T + 1e-6 * np.eye(3))


@given(factors)
def test_snapping_a_covariance_twice_changes_nothing(values: list[float]) -> None:
    once = snapped_covariance(covariance(values))
    assert np.array_equal(snapped_covariance(once), once)
    assert np.linalg.eigvalsh(full_covariance(once))[0] > 0


@given(st.tuples(*[st.integers(0, 255)] * 3, *[st.integers(-400, 400)] * 3))
def test_every_lattice_point_is_found_again(levels: tuple[int, int, int, int, int, int]) -> None:
    cov = covariance_of(levels)
    if np.isfinite(cov).all():
        assert levels_of(cov) == levels


@given(factors)
def test_snapping_keeps_standard_deviations_to_a_few_per_cent(values: list[float]) -> None:
    before, after = full_covariance(covariance(values)), full_covariance(snapped_covariance(covariance(values)))
    ratio = np.sqrt(np.diag(after) / np.diag(before))
    assert ((ratio > 0.93) & (ratio < 1.07)).all()


def test_a_singular_covariance_gets_a_millimetre() -> None:
    assert full_covariance(snapped_covariance(np.zeros(6)))[2, 2] == pytest.approx(1e-6)


# Features


def test_bad_features_are_refused_with_numbers() -> None:
    with pytest.raises(FeatureError, match="0 points"):
        sign(points_m=np.empty((0, 3)))
    with pytest.raises(Exception, match="not finite"):
        sign(points_m=np.array([[np.nan, 0.0, 0.0]]))
    with pytest.raises(FeatureError, match="eigenvalue"):
        sign(cov_m2=np.array([0.04, 0.5, 0.0, 0.09, 0.0, 1.0]))
    with pytest.raises(FeatureError, match="variance"):
        sign(cov_m2=np.array([1e6, 0.0, 0.0, 0.09, 0.0, 1.0]))
    with pytest.raises(FeatureError, match="not sorted"):
        sign(attributes=(("b", "1"), ("a", "2")))
    with pytest.raises(FeatureError, match="kind"):
        sign(kind="Traffic Sign")
    with pytest.raises(FeatureError, match="feature id"):
        sign(feature_id=0)
    with pytest.raises(FeatureError, match="m from its tile"):
        sign(points_m=np.array([[3e4, 0.0, 0.0]]))


def test_layers_are_told_by_their_name() -> None:
    assert [is_feature_layer(layer) for layer in ("signs", "anything", "ndt", "ndt_winter")] == [
        True,
        True,
        False,
        False,
    ]


kinds = st.sampled_from(["traffic_sign", "pole", "lane_boundary"])
coordinates = st.floats(-25, 25, allow_nan=False)
features = st.builds(
    lambda number, kind, points, cov, seen, part, text: snapped(
        Feature(number, kind, np.array(points), covariance(cov), hit(seen), (("note", text),) if text else (), part)
    ),
    st.integers(1, 2**63 - 1),
    kinds,
    st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=1, max_size=5),
    factors,
    st.floats(0, 1),
    st.integers(0, 3),
    st.text(max_size=5),
)
tiles = st.lists(features, max_size=6, unique_by=lambda f: f.key).map(
    lambda found: tuple(sorted(found, key=lambda f: f.key))
)


@given(tiles)
def test_features_survive_the_codec_to_the_bit(found: tuple[Feature, ...]) -> None:
    body = encode_features(found)
    assert decode_features(body) == found
    assert encode_features(decode_features(body)) == body


@given(tiles, tiles)
def test_a_delta_makes_the_new_features_of_the_old(old: tuple[Feature, ...], new: tuple[Feature, ...]) -> None:
    assert apply_features(old, diff_features(old, new)) == new
    assert decode_feature_delta(old, encode_feature_delta(old, new)) == new


@given(st.binary(max_size=60))
def test_anything_else_is_refused_by_name(body: bytes) -> None:
    with pytest.raises(CodecError):
        decode_features(body)


@settings(max_examples=300)
@given(st.data())
def test_damaged_bytes_with_a_right_checksum_are_refused_or_other_features(data: st.DataObject) -> None:
    body = bytearray(encode_features(FeatureTile.of(TILE, 1, [sign(1), sign(2)]).features)[:-4])
    for _ in range(data.draw(st.integers(1, 3))):
        body[data.draw(st.integers(1, len(body) - 1))] = data.draw(st.integers(0, 255))
    mended = bytes(body) + zlib.crc32(body).to_bytes(4, "little")
    with suppress(CodecError):
        assert all(isinstance(one, Feature) for one in decode_features(mended))


def test_the_bytes_of_two_signs_are_frozen() -> None:
    tile = FeatureTile.of(TILE, 3, [sign(2, x=-7.0, part=0), sign(1)])
    body = encode_features(tile.features)
    assert body.hex() == GOLDEN
    assert tile.sha == FeatureTile.of(TILE, 9, reversed(tile.features)).sha


def test_a_tile_refuses_features_off_the_lattice_unsorted_or_twice() -> None:
    with pytest.raises(FeatureError, match="not snapped"):
        FeatureTile(TILE, 1, (sign(),))
    with pytest.raises(CodecError, match="comes twice"):
        FeatureTile.of(TILE, 1, [sign(), sign()])


def test_a_delta_that_does_not_fit_is_refused() -> None:
    one, other = FeatureTile.of(TILE, 1, [sign(1)]).features, FeatureTile.of(TILE, 1, [sign(2)]).features
    with pytest.raises(DeltaError, match="absent"):
        decode_feature_delta((), encode_feature_delta(one, other))
    with pytest.raises(CodecError):
        decode_feature_delta(one, encode_feature_delta(one, other)[:-1])


# Polylines


def walk(seed: int, n: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    lat, lon = TILE.centre_rad
    steps = rng.normal(0.0, 0.3 * TILE_RAD, (n, 2))
    return lat + np.cumsum(steps[:, 0]), lon + np.cumsum(steps[:, 1]), rng.normal(30.0, 1.0, n)


@pytest.mark.parametrize("seed", range(20))
def test_a_polyline_cut_at_borders_joins_to_the_same(seed: int) -> None:
    lat, lon, height = walk(seed)
    feature = sign(points_m=np.zeros((2, 3)), kind="lane_boundary")
    pieces = [(tile, snapped(piece)) for tile, piece in pieces_of(feature, lat, lon, height)]
    assert len(pieces) > 3
    got = join_pieces(pieces[::-1])
    assert [len(column) for column in got] == [len(lat)] * 3
    metres = np.abs(np.column_stack([(got[0] - lat) * 6.4e6, (got[1] - lon) * 6.4e6, got[2] - height]))
    assert metres.max() < 1.5e-3


@pytest.mark.parametrize("seed", range(5))
def test_each_piece_lies_in_its_tile(seed: int) -> None:
    for tile, points, _ in cut_polyline(*walk(seed)):
        lat, lon, _ = geodetic_in_tile(tile, points)
        (south, west), (north, east) = tile.south_west_rad, tile.north_east_rad
        slack = 1e-9 * TILE_RAD + 1e-15
        assert ((lat >= south - slack) & (lat <= north + slack)).all()
        assert ((lon >= west - slack) & (lon <= east + slack)).all()


def test_cuts_are_marked_and_a_vertex_on_a_border_is_not() -> None:
    (south, west), (north, east) = TILE.south_west_rad, TILE.north_east_rad
    middle = (south + north) / 2
    beyond = np.array([west + 0.5 * TILE_RAD, east + 0.5 * TILE_RAD])
    pieces = cut_polyline(np.full(2, middle), beyond, np.zeros(2))
    assert [cuts for _, _, cuts in pieces] == [CUT_END, CUT_START]
    assert [tile.lon_index - TILE.lon_index for tile, _, _ in pieces] == [0, 1]
    point = cut_polyline(np.array([middle]), np.array([west + 0.1 * TILE_RAD]), np.zeros(1))
    assert [(tile, cuts, len(points)) for tile, points, cuts in point] == [(TILE, 0, 1)]


def test_positions_go_into_a_tile_and_out_again() -> None:
    lat, lon = TILE.centre_rad
    points = points_in_tile(TILE, lat + 1e-6, lon - 1e-6, 12.0)
    back = geodetic_in_tile(TILE, points)
    assert [float(v[0]) for v in back] == pytest.approx([lat + 1e-6, lon - 1e-6, 12.0], abs=1e-9)


def test_missing_pieces_are_noticed() -> None:
    pieces = pieces_of(sign(points_m=np.zeros((2, 3))), *walk(0))
    with pytest.raises(FeatureError, match="pieces of one"):
        join_pieces(pieces[:2] + pieces[3:])


def test_a_polyline_that_crosses_itself_is_refused() -> None:
    check_simple_polyline("a bend", np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]))
    check_simple_polyline("a loop", np.array([[0.0, 0], [1, 0], [1, 1], [0, 0]]))
    with pytest.raises(FeatureError, match="segments 0 and 2 of 3"):
        check_simple_polyline("an eight", np.array([[0.0, 0], [2, 0], [1, 1], [1, -1]]))
    with pytest.raises(FeatureError, match="crosses itself"):
        check_simple_polyline("a line that turns back", np.array([[0.0, 0], [2, 0], [1, 0]]))


GOLDEN = (
    "0105063237342d3530073530206b6d2f680c747261666669635f7369676e04747970650676c3a472646502bceea0eae9"
    "e7b2a10500021103a84600006d75ec01060000020300040101af6dd736a4e803ddd593d78883868a1600021103a84600"
    "006d75ec01060000020300040101a413d736a4e803f84223b7"
)
