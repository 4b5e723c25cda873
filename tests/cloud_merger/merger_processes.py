"""A real router, real shard processes, and what the tests ask of them."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import zenoh

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig, zenoh_config
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeAck, ChangeReport
from gnd.schemas.keys import alive_keys, change_key, parse_alive_key, update_keys
from gnd.schemas.updates import TileUpdate
from gnd.tile_store.sqlite_store import SqliteStore

DEADLINE_S = 90.0
TAKEN = ("stored", "duplicate")
"""What a vehicle hears of a good report: shards that do not know each other yet both answer, and an ack may be lost."""
FAST = """poll_s = 0.05
bus_lease_ms = 1500
[store]
merge_delay_s = 0.1
[confirmation]
together_voxels = 1  # the tests' tiles are a few voxels
"""


def wait_for(what: str, condition: Callable[[], object], deadline_s: float = DEADLINE_S) -> None:
    """Until the condition holds; fails the test with `what` after the deadline."""
    end_s = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < end_s, f"not within {deadline_s} s: {what}"
        time.sleep(0.01)


class Cloud:
    """A router in this process, a store file, shards as processes, and a client that watches."""

    def __init__(self, folder: Path, port: int) -> None:
        self.path, self.endpoint = folder / "map.sqlite", f"tcp/127.0.0.1:{port}"
        self.config_path = folder / "merger.toml"
        self.config_path.write_text(FAST)
        self.shards: dict[str, subprocess.Popen[bytes]] = {}
        self.living: set[str] = set()
        self.updates: list[TileUpdate] = []
        self._log = folder

    def open(self) -> None:
        self.router = open_router([self.endpoint])
        self.store = SqliteStore(self.path)
        self.bus: Bus = open_bus(BusConfig(connect=(self.endpoint,)), name="test")
        self.bus.watch_alive(alive_keys("merger"), self._on_alive)
        self.bus.subscribe(update_keys("ndt"), self._on_update, history=True)

    def restart_router(self, between: Callable[[], object]) -> None:
        """End the router, do something, and start it again."""
        self.router.close()
        between()
        self.router = open_router([self.endpoint])

    def close(self) -> None:
        for process in self.shards.values():
            with suppress(ProcessLookupError):
                process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()
        self.bus.close()
        self.store.close()
        self.router.close()

    def _on_alive(self, key: str, alive: bool) -> None:
        name = parse_alive_key(key)[1]
        self.living = self.living | {name} if alive else self.living - {name}

    def _on_update(self, _key: str, payload: bytes) -> None:
        self.updates.append(TileUpdate.decode(payload))

    def start(self, *names: str) -> None:
        """Start shards and wait until they show that they live."""
        for name in names:
            options = ["--id", name, "--store", str(self.path), "--connect", self.endpoint]
            with (self._log / f"{name}.log").open("ab") as log:
                self.shards[name] = subprocess.Popen(
                    [sys.executable, "-m", "gnd.deploy.cli", "merger", *options, "--config", str(self.config_path)],
                    stdout=log,
                    stderr=log,
                    env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                )
        wait_for(f"{names} live", lambda: set(names) <= self.living or self._dead(names))

    def _dead(self, names: tuple[str, ...]) -> bool:
        for name in names:
            if self.shards[name].poll() is not None:
                pytest.fail(f"shard {name} ended: {(self._log / f'{name}.log').read_text()}")
        return False

    def signal(self, name: str, number: signal.Signals) -> None:
        self.shards[name].send_signal(number)

    def kill(self, *names: str) -> None:
        """kill -9, and wait until they are gone."""
        for name in names:
            self.signal(name, signal.SIGKILL)
            self.shards[name].wait()
        wait_for(f"{names} are gone", lambda: not set(names) & self.living)

    def log(self, name: str) -> str:
        return (self._log / f"{name}.log").read_text()

    def send(self, report: ChangeReport, bus: Bus | None = None) -> ChangeAck:
        """As an agent sends: again and again until there is an ack."""
        retry = RetryPolicy(longest_wait_s=0.2, attempt_timeout_s=5.0)
        key = change_key("ndt", report.district)
        reply = (bus or self.bus).request(key, report.encode(), kind="change", retry=retry, timeout_s=DEADLINE_S)
        return ChangeAck.decode(reply)

    def is_settled(self) -> bool:
        """Whether every upload is looked at, every report merged and every version announced."""
        is_looked_at = "waiting" not in self.store.upload_counts().by_state
        return is_looked_at and self.store.dirty_count() == 0 and not self.store.notices()

    def versions(self) -> set[tuple[TileId, int]]:
        """Every version in the store after the first import."""
        tiles = [head.tile for head in self.store.heads()]
        return {(tile, v.version) for tile in tiles for v in self.store.history("ndt", tile) if v.version > 1}

    def announced(self) -> set[tuple[TileId, int]]:
        """Every version that this watcher has heard of."""
        return {(update.tile, update.version) for update in list(self.updates)}


@contextmanager
def raw_session(endpoint: str) -> Iterator[zenoh.Session]:
    """A session that sees every reply, not only the first."""
    with zenoh.open(zenoh_config(BusConfig(connect=(endpoint,)))) as session:
        yield session


def all_acks(session: zenoh.Session, report: ChangeReport) -> list[ChangeAck]:
    """Every ack to one sending of the report."""
    replies = session.get(
        change_key("ndt", report.district),
        payload=report.encode(),
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=5.0,
    )
    return [ChangeAck.decode(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]


def in_threads(count: int, work: Callable[[int], None]) -> None:
    """Run `work(0)` … in threads, and raise here what one of them raised."""
    errors: list[BaseException] = []

    def run(k: int) -> None:
        try:
            work(k)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(k,)) for k in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
