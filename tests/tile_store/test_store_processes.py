"""Several processes on one store, killed with -9 again and again: nothing acknowledged is lost or applied twice."""

import random
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import apsw
import pytest
from postgres_server import NoServerError, PostgresServer
from store_process import HURRY, TILES, merged_tile, publication_of

from gnd.tile_store.location import open_store
from gnd.tile_store.sqlite_store import SqlStore

pytestmark = pytest.mark.xdist_group("shards")

SCRIPT = Path(__file__).with_name("store_process.py")
KILLS = 20


@dataclass
class Worker:
    """One role in one process after the other, and all that they were told."""

    role: str
    store: str
    name: str
    facts: list[tuple[str, ...]] = field(default_factory=list)
    process: subprocess.Popen[str] = field(init=False)
    reader: threading.Thread = field(init=False)
    ready: threading.Event = field(init=False)

    def start(self) -> None:
        # A reporter begins a little before the last acknowledged report, as an outbox would.
        acknowledged = len(self.facts) if self.role == "reporter" else 0
        command = [sys.executable, str(SCRIPT), self.role, self.store, self.name, str(max(acknowledged - 9, 0))]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self.ready = threading.Event()
        self.reader = threading.Thread(target=self._read, args=(self.process, self.ready))
        self.reader.start()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        self.reader.join()
        assert self.process.stdout is not None
        self.process.stdout.close()

    def _read(self, process: subprocess.Popen[str], ready: threading.Event) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            ready.set()
            if line.endswith("\n") and line != "ready\n":
                self.facts.append(tuple(line.split()))


@pytest.mark.slow
def test_nothing_acknowledged_is_lost_or_applied_twice_whoever_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    told = run_and_kill(str(path), KILLS)
    assert min(told["stored"], told["duplicate"], told["published"], told["stale"]) > 0, told
    assert apsw.Connection(str(path)).pragma("integrity_check") == "ok"


@pytest.mark.slow
def test_the_same_of_a_database_whose_server_is_stopped_at_once_as_well() -> None:
    pytest.importorskip("psycopg", reason="pip install 'gnd-fleet[postgres]'")
    try:
        server = PostgresServer()
    except NoServerError as error:
        pytest.skip(str(error))

    def stop_at_once(k: int) -> None:
        if k % 4 == 3:
            server.stop("immediate")
            server.start()

    try:
        server.sql("CREATE DATABASE store")
        with open_store(server.url("store")):
            pass
        told = run_and_kill(server.url("store"), 8, stop_at_once)
    finally:
        server.end()
    assert min(told["stored"], told["duplicate"], told["published"]) > 0, told


def run_and_kill(location: str, kills: int, between: Callable[[int], None] = lambda _: None) -> Counter[str]:
    """Run reporters and mergers, kill them, and look at what the store holds; how often they were told what."""
    roles = [("reporter", "v0"), ("merger", "m0"), ("reporter", "v1"), ("merger", "m1")]
    workers = [Worker(role, location, name) for role, name in roles]
    for worker in workers:
        worker.start()
    try:
        kill_again_and_again(workers, kills, between)
    finally:
        for worker in workers:
            worker.kill()

    facts = [fact for worker in workers for fact in worker.facts]
    with open_store(location, HURRY) as store:
        check_reports(store, facts)
        check_versions(store, facts)
        drain(store)
        for tile in TILES:
            rows = tuple(row for row in store.reports() if row.tile == tile)
            head = store.get("ndt", tile)
            assert head is not None
            assert head.sha == merged_tile(tile, rows).sha
            assert [v.version for v in store.history("ndt", tile)] == list(range(1, head.version + 1))
    return Counter(fact[0] for fact in facts)


def kill_again_and_again(workers: list[Worker], kills: int, between: Callable[[int], None]) -> None:
    """Kill one after the other in mid-work: each lives until it has been told something."""
    generator = random.Random(7)
    for k in range(kills):
        deadline = time.monotonic() + 60
        worker = workers[k % len(workers)]
        assert worker.ready.wait(20), f"{worker.name} never opened the store"
        enough = len(worker.facts) + generator.randint(1, 60 if worker.role == "reporter" else 6)
        while len(worker.facts) < enough:
            assert time.monotonic() < deadline, f"{worker.name} makes no progress after {k} kills"
            time.sleep(0.002)
        worker.kill()
        worker.start()
        between(k)


def check_reports(store: SqlStore, facts: list[tuple[str, ...]]) -> None:
    kept = Counter((str(row.tile.morton), row.report_id) for row in store.reports())
    assert max(kept.values()) == 1
    acknowledged = {fact[1:] for fact in facts if fact[0] in ("stored", "duplicate")}
    assert acknowledged <= kept.keys()
    stored = Counter(fact[1:] for fact in facts if fact[0] == "stored")
    assert max(stored.values()) == 1


def check_versions(store: SqlStore, facts: list[tuple[str, ...]]) -> None:
    published = Counter((int(fact[1]), int(fact[2])) for fact in facts if fact[0] == "published")
    assert max(published.values()) == 1
    kept = {(tile.morton, v.version) for tile in TILES for v in store.history("ndt", tile)}
    assert published.keys() <= kept
    for tile in TILES:
        versions = store.history("ndt", tile)
        assert [v.parent for v in versions] == list(range(len(versions)))


def drain(store: SqlStore) -> None:
    """Merge what is left, as a shard does that outlives the others."""
    deadline = time.monotonic() + 20
    for name in ("m0", "m1"):
        store.release(name)
    while store.dirty_count():
        assert time.monotonic() < deadline
        for claim in store.claim("last", 10, lease_s=60.0):
            store.publish([publication_of(store.load(claim))])
        time.sleep(0.005)
    assert store.counts().waiting == 0
