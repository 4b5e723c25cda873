"""/metrics and /healthz of real processes, over real HTTP."""

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import apsw
import pytest
from parts_testing import Parts, get, metrics, until
from prometheus_client import CollectorRegistry

from gnd.fleet_bus.errors import PortInUse
from gnd.fleet_bus.health import CHECK_S, HealthServer


@pytest.fixture
def parts(tmp_path: Path) -> Iterator[Parts]:
    parts = Parts(tmp_path)
    yield parts
    parts.kill()


@pytest.mark.slow
def test_router_store_and_shard_show_how_they_are(parts: Parts) -> None:
    for name in ("router", "store", "merger"):
        parts.start(name)
    for name in parts.running:
        until(f"{name} is well", lambda name=name: parts.is_healthy(name))
    sessions = "gnd_router_sessions", "client"  # of the store, the shard and its worker
    until("all are connected", lambda: metrics(parts.ports["router"])[sessions] == 3)
    assert metrics(parts.ports["router"])["gnd_router_sessions", "router"] == 0, "also what there is none of is shown"
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
    assert get(parts.ports["store"], "livez") == (200, "ok\n"), "a restart would mend nothing"
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
