"""/metrics and /healthz of real processes, over real HTTP."""

import json
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import apsw
import numpy as np
import pytest
from prometheus_client import CollectorRegistry
from prometheus_client.parser import text_string_to_metric_families
from suite_ports import new_port

from gnd.fleet_bus.errors import PortInUse
from gnd.fleet_bus.health import CHECK_S, HealthServer
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.sqlite_store import SqliteStore

TILE = TileId(497353963154)


def get(port: int, page: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=20) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def metrics(port: int) -> dict[tuple[str, ...], float]:
    """Samples by name and label values; the parser is Prometheus's own."""
    families = text_string_to_metric_families(get(port, "metrics")[1])
    return {(s.name, *s.labels.values()): s.value for family in families for s in family.samples}


def until(what: str, condition: Callable[[], object], deadline_s: float = 30.0) -> None:
    end_s = time.monotonic() + deadline_s
    while True:
        try:
            if condition():
                return
        except OSError:
            pass  # it does not listen yet
        assert time.monotonic() < end_s, f"not within {deadline_s} s: {what}"
        time.sleep(0.1)


class Parts:
    """Router, store and shard as processes of their own."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "map.sqlite"
        self.endpoint = f"tcp/127.0.0.1:{new_port()}"
        self.ports = {name: new_port() for name in ("router", "store", "merger")}
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        with SqliteStore(self.path) as store:
            one = np.array([1], np.int32)
            mean_m, cov_m2 = np.zeros((1, 3), np.float32), np.array([[0.01, 0, 0, 0.01, 0, 0.01]], np.float32)
            store.put_tiles([Tile(TILE, 0, Gaussians(one, one * 100, one * 25, mean_m, cov_m2))])

    def start(self, name: str) -> None:
        options = {
            "router": ["--listen", self.endpoint],
            "store": ["--path", str(self.path), "--connect", self.endpoint],
            "merger": ["--id", "shard-0", "--store", str(self.path), "--connect", self.endpoint],
        }[name]
        command = [sys.executable, "-m", "gnd.deploy.cli", name, *options, "--metrics-port", str(self.ports[name])]
        self.running[name] = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def is_healthy(self, name: str) -> bool:
        return get(self.ports[name], "healthz")[0] == 200

    def told(self, name: str) -> dict[str, str]:
        checks: dict[str, str] = json.loads(get(self.ports[name], "healthz")[1])["checks"]
        return checks


@pytest.fixture
def parts(tmp_path: Path) -> Iterator[Parts]:
    parts = Parts(tmp_path)
    yield parts
    for process in parts.running.values():
        process.kill()
        process.wait()


@pytest.mark.slow
def test_router_store_and_shard_show_how_they_are(parts: Parts) -> None:
    for name in ("router", "store", "merger"):
        parts.start(name)
    for name in parts.running:
        until(f"{name} is well", lambda name=name: parts.is_healthy(name))
    sessions = "gnd_router_sessions", "client"  # of the store, the shard and its worker
    until("all are connected", lambda: metrics(parts.ports["router"])[sessions] == 3)
    of_store = metrics(parts.ports["store"])
    assert of_store[("gnd_tiles",)] == 1
    assert of_store["gnd_shard_alive", "shard-0"] == 1
    assert of_store["gnd_store_file_bytes", "store"] == parts.path.stat().st_size
    assert of_store[("process_resident_memory_bytes",)] > 1e6
    assert metrics(parts.ports["merger"])["gnd_merges_total", "published"] == 0
    assert get(parts.ports["store"], "nothing")[0] == 404

    # A tile that is overdue: the shard is ill as well as the store, and nobody merges it.
    other = apsw.Connection(str(parts.path))
    columns = "layer, tile, seq, waiting, ready_ns, owner, token, lease_ns"
    other.execute(f"INSERT INTO dirty ({columns}) VALUES ('ndt', 7, 1, 1, 0, 'x', 1, {2**61})")
    until("the queue is ill", lambda: "overdue by" in parts.told("store")["queue"])
    assert metrics(parts.ports["store"])[("gnd_queue_overdue_seconds",)] > 60
    other.execute("DELETE FROM dirty")
    until("the queue is well", lambda: parts.told("store")["queue"] == "ok")

    # Another process holds the write lock: what cannot be written is ill, the page answers all the same.
    other.execute("BEGIN IMMEDIATE")
    until("the store is ill", lambda: "no answer within" in parts.told("store")["store"])
    assert get(parts.ports["store"], "metrics")[0] == 200
    other.execute("ROLLBACK")
    other.close()
    until("the store is well", lambda: parts.is_healthy("store"))

    parts.running["router"].kill()
    parts.running["router"].wait()
    until("the router is missed", lambda: parts.told("merger")["router"] == "no router answers")
    until("by both", lambda: get(parts.ports["store"], "healthz")[0] == 503)
    parts.start("router")
    until("it is found again", lambda: parts.is_healthy("merger") and parts.is_healthy("store"))


def test_a_store_that_is_not_there_is_not_made(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "gnd.deploy.cli", "store", "--path", str(tmp_path / "TYPO")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == f"gnd: {tmp_path / 'TYPO'}: no such store; `gnd map build` makes one\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_check_that_fails_raises_or_hangs_makes_ill_and_never_stops_the_page() -> None:
    hang, calls = threading.Event(), []

    def count() -> None:
        calls.append(1)

    checks = {"bad": lambda: "it is bad", "raises": lambda: str(1 // 0), "hangs": hang.wait, "well": count}
    with HealthServer(0, CollectorRegistry(), checks) as server:  # type: ignore[arg-type]
        begin_s = time.monotonic()
        status, body = get(server.port, "healthz")
        assert CHECK_S <= time.monotonic() - begin_s < CHECK_S + 2.0
        assert status == 503
        assert json.loads(body)["checks"] == {
            "bad": "it is bad",
            "raises": "ZeroDivisionError: integer division or modulo by zero",
            "hangs": f"no answer within {CHECK_S:.0f} s",
            "well": "ok",
        }
        n_threads = threading.active_count()
        assert get(server.port, "metrics")[0] == 200
        get(server.port, "healthz")
        assert threading.active_count() <= n_threads + 1, "a check that hangs is not begun again"
        assert 1 <= len(calls) <= 2
        with pytest.raises(PortInUse, match=f"cannot serve metrics at 127.0.0.1:{server.port}: port in use"):
            HealthServer(server.port, CollectorRegistry(), {})
        hang.set()
