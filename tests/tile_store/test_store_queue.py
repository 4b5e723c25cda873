"""The queue of dirty tiles: when a tile is ready, who may merge it, and what happens when that one dies."""

import threading

import pytest
from store_helpers import EAGER, EAST, FAR, TILE, Clock, SqliteMaker, only_claim, publication, report

from tile_store.errors import StoreError
from tile_store.store import Store
from tile_store.values import StoreConfig

PATIENT = StoreConfig(merge_delay_s=2.0, merge_after_reports=3)


def test_nothing_to_do_in_an_empty_store(store: Store) -> None:
    assert store.claim("m1", 10, 10.0) == []
    assert store.next_ready_ns() is None
    assert store.dirty_count() == 0


def test_a_tile_is_ready_a_delay_after_its_first_report(maker: SqliteMaker, clock: Clock) -> None:
    store = maker.open(PATIENT, clock)
    first = clock.ns
    store.put_reports([report(1)])
    clock.advance(1.5)
    store.put_reports([report(2)])
    assert store.next_ready_ns() == first + 2_000_000_000
    assert store.claim("m1", 1, 10.0) == []
    clock.advance(0.5)
    assert only_claim(store).seq == 2
    store.close()


def test_a_tile_is_ready_at_once_when_enough_reports_wait(maker: SqliteMaker, clock: Clock) -> None:
    store = maker.open(PATIENT, clock)
    store.put_reports([report(1), report(2)])
    assert store.claim("m1", 1, 10.0) == []
    store.put_reports([report(3)])
    assert only_claim(store).seq == 3
    store.close()


def test_one_report_can_be_enough(maker: SqliteMaker, clock: Clock) -> None:
    store = maker.open(StoreConfig(merge_delay_s=60, merge_after_reports=1), clock)
    store.put_reports([report(1)])
    assert only_claim(store).tile == TILE
    store.close()


def test_a_claimed_tile_is_nobody_elses_until_the_lease_ends(store: Store, clock: Clock) -> None:
    store.put_reports([report(1)])
    first = only_claim(store, "m1", lease_s=5.0)
    assert first.attempts == 1
    assert store.claim("m2", 10, 5.0) == []
    assert store.claim("m1", 10, 5.0) == []
    assert store.next_ready_ns() == clock.ns + 5_000_000_000
    clock.advance(5.0)
    second = only_claim(store, "m2")
    assert second.attempts == 2
    assert second.token != first.token


def test_a_renewed_lease_lasts_longer_and_a_lost_one_cannot_be_renewed(store: Store, clock: Clock) -> None:
    store.put_reports([report(1)])
    claim = only_claim(store, "m1", lease_s=5.0)
    clock.advance(4.0)
    assert store.renew([claim], 5.0) == [True]
    clock.advance(4.0)
    assert store.claim("m2", 10, 5.0) == []
    clock.advance(1.0)
    only_claim(store, "m2")
    assert store.renew([claim], 5.0) == [False]


def test_the_leases_of_the_dead_are_freed_at_once(store: Store) -> None:
    store.put_reports([report(1), report(1, EAST), report(1, FAR)])
    assert len(store.claim("dead", 2, 600.0)) == 2
    (mine,) = store.claim("alive", 10, 600.0)
    assert store.release("dead") == 2
    assert store.release("dead") == 0
    assert {claim.tile for claim in store.claim("alive", 10, 600.0)} == {FAR, TILE, EAST} - {mine.tile}


def test_a_postponed_tile_waits_and_counts_its_attempts(store: Store, clock: Clock) -> None:
    store.put_reports([report(1)])
    store.postpone(only_claim(store), 3.0)
    assert store.claim("m2", 1, 10.0) == []
    clock.advance(3.0)
    assert only_claim(store, "m2").attempts == 2


def test_only_the_holder_can_postpone(store: Store, clock: Clock) -> None:
    store.put_reports([report(1)])
    old = only_claim(store, "m1", lease_s=1.0)
    clock.advance(1.0)
    only_claim(store, "m2", lease_s=60.0)
    store.postpone(old, 0.0)
    assert store.claim("m3", 1, 10.0) == []


def test_own_regions_come_first_then_any(store: Store) -> None:
    store.put_reports([report(1, FAR), report(1, TILE), report(1, EAST)])
    (first,) = store.claim("m1", 1, 10.0, prefer=["13033/03021/23031"])
    assert first.tile == TILE
    rest = store.claim("m1", 10, 10.0, prefer=("02", "13033/03021"))
    assert [claim.tile for claim in rest] == [EAST, FAR]


def test_a_region_that_is_none_is_refused(store: Store) -> None:
    store.put_reports([report(1)])
    with pytest.raises(StoreError, match="13a33"):
        store.claim("m1", 1, 10.0, prefer=["13a33"])


def test_never_more_tiles_than_asked_for(store: Store) -> None:
    store.put_reports([report(1, tile) for tile in (TILE, EAST, FAR)])
    assert len(store.claim("m1", 2, 10.0, prefer=["1", "0", "13033"])) == 2
    assert store.claim("m1", 0, 10.0) == []


def test_claims_of_two_owners_never_overlap(maker: SqliteMaker) -> None:
    clock = Clock()
    stores = [maker.open(EAGER, clock) for _ in range(2)]
    tiles = [TILE.neighbours()[0], TILE, *EAST.neighbours()]
    stores[0].put_reports([report(1, tile) for tile in set(tiles)])
    taken: list[object] = []

    def take(number: int) -> None:
        while claims := stores[number].claim(f"m{number}", 1, 60.0):
            taken.extend(claim.tile for claim in claims)

    threads = [threading.Thread(target=take, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(taken) == len(set(taken)) == len(set(tiles))
    for one in stores:
        one.close()


def test_attempts_start_anew_after_a_publication(store: Store) -> None:
    store.put_reports([report(1)])
    claim = only_claim(store)
    store.put_reports([report(2)])
    store.publish([publication(store.load(claim), 1)])
    store.put_reports([report(3)])
    assert only_claim(store).attempts == 1
