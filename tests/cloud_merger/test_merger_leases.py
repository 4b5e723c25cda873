"""Leases while batches are worked on: renewed in time, lost without harm, not kept for ever."""

import threading
import time

import pytest
from merger_world import GROUND, POLE, VOXEL_BY_VOXEL, WALL, change_of, gaussians_of, report_of, tile_of_states

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.leases import LONGEST_WORK_S, Leases
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import split
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow, StoreConfig

STATES = {0: GROUND, 1: WALL}
BASE = gaussians_of(STATES)
TILES = [TileId(497353963000 + k) for k in range(8)]
LEASE_S = 0.6


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "map.sqlite"
    with open_store(path) as store:
        store.put_tiles([tile_of_states(STATES, tile) for tile in TILES])
        for n, tile in enumerate(TILES):
            report = report_of(n, change_of(BASE, [0, 1, 2], {2: POLE}, tile=tile))
            ((_, body),) = split(report)
            store.put_reports([ReportRow(report.report_id, "ndt", tile, report.vehicle, 0, body)])
    return path


def open_store(path):
    return SqliteStore(path, StoreConfig(merge_delay_s=0.0))


class SlowWorker(Worker):
    """Each merge takes a third of a lease."""

    def _publication(self, *merged):
        time.sleep(LEASE_S / 3)
        return super()._publication(*merged)


@pytest.mark.parametrize("renewed", [True, False])
def test_two_shards_whose_batches_outlast_their_leases_publish_every_tile_once(path, renewed):
    statuses, at_once = [], threading.Barrier(2)

    def shard(name):
        config = ShardConfig(store_path=path, shard_id=name, lease_s=LEASE_S, confirmation=VOXEL_BY_VOXEL)
        with open_store(path) as store, Leases(store, name, LEASE_S if renewed else 1e6) as leases:
            worker = SlowWorker(store, config)
            at_once.wait(10)
            while store.dirty_count():
                claims = store.claim(name, 4, LEASE_S)  # 4 merges are 1.3 leases
                leases.hold(claims)
                for claim in claims:
                    result = worker.settle(claim)
                    statuses.append(None if result is None else result.status)
                    leases.drop(claim)

    threads = [threading.Thread(target=shard, args=(name,)) for name in ("left", "right")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    with open_store(path) as store:
        assert [store.get("ndt", tile).version for tile in TILES] == [2] * len(TILES)
        assert store.tiles_set_aside() == []
    assert statuses.count("published") == len(TILES)  # without renewal some work is lost, no tile is
    if renewed:
        assert len(statuses) == len(TILES)


class Clock:
    def __init__(self):
        self.ns = 10**18

    def __call__(self):
        return self.ns


def test_an_endless_merge_does_not_keep_its_tile_for_ever(path):
    clock = Clock()
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0), steady_ns=clock) as store:
        leases = Leases(store, "hung", 10.0, steady_s=lambda: clock.ns / 1e9)
        leases.hold(store.claim("hung", 1, 10.0))
        for _ in range(int(LONGEST_WORK_S / 5.0) - 1):
            clock.ns += 5_000_000_000
            leases.renew()
            assert len(store.claim("other", 100, 1e9)) in (0, len(TILES) - 1)
        clock.ns += 16_000_000_000
        leases.renew()
        assert len(store.claim("other", 100, 1e9)) == 1


def test_a_stolen_lease_is_dropped_and_the_others_are_renewed(path):
    with open_store(path) as store:
        leases = Leases(store, "a", 0.2)
        stolen, kept = store.claim("a", 2, 0.2)
        leases.hold([stolen, kept])
        store.postpone(stolen, 0.0)
        (taken,) = [one for one in store.claim("b", 100, 60.0) if one.tile == stolen.tile]
        leases.renew()
        assert store.beat("a", [taken, kept], 60.0) == [True, True]
        assert list(leases._held) == [kept]


def test_a_shard_that_ends_frees_its_leases_and_its_name(path):
    with open_store(path) as store:
        with Leases(store, "a", 60.0) as leases:
            leases.hold(store.claim("a", 100, 60.0))
            assert [one.owner for one in store.shards()] == ["a"]
        assert store.shards() == []
        assert len(store.claim("b", 100, 60.0)) == len(TILES)
