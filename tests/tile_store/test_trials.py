"""Versions on trial in the store and in the answers of the tile server."""

from dataclasses import replace

import apsw
import pytest
from store_helpers import EAGER, TILE, report, tile_of_voxels

from gnd.gnd_map.tile_id import TileId
from gnd.schemas.ticket import TICKETS, ticket_of
from gnd.schemas.tiles_batch import HeldVersion, TileAnswer, TilesReply, TilesRequest
from gnd.tile_store import released as released_tiles
from gnd.tile_store import releasing
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.answers import TileAnswers
from gnd.tile_store.errors import StoreError
from gnd.tile_store.released import released, released_heads
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.trials import TrialTerms, VehicleHealth, VersionTrial
from gnd.tile_store.values import Claim, Publication

OLD, NEW = tile_of_voxels(TILE, 1, 2), tile_of_voxels(TILE, 1, 2, 3)
TERMS = TrialTerms(0.5, 3600.0)
DISTRICT = TILE.district


@pytest.fixture
def store(tmp_path):
    with SqliteStore(tmp_path / "map.sqlite", EAGER) as opened:
        opened.put_tiles([OLD])
        publish(opened, NEW, 1)
        yield opened


def publish(store: SqliteStore, tile, number: int, terms: TrialTerms | None = TERMS) -> str:
    """A merge of one report that gives this content."""
    store.put_reports([report(number, tile.tile_id)])
    (claim,) = store.claim("one", 1, 30.0)
    work = store.load(claim)
    (found,) = store.publish(
        [Publication(claim, work.base_version, tile, report_ids=(report(number, tile.tile_id).report_id,), trial=terms)]
    )
    return found.status


def trial_of(store: SqliteStore) -> VersionTrial:
    return store.trials("ndt")[TILE]


def tickets(trial: VersionTrial, *, first: bool) -> int:
    return next(ticket for ticket in range(1, TICKETS) if trial.is_among_first(ticket) == first)


def answer(store: SqliteStore, ticket: int = 0, held=None, *, newest: bool = False) -> tuple[TileAnswer, bool]:
    """Of the tile server, over the wire; and whether it asks how the vehicle fares there."""
    wanted = HeldVersion(TILE) if held is None else HeldVersion(TILE, held.version, held.sha)
    request = TilesRequest.decode(TilesRequest.of([wanted], ticket=ticket, newest=newest).encode())
    reply = TilesReply.decode(TileAnswers(store).many("ndt", DISTRICT, request).encode())
    return reply.answers[0], reply.watched == (0,)


def test_a_version_on_trial_is_the_newest_and_not_released(store):
    assert store.get("ndt", TILE).version == 2
    assert released(store, "ndt", TILE).version == 1
    assert [(one.version, one.sha) for one in released_heads(store, "ndt", "")] == [(1, OLD.sha)]
    assert store.notices() == []


def test_a_region_that_is_read_whole_has_the_version_before_it(store, monkeypatch):
    monkeypatch.setattr(released_tiles, "READ_AT_ONCE", 2)
    others = [TileId(TILE.morton + n) for n in range(1, 5)]
    store.put_tiles([tile_of_voxels(tile, 1) for tile in others[1:]])
    asked = [TILE, *others]
    found = list(released_tiles.released_each(store, "ndt", asked, DISTRICT.path))
    assert found == [(tile, released(store, "ndt", tile)) for tile in asked]
    assert found[0][1] is not None
    assert (found[0][1].sha, found[1][1]) == (OLD.sha, None)


def test_vehicles_get_it_by_their_tickets_and_all_others_the_one_before(store):
    trial = trial_of(store)
    first, other = tickets(trial, first=True), tickets(trial, first=False)
    assert (answer(store, first)[0].version, answer(store, other)[0].version, answer(store)[0].version) == (2, 1, 1)
    assert answer(store, newest=True)[0].version == 2
    assert (answer(store, first)[1], answer(store, other)[1], answer(store)[1]) == (True, True, False)


def test_who_holds_it_keeps_it_whatever_its_ticket_is_by_now(store):
    trial = trial_of(store)
    held = store.get("ndt", TILE).decode()
    assert answer(store, tickets(trial, first=False), held)[0].status == "unchanged"


def test_the_first_get_it_as_a_delta_and_who_holds_it_loses_it_by_a_delta(store):
    first = tickets(trial_of(store), first=True)
    got, _ = answer(store, first, store.get("ndt", TILE, 1).decode())
    assert (got.status, got.version) in {("delta", 2), ("blob", 2)}
    releasing.withdraw(store, trial_of(store), "test", "it is wrong")
    got, watched = answer(store, first, store.get("ndt", TILE, 2).decode())
    assert got.version == 3
    assert not watched


def test_other_tiles_and_versions_have_other_first_vehicles_and_the_share_is_kept(store):
    trial = trial_of(store)
    some = [ticket for ticket in range(1, 4001) if trial.is_among_first(ticket)]
    assert 0.47 < len(some) / 4000 < 0.53
    for other in ({"tile": TileId(TILE.morton + 1)}, {"version": 3}, {"salt": b"another store's"}):
        also = [ticket for ticket in some if _with(trial, **other).is_among_first(ticket)]
        assert 0.45 < len(also) / len(some) < 0.55
    assert not trial.is_among_first(0)
    assert 1 <= ticket_of("car-1") <= TICKETS


def _with(trial: VersionTrial, **values) -> VersionTrial:
    return replace(trial, **values)


def test_what_is_reported_meanwhile_waits(store):
    store.put_reports([report(2, TILE)])
    assert store.claim("one", 1, 30.0) == []
    assert store.ready_in_s() is None
    assert store.queue_state().overdue_s == 0.0
    assert store.dirty_count() == 1
    assert releasing.release(store, trial_of(store), "test", "well")
    assert [claim.tile for claim in store.claim("one", 1, 30.0)] == [TILE]


def test_release_gives_it_to_all_with_a_notice_once(store):
    trial = trial_of(store)
    assert releasing.release(store, trial, "somebody", "all is well")
    assert not releasing.release(store, trial, "somebody", "again")
    assert not releasing.withdraw(store, trial, "somebody", "too late")
    assert [(one.tile, one.version) for one in store.notices()] == [(TILE, 2)]
    assert released(store, "ndt", TILE).version == 2
    assert store.trials("ndt") == {}
    assert [(one.who, one.action, one.why) for one in store.look(lambda c: trials.steered(c, "ndt", TILE))] == [
        ("somebody", "released", "all is well")
    ]


def test_withdrawal_is_the_next_version_with_the_old_content_and_doubts_its_reports(store):
    assert releasing.withdraw(store, trial_of(store), "shard one", "worse")
    head = store.get("ndt", TILE)
    assert (head.version, head.kind, head.sha) == (3, "rollback", OLD.sha)
    assert [(one.tile, one.version) for one in store.notices()] == [(TILE, 3)]
    (doubted,) = store.look(lambda c: trials.doubted_reports(c, "ndt", TILE))
    assert store.doubted_vehicles("ndt", TILE) == {doubted.vehicle}
    assert store.doubted_vehicles("ndt", TileId(TILE.morton + 1)) == frozenset()
    assert releasing.clear(store, "ndt", TILE, "operator", "looked at it") == 1
    assert store.doubted_vehicles("ndt", TILE) == frozenset()
    with pytest.raises(StoreError, match="no report about tile"):
        releasing.clear(store, "ndt", TILE, "operator", "again")


def test_a_base_or_an_operators_rollback_takes_the_place_of_a_trial(store):
    store.rollback("ndt", TILE, 1)
    assert store.trials("ndt") == {}
    (known,) = store.look(lambda c: trials.of_tile(c, "ndt", TILE))
    assert (known.state, known.settled_ns is not None) == ("superseded", True)
    assert [one.version for one in store.notices()] == [3]


def test_a_merge_that_was_begun_before_the_trial_is_stale(store, tmp_path):
    store.put_reports([report(5, TILE)])
    with apsw.Connection(str(store.path)) as c:  # as a shard of an older release would claim
        c.execute("UPDATE dirty SET owner = 'old', token = 77, lease_ns = 9e18")
    claim = Claim("ndt", TILE, 99, "old", 77)
    (found,) = store.publish([Publication(claim, 2, OLD)])
    assert found.status == "stale"
    assert store.get("ndt", TILE).version == 2


def test_what_nobody_has_before_is_released_at_once(store):
    new = TileId(TILE.morton + 3)
    assert publish(store, tile_of_voxels(new, 1), 7) == "published"
    assert new not in store.trials("ndt")


def test_upkeep_keeps_the_version_that_all_others_have(store):
    store.gc(1)
    assert released(store, "ndt", TILE) is not None
    assert releasing.withdraw(store, trial_of(store), "test", "worse")


def test_vehicles_beyond_the_bound_are_not_heard_and_the_newest_message_of_each_counts(store, monkeypatch):
    monkeypatch.setattr(trials, "ARM_MOST", 3)
    trial = trial_of(store)

    def told(vehicle: str, t_ns: int, scans: int = 5) -> bool:
        row = VehicleHealth(vehicle, "new", 0, t_ns, scans, 900, 800, 800, scans, 0, 0, False)
        return store.transact(lambda c, now: trials.put_health(c, trial, row, now))

    assert [told(f"car-{k}", 10) for k in range(5)] == [True, True, True, False, False]
    assert told("car-1", 11, 6)
    assert not told("car-1", 11, 7)
    assert not told("car-1", 12, 0)  # that it takes the tile once more says nothing against what it told
    rows = store.look(lambda c: trials.health(c, trial))
    assert [(row.vehicle, row.scans) for row in rows] == [("car-0", 5), ("car-1", 6), ("car-2", 5)]
    releasing.release(store, trial, "test", "well")
    assert store.look(lambda c: c.execute("SELECT COUNT(*) FROM trial_health").get) == 0


def test_only_so_many_settled_trials_are_told_of(store, monkeypatch):
    monkeypatch.setattr(trials, "SETTLED_KEPT", 2)
    releasing.release(store, trial_of(store), "test", "well")
    contents = [tile_of_voxels(TILE, 1, 2, 4 + k) for k in range(4)]
    for number, tile in enumerate(contents, 10):
        publish(store, tile, number)
        releasing.release(store, trial_of(store), "test", "well")
    assert [one.version for one in store.look(lambda c: trials.settled(c, 10))] == [6, 5]


def test_pausing_and_resuming_are_written_down(store):
    assert releasing.hold(store, trial_of(store), "me", "rain", paused=True)
    assert trial_of(store).state == "paused"
    assert releasing.hold(store, trial_of(store), "me", "dry", paused=False)
    assert [one.action for one in store.look(lambda c: trials.steered(c, "ndt", TILE))] == ["paused", "resumed"]


@pytest.mark.parametrize(("share", "longest_s"), [(0.0, 1.0), (1.1, 1.0), (0.1, 0.0)])
def test_terms_that_cannot_be_are_refused(share, longest_s):
    with pytest.raises(StoreError, match="share"):
        TrialTerms(share, longest_s)
