"""A district moves between two stores while vehicles report and read, over two linked routers, with identities.

Each store has a shard and a tile server, the western ones at a hub, the eastern ones at a router that is linked with
it; vehicles know both. What their tiles hold no vehicle has measured: here only their number and size matter.
"""

import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.cloud_merger.checking import IngestLimits
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.confirmation import ConfirmationParameters
from gnd.deploy import roles
from gnd.deploy.lab.hosts.cloud import lab_router
from gnd.deploy.ports import claim_port
from gnd.deploy.processes import ProcessSpec, Supervisor, start_fork_server
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import Refused
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import MemberName
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, TileId
from gnd.schemas.changes import ChangeAck
from gnd.schemas.keys import change_key, tile_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore
from studies.frame.measure import Figure
from studies.frame.options import check, option
from studies.small_cloud import base_tile, change_report

LAYER: Final = "ndt"
READY_S: Final = 120.0
ANSWER_S: Final = 60.0
MOVE_S: Final = 900.0
PAUSE_S: Final = 0.03
TAKEN: Final = ("stored", "duplicate")
QUICK: Final = RetryPolicy(longest_wait_s=0.2, attempt_timeout_s=5.0)
SIDES: Final = ("west", "east")


@dataclass(frozen=True, slots=True)
class DistrictMoveOptions:
    """What moves."""

    tiles: int = option(1000, "Tiles of the district.", span=(1, TILES_OF_DISTRICT))
    voxels: int = option(2000, "Voxels of each tile.", span=(500, 8000))
    times: int = option(3, "How often it moves, each time in a new cloud.", span=(1, 100))
    vehicles: int = option(2, "Vehicles that report and read there.", span=(1, 20))
    plain: int = option(0, "1: without certificates and TLS.", span=(0, 1))

    def __post_init__(self) -> None:
        check(self)


OPTIONS: Final = DistrictMoveOptions


@dataclass(frozen=True, slots=True)
class DistrictMoved:
    """One move.

    Attributes:
        gap_s: for which the store took nothing about the district.
        seconds: for which the command ran.
        refused: reports that were refused, not only put off.
        reports: that were acknowledged.
        longest_ack_s, longest_tile_s: while it moved.
    """

    gap_s: float
    seconds: float
    refused: int
    reports: int
    longest_ack_s: float
    longest_tile_s: float


class _Driving:
    """A vehicle that reports about tiles of the district, and reads them, until it is stopped."""

    def __init__(self, name: str, config: BusConfig, tiles: Sequence[Tile]) -> None:
        self.acknowledged: list[str] = []
        self.refused, self.reads = 0, 0
        self.longest_ack_s = self.longest_tile_s = 0.0
        self.failed: list[BaseException] = []
        self._name, self._tiles, self._stop = name, tiles, threading.Event()
        self._bus = open_bus(config, name=name)
        self._threads = [threading.Thread(target=self._run, args=(one,)) for one in (self._report, self._read)]
        for thread in self._threads:
            thread.start()

    def _run(self, work: Any) -> None:
        number = 0
        try:
            while not self._stop.wait(PAUSE_S):
                work(number)
                number += 1
        except BaseException as error:  # told by who waits
            self.failed.append(error)

    def _report(self, number: int) -> None:
        tile = self._tiles[number % len(self._tiles)]
        made = change_report(number, tile)
        report = replace(
            made,
            report_id=deterministic_report_id(made.first_ns // 1_000_000 + number, self._name),
            vehicle=self._name,
            tiles=(replace(made.tiles[0], tile=tile.tile_id),),
        )
        began_s = time.monotonic()
        try:
            answer = _ask(self._bus, change_key(LAYER, report.district), report.encode(), "change")
        except Refused:
            self.refused += 1
            return
        self.refused += ChangeAck.decode(answer).status not in TAKEN
        self.acknowledged.append(report.report_id)
        self.longest_ack_s = max(self.longest_ack_s, time.monotonic() - began_s)

    def _read(self, number: int) -> None:
        began_s = time.monotonic()
        _ask(self._bus, tile_key(LAYER, self._tiles[number * 7 % len(self._tiles)].tile_id), b"", "tile")
        self.reads += 1
        self.longest_tile_s = max(self.longest_tile_s, time.monotonic() - began_s)

    def goes_on(self) -> None:
        """Wait for further acknowledgements and tiles."""
        before = len(self.acknowledged), self.reads
        until_s = time.monotonic() + ANSWER_S
        while len(self.acknowledged) < before[0] + 10 or self.reads < before[1] + 10:
            if self.failed or time.monotonic() > until_s:
                raise TimeoutError(f"{self._name} is not served: {self.failed}")
            time.sleep(PAUSE_S)

    def close(self) -> None:
        """Stop."""
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._bus.close()


def _ask(bus: Bus, key: str, payload: bytes, kind: Any) -> bytes:
    return bus.request(key, payload, kind=kind, retry=QUICK, timeout_s=ANSWER_S)


def run(chosen: DistrictMoveOptions | None = None) -> list[Figure]:
    """Move it as often as is wanted."""
    options = chosen or DistrictMoveOptions()
    start_fork_server()
    moved = [_moved(options) for _ in range(options.times)]
    how = "plain" if options.plain else "TLS and identities"
    about = f"district of {options.tiles} tiles, two linked routers, {how}"
    names = {
        "gap_s": ("the store takes nothing about it", "s"),
        "refused": ("reports refused", ""),
        "longest_ack_s": ("longest time to an ack while it moves", "s"),
        "longest_tile_s": ("longest time to a tile while it moves", "s"),
        "seconds": ("the whole command", "s"),
    }
    reports = sum(one.reports for one in moved)
    about = f"{about}, {reports} reports"
    return [_figure(f"{about}: {text}", [getattr(one, name) for one in moved], unit) for name, (text, unit) in
            names.items()]  # fmt: skip


def _figure(name: str, found: list[float], unit: str) -> Figure:
    return Figure(name, max(found), unit, f"the worst of {len(found)}; mean {sum(found) / len(found):.2f}")


def _moved(options: DistrictMoveOptions) -> DistrictMoved:
    with tempfile.TemporaryDirectory(prefix="gnd-move-", ignore_cleanup_errors=True) as name, ExitStack() as stack:
        folder, first = Path(name), base_tile(options.voxels)
        begin = first.tile_id.district.first_morton
        tiles = [_filled(first, TileId(begin + k)) for k in range(options.tiles)]
        identities = None if options.plain else _identities(folder, options.vehicles)
        _fill(folder, tiles, identities)
        endpoints = stack.enter_context(_cloud(folder, identities))
        drivings = []
        for number in range(options.vehicles):
            vehicle = f"vehicle-{number:02d}"
            own = None if identities is None else identities / vehicle
            config = BusConfig(connect=endpoints, open_timeout_s=READY_S, identity=own)
            drivings.append(_Driving(vehicle, config, tiles[number :: options.vehicles] or tiles))
            stack.callback(drivings[-1].close)
        for driving in drivings:
            driving.goes_on()
            driving.longest_ack_s = driving.longest_tile_s = 0.0
        began_s = time.monotonic()
        told = _command("move", first.tile_id.district.path, "--from", _store(folder, "west"), "--to",
                        _store(folder, "east"))  # fmt: skip
        seconds = time.monotonic() - began_s
        for driving in drivings:
            driving.goes_on()
        return DistrictMoved(
            gap_s=float(told["districts"][0]["gap_s"]),
            seconds=seconds,
            refused=sum(one.refused for one in drivings),
            reports=sum(len(one.acknowledged) for one in drivings),
            longest_ack_s=max(one.longest_ack_s for one in drivings),
            longest_tile_s=max(one.longest_tile_s for one in drivings),
        )


def _filled(first: Tile, at: TileId) -> Tile:
    g = first.gaussians
    mean_m = np.random.default_rng(at.morton).uniform(-0.1, 0.1, g.mean_m.shape).astype(np.float32)
    return Tile(at, 1, replace(g, mean_m=mean_m))


def _store(folder: Path, side: str) -> str:
    return str(folder / f"{side}.sqlite")


def _fill(folder: Path, tiles: Sequence[Tile], identities: Path | None) -> None:
    signing = None if identities is None else Signing(identities / "operator")
    with SqliteStore(folder / "west.sqlite", signing=signing) as store:
        for at in range(0, len(tiles), 64):
            store.put_tiles(tiles[at : at + 64])
    _command("create", _store(folder, "east"), "east")


def _command(*words: str) -> Any:
    command = [sys.executable, "-m", "gnd.deploy.cli", "regions", *words, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=MOVE_S, check=False)  # noqa: S603
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)}: {done.stderr[-500:]}")
    return json.loads(done.stdout)


def _identities(folder: Path, vehicles: int) -> Path:
    authority, out = Authority.create(folder / "authority", "GND study"), folder / "identities"
    members = {
        **{f"router-{side}": MemberName("router", f"router-{side}") for side in SIDES},
        **{f"tiles-{side}": MemberName("tiles", f"tiles-{side}") for side in SIDES},
        **{f"shard-{side}": MemberName("shard", side) for side in SIDES},
        "operator": MemberName("operator", "operator"),
        **{f"vehicle-{n:02d}": MemberName("vehicle", f"vehicle-{n:02d}") for n in range(vehicles)},
    }
    for process, member in members.items():
        authority.issue(member, out / process)
    authority.copy_lists(out / process for process in members)
    return out


@contextmanager
def _cloud(folder: Path, identities: Path | None) -> Iterator[tuple[str, ...]]:
    """Start all parts; the endpoints of both routers, the hub's first."""
    protocol = "tcp" if identities is None else "tls"
    hub, region = (f"{protocol}/127.0.0.1:{claim_port(0)}" for _ in SIDES)
    at = dict(zip(SIDES, (hub, region), strict=True))
    specs = [
        ProcessSpec("router-west", lab_router, (hub, ())),
        ProcessSpec("router-east", lab_router, (region, (hub,))),
    ]
    for side in SIDES:
        shard = ShardConfig(
            side,
            _store(folder, side),
            (at[side],),
            ingest=IngestLimits(speeds=False),
            confirmation=ConfirmationParameters(copies=False),
        )
        specs += [
            ProcessSpec(f"tiles-{side}", roles.store, (_store(folder, side), at[side])),
            ProcessSpec(f"shard-{side}", roles.merger, (shard,)),
        ]
    supervisor = Supervisor(folder, folder / "pids.json")
    try:
        for spec in specs:
            supervisor.start(replace(spec, identity=None if identities is None else identities / spec.name))
        yield hub, region
    finally:
        supervisor.stop()
