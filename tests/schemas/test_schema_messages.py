"""Messages: known bytes, round trips of any value, and refusals that say what is wrong."""

import zlib
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from schema_values import (
    EAST,
    GOLDEN,
    GOLDEN_DIR,
    KINDS,
    NOTHING,
    OTHER_SHA,
    REPORT_ID,
    SHA,
    TILE,
    any_report,
    any_tile,
    any_update,
    change,
    gaussians,
    kind_of,
    met,
    pairs,
    report,
    sample,
    shas,
    tiles,
    update,
    versions,
)

from gnd.gnd_map.codec import encode_gaussians
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile, TileDelta
from gnd.gnd_map.tile_id import TileId
from gnd.schemas import limits
from gnd.schemas.bitmap import decode_observed, encode_observed
from gnd.schemas.changes import ChangeAck, ChangeReport, split
from gnd.schemas.doubt import Doubt, DoubtReason
from gnd.schemas.errors import BadValue, Malformed, SchemaError, TooLarge, WrongHash, WrongVersion
from gnd.schemas.generated import (
    change_report_pb2,
    tile_change_pb2,
    tile_reply_pb2,
    tile_update_pb2,
    traffic_sample_pb2,
)
from gnd.schemas.report_id import check_report_id, deterministic_report_id
from gnd.schemas.tiles import Catalog, CatalogEntry, TileBlob, TileReply, TileRequest, blob_of, tile_of
from gnd.schemas.traffic import TrafficLine, TrafficSample
from gnd.schemas.updates import TileUpdate

golden = pytest.mark.parametrize("name", GOLDEN)
# The halves of reports travel inside ChangeReport: test_packed_reports.py.
ALONE = {name: kind for name, kind in KINDS.items() if not name.startswith("Packed")}


# Golden bytes: what was sent once is understood for ever.


def unzipped(data: bytes) -> change_report_pb2.ChangeReport:
    """A report whose bitmaps are unpacked: zlib may pack the same bitmap into other bytes elsewhere."""
    message = change_report_pb2.ChangeReport.FromString(data)
    for tile in message.tiles:
        tile.observed_bitmap = zlib.decompress(tile.observed_bitmap) if tile.observed_bitmap else b""
    return message


@golden
def test_golden_bytes_decode_to_their_value(name: str) -> None:
    assert kind_of(name).decode((GOLDEN_DIR / f"{name}.bin").read_bytes()) == GOLDEN[name]


@golden
def test_values_encode_to_their_golden_bytes(name: str) -> None:
    encoded, expected = GOLDEN[name].encode(), (GOLDEN_DIR / f"{name}.bin").read_bytes()
    if name.startswith("ChangeReport"):
        assert unzipped(encoded) == unzipped(expected)
    else:
        assert encoded == expected


def test_every_golden_file_has_its_value() -> None:
    assert {path.stem for path in GOLDEN_DIR.glob("*.bin")} == set(GOLDEN)


@golden
def test_a_field_of_a_newer_minor_version_is_passed_over(name: str) -> None:
    unknown_field_2000 = b"\x82\x7d\x05newer"
    assert kind_of(name).decode(GOLDEN[name].encode() + unknown_field_2000) == GOLDEN[name]


# Round trips


@given(pairs, st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=16))
def test_any_tile_request_survives(pair: tuple[int, bytes], codecs: list[int]) -> None:
    request = TileRequest(*pair, tuple(codecs))
    assert TileRequest.decode(request.encode()) == request


@given(any_tile())
def test_any_tile_survives_as_blob_and_reply(tile: Tile) -> None:
    blob = blob_of(tile)
    assert TileBlob.decode(blob.encode()) == blob
    reply = TileReply.decode(TileReply("blob", blob).encode())
    assert reply.blob is not None
    assert tile_of(reply.blob) == tile


@given(st.dictionaries(tiles, st.tuples(versions, shas), max_size=20))
def test_any_catalog_survives(found: dict[TileId, tuple[int, bytes]]) -> None:
    catalog = Catalog(tuple(CatalogEntry(tile, *found[tile]) for tile in sorted(found)))
    assert Catalog.decode(catalog.encode()) == catalog


@given(any_report())
@settings(max_examples=60)
def test_any_change_report_survives(value: ChangeReport) -> None:
    assert ChangeReport.decode(value.encode()) == value


@given(any_report())
@settings(max_examples=30)
def test_a_split_report_holds_the_same_statements_one_tile_each(value: ChangeReport) -> None:
    parts = [(tile, ChangeReport.decode(body)) for tile, body in split(value)]
    assert [tile for tile, _ in parts] == [change.tile for change in value.tiles]
    assert tuple(part.tiles[0] for _, part in parts) == value.tiles
    assert {(p.report_id, p.vehicle, p.district, len(p.tiles)) for _, p in parts} == {
        (value.report_id, value.vehicle, value.district, 1)
    }


@given(any_update())
@settings(max_examples=60)
def test_any_tile_update_survives(value: TileUpdate) -> None:
    assert TileUpdate.decode(value.encode()) == value


@given(st.floats(0, 1e9), st.floats(-np.pi / 2, np.pi / 2), st.floats(-np.pi, np.pi), st.integers(0, 2**63 - 1))
def test_any_traffic_sample_survives(odometer_m: float, lat_rad: float, lon_rad: float, t_ns: int) -> None:
    value = sample(odometer_m=odometer_m, lat_rad=lat_rad, lon_rad=lon_rad, t_ns=t_ns)
    assert TrafficSample.decode(value.encode()) == value


@given(st.frozensets(st.integers(-(2**31), 2**31 - 1), max_size=3), st.integers(0, 1_000_000))
def test_any_observed_voxels_survive_or_span_too_much(ids: frozenset[int], first: int) -> None:
    observed = np.array(sorted(ids), np.int32)
    if len(observed) and int(observed[-1]) - int(observed[0]) >= 8 * limits.MAX_OBSERVED_BITMAP_BYTES:
        with pytest.raises(TooLarge, match=r"observed voxels span \d+ ids, the limit is 1048576"):
            encode_observed(observed)
    else:
        assert np.array_equal(decode_observed(*encode_observed(observed)), observed)


def test_the_largest_bitmap_survives_and_one_more_does_not() -> None:
    last = 8 * limits.MAX_OBSERVED_BITMAP_BYTES - 1
    widest = np.array([0, last], np.int32)
    assert np.array_equal(decode_observed(*encode_observed(widest)), widest)
    with pytest.raises(TooLarge, match="observed voxels span 1048577 ids"):
        encode_observed(np.array([0, last + 1], np.int32))


# Report ids


def test_a_report_id_is_the_same_whenever_it_is_made_again() -> None:
    assert deterministic_report_id(1_700_000_000_000, "car-1", b"drive") == "01HF7YAT00N6413QVT7B2DFN5Y"


@given(st.integers(0, 2**48 - 1), st.integers(0, 2**48 - 1), st.text(max_size=8))
def test_report_ids_sort_by_time(a: int, b: int, part: str) -> None:
    first, second = deterministic_report_id(a, part), deterministic_report_id(b, part)
    assert (first < second) == (a < b)
    check_report_id(first)


def test_report_ids_tell_how_the_parts_are_cut() -> None:
    assert deterministic_report_id(5, "ab", "c") != deterministic_report_id(5, "a", "bc")
    assert deterministic_report_id(5, "ab") == deterministic_report_id(5, b"ab")


@pytest.mark.parametrize(
    "wrong", ["", "x", "01hf7yat00", "U" * 26, "01HF7YAT00" + "0" * 17, "01hf7yat00n6413qvt7b2dfn5y"]
)
def test_what_is_no_report_id_is_refused(wrong: str) -> None:
    with pytest.raises(BadValue, match="report id"):
        check_report_id(wrong)


def test_a_report_time_before_1970_is_refused() -> None:
    with pytest.raises(BadValue, match="-1 ms is outside the 48 bits"):
        deterministic_report_id(-1)


# Versions and sizes


@pytest.mark.parametrize("kind", [k for name, k in ALONE.items() if name != "TileBlob"], ids=lambda k: k.__name__)
def test_another_major_version_is_refused_clearly(kind: Any) -> None:
    name = kind.__name__
    with pytest.raises(WrongVersion, match=rf"{name} of major version 2; this program reads 1"):
        kind.decode(b"\x08\x02")
    with pytest.raises(WrongVersion, match=rf"{name} of major version 0"):
        kind.decode(b"")


@pytest.mark.parametrize("kind", ALONE.values(), ids=lambda k: k.__name__)
def test_oversize_is_refused_before_parsing(kind: Any) -> None:
    with pytest.raises(TooLarge, match=rf"{kind.__name__} of 8500000 bytes exceeds the limit of \d+ bytes"):
        kind.decode(bytes(8_500_000))


def test_a_report_of_millions_of_empty_tiles_is_refused_before_parsing() -> None:
    with pytest.raises(TooLarge, match=r"ChangeReport of 8388608 bytes has more than 1088 fields"):
        ChangeReport.decode(b"\x52\x00" * (4 * limits.MIB))


def test_encoding_more_than_a_reader_takes_is_refused_by_the_writer() -> None:
    with pytest.raises(TooLarge, match=r"has 4800004 bytes, the limit is 4194304"):
        blob_of(Tile(TILE, 1, gaussians(np.arange(100_000))))


def test_a_report_that_no_reader_would_take_cannot_be_made() -> None:
    full = np.arange(8 * limits.MAX_OBSERVED_BITMAP_BYTES, dtype=np.int32)
    first = TILE.district.first_morton
    all_of_it = tuple(change(TileId(first + k), changed=Gaussians.empty(), observed=full) for k in range(9))
    report(tiles=all_of_it[:8])
    with pytest.raises(TooLarge, match="observes more than 8388608 voxels in 9 tiles"):
        report(tiles=all_of_it)
    with pytest.raises(TooLarge, match="has 200001 removed voxels"):
        update(delta=TileDelta(np.arange(200_001, dtype=np.int32), Gaussians.empty()))


# Hostile reports. Each starts from a good message and changes one thing.


def tampered(**fields: Any) -> bytes:
    """A report of one tile with some of that tile's encoded fields replaced."""
    message = change_report_pb2.ChangeReport.FromString(report(tiles=(change(),)).encode())
    tile: tile_change_pb2.TileChange = message.tiles[0]
    for name, value in fields.items():
        tile.ClearField(name)  # type: ignore[arg-type]
        getattr(tile, name).extend(value) if isinstance(value, list) else setattr(tile, name, value)
    return message.SerializeToString()


def with_value(column: str, value: float) -> bytes:
    """Codec 0 bytes of six Gaussians, the first of which has `value` in a float column."""
    from gnd.gnd_map.codec import encode_gaussians

    at = {"mean_x": 0, "cov_xx": 3, "cov_xy": 4, "cov_yy": 6}[column]
    body = bytearray(encode_gaussians(change().changed))
    body[4 + 6 * 12 + at * 24 : 4 + 6 * 12 + at * 24 + 4] = np.float32(value).tobytes()
    return bytes(body)


def bomb(size: int) -> bytes:
    return zlib.compress(bytes(size), 9)


HOSTILE = {
    "absurd tile": ({"tile": 2**39}, BadValue, rf"tile {2**39}: tile id {2**39} is not in"),
    "huge tile": ({"tile": 2**64 - 1}, BadValue, r"tile 18446744073709551615"),
    "tile elsewhere": ({"tile": 0}, BadValue, r"tile 00000/00000/00000/00000 is not in district 13033/03021/23031"),
    "short sha": ({"base_sha": b"abc"}, BadValue, r"base sha has 3 bytes, expected 32 or none"),
    "version without sha": ({"base_sha": b""}, BadValue, r"base version 3 with a sha of 0 bytes"),
    "sha without version": ({"base_version": 0}, BadValue, r"base version 0 with a sha of 32 bytes"),
    "bitmap is no zlib": ({"observed_bitmap": b"hello"}, Malformed, r"bitmap of 5 bytes is not zlib data"),
    "bitmap is cut off": ({"observed_bitmap": bomb(5000)[:-3]}, Malformed, r"truncated or has bytes behind"),
    "bitmap and more": ({"observed_bitmap": bomb(5) + b"x"}, Malformed, r"truncated or has bytes behind"),
    "bitmap bomb": ({"observed_bitmap": partial(bomb, 200_000_000)}, TooLarge, r"unpacks to more than 131072 bytes"),
    "voxels beyond 32 bits": ({"observed_first": 2**31 - 5}, BadValue, r"do not fit 32 bits"),
    "voxels in space": ({"observed_first": 1_000_000_000}, BadValue, r"changed voxels are not among the observed"),
    "changed but not observed": (
        {"observed_first": -600},
        BadValue,
        r"[1-6] changed voxels are not among the observed",
    ),
    "unknown codec": ({"codec_id": 77}, BadValue, r"codec 77 is unknown"),
    "truncated Gaussians": ({"changed": with_value("cov_xx", 0.1)[:-1]}, BadValue, r"291 bytes, expected 292 for 6"),
    "NaN mean": ({"changed": with_value("mean_x", np.nan)}, BadValue, r"1 of 18 values are not finite"),
    "infinite variance": ({"changed": with_value("cov_xx", np.inf)}, BadValue, r"1 of 36 values are not finite"),
    "mean outside": ({"changed": with_value("mean_x", 2.5)}, BadValue, r"means beyond 2\.0 m in 1 of 6"),
    "negative variance": ({"changed": with_value("cov_yy", -0.1)}, BadValue, r"negative variances in 1 of 6"),
    "not positive": ({"changed": with_value("cov_xy", 0.2)}, BadValue, r"1 covariances are not positive or too large"),
    "large variance": ({"changed": with_value("cov_xx", 1.5)}, BadValue, r"has eigenvalues .* 1\.5 m\^2"),
    "class 6": ({"change_class": b"\x06" * 6}, BadValue, r"change class 6 is outside 0 \.\. 5"),
    "too few classes": ({"change_class": b"\x01"}, BadValue, r"change_class: expected shape \(6,\), got \(1,\)"),
    "too few counters": ({"evidence": [1, 2, 3]}, BadValue, r"3 counters of rays for 6 changed voxels, expected 24"),
    "overflowing counter": (
        {"evidence": [2**32 - 1] * 24},
        BadValue,
        r"change of tile 13033\S+: evidence of 4294967295 rays does not fit 31 bits",
    ),
    "unsure and observed": (
        {"unsure": encode_gaussians(met([-700, -690, 2000]))},
        BadValue,
        r"2 voxels are unsure and observed, first -700",
    ),
    "unsure of a Gaussian": (
        {"unsure": encode_gaussians(met([-690], 20))},
        BadValue,
        r"unsure voxels of 20 \.\. 20 cells, not 1 \.\. 19",
    ),
    "unsure of nothing": ({"unsure": encode_gaussians(gaussians([-690], 0))}, BadValue, r"of 0 \.\. 0 cells"),
    "unsure by points": (
        {"unsure": encode_gaussians(gaussians([-690], 38))},
        BadValue,
        r"1 unsure voxels count points",
    ),
    "unsure in space": ({"unsure": encode_gaussians(met([2**30]))}, BadValue, r"lie at heights \d+ .. \d+ m"),
    "unsure and cut off": ({"unsure": encode_gaussians(met([-690]))[:-1]}, BadValue, r"51 bytes, expected 52"),
    "NaN sigma": ({"pose_sigma_m": float("nan")}, BadValue, r"pose sigma nan m is outside"),
    "negative sigma": ({"pose_sigma_rad": -0.1}, BadValue, r"pose sigma -0\.1 rad is outside"),
    "endless sigma": ({"pose_sigma_m": float("inf")}, BadValue, r"pose sigma inf m is outside"),
}


@pytest.mark.parametrize(("fields", "kind", "message"), HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_report_is_refused_with_what_is_wrong(fields: dict[str, Any], kind: type, message: str) -> None:
    made = {name: value() if callable(value) else value for name, value in fields.items()}
    with pytest.raises(kind, match=message):
        ChangeReport.decode(tampered(**made))


def test_the_untampered_report_is_accepted() -> None:
    assert ChangeReport.decode(tampered()) == report(tiles=(change(),))


def test_a_voxel_given_twice_is_refused() -> None:
    from gnd.gnd_map.codec import encode_gaussians

    body = bytearray(encode_gaussians(change().changed))
    body[4:8] = body[8:12]
    with pytest.raises(BadValue, match=r"voxel ids are not strictly increasing in 1 of 6 voxels"):
        ChangeReport.decode(tampered(changed=bytes(body)))


def test_voxels_far_above_the_earth_are_refused() -> None:
    # 1209 voxels a floor: floor 10,001 begins at 1209 * 10,001 - 604.
    high = np.array([1209 * 10_001], np.int32)
    with pytest.raises(BadValue, match=r"heights 10001 \.\. 10001 m, the Earth's surface at -1000 \.\. 10000 m"):
        change(changed=Gaussians.empty(), observed=high)
    change(changed=Gaussians.empty(), observed=high - 1209)


def test_unsure_voxels_of_many_tiles_are_bounded_together() -> None:
    first, many = TILE.district.first_morton, met(np.arange(limits.MAX_UNSURE_OF_REPORT // 2))
    tiles = tuple(change(TileId(first + k), unsure=many, **NOTHING) for k in range(3))
    assert len(ChangeReport.decode(report(tiles=tiles[:2]).encode()).tiles[1].unsure) == len(many)
    with pytest.raises(TooLarge, match="unsure of more than 65536 voxels in 3 tiles"):
        report(tiles=tiles)
    with pytest.raises(BadValue, match="5 changes are held back, and 1 voxels are named"):
        change(unsure=met([7]), doubt=Doubt(DoubtReason.EXPLAINED_BY_SHIFT, withheld=5), **NOTHING)


def test_many_small_bitmap_bombs_are_one_bomb() -> None:
    full = np.arange(8 * limits.MAX_OBSERVED_BITMAP_BYTES, dtype=np.int32)
    first = TILE.district.first_morton
    nothing = {"changed": Gaussians.empty(), "observed": full}
    message = change_report_pb2.ChangeReport.FromString(report().encode())
    one = change_report_pb2.ChangeReport.FromString(report(tiles=(change(**nothing),)).encode()).tiles[0]
    del message.tiles[:]
    for k in range(20):
        one.tile = first + k
        message.tiles.append(one)
    assert len(message.SerializeToString()) < 10_000
    with pytest.raises(TooLarge, match=r"observes more than 8388608 voxels in 9 tiles"):
        ChangeReport.decode(message.SerializeToString())


def test_a_plane_of_points_rounded_to_float32_is_accepted() -> None:
    rng = np.random.default_rng(5)
    n = 500
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    points = rng.uniform(-0.5, 0.5, (n, 60, 3))
    points -= (points @ normal[:, :, None]) * normal[:, None, :]
    centred = points - points.mean(axis=1, keepdims=True)
    cov = np.einsum("nki,nkj->nij", centred, centred) / 60
    six = cov[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32)
    ids = np.arange(n, dtype=np.int32)
    flat = Gaussians(ids, np.full(n, 60, np.int32), np.full(n, 30, np.int32), np.zeros((n, 3), np.float32), six)
    assert (np.linalg.eigvalsh(flat.full_cov())[:, 0] < 0).any()
    change(changed=flat)


BAD_REPORTS = {
    "no tiles": ({"tiles": ()}, r"has no tiles"),
    "wrong order": ({"tiles": (change(EAST), change())}, r"lists tile 13033/03021/23031/22102 after"),
    "twice": ({"tiles": (change(), change())}, r"ascending, none twice"),
    "backwards": ({"first_ns": 5, "last_ns": 4}, r"begins at 5 ns, after its end at 4 ns"),
    "before 1970": ({"first_ns": -1}, r"first_ns -1 is outside"),
    "key in vehicle": ({"vehicle": "a/**"}, r"vehicle 'a/\*\*' does not match"),
    "new line in software": ({"software": "a\nb"}, r"software 'a\\nb' does not match"),
    "layer": ({"layer": "NDT"}, r"layer 'NDT' does not match"),
    "id": ({"report_id": "0" * 25}, r"report id '0+'"),
}


@pytest.mark.parametrize(("values", "message"), BAD_REPORTS.values(), ids=BAD_REPORTS)
def test_a_report_that_cannot_be_is_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(BadValue, match=message):
        report(**values)


def test_a_report_with_an_unknown_district_is_refused() -> None:
    message = change_report_pb2.ChangeReport.FromString(report().encode())
    message.district = "13033/03021"
    with pytest.raises(BadValue, match="'13033/03021' is no district"):
        ChangeReport.decode(message.SerializeToString())


# The other messages


def test_a_tile_with_another_content_than_its_hash_is_refused() -> None:
    blob = blob_of(Tile(TILE, 3, gaussians([1, 2])))
    with pytest.raises(WrongHash, match=r"version 3: content has sha [0-9a-f]{16}…, claimed is 000102030405"):
        tile_of(TileBlob(blob.tile, blob.version, SHA, blob.codec_id, blob.body))
    with pytest.raises(WrongHash):
        tile_of(TileBlob(EAST, blob.version, blob.sha, blob.codec_id, blob.body))


def test_a_tile_in_an_unknown_codec_or_with_a_broken_body_is_refused() -> None:
    blob = blob_of(Tile(TILE, 3, gaussians([1, 2])))
    with pytest.raises(BadValue, match=r"tile .* version 3: codec 77 is unknown"):
        tile_of(TileBlob(blob.tile, blob.version, blob.sha, 77, blob.body))
    with pytest.raises(BadValue, match=r"99 bytes, expected 100 for 2 voxels"):
        tile_of(TileBlob(blob.tile, blob.version, blob.sha, blob.codec_id, blob.body[:-1]))


def test_a_published_tile_with_an_empty_voxel_is_refused() -> None:
    from gnd.gnd_map.codec import encode_gaussians

    body = encode_gaussians(Gaussians.nothing_at([4]))
    with pytest.raises(BadValue, match="1 voxels have count 0"):
        tile_of(TileBlob(TILE, 1, SHA, 0, body))


def test_a_reply_without_its_blob_or_with_an_unknown_status_is_refused() -> None:
    with pytest.raises(BadValue, match="TileReply 'blob' without a blob"):
        TileReply("blob")
    with pytest.raises(BadValue, match="TileReply status 'gone' is unknown; known are blob, unchanged, absent"):
        TileReply("gone")  # type: ignore[arg-type]
    with pytest.raises(BadValue, match="TileReply status 9 is unknown"):
        TileReply.decode(tile_reply_pb2.TileReply(major=1, status=9).SerializeToString())  # type: ignore[arg-type]


def test_a_request_without_codecs_or_with_half_a_cache_is_refused() -> None:
    with pytest.raises(BadValue, match=r"codecs \(\): at least one"):
        TileRequest(codecs=())
    with pytest.raises(BadValue, match="cached version 3 with a sha of 0 bytes"):
        TileRequest(cached_version=3)
    with pytest.raises(TooLarge, match="has 17 codecs, the limit is 16"):
        TileRequest(codecs=tuple(range(17)))


def test_a_catalog_out_of_order_is_refused() -> None:
    entry = CatalogEntry(TILE, 1, SHA)
    with pytest.raises(BadValue, match="ascending, none twice"):
        Catalog((entry, entry))


def test_an_ack_that_asks_for_something_needs_an_id() -> None:
    for status, wanted in (("wanted", b"x"), ("resend", b"")):
        with pytest.raises(BadValue, match="report id ''"):
            ChangeAck("", status, wanted=wanted)  # type: ignore[arg-type]
        ack = ChangeAck(REPORT_ID, status, wanted=wanted)  # type: ignore[arg-type]
        assert ack.unnamed() is ack
    ack = ChangeAck(REPORT_ID, "stored")
    assert ChangeAck.decode(ack.unnamed().encode()).report_id == ""
    assert len(ack.encode()) - len(ack.unnamed().encode()) == 28
    assert ChangeAck.decode(ChangeAck("", "quarantined", "no id").encode()).reason == "no id"
    with pytest.raises(BadValue, match="reason"):
        ChangeAck(REPORT_ID, "quarantined", "two\nlines")


def test_an_update_goes_forward_and_its_delta_is_checked() -> None:
    with pytest.raises(BadValue, match="to version 3 from 3"):
        update(version=3)
    with pytest.raises(BadValue, match="previous version 0 with a sha of 32 bytes"):
        update(previous_version=0)
    message = tile_update_pb2.TileUpdate.FromString(update().encode())
    message.delta.removed.append(12)
    with pytest.raises(BadValue, match="3 removed voxel ids are not strictly increasing"):
        TileUpdate.decode(message.SerializeToString())
    message.delta.removed[:] = range(200_001)
    with pytest.raises(TooLarge, match="has 200001 removed voxels"):
        TileUpdate.decode(message.SerializeToString())


def test_a_sample_that_cannot_be_is_refused() -> None:
    with pytest.raises(BadValue, match=r"position \(1\.6, 0\.0\) rad is not on the Earth"):
        sample(lat_rad=1.6, lon_rad=0.0)
    with pytest.raises(BadValue, match="odometer nan m"):
        sample(odometer_m=float("nan"))
    line = TrafficLine("ack", "down", 1, 20)
    with pytest.raises(BadValue, match="two lines of one kind and direction"):
        sample(lines=(line, line))
    with pytest.raises(BadValue, match="traffic direction 'sideways' is unknown; known are up, down"):
        TrafficLine("ack", "sideways", 1, 20)  # type: ignore[arg-type]
    message = traffic_sample_pb2.TrafficSample.FromString(sample().encode())
    message.lines[0].app_bytes = 2**63
    with pytest.raises(BadValue, match=r"app_bytes 9223372036854775808 is outside 0 \.\. 2\^63 - 1"):
        TrafficSample.decode(message.SerializeToString())


def test_values_are_compared_by_content() -> None:
    assert report() == report()
    assert report() != report(vehicle="car-2")
    assert change() != change(evidence=change().evidence + np.int32(1))
    assert change() != change(observed=np.append(change().observed, np.int32(5000)))
    assert change() != OTHER_SHA


def test_every_refusal_is_a_schema_error() -> None:
    assert all(issubclass(kind, SchemaError) for _, kind, _ in HOSTILE.values())
