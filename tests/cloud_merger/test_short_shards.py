"""Reports in short through real shards and a real router: halves that meet another shard, kills, and the same map."""

import signal
import threading
from pathlib import Path

import pytest
from merger_processes import DEADLINE_S, Cloud, in_threads, wait_for
from merger_world import BALL, POLE, TILE, VOXEL_BY_VOXEL, WALL_AGAIN, report_of
from short_world import bases_of, flagged, packed_of, tile_at

from cloud_merger.config import ShardConfig
from cloud_merger.ownership import owner_of
from cloud_merger.work import Worker
from fleet_bus.bus import open_bus
from fleet_bus.config import BusConfig
from fleet_bus.requesting import RetryPolicy
from gnd_map.tile_id import TileId
from schemas.changes import ChangeAck, ChangeReport
from schemas.keys import change_key
from schemas.packed import decode_upload
from tile_store.sqlite_store import SqliteStore
from tile_store.values import StoreConfig
from vehicle_agent.outbox import Outbox
from vehicle_agent.packing import pack_measured
from vehicle_agent.sending import SenderThread

SHARDS = ("left", "right")
FIRST = [TileId((TILE.morton & ~1023) + k * 1024 + 5) for k in range(8)]
TILES = [*FIRST, *(TileId(tile.morton + 1) for tile in FIRST)]


@pytest.fixture
def cloud(tmp_path, free_port):
    cloud = Cloud(tmp_path, free_port)
    cloud.config_path.write_text(cloud.config_path.read_text() + "[want]\nenough = 1\n")
    cloud.open()
    cloud.store.put_tiles([tile_at(tile) for tile in TILES])
    yield cloud
    cloud.close()


def report_number(n):
    """Reports over one or two tiles of a district that agree or disagree about two voxels."""
    first = FIRST[n % len(FIRST)]
    new = {3: (POLE, POLE, BALL)[n % 3]}
    said = {"new": new, "modified": {1: WALL_AGAIN}} if n % 5 else {"new": new, "deleted": (1,)}
    return report_of(n, *(flagged(tile=TileId(first.morton + k), **said) for k in range(1 + n % 2)))


def send(cloud, report: ChangeReport, payload: bytes) -> ChangeAck:
    retry = RetryPolicy(longest_wait_s=0.2, attempt_timeout_s=10.0)
    key = change_key("ndt", report.district)
    return ChangeAck.decode(cloud.bus.request(key, payload, kind="change", retry=retry, timeout_s=DEADLINE_S))


def merged_anew(path: Path, reports) -> dict:
    """Head hashes when one worker merges the stored reports one by one, in order of their ids."""
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([tile_at(tile) for tile in TILES])
        worker = Worker(store, ShardConfig(store_path=path, confirmation=VOXEL_BY_VOXEL))
        for row in sorted(reports, key=lambda row: (row.report_id, row.tile)):
            store.put_reports([row])
            while claims := store.claim("one", 16, 30.0):
                store.publish(worker.merge(claims))
        return {head.tile: head.sha for head in store.heads()}


@pytest.mark.slow
def test_a_shard_killed_between_the_halves_costs_a_second_question_and_nothing_else(cloud):
    cloud.start(*SHARDS)
    report = report_number(1)
    owner = owner_of(report.district, SHARDS)
    first = send(cloud, report, packed_of(report))
    assert first.status == "wanted"
    assert cloud.store.counts().report_rows == 0
    cloud.signal(owner, signal.SIGKILL)
    second = pack_measured(report, bases_of(report), first.wanted).encode()
    assert send(cloud, report, second).status == "resend"
    again = send(cloud, report, packed_of(report))
    assert again == first, "the same store, the same question"
    assert send(cloud, report, second).status == "stored"
    assert send(cloud, report, second).status == "duplicate"
    assert send(cloud, report, report.encode()).status == "duplicate"
    assert cloud.store.counts().report_rows == len(report.tiles)
    wait_for("all is merged and announced", cloud.is_settled)
    assert {tile for tile, _ in cloud.versions()} == {change.tile for change in report.tiles}
    for change in report.tiles:
        merged = cloud.store.get("ndt", change.tile).decode().gaussians
        assert set(change.changed.voxel_id.tolist()) <= set(merged.voxel_id.tolist())


@pytest.mark.slow
def test_senders_lose_nothing_and_apply_nothing_twice_while_a_shard_is_killed(cloud, tmp_path):
    cloud.start(*SHARDS)
    reports = [report_number(n) for n in range(18)]
    never, killed = threading.Event(), threading.Event()

    def vehicle(k):
        outbox = Outbox(tmp_path / f"outbox-{k}.sqlite")
        for report in reports[k::3]:
            key, bases = change_key("ndt", report.district), [tile_at(change.tile) for change in report.tiles]
            assert outbox.put(report.report_id, key, report.encode(), packed_of(report), bases)
        with open_bus(BusConfig(connect=(cloud.endpoint,)), name=f"car-{k}") as bus:
            sender = SenderThread(bus, outbox)
            wait_for("some are acknowledged", lambda: outbox.counts().acknowledged > 1)
            if not killed.is_set():
                killed.set()
                cloud.signal("left", signal.SIGKILL)
            assert sender.drain(60.0, never), sender.last_error
            sender.close()
        assert outbox.counts().acknowledged == len(reports[k::3])
        assert outbox._db.run("SELECT count(*) FROM base") == [(0,)]
        outbox.close()

    in_threads(3, vehicle)
    wait_for("all is merged and announced", cloud.is_settled)
    assert cloud.store.counts().reports == len(reports)
    assert cloud.store.counts().report_rows == sum(len(report.tiles) for report in reports)
    assert cloud.store.quarantined() == []
    rows = list(cloud.store.reports())
    asked = sum(int(c.changed.exists.sum()) for row in rows for c in ChangeReport.decode(row.body).tiles)
    assert 0 < asked < sum(int(c.changed.exists.sum()) for report in reports for c in report.tiles)
    assert {head.tile: head.sha for head in cloud.store.heads()} == merged_anew(tmp_path / "plain.sqlite", rows)


@pytest.mark.slow
def test_halves_outlive_a_restart_of_the_router(cloud):
    cloud.start(*SHARDS)
    report = report_number(3)
    first = send(cloud, report, packed_of(report))
    assert first.status == "wanted"
    cloud.restart_router(lambda: None)
    wait_for("both live again", lambda: cloud.living == set(SHARDS))
    ack = send(cloud, report, pack_measured(report, bases_of(report), first.wanted).encode())
    assert ack.status == "stored"
    assert decode_upload(packed_of(report)).report_id == ack.report_id
    wait_for("all is merged and announced", cloud.is_settled)
    assert cloud.store.counts().reports == 1
