"""Router, store and shard as processes of their own, and a look at their pages."""

import json
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from prometheus_client.parser import text_string_to_metric_families
from suite_ports import new_port

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


def until(what: str, condition: Callable[[], object], deadline_s: float = 90.0) -> None:
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
    """Router, store and shard as processes of their own.

    Args:
        folder: of the store.
        before: words before each command, for instance of a launcher that takes rights away.
        environment: of the processes; None: that of the tests.
    """

    def __init__(self, folder: Path, before: Sequence[str] = (), environment: dict[str, str] | None = None) -> None:
        self._before, self._environment = list(before), environment
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
        words = [sys.executable, "-m", "gnd.deploy.cli", name, *options, "--metrics-port", str(self.ports[name])]
        with (self.path.parent / f"{name}.log").open("wb") as log:
            self.running[name] = subprocess.Popen(
                [*self._before, *words], stdout=log, stderr=log, env=self._environment, cwd=self.path.parent
            )

    def is_healthy(self, name: str) -> bool:
        return get(self.ports[name], "healthz")[0] == 200

    def told(self, name: str) -> dict[str, str]:
        checks: dict[str, str] = json.loads(get(self.ports[name], "healthz")[1])["checks"]
        return checks

    def log(self, name: str) -> str:
        return (self.path.parent / f"{name}.log").read_text()

    def kill(self) -> None:
        for process in self.running.values():
            process.kill()
            process.wait()
