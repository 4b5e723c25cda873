"""Two real shard processes, one real router: one ack, fail-over, nothing lost, nothing twice."""

import itertools
import signal
from pathlib import Path

import pytest
from merger_processes import Cloud, all_acks, in_threads, raw_session, wait_for
from merger_world import (
    BALL,
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
from suite_kernels import has_library

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.ownership import owner_of
from gnd.cloud_merger.work import Worker
from gnd.deploy.load.cpu import children
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import split
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow, StoreConfig

SHARDS = ("left", "right")
STATES = {0: GROUND, 1: WALL}
BASE = gaussians_of(STATES)
# The same place of eight districts in a row, and a second tile in each: both shards own some.
FIRST = [TileId((TILE.morton & ~1023) + k * 1024 + 5) for k in range(8)]
TILES = [*FIRST, *(TileId(tile.morton + 1) for tile in FIRST)]


@pytest.fixture
def cloud(tmp_path, free_port):
    cloud = Cloud(tmp_path, free_port)
    cloud.open()
    cloud.store.put_tiles([tile_of_states(STATES, tile) for tile in TILES])
    yield cloud
    cloud.close()


def report_number(n):
    """Reports over one or two tiles of a district that agree or disagree about two voxels."""
    first = FIRST[n % len(FIRST)]
    tiles = [first, TileId(first.morton + 1)][: 1 + n % 2]
    changed = {2: (POLE, POLE, BALL)[n % 3], 1: (WALL, None)[n % 5 == 0]}
    return report_of(n, *(change_of(BASE, [0, 1, 2], changed, tile=tile) for tile in tiles))


def fault_free(path, reports):
    """Head hashes when one worker merges the reports one by one, in order."""
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([tile_of_states(STATES, tile) for tile in TILES])
        worker = Worker(store, ShardConfig(store_path=path, confirmation=VOXEL_BY_VOXEL))
        for report in reports:
            bodies = split(report)
            store.put_reports(
                [ReportRow(report.report_id, "ndt", tile, report.vehicle, 0, body) for tile, body in bodies]
            )
            while claims := store.claim("one", 16, 30.0):
                store.publish(worker.merge(claims))
        return {head.tile: head.sha for head in store.heads()}


def test_the_test_gives_both_shards_districts():
    assert {owner_of(tile.district, SHARDS) for tile in TILES} == set(SHARDS)
    assert TILE.district == NEIGHBOUR.district


def has_scipy(pid):
    """Whether a shard or its worker has loaded scipy."""
    (worker,) = children(pid)
    return any("/scipy/" in Path(f"/proc/{one}/maps").read_text(encoding="utf-8") for one in (pid, worker))


@pytest.mark.slow
def test_every_report_has_one_ack_and_every_version_one_notice(cloud):
    cloud.start(*SHARDS)
    wait_for("the shards have seen each other", lambda: one_ack_each(cloud, range(100, 108)))
    with raw_session(cloud.endpoint) as session:
        for n in range(16):
            assert [ack.status for ack in all_acks(session, report_number(n))] == ["stored"]
            assert [ack.status for ack in all_acks(session, report_number(n))] == ["duplicate"]
    wait_for("all is merged and announced", cloud.is_settled)
    wait_for("the watcher has heard of all", lambda: cloud.versions() == cloud.announced())
    told = {(one.tile, one.version): one for one in cloud.updates}
    assert len(told) == len(cloud.versions()) > 0
    assert all(one == told[one.tile, one.version] for one in cloud.updates)  # a slow owner's is sent by another, too
    assert cloud.store.counts().reports == 24
    if has_library():  # numba's compiler loads it
        assert not any(has_scipy(cloud.shards[name].pid) for name in SHARDS)
    for name in SHARDS:
        cloud.signal(name, signal.SIGTERM)
        assert cloud.shards[name].wait(20) == 0, cloud.log(name)
        assert "Traceback" not in cloud.log(name)


@pytest.mark.slow
def test_a_shard_killed_while_reports_flow_loses_nothing_and_applies_nothing_twice(cloud, tmp_path):
    cloud.start(*SHARDS)
    reports = [report_number(n) for n in range(96)]
    sent = itertools.count()
    acks = []

    def agent(k):
        for report in reports[k::3]:
            if next(sent) == len(reports) // 3:
                cloud.signal("left", signal.SIGKILL)
            acks.append(cloud.send(report))

    in_threads(3, agent)
    assert {ack.report_id for ack in acks} == {report.report_id for report in reports}
    assert {ack.status for ack in acks} <= {"stored", "duplicate"}
    assert cloud.shards["left"].wait(5) == -signal.SIGKILL
    wait_for("all is merged and announced", cloud.is_settled)
    assert cloud.store.counts().reports == len(reports)
    assert cloud.store.counts().report_rows == sum(len(report.tiles) for report in reports)
    assert {head.tile: head.sha for head in cloud.store.heads()} == fault_free(tmp_path / "plain.sqlite", reports)
    wait_for("the watcher has heard of all", lambda: cloud.versions() <= cloud.announced())

    cloud.start("left")  # and when it comes back, it answers again, alone
    wait_for("one ack each", lambda: one_ack_each(cloud, range(len(reports), len(reports) + 8)))


def one_ack_each(cloud, numbers):
    with raw_session(cloud.endpoint) as session:
        return all(len(all_acks(session, report_number(n))) == 1 for n in numbers)


@pytest.mark.slow
def test_a_shard_that_hangs_is_replaced_after_its_lease_and_may_come_back(cloud):
    cloud.start(*SHARDS)
    cloud.signal("left", signal.SIGSTOP)
    for n in range(8):
        assert cloud.send(report_number(n)).status in ("stored", "duplicate")
    wait_for("its lease is over", lambda: cloud.living == {"right"})
    cloud.signal("left", signal.SIGCONT)
    wait_for("both live again", lambda: cloud.living == set(SHARDS))
    wait_for("one ack each", lambda: one_ack_each(cloud, range(8, 16)))
    wait_for("all is merged and announced", cloud.is_settled)
    assert cloud.store.counts().reports == 16


@pytest.mark.slow
def test_shards_outlive_the_router_and_announce_what_they_merged_meanwhile(cloud):
    cloud.start(*SHARDS)
    for n in range(8):
        cloud.send(report_number(n))
    wait_for("all is merged and announced", cloud.is_settled)
    late = report_of(8, change_of(BASE, [0, 1, 2], {1: None, 2: BALL}, tile=TILES[0]))
    rows = [ReportRow(late.report_id, "ndt", tile, "car", 0, body) for tile, body in split(late)]

    def merge_without_router():
        cloud.store.put_reports(rows)
        wait_for("the late report is merged", lambda: cloud.store.dirty_count() == 0)
        assert cloud.store.notices()

    cloud.restart_router(merge_without_router)
    wait_for("both live again", lambda: cloud.living == set(SHARDS))
    wait_for("one ack each", lambda: one_ack_each(cloud, range(16, 24)))
    wait_for("all is merged and announced", cloud.is_settled)
    wait_for("the watcher has heard of all", lambda: cloud.versions() <= cloud.announced())
    assert cloud.store.counts().reports == 17
