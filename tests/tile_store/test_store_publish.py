"""Publishing: compare-and-swap on the head, in the transaction that consumes the reports."""

import dataclasses

import pytest
from store_helpers import (
    EAST,
    TILE,
    Clock,
    Maker,
    merge_once,
    only_claim,
    publication,
    report,
    report_id,
    tile_of_voxels,
)

from gnd.tile_store.errors import StoreError, UnknownReports
from gnd.tile_store.store import Store
from gnd.tile_store.values import Publication, PublishResult, StoreConfig


def test_a_publication_makes_the_next_version_and_cleans_the_tile(store: Store) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    store.put_reports([report(1), report(2)])
    work = store.load(only_claim(store))
    assert [row.report_id for row in work.reports] == [report_id(1), report_id(2)]
    assert store.publish([publication(work, 1, 2)]) == [PublishResult("published", 2)]
    head = store.get("ndt", TILE)
    assert head is not None
    assert (head.version, head.parent, head.kind, head.merger, head.n_reports) == (2, 1, "merged", "m1", 2)
    assert head.decode().gaussians == tile_of_voxels(TILE, 1, 2).gaussians
    assert (store.dirty_count(), store.counts().waiting) == (0, 0)


def test_a_tile_that_the_map_lacks_begins_at_version_1_without_an_epoch(store: Store) -> None:
    store.put_reports([report(1)])
    work = store.load(only_claim(store))
    assert (work.head, work.epoch, work.base_version) == (None, None, 0)
    assert store.publish([publication(work, 7)]) == [PublishResult("published", 1)]
    store.put_reports([report(2)])
    work = store.load(only_claim(store))
    assert work.epoch is None
    assert [row.report_id for row in work.reports] == [report_id(1), report_id(2)]


def test_all_reports_since_the_epoch_are_loaded_again_whatever_the_batching(store: Store) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    for number in (3, 1, 2):
        store.put_reports([report(number)])
        merge_once(store, 1, 10 + number)
    store.put_reports([report(0)])
    work = store.load(only_claim(store))
    assert [row.report_id for row in work.reports] == [report_id(i) for i in range(4)]
    assert work.epoch is not None
    assert (work.epoch.version, work.base_version) == (1, 4)


def test_no_visible_change_consumes_the_reports_without_a_version(store: Store) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    store.put_reports([report(1)])
    work = store.load(only_claim(store))
    assert store.publish([Publication(work.claim, 1, None)]) == [PublishResult("unchanged", 1)]
    assert (store.dirty_count(), store.counts().waiting, len(store.history("ndt", TILE))) == (0, 0, 1)
    store.put_reports([report(2)])
    assert len(store.load(only_claim(store)).reports) == 2


def test_the_same_content_again_is_no_new_version(store: Store) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    store.put_reports([report(1)])
    assert store.publish([publication(store.load(only_claim(store)), 1)]) == [PublishResult("unchanged", 1)]
    assert store.dirty_count() == 0


def test_a_report_that_arrives_during_the_merge_keeps_the_tile_dirty(store: Store) -> None:
    store.put_reports([report(1)])
    work = store.load(only_claim(store))
    store.put_reports([report(2)])
    assert store.publish([publication(work, 1)]) == [PublishResult("published", 1)]
    assert (store.dirty_count(), store.counts().waiting) == (1, 1)
    again = store.load(only_claim(store))
    assert [row.report_id for row in again.reports] == [report_id(1), report_id(2)]
    assert store.publish([publication(again, 1, 2)]) == [PublishResult("published", 2)]
    assert store.dirty_count() == 0


def test_a_report_between_claim_and_load_is_merged_with_the_others(store: Store) -> None:
    store.put_reports([report(1)])
    claim = only_claim(store)
    store.put_reports([report(2)])
    work = store.load(claim)
    assert len(work.reports) == 2
    store.publish([publication(work, 1, 2)])
    assert (store.counts().waiting, store.dirty_count()) == (0, 0)


def test_a_tile_left_dirty_waits_its_delay_again(maker: Maker, clock: Clock) -> None:
    store = maker.open(StoreConfig(merge_delay_s=2.0, merge_after_reports=9), clock)
    store.put_reports([report(1)])
    clock.advance(2.0)
    work = store.load(only_claim(store))
    store.put_reports([report(2)])
    store.publish([publication(work, 1)])
    assert store.ready_in_s() == pytest.approx(2.0)
    store.close()


def test_of_two_merges_of_one_tile_the_slow_one_is_refused(store: Store, clock: Clock) -> None:
    store.put_reports([report(1)])
    slow = store.load(only_claim(store, "slow", lease_s=1.0))
    clock.advance(1.0)
    fast = store.load(only_claim(store, "fast"))
    assert store.publish([publication(fast, 1)]) == [PublishResult("published", 1)]
    assert store.publish([publication(slow, 1)]) == [PublishResult("stale", 1)]
    assert len(store.history("ndt", TILE)) == 1


def test_a_holder_of_a_lost_lease_cannot_undo_a_merge_without_visible_change(store: Store, clock: Clock) -> None:
    """The head alone cannot tell: it has not moved, but more reports have been weighed than the slow one knows."""
    store.put_tiles([tile_of_voxels(TILE, 1)])
    store.put_reports([report(1)])
    slow = store.load(only_claim(store, "slow", lease_s=1.0))
    store.put_reports([report(2)])
    clock.advance(1.0)
    fast = store.load(only_claim(store, "fast"))
    assert store.publish([Publication(fast.claim, 1, None)]) == [PublishResult("unchanged", 1)]
    assert store.publish([publication(slow, 1, 2)]) == [PublishResult("stale", 1)]
    assert len(store.history("ndt", TILE)) == 1


def test_a_zombie_of_the_same_name_is_refused(store: Store) -> None:
    store.put_reports([report(1)])
    before = store.load(only_claim(store, "shard-0"))
    store.release("shard-0")
    after = store.load(only_claim(store, "shard-0"))
    assert store.publish([publication(before, 1)]) == [PublishResult("stale", 0)]
    assert store.publish([publication(after, 1)]) == [PublishResult("published", 1)]


def test_an_expired_lease_that_nobody_has_taken_still_publishes(store: Store, clock: Clock) -> None:
    store.put_reports([report(1)])
    work = store.load(only_claim(store, lease_s=1.0))
    clock.advance(60.0)
    assert store.publish([publication(work, 1)]) == [PublishResult("published", 1)]


@pytest.mark.parametrize("move", ["import", "rollback"])
def test_a_merge_against_a_head_that_has_moved_is_refused_and_ready_again_at_once(store: Store, move: str) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    store.put_reports([report(1)])
    work = store.load(only_claim(store))
    if move == "import":
        store.put_tiles([tile_of_voxels(TILE, 5)])
    else:
        store.rollback("ndt", TILE, 1)
    assert store.publish([publication(work, 1, 2)]) == [PublishResult("stale", 2)]
    assert store.counts().waiting == 1
    work = store.load(only_claim(store))
    assert (work.base_version, len(work.reports)) == (2, 1)
    assert store.publish([publication(work, 1, 2)]) == [PublishResult("published", 3)]


def test_a_merge_that_others_have_overtaken_again_and_again_is_no_fault_of_its_tile(store: Store) -> None:
    """Six such attempts once had the tile set aside, as if its merges killed shards."""
    store.put_tiles([tile_of_voxels(TILE, 1)])
    store.put_reports([report(1)])
    for number in range(8):
        work = store.load(only_claim(store))
        assert work.claim.attempts == 1
        assert store.begin([work.claim], 10.0) == [True]
        store.put_tiles([tile_of_voxels(TILE, 5 + number)])
        assert [result.status for result in store.publish([publication(work, 1, 2)])] == ["stale"]


def test_a_publication_of_nothing_claimed_is_refused(store: Store) -> None:
    store.put_reports([report(1)])
    work = store.load(only_claim(store))
    store.publish([publication(work, 1)])
    assert store.publish([publication(work, 2)]) == [PublishResult("stale", 1)]


def test_the_fresh_ones_of_a_group_are_published_beside_a_stale_one(store: Store) -> None:
    store.put_reports([report(1, TILE), report(1, EAST)])
    stale, fresh = map(store.load, store.claim("m1", 2, 10.0))
    store.put_tiles([tile_of_voxels(stale.claim.tile, 9)])
    results = store.publish([publication(stale, 1), publication(fresh, 1)])
    assert results == [PublishResult("stale", 1), PublishResult("published", 1)]


def test_a_publication_with_unknown_reports_undoes_its_whole_call(store: Store) -> None:
    store.put_reports([report(1, TILE), report(1, EAST)])
    good, bad = map(store.load, store.claim("m1", 2, 10.0))
    wrong = dataclasses.replace(publication(bad, 1), report_ids=(report_id(1), report_id(77)))
    with pytest.raises(UnknownReports, match=f"1 of 2 report ids are not in the store, first {report_id(77)}"):
        store.publish([publication(good, 1), wrong])
    assert (store.counts().versions, store.counts().waiting, store.dirty_count()) == (0, 2, 2)


def test_a_publication_must_be_of_the_claimed_tile(store: Store) -> None:
    store.put_reports([report(1)])
    claim = only_claim(store)
    with pytest.raises(StoreError, match="under a claim of"):
        Publication(claim, 0, tile_of_voxels(EAST, 1))


def test_layers_are_apart(store: Store) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    store.put_reports([report(1, layer="ndt_summer")])
    claim = only_claim(store)
    assert (claim.layer, store.load(claim).base_version) == ("ndt_summer", 0)
    store.publish([publication(store.load(claim), 3)])
    assert store.layers() == ["ndt", "ndt_summer"]
    assert [entry.version for entry in store.heads("ndt_summer")] == [1]


def test_the_reports_of_a_feature_layer_are_cut_into_windows_by_the_time_of_day(maker: Maker) -> None:
    """Neighbouring tiles, which hear the same of what lies at their border, cut alike whoever speaks first."""
    store = maker.open(StoreConfig(merge_delay_s=0.0, window_s=100.0))
    seconds = [130, 190, 199, 200, 150, 299, 305]  # one clock steps back
    rows = [
        dataclasses.replace(report(i, tile=tile), layer="signs", received_ns=t * 10**9)
        for i, t in enumerate(seconds)
        for tile in (TILE, EAST)[: 1 + (i > 0)]  # the other tile hears from the second on
    ]
    store.put_reports(rows)
    windows = [[row.window for row in store.in_play("signs", tile).reports] for tile in (TILE, EAST)]
    assert windows == [[1, 1, 1, 2, 2, 2, 3], [1, 1, 2, 2, 2, 3]]
    store.close()
