"""Feature layers in a store: versions, answers by blob, delta and "unchanged", notices, provenance, commands."""

import json
from pathlib import Path
from typing import Any

import apsw
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from store_helpers import EAGER, EAST, TILE, only_claim, report, report_id, tile_of_voxels

from gnd.cloud_merger.announce import encoded, update_of
from gnd.deploy.map_cli import map_group
from gnd.fleet_bus.errors import Refused
from gnd.gnd_map.codec import PREFERRED
from gnd.gnd_map.content import codecs_of_layer, encode_content_delta
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.features import CODEC_FEATURES, Existence, Feature, FeatureTile, hit
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import BadValue, SchemaError, WrongHash
from gnd.schemas.tile_answer import content_of_answer
from gnd.schemas.tiles import TileBlob, TileReply, TileRequest, content_of, features_of, tile_after, tile_of
from gnd.schemas.tiles_batch import HeldVersion, TileAnswer, TilesReply, TilesRequest
from gnd.schemas.updates import TileUpdate, updated
from gnd.tile_store.answers import TileAnswers
from gnd.tile_store.build import build_map
from gnd.tile_store.compare import layer_info, map_diff, version_diff
from gnd.tile_store.errors import StoreError
from gnd.tile_store.export import ExportError, export_map
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import Publication

DISTRICT = TILE.district
READS = codecs_of_layer("signs")


def sign(number: int, x_m: float = 1.0, **values: Any) -> Feature:
    cov_m2 = np.array([0.04, 0.0, 0.0, 0.04, 0.0, 1e4])
    return Feature(number, "traffic_sign", np.array([[x_m, -2.0, 30.25]]), cov_m2, hit(0.9), **values)


def lane(number: int, part: int = 0, bend_m: float = 0.0) -> Feature:
    points_m = np.array([[-15.0, -3.5, 30.0], [0.0, -3.25 + bend_m, 30.125], [15.0, -3.0, 30.25]])
    cov_m2 = np.array([0.01, 0.0, 0.0, 0.01, 0.0, 0.04])
    return Feature(number, "lane_boundary", points_m, cov_m2, Existence(0.8, 0.0, 0.2), part=part)


def tile(where: TileId = TILE, *features: Feature) -> FeatureTile:
    return FeatureTile.of(where, 0, features)


@pytest.fixture
def store(tmp_path: Path):
    with SqliteStore(tmp_path / "store.db", EAGER) as opened:
        yield opened


def put(store: SqliteStore, *tiles: FeatureTile, layer: str = "signs") -> list[FeatureTile]:
    """The tiles as the store numbers them."""
    results = store.put_tiles(tiles, layer=layer)
    return [FeatureTile(one.tile_id, r.version, one.features) for one, r in zip(tiles, results, strict=True)]


def many(answers: TileAnswers, request: TilesRequest, layer: str = "signs") -> dict[TileId, TileAnswer]:
    """Over the wire and back."""
    reply = answers.many(layer, DISTRICT, TilesRequest.decode(request.encode()))
    return dict(TilesReply.decode(reply.encode()).of_request(request, DISTRICT))


def held(*tiles: FeatureTile) -> list[HeldVersion]:
    return [HeldVersion(one.tile_id, one.version, one.sha) for one in tiles]


# What a layer holds


def test_a_tile_comes_back_as_it_was_put(store: SqliteStore) -> None:
    (first,) = put(store, tile(TILE, sign(1, attributes=(("code", "206"),)), lane(5), lane(5, part=1)))
    stored = store.get("signs", TILE)
    assert (stored.codec_id, stored.sha, stored.decode(), stored.decode_features()) == (32, first.sha, first, first)
    assert features_of(stored.to_blob()) == first
    with pytest.raises(BadValue, match="version 1 holds features, expected Gaussians"):
        stored.decode_gaussians()
    assert store.put_tiles([tile(TILE, *first.features)], layer="signs")[0].status == "unchanged"


@pytest.mark.parametrize(
    ("content", "layer", "reason"),
    [
        (tile_of_voxels(TILE, 1), "signs", "holds Gaussians, layer 'signs' does not"),
        (tile(TILE, sign(1)), "ndt", "holds features, layer 'ndt' does not"),
        (tile(TILE, sign(1)), "ndt_winter", "holds features, layer 'ndt_winter' does not"),
    ],
)
def test_what_a_layer_does_not_hold_is_refused(store: SqliteStore, content: Any, layer: str, reason: str) -> None:
    with pytest.raises(StoreError, match=reason):
        store.put_tiles([content], layer=layer)
    store.put_reports([report(1, layer=layer)])
    with pytest.raises(StoreError, match=reason):
        Publication(only_claim(store), 0, content)
    assert store.heads(layer) == []


def test_the_same_tile_has_a_history_in_each_layer(store: SqliteStore) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    put(store, tile(TILE, sign(1)))
    put(store, tile(TILE, sign(1), sign(2)))
    put(store, tile(TILE, sign(9)), layer="poles")
    assert store.layers() == ["ndt", "poles", "signs"]
    assert {layer: len(store.history(layer, TILE)) for layer in store.layers()} == {"ndt": 1, "poles": 1, "signs": 2}
    back = store.rollback("signs", TILE, 1)
    assert (back.version, back.decode_features().features) == (3, tile(TILE, sign(1)).features)
    assert isinstance(store.get("ndt", TILE).decode(), Tile)
    store.gc(1)
    assert [line.version for line in store.history("signs", TILE)] == [3]


def test_a_merge_is_published_with_the_reports_of_each_feature(store: SqliteStore) -> None:
    put(store, tile(TILE, sign(1)))
    store.put_reports([report(number, layer="signs", vehicle=f"v{number}") for number in (1, 2)])
    work = store.load(only_claim(store))
    assert work.head.decode() == work.epoch.decode()
    ids = tuple(row.report_id for row in work.reports)
    new = tile(TILE, sign(1), sign(2**62 + 1))
    (result,) = store.publish([Publication(work.claim, 1, new, report_ids=ids, voxel_reports={2**62 + 1: ids[:1]})])
    assert (result.status, result.version) == ("published", 2)
    assert store.voxel_provenance("signs", TILE, 2) == {2**62 + 1: (report_id(1, "v1"),)}
    assert store.provenance("signs", TILE, 2) == tuple(sorted(ids))
    assert [notice.layer for notice in store.notices()] == ["signs"]


# Answers


def test_one_tile_is_answered_by_blob_delta_unchanged_or_absent(store: SqliteStore) -> None:
    old, answers = put(store, tile(TILE, *map(sign, range(1, 60))))[0], TileAnswers(store)
    reply = answers.one(store.get("signs", TILE), TileRequest(codecs=READS))
    assert content_of(reply.blob) == old
    new = put(store, tile(TILE, sign(1, x_m=-9.5), *map(sign, range(3, 61))))[0]
    reply = TileReply.decode(answers.one(store.get("signs", TILE), TileRequest(1, old.sha, READS)).encode())
    assert tile_after(reply.delta, old) == new
    assert len(reply.delta.body) < 120 < len(store.get("signs", TILE).body) / 10
    assert answers.one(store.get("signs", TILE), TileRequest(2, new.sha, READS)).status == "unchanged"
    assert answers.one(store.get("signs", EAST), TileRequest(codecs=READS)).status == "absent"
    assert answers.one(store.get("signs", TILE), TileRequest(1, old.sha, READS, deltas=False)).status == "blob"
    assert answers.one(store.get("signs", TILE), TileRequest(7, bytes(32), READS)).status == "blob"


def test_many_tiles_are_answered_together(store: SqliteStore) -> None:
    a, b = put(store, tile(TILE, *map(sign, range(1, 60))), tile(EAST, lane(4)))
    new = put(store, tile(TILE, *map(sign, range(2, 61))))[0]
    answers, absent = TileAnswers(store), TileId(DISTRICT.first_morton)
    found = many(answers, TilesRequest.of([HeldVersion(absent), *held(a, b)], codecs=READS))
    assert {t: one.status for t, one in found.items()} == {absent: "absent", TILE: "delta", EAST: "unchanged"}
    assert content_of_answer(TILE, found[TILE], FeatureTile, a) == new
    lost = many(answers, TilesRequest.of([HeldVersion(TILE, 1, bytes(32)), *held(b)], codecs=READS))
    assert {one.status for one in lost.values()} == {"hash"}
    told = many(answers, TilesRequest.of([HeldVersion(TILE, 9, a.sha), *held(b)], codecs=READS, with_hashes=True))
    assert [one.status for one in told.values()] == ["delta", "unchanged"]
    first = many(answers, TilesRequest.of([HeldVersion(TILE), HeldVersion(EAST)], codecs=READS, max_bytes=1))
    assert [one.status for one in first.values()] == ["blob", "later"]
    with pytest.raises(BadValue, match="holds features, expected Gaussians"):
        content_of_answer(TILE, first[TILE], Tile)


def test_who_does_not_read_features_is_told_by_name(store: SqliteStore) -> None:
    put(store, tile(TILE, sign(1)))
    answers = TileAnswers(store)
    reason = f"tile {TILE.path} of layer signs comes in codec 32, asked for"
    with pytest.raises(Refused, match=reason):
        answers.one(store.get("signs", TILE), TileRequest(codecs=PREFERRED))
    with pytest.raises(Refused, match=reason):
        many(answers, TilesRequest.of([HeldVersion(TILE)], codecs=PREFERRED))
    store.put_tiles([tile_of_voxels(TILE, 1)])
    with pytest.raises(Refused, match=r"of layer ndt comes in codec \d, asked for \(32,\)"):
        answers.one(store.get("ndt", TILE), TileRequest(codecs=READS))


def test_a_damaged_tile_is_named_and_does_not_keep_the_others(store: SqliteStore) -> None:
    old = put(store, tile(TILE, *map(sign, range(1, 60))), tile(EAST, sign(3)))[0]
    put(store, tile(TILE, *map(sign, range(1, 61))))
    with apsw.Connection(str(store.path)) as connection:
        body = bytearray(
            connection.execute("SELECT body FROM tile_version WHERE version = 1 AND tile = ?", (TILE.morton,)).get
        )
        body[40] ^= 8
        connection.execute(
            "UPDATE tile_version SET body = ? WHERE version = 1 AND tile = ?", (bytes(body), TILE.morton)
        )
    found = many(TileAnswers(store), TilesRequest.of([*held(old), HeldVersion(EAST)], codecs=READS))
    assert [one.status for one in found.values()] == ["blob", "blob"], "its base is damaged: no delta"
    with pytest.raises(SchemaError, match="checksum"):
        store.get("signs", TILE, 1).decode()
    with pytest.raises(WrongHash, match="content has sha"):
        content_of(TileBlob(TILE, 2, bytes(32), 32, store.get("signs", TILE).body))


ids = st.frozensets(st.integers(1, 12), max_size=9)


@settings(max_examples=25, deadline=None)
@given(states=st.lists(st.tuples(ids, st.integers(0, 3)), min_size=2, max_size=4))
def test_a_delta_from_any_state_gives_any_other(states: list[tuple[frozenset[int], int]]) -> None:
    tiles = [tile(TILE, *(sign(n, x_m=move) for n in names), lane(99, bend_m=move / 4)) for names, move in states]
    for before in tiles:
        for after in tiles:
            notice = TileUpdate(
                TILE, "signs", 2, 1, after.sha, before.sha, "merged", None, encode_content_delta(before, after)
            )
            made = updated(TileUpdate.decode(notice.encode()), before)
            assert (made.features, made.sha) == (after.features, after.sha)


# Notices


def test_a_notice_says_what_has_changed(store: SqliteStore) -> None:
    old = put(store, tile(TILE, sign(1), sign(2), sign(3)))[0]
    new = put(store, tile(TILE, sign(2, x_m=5.0), sign(3), sign(4)))[0]
    update = TileUpdate.decode(encoded(update_of(store.get("signs", TILE), store.get("signs", TILE, 1))))
    assert (update.layer, update.voxels, update.version, update.delta) == ("signs", (2, 1), 2, None)
    assert updated(update, old) == new
    with pytest.raises(WrongHash, match="does not fit"):
        updated(update, FeatureTile(TILE, 1, ()))
    with pytest.raises(WrongHash, match="does not fit"):
        updated(update, tile_of_voxels(TILE, 1))
    fresh = TileUpdate.decode(encoded(update_of(store.get("signs", TILE, 1), None)))
    assert (fresh.previous_version, fresh.has_delta) == (0, False)


def test_a_delta_of_gaussians_is_not_for_features(store: SqliteStore) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    store.put_tiles([tile_of_voxels(TILE, 1, 2)])
    update = update_of(store.get("ndt", TILE), store.get("ndt", TILE, 1))
    with pytest.raises(WrongHash, match=r"delta of Gaussians, held are features|does not fit"):
        updated(update, tile(TILE, sign(1)))


# Commands and exports


def test_info_counts_what_a_feature_layer_holds(store: SqliteStore) -> None:
    put(store, tile(TILE, sign(1), sign(2), lane(5)), tile(EAST, lane(5, part=1)))
    info = layer_info(store, layer="signs")
    assert (info.features, info.pieces, info.points, info.tiles) == (3, 4, 8, 2)
    assert (info.kinds, info.states) == ({"lane_boundary": 1, "traffic_sign": 2}, {"exist": 4})
    assert (info.lowest_m, info.highest_m) == (30, 31)
    assert info.south_deg < 37.56 < info.north_deg
    assert layer_info(store, layer="signs", prefix=EAST.path).pieces == 1
    with pytest.raises(StoreError, match="no tiles in layer 'lanes'"):
        layer_info(store, layer="lanes")


def test_differences_of_feature_layers_are_counted_in_features(store: SqliteStore, tmp_path: Path) -> None:
    put(store, tile(TILE, sign(1), sign(2), sign(3), lane(7)), tile(EAST, sign(8)))
    put(store, tile(TILE, sign(2), sign(3, x_m=4.0), sign(4), lane(7, bend_m=0.5)))
    (one,) = version_diff(store, "signs", TILE, 1, 2).tiles
    assert (one.new, one.deleted, one.modified, one.same, one.max_shift_m) == (1, 1, 2, 1, 3.0)
    with SqliteStore(tmp_path / "other.db", EAGER) as other:
        put(other, tile(TILE, sign(2)))
        found = map_diff(other, store, layer="signs")
        assert [(t.old_version, t.new_version, t.new, t.same) for t in found.tiles] == [(1, 2, 3, 1), (0, 1, 1, 0)]
        assert found.noun == "features"


def gnd_map(*arguments: object) -> str:
    outcome = CliRunner().invoke(map_group, list(map(str, arguments)), catch_exceptions=False)
    assert outcome.exit_code == 0, outcome.output
    return outcome.output


def test_commands_with_a_layer(store: SqliteStore) -> None:
    put(store, tile(TILE, sign(1), sign(2)))
    put(store, tile(TILE, sign(2), lane(6)))
    path = store.path
    shown = gnd_map("info", path, "--layer", "signs", "--deep")
    assert "2 in 2 pieces with 4 points" in shown
    assert "lane_boundary (1), traffic_sign (1)" in shown
    assert json.loads(gnd_map("info", path, "--layer", "signs", "--deep", "--json"))["kinds"] == {
        "lane_boundary": 1,
        "traffic_sign": 1,
    }
    assert "features: 1 new, 1 deleted, 0 modified, 1 the same" in gnd_map(
        "diff", path, "--tile", TILE.path, "--layer", "signs"
    )
    history = json.loads(gnd_map("history", path, TILE.path, "--layer", "signs", "--json"))
    assert [line["kind"] for line in history["versions"]] == ["base", "base"]
    gnd_map("rollback", path, TILE.path, "1", "--layer", "signs")
    assert store.get("signs", TILE).decode_features().features == tile(TILE, sign(1), sign(2)).features


@pytest.mark.parametrize("ending", ["pcd", "ply", "geojson"])
def test_exports_of_gaussians_name_the_command_for_features(store: SqliteStore, tmp_path: Path, ending: str) -> None:
    put(store, tile(TILE, sign(1)))
    with pytest.raises(ExportError, match=r"the 1 tiles of layer 'signs' hold features, .* `gnd features"):
        export_map(store, "signs", "", tmp_path / f"map.{ending}")
    assert not (tmp_path / f"map.{ending}").exists()


def test_no_map_of_gaussians_is_built_into_a_feature_layer(store: SqliteStore, tmp_path: Path) -> None:
    with pytest.raises(GndError, match="layer 'signs' holds features; a map of Gaussians has a name"):
        build_map([tmp_path / "none.mcap"], store, layer="signs")
    assert CODEC_FEATURES not in PREFERRED
    assert tile_of(TileBlob(EAST, 1, tile_of_voxels(EAST).sha, 0, bytes(4))).gaussians == tile_of_voxels(EAST).gaussians
