"""Versions: read by number, hash or time, rolled back, explained, retired."""

import dataclasses
import hashlib

import pytest
from store_helpers import (
    EAST,
    FAR,
    TILE,
    Clock,
    Maker,
    SqliteMaker,
    merge_once,
    of_a_file,
    only_claim,
    publication,
    report,
    report_id,
    tile_of_voxels,
)

from gnd.gnd_map.codec import LATTICES, best_codec, encode_gaussians, snap
from gnd.gnd_map.day import UNKNOWN_DAY, day_of
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, TileId
from gnd.schemas.errors import SchemaError, WrongHash
from gnd.tile_store.errors import StoreError, UnknownVersion
from gnd.tile_store.store import Store
from gnd.tile_store.values import GcResult, Notice, Publication, PublishResult, ReportRow

DAY_NS = 86_400_000_000_000


def merged_versions(store: Store, n: int) -> None:
    """A base of voxel 0 and `n` merges, version k + 1 with the voxels 0 .. k."""
    store.put_tiles([tile_of_voxels(TILE, 0)])
    for k in range(1, n + 1):
        store.put_reports([report(k)])
        merge_once(store, *range(k + 1))


def test_an_import_is_version_1_of_kind_base(store: Store) -> None:
    assert store.put_tiles([tile_of_voxels(TILE, 1, 2), tile_of_voxels(EAST)]) == [PublishResult("published", 1)] * 2
    head = store.get("ndt", TILE)
    assert head is not None
    assert (head.kind, head.parent, head.merger, head.n_reports) == ("base", 0, "", 0)
    decoded = head.decode()
    assert (decoded.tile_id, decoded.version, decoded.sha) == (TILE, 1, tile_of_voxels(TILE, 1, 2).sha)


def test_the_stored_hash_is_that_of_the_tile_and_its_plain_columns_whatever_the_codec(store: Store) -> None:
    plain = tile_of_voxels(TILE, 1, 2)
    rounded = Tile(TILE, 0, snap(plain.gaussians, LATTICES["standard"]))
    for tile in (plain, rounded):
        store.put_tiles([tile])
        head = store.get("ndt", TILE)
        assert head is not None
        assert head.codec_id == best_codec(tile.gaussians)
        assert head.sha == hashlib.sha256(TILE.morton.to_bytes(8, "little") + encode_gaussians(tile.gaussians)).digest()
        assert head.decode().gaussians == tile.gaussians
    assert best_codec(plain.gaussians) != best_codec(rounded.gaussians)


def test_a_body_of_plain_columns_that_an_older_program_has_stored_is_read(store: Store, maker: Maker) -> None:
    tile = tile_of_voxels(TILE, 1, 2)
    store.put_tiles([tile])
    body = encode_gaussians(tile.gaussians)
    maker.sql("UPDATE tile_version SET codec_id = 0, body = ? WHERE tile = ?", body, TILE.morton)
    old = store.get("ndt", TILE)
    assert old is not None
    assert (old.codec_id, old.sha, old.decode().gaussians) == (0, tile.sha, tile.gaussians)
    store.put_tiles([tile_of_voxels(TILE, 3)])
    assert store.rollback("ndt", TILE, 1).codec_id == 0
    assert store.put_tiles([tile]) == [PublishResult("unchanged", 3)]


def test_the_same_import_again_changes_nothing(store: Store) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    assert store.put_tiles([tile_of_voxels(TILE, 1)]) == [PublishResult("unchanged", 1)]


def test_the_same_import_over_a_merged_tile_starts_anew(store: Store) -> None:
    merged_versions(store, 1)
    assert store.put_tiles([tile_of_voxels(TILE, 0)]) == [PublishResult("published", 3)]
    store.put_reports([report(9)])
    work = store.load(only_claim(store))
    assert [row.report_id for row in work.reports] == [report_id(9)]


def test_an_import_is_all_or_nothing(store: Store) -> None:
    class Broken:
        tile_id = EAST

        @property
        def gaussians(self) -> object:
            raise ValueError("half a tile")

    with pytest.raises(ValueError, match="half a tile"):
        store.put_tiles([tile_of_voxels(TILE, 1), Broken()])  # type: ignore[list-item]
    assert store.heads() == []


def test_what_does_not_exist_is_none(store: Store) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    assert store.get("ndt", EAST) is None
    assert store.get("signs", TILE) is None
    assert store.get("ndt", TILE, version=2) is None
    assert store.by_sha("ndt", TILE, b"x" * 32) is None
    assert store.history("ndt", EAST) == []


def test_any_version_can_be_read_by_number_and_by_hash(store: Store) -> None:
    merged_versions(store, 3)
    for version in range(1, 5):
        stored = store.get("ndt", TILE, version=version)
        assert stored is not None
        assert stored.decode().gaussians.voxel_id.tolist() == list(range(version))
        assert store.by_sha("ndt", TILE, stored.sha) == stored


def test_a_tile_can_be_read_as_it_was_at_a_time(store: Store, clock: Clock) -> None:
    times = []
    for k in range(3):
        times.append(clock.ns)
        store.put_tiles([tile_of_voxels(TILE, k)])
        clock.advance(10.0)
    assert store.get("ndt", TILE, at_ns=times[0] - 1) is None
    for k, t_ns in enumerate(times):
        for t in (t_ns, t_ns + 9_999_999_999):
            stored = store.get("ndt", TILE, at_ns=t)
            assert stored is not None
            assert stored.version == k + 1


def test_times_of_versions_grow_also_when_a_clock_goes_back(store: Store, clock: Clock) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    clock.advance(-3600.0)
    store.put_tiles([tile_of_voxels(TILE, 2)])
    first, second = store.history("ndt", TILE)
    assert second.created_ns == first.created_ns + 1


def test_a_version_and_a_time_at_once_are_refused(store: Store) -> None:
    with pytest.raises(StoreError, match="not both"):
        store.get("ndt", TILE, version=1, at_ns=1)


def test_history_tells_what_became_of_a_tile(store: Store) -> None:
    merged_versions(store, 1)
    store.rollback("ndt", TILE, 1)
    lines = [(v.version, v.parent, v.kind, v.merger, v.n_reports) for v in store.history("ndt", TILE)]
    assert lines == [(1, 0, "base", "", 0), (2, 1, "merged", "m1", 1), (3, 2, "rollback", "", 0)]
    bodies = [store.get("ndt", TILE, version=v) for v in (1, 2, 3)]
    assert [v.size_bytes for v in store.history("ndt", TILE)] == [len(b.body) for b in bodies if b]


def test_every_version_says_what_its_body_was_when_it_was_encoded(store: Store) -> None:
    merged_versions(store, 1)
    store.rollback("ndt", TILE, 1)
    read = [store.get("ndt", TILE, version=v) for v in (1, 2, 3)]
    assert [one.is_as_encoded for one in read if one] == [True, True, True]
    assert read[2] == store.get_each("ndt", [EAST, TILE])[1]
    assert read[0] is not None
    for other in ({"body": b"?"}, {"sha": bytes(32)}, {"codec_id": 9}, {"body_check": None}):
        assert not dataclasses.replace(read[0], **other).is_as_encoded


def test_rollback_publishes_the_next_version_with_the_old_body(store: Store) -> None:
    merged_versions(store, 2)
    old = store.get("ndt", TILE, version=1)
    new = store.rollback("ndt", TILE, 1)
    assert old is not None
    assert (new.version, new.kind, new.sha, new.body) == (4, "rollback", old.sha, old.body)
    assert store.get("ndt", TILE) == new


def test_reports_merged_before_a_rollback_count_no_more_but_waiting_ones_do(store: Store) -> None:
    merged_versions(store, 2)
    store.put_reports([report(5)])
    store.rollback("ndt", TILE, 2)
    store.put_reports([report(6)])
    work = store.load(only_claim(store))
    assert work.epoch is not None
    assert work.epoch.version == 4
    assert [row.report_id for row in work.reports] == [report_id(5), report_id(6)]


def test_a_report_merged_without_visible_change_before_a_rollback_counts_no_more(store: Store) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    store.put_reports([report(1)])
    store.publish([Publication(only_claim(store), 1, None)])
    store.rollback("ndt", TILE, 1)
    store.put_reports([report(2)])
    assert [row.report_id for row in store.load(only_claim(store)).reports] == [report_id(2)]


def test_rollback_to_what_never_was_names_the_newest(store: Store) -> None:
    merged_versions(store, 1)
    with pytest.raises(UnknownVersion, match=rf"{TILE.path} of layer ndt has no version 7 \(newest: 2\)"):
        store.rollback("ndt", TILE, 7)
    assert len(store.history("ndt", TILE)) == 2


def test_heads_are_those_of_a_region_in_order(store: Store) -> None:
    store.put_tiles([tile_of_voxels(tile, 1) for tile in (EAST, FAR, TILE)])
    store.put_tiles([tile_of_voxels(EAST, 2)])
    assert [(entry.tile, entry.version) for entry in store.heads()] == [(FAR, 1), (TILE, 1), (EAST, 2)]
    for prefix, expected in {
        "13033": [TILE, EAST],
        "13033/03021/23031": [TILE, EAST],
        TILE.path: [TILE],
        "13033/03022": [],
        "0": [FAR],
    }.items():
        assert [entry.tile for entry in store.heads(prefix=prefix)] == expected
    assert store.heads("signs") == []


@pytest.mark.parametrize("bad", ["9", "13033/xyz", "0" * 21])
def test_a_region_must_be_a_path_prefix(store: Store, bad: str) -> None:
    with pytest.raises(StoreError, match="base-4 digits"):
        store.heads(prefix=bad)


def test_every_published_voxel_names_its_reports(store: Store) -> None:
    store.put_reports([report(1), report(2), report(3)])
    work = store.load(only_claim(store))
    voxels = {4: (report_id(3), report_id(1)), -9: (report_id(2),)}
    store.publish(
        [Publication(work.claim, 0, tile_of_voxels(TILE, 4, -9), report_ids=(report_id(1),), voxel_reports=voxels)]
    )
    assert store.provenance("ndt", TILE, 1) == (report_id(1), report_id(2), report_id(3))
    assert store.voxel_provenance("ndt", TILE, 1) == {-9: (report_id(2),), 4: (report_id(1), report_id(3))}


def test_a_base_comes_from_no_report_and_a_missing_version_is_named(store: Store) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    assert store.provenance("ndt", TILE, 1) == ()
    assert store.voxel_provenance("ndt", TILE, 1) == {}
    with pytest.raises(UnknownVersion, match="no version 2"):
        store.provenance("ndt", TILE, 2)


def test_each_change_of_a_known_tile_leaves_a_notice_until_it_is_announced(store: Store, clock: Clock) -> None:
    store.put_tiles([tile_of_voxels(TILE, 0)])
    assert store.notices() == []
    clock.advance(1.0)
    store.put_reports([report(1)])
    merge_once(store, 1)
    clock.advance(5.0)
    store.rollback("ndt", TILE, 1)
    assert store.notices() == [Notice("ndt", TILE, 2), Notice("ndt", TILE, 3)]
    assert store.notices(n=1) == [Notice("ndt", TILE, 2)]
    assert store.notices(older_than_s=5.0) == [Notice("ndt", TILE, 2)]
    clock.advance(-86_400.0)
    assert store.notices() == [Notice("ndt", TILE, 2), Notice("ndt", TILE, 3)], "a date set back keeps none of them"
    store.announced([Notice("ndt", TILE, 2), Notice("ndt", EAST, 9)])
    assert store.notices() == [Notice("ndt", TILE, 3)]


def test_a_refused_publication_leaves_no_notice(store: Store) -> None:
    store.put_reports([report(1)])
    work = store.load(only_claim(store))
    store.release("m1")
    store.publish([publication(work, 1)])
    assert store.notices() == []


def test_retention_keeps_the_newest_and_the_epoch(store: Store) -> None:
    merged_versions(store, 5)
    sizes = {v.version: v.size_bytes for v in store.history("ndt", TILE)}
    assert store.gc(2) == GcResult(3, sizes[2] + sizes[3] + sizes[4])
    assert [v.version for v in store.history("ndt", TILE)] == [1, 5, 6]
    assert store.gc(2) == GcResult(0, 0)
    store.put_reports([report(9)])
    assert merge_once(store, 99) == 7


def test_retention_keeps_what_counting_reports_refer_to(store: Store) -> None:
    merged_versions(store, 4)
    cited = store.get("ndt", TILE, version=3)
    assert cited is not None
    store.put_reports([ReportRow(report_id(50), "ndt", TILE, "v1", 0, b"", cited.sha)])
    store.gc(1)
    assert [v.version for v in store.history("ndt", TILE)] == [1, 3, 5]
    store.rollback("ndt", TILE, 5)
    merge_once(store, 7)
    store.put_tiles([tile_of_voxels(TILE, 8)])
    store.gc(1)
    assert [v.version for v in store.history("ndt", TILE)] == [8]


def test_a_version_number_never_comes_twice_after_retention(store: Store, clock: Clock) -> None:
    merged_versions(store, 3)
    store.put_reports([report(9)])
    slow = store.load(only_claim(store, "slow", lease_s=1.0))
    clock.advance(1.0)
    merge_once(store, 98, owner="fast")
    store.put_tiles([tile_of_voxels(TILE, 99)])
    store.gc(1)
    assert [v.version for v in store.history("ndt", TILE)] == [6]
    assert store.publish([publication(slow, 1)]) == [PublishResult("stale", 6)]


def test_retention_of_no_version_at_all_is_refused(store: Store) -> None:
    with pytest.raises(StoreError, match="keep_versions is 0"):
        store.gc(0)


def test_a_body_that_is_not_what_its_hash_says_is_found_when_it_is_decoded(store: Store) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(EAST, 2)])
    one, other = store.get("ndt", TILE), store.get("ndt", EAST)
    assert one is not None
    assert other is not None
    with pytest.raises(SchemaError, match="13033/03021/23031/22102"):
        dataclasses.replace(one, body=other.body).decode()
    plain = dataclasses.replace(one, codec_id=0, body=encode_gaussians(other.decode().gaussians))
    with pytest.raises(WrongHash):
        plain.decode()


@of_a_file
def test_a_backup_is_a_store_and_overwrites_nothing(store: Store, maker: Maker) -> None:
    merged_versions(store, 2)
    path = maker.path.with_name("backup.db")
    store.backup(path)
    copy = SqliteMaker(path).open()
    assert copy.counts() == store.counts()
    assert copy.get("ndt", TILE) == store.get("ndt", TILE)
    copy.close()
    with pytest.raises(StoreError, match="exists"):
        store.backup(path)


# Days


def day_of_head(store: Store) -> int:
    head = store.get("ndt", TILE)
    assert head is not None
    assert head.to_blob().day == head.decode_gaussians().day == head.day
    return head.day


def test_a_base_has_the_day_of_its_survey_and_a_merge_that_of_its_publication(store: Store, clock: Clock) -> None:
    surveyed_ns = clock.ns - 400 * DAY_NS
    store.put_tiles([tile_of_voxels(TILE, 1)], surveyed_ns=surveyed_ns)
    assert day_of_head(store) == day_of(surveyed_ns)
    store.put_tiles([tile_of_voxels(TILE, 1)], surveyed_ns=surveyed_ns + 9 * DAY_NS)  # surveyed again, and unchanged
    store.put_tiles([tile_of_voxels(TILE, 1)], surveyed_ns=surveyed_ns - 9 * DAY_NS)
    assert day_of_head(store) == day_of(surveyed_ns) + 9
    store.put_reports([report(1)])
    merge_once(store, 1, 2)
    assert day_of_head(store) == day_of(clock.ns)
    store.rollback("ndt", TILE, 1)
    assert day_of_head(store) == UNKNOWN_DAY  # as old as it was


def test_a_base_of_which_nobody_told_when_it_was_surveyed_has_no_day(store: Store) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    assert day_of_head(store) == UNKNOWN_DAY


def test_a_survey_goes_with_its_version(store: Store, maker: Maker) -> None:
    for k in range(4):
        store.put_tiles([tile_of_voxels(TILE, k)], surveyed_ns=1_700_000_000_000_000_000)
    store.gc(1)
    assert maker.sql("SELECT version FROM survey") == [(4,)]


def test_several_heads_are_read_as_one_by_one_in_the_order_asked_for(store: Store) -> None:
    merged_versions(store, 2)
    store.put_tiles([tile_of_voxels(FAR, 3)])
    asked = [FAR, EAST, TILE, FAR]
    assert store.get_each("ndt", asked) == [store.get("ndt", tile) for tile in asked]
    assert store.get_each("ndt", asked)[1] is None
    assert store.get_each("ndt", []) == store.get_each("other", []) == []
    assert store.get_each("other", [TILE]) == [None]


def test_districts_are_those_of_tiles_in_any_layer(store: Store) -> None:
    assert store.districts() == frozenset()
    begin = TILE.district.first_morton
    first, last = TileId(begin + TILES_OF_DISTRICT), TileId(begin + 3 * TILES_OF_DISTRICT - 1)
    store.put_tiles([tile_of_voxels(tile, 0) for tile in (first, TileId(first.morton + 1), last, FAR)])
    assert store.districts() == {first.district, last.district, FAR.district}
    assert store.districts() == {head.tile.district for head in store.heads()}
