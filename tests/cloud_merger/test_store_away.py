"""Shards and tile servers that are started while the database server of their store is stopped."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from merger_processes import wait_for
from merger_world import GROUND, TILE, tile_of_states
from postgres_fixtures import postgres_server
from postgres_server import PostgresServer

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.codec import CODEC_FLOAT32
from gnd.schemas.keys import alive_keys, tile_key
from gnd.schemas.tiles import TileReply, TileRequest
from gnd.tile_store.errors import StoreAway, StoreUnavailable
from gnd.tile_store.location import open_store
from gnd.tile_store.waiting import wait_for_store

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    """A stopped server with a store in it."""
    with postgres_server() as server:
        server.sql("CREATE DATABASE map")
        with open_store(server.url("map")) as store:
            store.put_tiles([tile_of_states({0: GROUND})])
        server.stop()
        yield server


class Part:
    """A program of the cloud."""

    def __init__(self, log: Path, *command: str) -> None:
        self._log = log
        with log.open("wb") as file:
            program = [sys.executable, "-m", "gnd.deploy.cli", *command]
            self.process = subprocess.Popen(program, stdout=file, stderr=file)

    @property
    def said(self) -> str:
        return self._log.read_text()


def commands(server: PostgresServer, endpoint: str, *more: str) -> dict[str, list[str]]:
    at = ["--connect", endpoint, *more]
    return {
        "shard": ["merger", "--id", "one", "--store", server.url("map"), *at],
        "tiles": ["store", "--path", server.url("map"), *at],
    }


def test_parts_wait_for_the_database_and_then_work(server: PostgresServer, free_port: int, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    wanted, living = TileRequest(codecs=(CODEC_FLOAT32,)).encode(), list[str]()
    parts = {name: Part(tmp_path / name, *told) for name, told in commands(server, endpoint).items()}
    with open_router([endpoint]), open_bus(BusConfig(connect=(endpoint,)), name="test") as bus:
        bus.watch_alive(alive_keys("merger"), lambda key, alive: living.append(key) if alive else None)
        try:
            for part in parts.values():
                wait_for("a line about it", lambda part=part: "waiting for the database, at most 60 s: " in part.said)
                assert "no server answers there" in part.said
            time.sleep(1.0)  # some more attempts
            assert [part.process.poll() for part in parts.values()] == [None, None]
            assert [part.said.count("waiting for the database") for part in parts.values()] == [1, 1]
            server.start()
            reply = TileReply.decode(bus.request(tile_key("ndt", TILE), wanted, kind="tile", timeout_s=60))
            assert reply.blob is not None
            wait_for("the shard lives", lambda: living)
        finally:
            for part in parts.values():
                part.process.send_signal(signal.SIGINT)
            ended = [part.process.wait(60) for part in parts.values()]
            server.stop()
    assert ended == [0, 0]


def test_who_has_waited_long_enough_ends_with_an_error(server: PostgresServer, free_port: int, tmp_path: Path) -> None:
    told = commands(server, f"tcp/127.0.0.1:{free_port}", "--wait", "1.5")
    parts = [Part(tmp_path / name, *command) for name, command in told.items()]
    assert all(part.process.wait(60) for part in parts)
    for part in parts:
        (line,) = [line for line in part.said.splitlines() if "waited for 1.5 s" in line]
        assert "no server answers there" in line
        assert "Traceback" not in part.said


def test_who_is_stopped_while_waiting_ends_in_order(server: PostgresServer, free_port: int, tmp_path: Path) -> None:
    told = commands(server, f"tcp/127.0.0.1:{free_port}")
    parts = [Part(tmp_path / name, *command) for name, command in told.items()]
    for part in parts:
        wait_for("a line about it", lambda part=part: "waiting for the database" in part.said)
        part.process.send_signal(signal.SIGTERM)
    assert [part.process.wait(20) for part in parts] == [0, 0]


def test_what_does_not_pass_by_itself_is_told_at_once(server: PostgresServer, tmp_path: Path) -> None:
    stop = threading.Event()
    wait_for_store(tmp_path / "nothing.sqlite", 60.0, stop)  # a file comes from no server
    with pytest.raises(StoreAway, match="waited for 0 s"):
        wait_for_store(server.url("map"), 0.0, stop)
    server.start()
    try:
        with pytest.raises(StoreUnavailable, match="no such database") as raised:
            wait_for_store(server.url("nothing"), 60.0, stop)
        assert not isinstance(raised.value, StoreAway)
    finally:
        server.stop()
