"""Reports in short through real shards and a real router: halves that meet another shard, kills, and the same map."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest
from merger_processes import DEADLINE_S, TAKEN, Cloud, in_threads, wait_for
from merger_world import BALL, POLE, TILE, VOXEL_BY_VOXEL, WALL_AGAIN, report_of
from short_world import bases_of, flagged, packed_of, tile_at

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.work import Worker
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeAck, ChangeReport
from gnd.schemas.keys import change_key, state_key
from gnd.schemas.report_states import ReportQuestion, ReportState, ReportStates
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.link.sending import SenderThread
from gnd.vehicle_agent.report.packing import pack_measured

pytestmark = pytest.mark.xdist_group("shards")

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
    return report_of(
        n, *(flagged(tile=TileId(first.morton + k), **said) for k in range(1 + n % 2)), vehicle=f"car-{n % 3}"
    )


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


def state_of(cloud, report) -> ReportState:
    """What the vehicle hears when it asks."""
    question = ReportQuestion((report.report_id,)).encode()
    retry = RetryPolicy(longest_wait_s=0.2, attempt_timeout_s=5.0)
    answer = cloud.bus.request(state_key(report.vehicle), question, kind="change", retry=retry, timeout_s=DEADLINE_S)
    return ReportStates.decode(answer).states[0]


@pytest.mark.slow
def test_shards_killed_between_ack_and_expansion_and_between_the_halves_lose_and_double_nothing(cloud):
    """Every step meets shards that have just been killed: what is durable is all that they know."""
    cloud.start(*SHARDS)
    report = report_number(1)
    assert send(cloud, report, packed_of(report)).status in TAKEN
    cloud.kill(*SHARDS)  # before or after they looked at it
    cloud.start(*SHARDS)
    wait_for("the flags are looked at", lambda: state_of(cloud, report).status == "wanted")
    wanted = state_of(cloud, report).wanted
    second = pack_measured(report, bases_of(report), wanted).encode()
    assert send(cloud, report, second).status in TAKEN
    cloud.kill(*SHARDS)
    cloud.start(*SHARDS)
    wait_for("the Gaussians are looked at", lambda: state_of(cloud, report).status == "released")
    assert [send(cloud, report, half).status for half in (packed_of(report), second)] == ["duplicate"] * 2
    rows = sorted((row.tile, row.part) for row in cloud.store.reports())
    assert rows == sorted((change.tile, part) for change in report.tiles for part in (0, 1))
    wait_for("all is merged and announced", cloud.is_settled)
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
            sender = SenderThread(bus, outbox, f"car-{k}")
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
    first = [row for row in cloud.store.reports() if row.part == 0]
    assert len(first) == sum(len(report.tiles) for report in reports)
    assert cloud.store.quarantined() == []
    rows = list(cloud.store.reports())
    assert set(cloud.store.upload_counts().by_state) == {"released"}
    asked = sum(int(c.changed.exists.sum()) for row in rows for c in ChangeReport.decode(row.body).tiles)
    assert 0 < asked < sum(int(c.changed.exists.sum()) for report in reports for c in report.tiles)
    assert {head.tile: head.sha for head in cloud.store.heads()} == merged_anew(tmp_path / "plain.sqlite", rows)


@pytest.mark.slow
def test_what_is_wanted_outlives_a_restart_of_the_router_and_a_lost_notice(cloud):
    cloud.start(*SHARDS)
    report = report_number(3)
    assert send(cloud, report, packed_of(report)).status in TAKEN  # nobody hears the notice
    cloud.restart_router(lambda: None)
    wait_for("both live again", lambda: cloud.living == set(SHARDS))
    wait_for("the flags are looked at", lambda: state_of(cloud, report).status == "wanted")
    second = pack_measured(report, bases_of(report), state_of(cloud, report).wanted).encode()
    assert send(cloud, report, second).status in TAKEN
    wait_for("the Gaussians are looked at", lambda: state_of(cloud, report).status == "released")
    wait_for("all is merged and announced", cloud.is_settled)
    assert cloud.store.counts().reports == 1


def worker_of(cloud, name) -> int:
    """Process id of a shard's worker."""
    shard = cloud.shards[name].pid
    return int(Path(f"/proc/{shard}/task/{shard}/children").read_text().split()[0])


@pytest.mark.slow
def test_acks_come_while_the_worker_is_stopped_and_what_came_is_looked_at_when_it_goes_on(cloud):
    cloud.start("left")
    report = report_number(100)
    send(cloud, report, packed_of(report))
    wait_for("the worker works", lambda: state_of(cloud, report).status != "waiting")
    worker = worker_of(cloud, "left")
    os.kill(worker, signal.SIGSTOP)
    reports, took_s = [report_number(n) for n in range(40)], []
    for report in reports:
        start_s = time.monotonic()
        assert send(cloud, report, packed_of(report)).status in TAKEN
        took_s.append(time.monotonic() - start_s)
    assert sorted(took_s)[20] < 0.5
    assert {state_of(cloud, report).status for report in reports} == {"waiting"}
    os.kill(worker, signal.SIGCONT)
    wait_for("all is looked at and merged", cloud.is_settled)
    assert cloud.store.counts().reports == 41


@pytest.mark.slow
def test_a_worker_that_is_killed_is_started_again_and_one_whose_shard_is_killed_ends(cloud):
    cloud.start("left")
    report, worker = report_number(1), worker_of(cloud, "left")
    os.kill(worker, signal.SIGSTOP)
    assert send(cloud, report, packed_of(report)).status in TAKEN
    assert len(cloud.store.claim_uploads("left", 8, 3600.0)) == 1, "what it has in hand when it is killed"
    os.kill(worker, signal.SIGKILL)
    wait_for("another worker has looked at it", lambda: state_of(cloud, report).status == "wanted")
    second = worker_of(cloud, "left")
    assert second != worker
    cloud.kill("left")
    wait_for("its worker has ended", lambda: not Path(f"/proc/{second}").exists())
