"""What the tests of the page share: a street that changes, its router, and `gnd serve` in a process of its own."""

import gzip
import http.client
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from suite_ports import new_port

from gnd.cloud_merger.announce import encoded, update_of
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile, diff
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.keys import traffic_key, update_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.traffic import TrafficSample
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import Basis, Publication, ReportRow, StoreConfig

HERE = TileId.from_path("13033/03021/23031/22102")
EAST = TileId.from_path("13033/03021/23031/22103")
FLOOR = 30
EAGER = StoreConfig(merge_delay_s=0.0, merge_after_reports=1)


def street_tile(tile: TileId, *, wall: bool = True, hump: float = 0.0) -> Tile:
    """Ground 24 m wide, and a wall of 12 m, 10 m high, along its middle; `hump` lifts the south-western ground, m."""
    grid = VoxelGrid.of(tile)
    x, y = (one.ravel() for one in np.meshgrid(np.arange(3, 27), np.arange(3, 27)))
    ground = grid.voxel_id(x, y, np.full(len(x), FLOOR))
    upright = grid.voxel_id(np.tile(np.arange(9, 21), 10), np.full(120, 15), np.repeat(np.arange(10) + FLOOR + 1, 12))
    flat, tall = [0.083, 0, 0, 0.083, 0, 0.0004], [0.083, 0, 0, 0.0004, 0, 0.083]
    rows = [(int(one), flat, 0.0) for one in ground] + [(int(one), tall, 0.0) for one in (upright if wall else ())]
    lifted = set(grid.voxel_id(x[:40], y[:40], np.full(40, FLOOR)).tolist())
    rows = sorted((voxel, cov, hump if voxel in lifted else 0.0) for voxel, cov, _ in rows)
    ids, n = np.array([row[0] for row in rows], np.int32), len(rows)
    mean_m = np.zeros((n, 3), np.float32)
    mean_m[:, 2] = [row[2] for row in rows]
    cov_m2 = np.array([row[1] for row in rows], np.float32)
    return Tile(tile, 0, Gaussians(ids, np.full(n, 400, np.int32), np.full(n, 60, np.int32), mean_m, cov_m2))


@dataclass
class LiveStreet:
    """A store with two tiles behind a router, to which versions are published as a merger does."""

    path: Path
    endpoint: str
    store: SqliteStore
    bus: Bus | None = None
    _reports: Iterator[int] = field(default_factory=lambda: iter(range(1, 10_000)))
    _stack: ExitStack = field(default_factory=ExitStack)
    _router: ExitStack = field(default_factory=ExitStack)

    def start_router(self) -> None:
        self._router.enter_context(open_router((self.endpoint,)))
        self.bus = self._router.enter_context(open_bus(BusConfig(connect=(self.endpoint,)), name="cloud"))

    def stop_router(self) -> None:
        self._router.close()

    def close(self) -> None:
        self._router.close()

    def merge(self, content: Tile, vehicle: str = "vehicle-07", *, quietly: bool = False) -> int:
        """Report a tile as it is now, merge the report, and publish the version; its number."""
        row, changed = self._put(content, vehicle)
        (claim,) = self.store.claim("shard-0", 10, 30.0)
        work = self.store.load(claim)
        said = {int(voxel): (row.report_id,) for voxel in changed}
        basis = Basis(work.journal.window, work.journal.seq)
        publication = Publication(
            claim, work.base_version, content, report_ids=(row.report_id,), voxel_reports=said, basis=basis
        )
        (result,) = self.store.publish([publication])
        assert result.status == "published"
        if not quietly:
            self.announce(content.tile_id, result.version)
        return result.version

    def put_report(self, content: Tile, vehicle: str = "vehicle-07") -> ReportRow:
        """Report a tile as it is now, without merging it."""
        return self._put(content, vehicle)[0]

    def _put(self, content: Tile, vehicle: str) -> tuple[ReportRow, list[int]]:
        head = self.store.get("ndt", content.tile_id)
        assert head is not None
        before = head.decode_gaussians().gaussians
        row, changed = self._report(head.version, head.sha, content, before, vehicle)
        assert self.store.put_reports([row]) == ["stored"]
        return row, changed

    def announce(self, tile: TileId, version: int) -> None:
        new, old = (self.store.get("ndt", tile, one) for one in (version, version - 1))
        assert new is not None
        assert self.bus is not None
        self.bus.publish(update_key("ndt", tile), encoded(update_of(new, old)), kind="update")

    def _report(
        self, version: int, sha: bytes, content: Tile, before: Gaussians, vehicle: str
    ) -> tuple[ReportRow, list[int]]:
        delta = diff(before, content.gaussians)
        gone = Gaussians.nothing_at(delta.removed)
        ids = np.concatenate([delta.put.voxel_id, gone.voxel_id])
        order = np.argsort(ids)
        columns = [np.concatenate(pair)[order] for pair in zip(delta.put.columns, gone.columns, strict=True)]
        changed = Gaussians(*columns)
        kinds = np.where(changed.count == 0, ChangeClass.DELETED, ChangeClass.NEW).astype(np.uint8)
        kinds[np.isin(changed.voxel_id, before.voxel_id) & (changed.count > 0)] = ChangeClass.MODIFIED
        evidence = np.tile(np.array([7, 1, 0, 3], np.int32), (len(changed), 1))
        sigmas = {"pose_sigma_m": 0.02, "pose_sigma_rad": 0.001}
        change = TileChange(content.tile_id, version, sha, changed.voxel_id, changed, kinds, evidence, **sigmas)
        now_ns = time.time_ns()
        name = deterministic_report_id(now_ns // 1_000_000, vehicle, str(next(self._reports)))
        body = ChangeReport(
            name, vehicle, "VLP-16", "test", content.tile_id.district, now_ns - 10**9, now_ns, (change,)
        ).encode()
        row = ReportRow(name, "ndt", content.tile_id, vehicle, now_ns, body, base_sha=sha)
        return row, changed.voxel_id.tolist()

    def tell(self, vehicle: str, lat_deg: float, lon_deg: float, health: str = "good", odometer_m: float = 0.0) -> None:
        """A vehicle says where it is."""
        at = np.radians([lat_deg, lon_deg]).tolist()
        sample = TrafficSample(vehicle, time.time_ns(), odometer_m, (), 0, 0, at[0], at[1], health, 3, 1)
        assert self.bus is not None
        self.bus.publish(traffic_key(vehicle), sample.encode(), kind="telemetry")


@contextmanager
def live_street(folder: Path, *, router: bool = True) -> Iterator[LiveStreet]:
    path = folder / "map.sqlite"
    with SqliteStore(path, EAGER) as store:
        store.put_tiles([street_tile(HERE), street_tile(EAST, wall=False)], surveyed_ns=1_767_225_600_000_000_000)
        street = LiveStreet(path, f"tcp/127.0.0.1:{new_port()}", store)
        if router:
            street.start_router()
        try:
            yield street
        finally:
            street.close()


@dataclass(frozen=True)
class Answer:
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def value(self) -> Any:
        return json.loads(self.body)


class ServedPage:
    """`gnd serve` in a process of its own."""

    def __init__(self, source: Path | str, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "gnd.deploy.cli", "serve", str(source), "--port", "0", *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )  # fmt: skip
        self.lines: list[str] = []
        self._said: queue.Queue[str | None] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()
        self.url = self._address()
        told = urlsplit(self.url)
        assert told.port is not None
        self.port, self.token = told.port, parse_qs(told.query).get("token", [""])[0]

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._said.put(line)
        self._said.put(None)

    def _address(self) -> str:
        while (line := self._said.get(timeout=120)) is not None:
            self.lines.append(line)
            if line.startswith("the map is at "):
                return line.split()[4]
        raise AssertionError(f"gnd serve has ended: {''.join(self.lines)}")

    def get(self, path: str, *, method: str = "GET", host: str | None = None, **headers: str) -> Answer:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            told = {name.replace("_", "-"): value for name, value in headers.items()}
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            connection.putheader("Host", host if host is not None else f"127.0.0.1:{self.port}")
            for name, value in told.items():
                connection.putheader(name, value)
            connection.endheaders()
            got = connection.getresponse()
            body = got.read()
            found = {name.lower(): value for name, value in got.getheaders()}
            return Answer(got.status, found, gzip.decompress(body) if found.get("content-encoding") == "gzip" else body)
        finally:
            connection.close()

    def value(self, path: str) -> Any:
        answer = self.get(path, **({"Authorization": f"Bearer {self.token}"} if self.token else {}))
        assert answer.status == 200, answer.body
        return answer.value

    def decide(self, key: str, judgement: str, why: str = "", **headers: str) -> Answer:
        """Decide about a change as the page does; headers may be others, "" leaves one out."""
        own = {"Origin": f"http://127.0.0.1:{self.port}", "Content-Type": "application/json",
               "Authorization": f"Bearer {self.token}"}  # fmt: skip
        told = {name.replace("_", "-"): value for name, value in headers.items()}
        return self.post(f"/api/changes/{key}", json.dumps({"judgement": judgement, "why": why}).encode(), own | told)

    def post(self, path: str, body: bytes, headers: dict[str, str]) -> Answer:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            connection.request("POST", path, body, {name: one for name, one in headers.items() if one})
            got = connection.getresponse()
            return Answer(got.status, {name.lower(): one for name, one in got.getheaders()}, got.read())
        finally:
            connection.close()

    def end(self, number: int = signal.SIGTERM) -> int:
        if self.process.poll() is None:
            self.process.send_signal(number)
        try:
            return self.process.wait(timeout=60)
        finally:
            if self.process.poll() is None:
                self.process.kill()
                self.process.wait()
            assert self.process.stdout is not None
            self.process.stdout.close()


@contextmanager
def served(source: Path | str, *arguments: str) -> Iterator[ServedPage]:
    page = ServedPage(source, *arguments)
    try:
        yield page
    finally:
        page.end()


def columns_of(body: bytes) -> dict[str, np.ndarray]:
    """The columns of a packed tile, read by its description alone."""
    assert body[:4] == b"GND1"
    n, version, level = (int.from_bytes(body[at : at + 4], "little") for at in (4, 8, 12))
    found: dict[str, np.ndarray] = {"n": np.array(n), "version": np.array(version), "level": np.array(level)}
    at = 16
    for name, kind, width in (
        ("mean", "<f4", 3), ("voxel", "<i4", 1), ("since", "<u4", 1), ("turn", "<i2", 4), ("shape", "<u2", 4),
        ("reports", "<u2", 1), ("cells", "<u2", 1), ("kind", "u1", 1),
    ):  # fmt: skip
        size = np.dtype(kind).itemsize * width * n
        found[name] = np.frombuffer(body[at : at + size], kind).reshape((n, width) if width > 1 else n)
        at += size
    assert at == len(body)
    return found
