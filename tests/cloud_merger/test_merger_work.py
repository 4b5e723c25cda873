"""Merging claimed tiles: what is published, and what happens to a tile whose merge fails."""

import logging
from dataclasses import replace

import apsw
import numpy as np
import pytest
from merger_world import (
    GROUND,
    NEIGHBOUR,
    POLE,
    TILE,
    VOXEL_BY_VOXEL,
    WALL,
    change_of,
    gaussians_of,
    report_of,
    tile_of_states,
)
from upload_desk import Desk

from gnd.cloud_merger import work
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.work import SETTLED_TOGETHER, Worker, in_turn
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import change_key
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import Claim, ReportRow, StoreConfig

STATES = {0: GROUND, 1: WALL}
BASE = gaussians_of(STATES)
KEY = change_key("ndt", TILE.district)


@pytest.fixture
def store(tmp_path):
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([tile_of_states(STATES, tile) for tile in (TILE, NEIGHBOUR)])
        yield store


@pytest.fixture
def worker(store, tmp_path, monkeypatch):
    """Three attempts without a pause."""
    monkeypatch.setattr(work, "MAX_ATTEMPTS", 3)
    monkeypatch.setattr(work, "RETRY_S", 0.0)
    return Worker(store, ShardConfig(store_path=tmp_path / "map.sqlite", confirmation=VOXEL_BY_VOXEL))


def put(store, number, tile=TILE, changed=None, base=BASE, version=1):
    changed = {2: POLE} if changed is None else changed
    report = report_of(number, change_of(base, [0, 1, 2], changed, tile=tile, version=version))
    assert Desk(store).send(KEY, report.encode()).status == "released"
    return report.report_id


def merge_once(store, worker):
    return store.publish(worker.merge(store.claim("one", 16, 30.0)))


def head(store, tile=TILE):
    return store.get("ndt", tile).decode()


def test_a_merge_becomes_the_next_version_and_names_its_reports(store, worker):
    one = put(store, 1)
    assert [(r.status, r.version) for r in merge_once(store, worker)] == [("published", 2)]
    assert head(store).gaussians == gaussians_of({**STATES, 2: POLE})
    assert store.provenance("ndt", TILE, 2) == (one,)
    assert store.voxel_provenance("ndt", TILE, 2) == {2: (one,)}
    assert store.dirty_count() == 0


def test_reports_that_change_nothing_are_consumed_without_a_version(store, worker):
    put(store, 1, changed={})
    assert [(r.status, r.version) for r in merge_once(store, worker)] == [("unchanged", 1)]
    assert store.counts().waiting == store.dirty_count() == 0


def test_a_tile_without_a_map_of_which_nobody_says_anything_gets_no_version(store, worker):
    unmapped = TileId(TILE.morton - 2)
    put(store, 1, tile=unmapped, changed={}, base=None)
    assert [(r.status, r.version) for r in merge_once(store, worker)] == [("unchanged", 0)]
    put(store, 2, tile=unmapped, base=None)
    put(store, 3, tile=unmapped, base=None)
    assert [(r.status, r.version) for r in merge_once(store, worker)] == [("published", 1)]


def test_what_one_car_published_others_take_back(store, worker):
    put(store, 1)
    merge_once(store, worker)
    put(store, 2, changed={2: None}, base=head(store).gaussians, version=2)
    merge_once(store, worker)
    assert head(store).gaussians == BASE  # 1 against 1: not more than ξ for the pole
    assert store.get("ndt", TILE).version == 3


def test_after_a_rollback_only_later_reports_count(store, worker):
    put(store, 1)
    merge_once(store, worker)
    store.rollback("ndt", TILE, 1)
    put(store, 2, changed={1: None})
    merge_once(store, worker)
    assert head(store).gaussians == gaussians_of({0: GROUND})


def damage(store, tile):
    """Flip a byte of the newest body, as a failing disk would."""
    with apsw.Connection(str(store.path)) as connection:
        select = "SELECT body FROM tile_version WHERE tile = ? AND version = 1"
        body = bytearray(connection.execute(select, (tile.morton,)).get)
        body[-1] ^= 0x40
        connection.execute("UPDATE tile_version SET body = ? WHERE tile = ?", (bytes(body), tile.morton))


def test_a_tile_whose_merge_fails_is_set_aside_after_some_attempts_and_the_others_go_on(store, worker, caplog):
    damage(store, NEIGHBOUR)
    failing = put(store, 1, tile=NEIGHBOUR)
    put(store, 2)
    with caplog.at_level(logging.CRITICAL):
        assert [r.status for r in merge_once(store, worker)] == ["published"]
        assert store.dirty_count() == 1
        assert merge_once(store, worker) == []
        assert merge_once(store, worker) == []
    assert store.dirty_count() == 0
    (aside,) = store.tiles_set_aside()
    assert (aside.tile, aside.attempts, aside.reports) == (NEIGHBOUR, 3, 1)
    assert "damaged" in aside.reason
    assert [row.report_id for row in store.in_play("ndt", NEIGHBOUR).reports] == [failing]
    damage(store, NEIGHBOUR)  # the same bit again: it is whole
    assert store.take_up_again([("ndt", NEIGHBOUR)]) == 1
    assert [r.status for r in merge_once(store, worker)] == ["published"]
    assert store.provenance("ndt", NEIGHBOUR, 2) == (failing,)
    assert (store.tiles_set_aside(), store.counts().waiting) == ([], 0)


def test_a_damaged_page_stops_its_own_tile_only(tmp_path, caplog, monkeypatch):
    path = tmp_path / "damaged.sqlite"
    monkeypatch.setattr(work, "MAX_ATTEMPTS", 2)
    monkeypatch.setattr(work, "RETRY_S", 0.0)
    config = ShardConfig(store_path=path, confirmation=VOXEL_BY_VOXEL)
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([large_tile(NEIGHBOUR), tile_of_states(STATES, TILE)])
        body = store.get("ndt", NEIGHBOUR).body
    damage_page(path, body)
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store, caplog.at_level(logging.CRITICAL):
        failing = put(store, 1, tile=NEIGHBOUR, base=None)
        put(store, 2)
        worker = Worker(store, config)
        results = []
        while claims := store.claim("one", 16, 30.0):
            for some in in_turn(claims):
                results += worker.settle_some(some)
        assert [r.status for r in results if r] == ["published"]
        (aside,) = store.tiles_set_aside()
        assert (aside.tile, aside.attempts) == (NEIGHBOUR, 2)
        assert "StoreDamaged" in aside.reason
        assert [row.report_id for row in store.reports() if row.tile == NEIGHBOUR] == [failing]


def test_first_attempts_share_a_commit_and_whoever_was_tried_before_goes_alone():
    first = [Claim("ndt", TILE, number, "one", number) for number in range(SETTLED_TOGETHER + 1)]
    again, aside = replace(first[0], attempts=2), replace(first[1], is_retry=True)
    groups = list(in_turn([first[0], again, *first[1:], aside]))
    assert [claim for some in groups for claim in some if claim.attempts == 1 and not claim.is_retry] == first
    assert [again] in groups
    assert [aside] in groups
    assert max(map(len, groups)) == SETTLED_TOGETHER


def test_a_publication_that_is_refused_takes_no_other_with_it(store, worker, monkeypatch):
    for number, tile in enumerate((TILE, NEIGHBOUR)):
        put(store, number, tile=tile)
    attempt = worker._attempt

    def with_a_stranger(claim):
        publication = attempt(claim)
        return replace(publication, report_ids=("0" * 26,)) if claim.tile == NEIGHBOUR else publication

    monkeypatch.setattr(worker, "_attempt", with_a_stranger)
    claims = store.claim("one", 16, 30.0)
    assert len(claims) == 2
    results = {claim.tile: result for claim, result in zip(claims, worker.settle_some(claims), strict=True)}
    assert results[NEIGHBOUR] is None
    assert results[TILE].status == "published"


def large_tile(tile):
    """One that needs several pages."""
    random = np.random.default_rng(5)
    n = 2000
    ids = np.arange(n, dtype=np.int32)
    half = np.tile(np.array([0.01, 0, 0, 0.01, 0, 0.01], dtype=np.float32), (n, 1))
    mean_m = random.uniform(0.1, 0.9, (n, 3)).astype(np.float32)
    return Tile(tile, 0, Gaussians(ids, np.full(n, 50, np.int32), np.full(n, 9, np.int32), mean_m, half))


def damage_page(path, body):
    """Break the chain of pages in the middle of a body, as a failing disk would."""
    raw = bytearray(path.read_bytes())
    at = raw.index(body[len(body) // 2 : len(body) // 2 + 64]) // 4096 * 4096
    raw[at : at + 4] = b"\xff" * 4
    path.write_bytes(raw)


def test_a_tile_that_kills_its_shards_is_set_aside_without_another_attempt(store, worker):
    first = put(store, 1)
    for shard in ("a", "b", "c"):
        (claim,) = store.claim(shard, 1, 30.0)
        assert store.begin([claim], 30.0) == [True]
        store.release(shard)  # as the others do when it has died
    assert merge_once(store, worker) == []
    assert "no shard that merged it came to an end" in store.tiles_set_aside()[0].reason
    second = put(store, 2)  # the next report gives both another chance
    assert [r.status for r in merge_once(store, worker)] == ["published"]
    assert store.provenance("ndt", TILE, 2) == (first, second)


def test_a_stored_report_that_cannot_be_read_any_more_is_left_out_and_said_so(store, worker):
    put(store, 1)
    store.put_reports([ReportRow("01HF7YAT00" + "0" * 16, "ndt", TILE, "car", 0, b"\xff")])
    assert [r.status for r in merge_once(store, worker)] == ["published"]
    assert head(store).gaussians == gaussians_of({**STATES, 2: POLE})
    assert "cannot be read any more" in store.quarantined()[0].reason


def test_a_lease_that_was_lost_publishes_nothing(store, worker):
    put(store, 1)
    claims = store.claim("slow", 16, 30.0)
    publications = worker.merge(claims)
    store.release("slow")
    assert [r.status for r in merge_once(store, worker)] == ["published"]
    assert [r.status for r in store.publish(publications)] == ["stale"]
    assert store.get("ndt", TILE).version == 2


def test_a_lease_that_was_lost_before_its_turn_is_no_work_and_no_crash(store, worker):
    put(store, 1)
    (claim,) = store.claim("slow", 16, 30.0)
    store.release("slow")
    assert [r.status for r in merge_once(store, worker)] == ["published"]
    assert worker.settle(claim) is None
    assert (store.get("ndt", TILE).version, store.dirty_count(), store.tiles_set_aside()) == (2, 0, [])


def test_idle_time_ends_when_the_next_tile_is_ready(store, worker):
    assert worker.idle_s(None) == ShardConfig().poll_s
    assert worker.idle_s(0.1) == pytest.approx(0.1)
    assert worker.idle_s(0.001) == pytest.approx(0.005)
    assert worker.idle_s(-3.0) == pytest.approx(0.05), "it was not given: it is another shard's"
