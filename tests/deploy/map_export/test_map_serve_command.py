"""`gnd map serve` as a process: what it says, what it refuses, how it ends, and its section of the page."""

import json
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from autoware_client import AutowareClient
from click.testing import CliRunner
from map_export_maps import TILE, some_tile
from test_export_page import NUMBER, PAGE, make_maps

from gnd.deploy.cli import gnd
from gnd.deploy.map_export.autoware import read_metadata
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.tile import Tile
from gnd.tile_store.export import region_tiles
from gnd.tile_store.sqlite_store import SqliteStore

CTRL_C_S = 1.0


class Serve:
    """The command in a process of its own, and what it prints."""

    def __init__(self, *arguments: str, cwd: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "gnd.deploy.cli", "map", "serve", *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=cwd,
        )  # fmt: skip
        self.lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.put(line.rstrip("\n"))
        self.process.stdout.close()

    def line(self) -> str:
        return self.lines.get(timeout=60)

    def interrupt(self) -> tuple[str, float]:
        """Ctrl-C; the last line, and how long it took to end, s."""
        began_s = time.monotonic()
        self.process.send_signal(signal.SIGINT)
        last = self.line()
        assert self.process.wait(30) == 0
        return last, time.monotonic() - began_s

    def close(self) -> None:
        self.process.kill()
        self.process.wait(30)
        self._reader.join()


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Serve]]:
    started: list[Serve] = []

    def start(*arguments: str) -> Serve:
        started.append(Serve(*arguments, cwd=tmp_path))
        return started[-1]

    yield start
    for one in started:
        one.close()


@pytest.fixture
def endpoint(free_port: int) -> Iterator[str]:
    with open_router((f"tcp/127.0.0.1:{free_port}",)):
        yield f"tcp/127.0.0.1:{free_port}"


def test_it_serves_a_store_follows_it_and_ends_within_a_second(
    tmp_path: Path, endpoint: str, serve: Callable[..., Serve]
) -> None:
    with SqliteStore(tmp_path / "map.sqlite") as store, AutowareClient(endpoint, domain=3, namespace="gnd") as client:
        store.put_tiles([some_tile(1)])
        served = serve("map.sqlite", "out", "--connect", endpoint, "--domain", "3", "--namespace", "/gnd", "--json")
        start = json.loads(served.line())
        assert (start["tiles"], start["domain"], start["cells"]) == (1, 3, len(read_metadata(tmp_path / "out")))
        assert start["services"][0] == "/gnd/get_differential_pointcloud_map"
        client.wait_served()
        client.update(0.0, 0.0, 1000.0)
        store.put_tiles([Tile(TILE, 2, some_tile(1).gaussians.take(np.arange(100)))])
        change = json.loads(served.line())
        assert (change["tile"], change["version"]) == (TILE.path, 2)
        answer = client.update(0.0, 0.0, 1000.0)
        assert (len(answer.new), len(answer.ids_to_remove)) == (change["cells_new"], change["cells_removed"])
        assert client.held.keys() == read_metadata(tmp_path / "out").keys()
        last, took_s = served.interrupt()
        assert json.loads(last) == {"answered": 2, "refused": 0}
        print(f"Ctrl-C: ended after {took_s:.2f} s")
        assert took_s < CTRL_C_S


def test_a_second_server_is_told_of_the_first(tmp_path: Path, endpoint: str, serve: Callable[..., Serve]) -> None:
    with SqliteStore(tmp_path / "map.sqlite") as store:
        store.put_tiles([some_tile(1)])
    first = serve("map.sqlite", "one", "--connect", endpoint)
    assert "cells of 1 tiles, TransverseMercator, origin 49.0" in first.line()
    assert first.line().startswith("serving /map/get_differential_pointcloud_map and /map/get_partial")
    second = serve("map.sqlite", "two", "--connect", endpoint)
    assert "/map/get_differential_pointcloud_map is served by /gnd_map as well: clients would mix" in second.line()


def test_what_it_cannot_serve_it_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with SqliteStore(tmp_path / "map.sqlite") as store:
        store.put_tiles([some_tile(1)])
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.txt").write_text("years of work")
    for words, says in (
        ("none.sqlite out", "none.sqlite"),
        ("map.sqlite out --layer signs", "holds features, not Gaussians"),
        ("map.sqlite out --region 00000", "no tiles in layer 'ndt', region '00000'"),
        ("map.sqlite thesis", "holds no map that was exported before"),
    ):
        ran = CliRunner().invoke(gnd, ["map", "serve", *words.split()])
        assert ran.exit_code != 0
        assert says in ran.output + str(ran.exception), words


@pytest.mark.slow
def test_a_router_that_is_not_there_is_named(tmp_path: Path, free_port: int) -> None:
    with SqliteStore(tmp_path / "map.sqlite") as store:
        store.put_tiles([some_tile(1)])
    for source in (str(tmp_path / "map.sqlite"), f"tcp/127.0.0.1:{free_port}"):
        words = ["map", "serve", source, str(tmp_path / "out"), "--connect", f"tcp/127.0.0.1:{free_port}"]
        ran = CliRunner().invoke(gnd, words)
        assert ran.exit_code != 0
        assert f"no router at tcp/127.0.0.1:{free_port} for 10 s" in ran.output + str(ran.exception)


@pytest.mark.slow
def test_the_page_shows_what_the_command_prints(tmp_path: Path, endpoint: str, serve: Callable[..., Serve]) -> None:
    make_maps(tmp_path)
    command, *wanted = next(
        block.splitlines()
        for block in re.findall(r"```console\n(.*?)```", PAGE.read_text(), re.DOTALL)
        if "serve" in block
    )
    served = serve(*command.removeprefix("$ gnd map serve ").split(), "--connect", endpoint)
    printed = [served.line(), served.line()]
    with (
        AutowareClient(endpoint) as client,
        SqliteStore(tmp_path / "base.sqlite") as base,
        SqliteStore(tmp_path / "after.sqlite", create=False) as after,
    ):
        client.wait_served()
        client.update(0.0, 0.0, 150.0)
        tile = max(region_tiles(after, "ndt", ""), key=lambda one: len(one.gaussians))
        base.put_tiles([tile])  # as a merger publishes what the fleet has seen
        printed += [served.line(), "^C"]
        client.update(0.0, 0.0, 150.0)
        assert client.held.keys() == read_metadata(tmp_path / "autoware").keys()
    printed.append(served.interrupt()[0])
    print("\n".join(printed))
    assert [NUMBER.sub("#", line) for line in printed] == [NUMBER.sub("#", line) for line in wanted]
    for line, on_page in zip(printed, wanted, strict=True):
        numbers = [[float(n.rstrip(".")) for n in NUMBER.findall(text)] for text in (line, on_page)]
        assert numbers[0] == pytest.approx(numbers[1], rel=0.02, abs=0.011), (line, on_page)
