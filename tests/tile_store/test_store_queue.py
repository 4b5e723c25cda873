"""The queue of dirty tiles: when a tile is ready, who may merge it, and what happens when that one dies."""

import threading
from dataclasses import replace

import pytest
from store_helpers import EAGER, EAST, FAR, TILE, Clock, Maker, of_a_file, only_claim, publication, report

from gnd.gnd_map.tile_id import District, TileId
from gnd.tile_store import clocks
from gnd.tile_store.sql_inbox import LOOKED_AT
from gnd.tile_store.store import Store
from gnd.tile_store.values import StoreConfig

PATIENT = StoreConfig(merge_delay_s=2.0, merge_after_reports=3)


def test_nothing_to_do_in_an_empty_store(store: Store) -> None:
    assert store.claim("m1", 10, 10.0) == []
    assert store.ready_in_s() is None
    assert store.dirty_count() == 0


def test_a_tile_is_ready_a_delay_after_its_first_report(maker: Maker, clock: Clock) -> None:
    store = maker.open(PATIENT, clock)
    store.put_reports([report(1)])
    clock.advance(1.5)
    store.put_reports([report(2)])
    assert store.ready_in_s() == pytest.approx(0.5)
    assert store.claim("m1", 1, 10.0) == []
    clock.advance(0.5)
    assert only_claim(store).seq == 2
    store.close()


def test_a_tile_is_ready_at_once_when_enough_reports_wait(maker: Maker, clock: Clock) -> None:
    store = maker.open(PATIENT, clock)
    store.put_reports([report(1), report(2)])
    assert store.claim("m1", 1, 10.0) == []
    store.put_reports([report(3)])
    assert only_claim(store).seq == 3
    store.close()


def test_what_is_half_said_waits_for_its_gaussians_but_not_for_ever(maker: Maker, clock: Clock) -> None:
    store = maker.open(PATIENT, clock)
    half = replace(report(1), is_half=True)
    store.put_reports([half])
    assert store.ready_in_s() == pytest.approx(8.0)
    clock.advance(1.0)
    store.put_reports([replace(half, part=1, is_half=False)])
    assert store.ready_in_s() == pytest.approx(2.0), "its other half has come"
    store.put_reports([replace(report(2, EAST), is_half=True), replace(report(3, EAST), is_half=True)])
    store.put_reports([replace(report(4, EAST), is_half=True)])
    clock.advance(2.0)
    assert only_claim(store).tile == TILE
    store.put_reports([report(5, EAST)])
    assert only_claim(store).tile == EAST, "enough wait, and one of them is whole"
    store.close()


def test_one_report_can_be_enough(maker: Maker, clock: Clock) -> None:
    store = maker.open(StoreConfig(merge_delay_s=60, merge_after_reports=1), clock)
    store.put_reports([report(1)])
    assert only_claim(store).tile == TILE
    store.close()


def test_a_claimed_tile_is_nobody_elses_until_the_lease_ends(store: Store, clock: Clock) -> None:
    store.put_reports([report(1)])
    first = only_claim(store, "m1", lease_s=5.0)
    assert first.attempts == 1
    assert store.begin([first], 5.0) == [True]
    assert store.claim("m2", 10, 5.0) == []
    assert store.claim("m1", 10, 5.0) == []
    assert store.ready_in_s() == pytest.approx(5.0)
    clock.advance(5.0)
    second = only_claim(store, "m2")
    assert second.attempts == 2
    assert second.token != first.token


def test_a_renewed_lease_lasts_longer_and_a_lost_one_cannot_be_renewed(store: Store, clock: Clock) -> None:
    store.put_reports([report(1)])
    claim = only_claim(store, "m1", lease_s=5.0)
    clock.advance(4.0)
    assert store.beat("m1", [claim], 5.0) == [True]
    clock.advance(4.0)
    assert store.claim("m2", 10, 5.0) == []
    clock.advance(1.0)
    only_claim(store, "m2")
    assert store.beat("m1", [claim], 5.0) == [False]


def test_the_leases_of_the_dead_are_freed_at_once(store: Store) -> None:
    store.put_reports([report(1), report(1, EAST), report(1, FAR)])
    assert len(store.claim("dead", 2, 600.0)) == 2
    (mine,) = store.claim("alive", 10, 600.0)
    assert store.release("dead") == 2
    assert store.release("dead") == 0
    assert {claim.tile for claim in store.claim("alive", 10, 600.0)} == {FAR, TILE, EAST} - {mine.tile}


def test_a_postponed_tile_waits_and_counts_its_attempts(store: Store, clock: Clock) -> None:
    store.put_reports([report(1)])
    claim = only_claim(store)
    assert store.begin([claim], 10.0) == [True]
    store.postpone(claim, 3.0)
    assert store.claim("m2", 1, 10.0) == []
    clock.advance(3.0)
    again = only_claim(store, "m2")
    assert again.attempts == 2
    assert store.begin([again], 10.0) == [True]
    store.postpone(again, 1.0, blameless=True)
    clock.advance(1.0)
    assert only_claim(store, "m1").attempts == 2, "the second attempt does not count"


def test_only_the_holder_can_postpone(store: Store, clock: Clock) -> None:
    store.put_reports([report(1)])
    old = only_claim(store, "m1", lease_s=1.0)
    clock.advance(1.0)
    only_claim(store, "m2", lease_s=60.0)
    store.postpone(old, 0.0)
    assert store.claim("m3", 1, 10.0) == []


def of_here(district: District) -> bool:
    return district == TILE.district


def test_another_shards_tile_is_left_to_it_for_a_second(store: Store, clock: Clock) -> None:
    store.put_reports([report(1, FAR), report(1, TILE), report(1, EAST)])
    assert [claim.tile for claim in store.claim("m1", 10, 10.0, of_here)] == [TILE, EAST]
    assert store.ready_in_s() == 0.0
    clock.advance(0.999)
    assert store.claim("m1", 10, 10.0, of_here) == []
    clock.advance(0.002)
    assert [claim.tile for claim in store.claim("m1", 10, 10.0, of_here)] == [FAR]


def test_who_has_tiles_of_its_own_helps_where_others_lag_twice_as_far(store: Store, clock: Clock) -> None:
    store.put_reports([report(1, FAR)])
    clock.advance(5.0)
    store.put_reports([report(1, TILE)])
    clock.advance(3.0)
    assert [claim.tile for claim in store.claim("m1", 2, 0.1, of_here)] == [FAR, TILE], "8 s are more than 1 + 2 * 3"
    clock.advance(1.1)
    assert [claim.tile for claim in store.claim("m1", 2, 1.0, of_here)] == [TILE, FAR], (
        "9.1 s are less than 1 + 2 * 4.1"
    )


def test_own_tiles_behind_very_many_of_a_slow_shard_are_not_waited_for(store: Store, clock: Clock) -> None:
    first = FAR.district.first_morton
    store.put_reports([report(1, TileId(first + k)) for k in range(LOOKED_AT + 1)])
    clock.advance(0.1)
    store.put_reports([report(1, TILE)])
    (claim,) = store.claim("m1", 1, 10.0, of_here)
    assert claim.tile.district == FAR.district, "it has looked at no other ones"


def test_never_more_tiles_than_asked_for(store: Store) -> None:
    store.put_reports([report(1, tile) for tile in (TILE, EAST, FAR)])
    assert len(store.claim("m1", 2, 10.0, lambda _: True)) == 2
    assert store.claim("m1", 0, 10.0) == []


def test_claims_of_two_owners_never_overlap(maker: Maker) -> None:
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


def test_only_a_merge_that_was_begun_counts_as_an_attempt(store: Store) -> None:
    store.put_reports([report(1), report(1, EAST)])
    first, second = store.claim("killed", 2, 10.0)
    assert store.begin([first], 10.0) == [True]
    store.release("killed")
    assert {claim.tile: claim.attempts for claim in store.claim("m2", 2, 10.0)} == {first.tile: 2, second.tile: 1}
    assert store.begin([second], 10.0) == [False]


@pytest.mark.parametrize("step_s", [-86_400.0, 86_400.0])
def test_the_time_of_day_may_step_and_the_queue_does_not_care(maker: Maker, step_s: float) -> None:
    day, steady = Clock(), Clock()
    with maker.open(PATIENT, day, steady) as store:
        store.put_reports([report(1)])
        day.advance(step_s)
        assert store.claim("m1", 1, 10.0) == []
        assert store.ready_in_s() == pytest.approx(2.0)
        steady.advance(2.0)
        claim = only_claim(store, "m1", lease_s=10.0)
        day.advance(-2 * step_s)
        assert store.claim("m2", 1, 10.0) == []
        assert store.beat("m1", [claim], 10.0) == [True]
        steady.advance(10.0)
        assert only_claim(store, "m2").token != claim.token


@of_a_file
def test_leases_and_delays_of_another_boot_are_over(maker: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    late, early = Clock(), Clock()
    early.ns = 5_000_000_000
    with maker.open(PATIENT, steady=late) as store:
        store.put_reports([report(1), report(2), report(3), report(1, EAST)])
        held = only_claim(store, "dead", lease_s=600.0)
        assert [one.is_alive for one in store.shards()] == []
        store.join("alive")
        assert [one.is_alive for one in store.shards()] == [True]
    monkeypatch.setattr(clocks, "boot_id", lambda: "another")
    with maker.open(PATIENT, steady=early) as store:
        assert [one.is_alive for one in store.shards()] == [False]
        assert {one.tile for one in store.claim("m1", 10, 10.0)} == {TILE, EAST}
        assert store.beat("dead", [held], 10.0) == [False]
        assert store.claim("m2", 10, 10.0) == []


def test_a_tile_set_aside_waits_with_its_reports_until_it_is_taken_up_again(store: Store, clock: Clock) -> None:
    store.put_reports([report(1), report(2), report(1, EAST)])
    claim = next(one for one in store.claim("m1", 2, 5.0) if one.tile == TILE)
    assert store.begin([claim], 5.0) == [True]
    assert store.set_aside(claim, "a page is damaged")
    clock.advance(59.0)
    assert [one.tile for one in store.claim("m1", 2, 5.0)] == [EAST]
    (aside,) = store.tiles_set_aside()
    assert (aside.tile, aside.attempts, aside.reports, aside.reason) == (TILE, 1, 2, "a page is damaged")
    assert (store.dirty_count(), store.counts().dirty, store.counts().waiting, store.counts().set_aside) == (1, 1, 3, 1)
    assert not store.set_aside(claim, "a lease that is gone")
    assert store.take_up_again([("ndt", TILE), ("ndt", EAST), ("signs", TILE)]) == 1
    again = only_claim(store)
    assert (again.tile, again.attempts, again.seq) == (TILE, 1, 2)
    store.publish([publication(store.load(again), 1)])
    assert (store.tiles_set_aside(), store.counts().waiting) == ([], 1)


def test_a_tile_set_aside_is_tried_once_in_a_while_whatever_becomes_of_its_shard(store: Store, clock: Clock) -> None:
    store.put_reports([report(1)])
    for attempt in range(1, 6):
        claim = only_claim(store)
        assert (claim.attempts, claim.is_retry) == (attempt, False)
        assert store.begin([claim], 10.0) == [True]
        store.set_aside(claim, "why") if attempt == 5 else store.release("m1")
    for pause_s in (60.0, 120.0, 240.0):
        clock.advance(pause_s - 1.0)
        assert store.claim("m1", 1, 10.0) == []
        clock.advance(1.0)
        claim = only_claim(store)
        assert claim.is_retry
        assert store.begin([claim], 10.0) == [True]
        store.release("m1")  # it has killed this shard, too: no other is sent after it at once
    clock.advance(1e5)
    assert only_claim(store).is_retry
    (aside,) = store.tiles_set_aside()
    assert aside.attempts == 8


def test_the_next_report_gives_a_tile_set_aside_another_chance(store: Store) -> None:
    store.put_reports([report(1)])
    claim = only_claim(store)
    assert store.begin([claim], 5.0) == [True]
    store.set_aside(claim, "why")
    store.put_reports([report(2)])
    assert store.tiles_set_aside() == []
    again = only_claim(store)
    assert (again.seq, again.attempts) == (2, 1)


def test_a_shard_shows_that_it_lives_and_keeps_its_leases(store: Store, clock: Clock) -> None:
    store.put_reports([report(1), report(1, EAST)])
    store.join("m1")
    claims = store.claim("m1", 2, 5.0)
    clock.advance(4.0)
    assert store.beat("m1", claims, 5.0) == [True, True]
    clock.advance(4.0)
    assert store.claim("m2", 2, 5.0) == []
    (seen,) = store.shards()
    assert (seen.owner, seen.silent_s, seen.is_alive) == ("m1", 4.0, True)
    clock.advance(11.0)
    assert not store.shards()[0].is_alive
    store.join("m1")
    assert len(store.claim("m1", 2, 5.0)) == 2
    clock.advance(86_401.0)
    store.join("m2")  # a day later m1 is not told of any more
    assert [one.owner for one in store.shards()] == ["m2"]
    store.leave("m2")
    store.release("m1")
    assert (store.shards(), len(store.claim("m2", 2, 5.0))) == ([], 2)
