"""A load run: streets into a store, the processes of a cloud, clients that send, and what it came to."""

import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from gnd.cloud_merger.checking import IngestLimits
from gnd.deploy import roles
from gnd.deploy.errors import DeployError, LoadError
from gnd.deploy.fleet import shard_config
from gnd.deploy.fleet_config import FleetConfig
from gnd.deploy.load.audit import Auditor, Backlog
from gnd.deploy.load.client import ClientConfig, client, read_accounts, start_file
from gnd.deploy.load.cpu import DATABASE, busy_s, by_part, server_of
from gnd.deploy.load.drives import LAYER, KeptRuns
from gnd.deploy.load.plan import LoadOptions, shared_out
from gnd.deploy.load.sending import SenderAccount
from gnd.deploy.load.streets import Streets
from gnd.deploy.load.verdict import LoadOutcome
from gnd.deploy.ports import claim_port
from gnd.deploy.processes import ProcessSpec, Supervisor, start_fork_server
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.schemas.keys import parse_update_key, update_keys
from gnd.schemas.updates import TileUpdate
from gnd.tile_store.location import StoreLocation, open_store, shown

LOOK_S: Final = 0.5
READY_S: Final = 120.0
LEAD_S: Final = 1.0
"""Time between the start signal and the first report."""
END_S: Final = 30.0
"""Clients that have not ended so long after their time are ended."""

Tell = Callable[[str, float, float], None]
"""Called with what is being done, how much of it is done, and of how much."""


@dataclass(slots=True)
class Running:
    """A cloud with its clients while they run.

    Attributes:
        folder: of logs, accounts, and the store if it is a file.
        store: where it is.
        supervisor: of all processes.
        connect: endpoint of the router.
        clients: what was started.
        auditor: of the store.
        notices_s: when each (tile, version) was heard of here, s UTC.
        backlog: what was waiting when.
        names: of the processes of the cloud.
        server: first process of the database server; None: there is none on this machine.
    """

    folder: Path
    store: StoreLocation
    supervisor: Supervisor
    connect: str
    clients: list[ClientConfig]
    auditor: Auditor
    stop: threading.Event
    names: tuple[str, ...]
    server: int | None = None
    notices_s: dict[tuple[int, int], float] = field(default_factory=dict)
    backlog: list[Backlog] = field(default_factory=list)

    def on_update(self, key: str, payload: bytes) -> None:
        """Note a notice."""
        now_s = time.time()
        self.notices_s.setdefault((parse_update_key(key)[1].morton, TileUpdate.decode(payload).version), now_s)

    def look(self) -> Backlog:
        """Supervise, and note what waits."""
        self.supervisor.poll()
        now = self.auditor.backlog(time.monotonic())
        self.backlog.append(now)
        return now

    def cloud_cpu_s(self) -> dict[str, float]:
        """CPU of the cloud's parts so far."""
        pids = self.supervisor.pids()
        of_database = {} if self.server is None else {DATABASE: self.server}
        return by_part({name: pids[name] for name in self.names if name in pids} | of_database)

    def client_cpu_s(self) -> float:
        """CPU of the clients, which have ended."""
        files = [one.cpu for one in self.clients if one.cpu.exists()]
        return sum(float(file.read_text(encoding="utf-8")) for file in files)

    def wait_until(self, done: Callable[[], bool], until_s: float, each: Callable[[], object]) -> bool:
        """Poll until a condition holds; False: the time is over, or `stop` is set."""
        while not done():
            if self.stop.is_set() or time.monotonic() > until_s:
                return False
            each()
            self.stop.wait(LOOK_S)
        return True


def run_load(
    options: LoadOptions,
    runs: KeptRuns,
    folder: Path,
    tell: Tell,
    stop: threading.Event,
    store: StoreLocation | None = None,
) -> LoadOutcome:
    """Replay kept drives as many vehicles.

    Args:
        options: what to replay.
        runs: the kept drives.
        folder: empty; for store, logs and accounts.
        tell: is told how far it is.
        stop: ends the run early: what was measured until then is the outcome.
        store: a new one, which keeps what is written; None: a file in the folder.

    Raises:
        LoadError: the drives cannot be replayed, or the store holds a map.
        DeployError: the cloud does not start, or does not stay alive.
    """
    streets = Streets.of(runs, options)
    location = folder / "store.sqlite" if store is None else store
    _put_streets(streets, location, tell, stop)
    start_fork_server()
    with _cloud(options, runs, folder, location, stop) as running:
        tell("start", 0, 1)
        planned = _ready(running)
        return _measured(running, options, planned, tell)


def _put_streets(streets: Streets, location: StoreLocation, tell: Tell, stop: threading.Event) -> None:
    count = streets.options.streets
    with open_store(location) as store:
        if any(True for _ in store.heads(LAYER)):
            raise LoadError(f"{shown(location)} holds a map; a load needs a store of its own")
        for street in range(count):
            if stop.is_set():
                raise KeyboardInterrupt
            store.put_tiles(streets.tiles(street))
            tell("streets", street + 1, count)


@contextmanager
def _cloud(
    options: LoadOptions, runs: KeptRuns, folder: Path, store: StoreLocation, stop: threading.Event
) -> Iterator[Running]:
    connect = f"tcp/127.0.0.1:{claim_port(0)}"
    made = (shard_config(FleetConfig(), f"shard-{n}", store, connect) for n in range(options.shards))
    # streets lie districts apart, and vehicles that follow each other send the same drives
    shards = [
        replace(one, ingest=IngestLimits(speeds=False), confirmation=replace(one.confirmation, copies=False))
        for one in made
    ]
    clients = [
        ClientConfig(number, vehicles, options, runs, connect, folder)
        for number, vehicles in enumerate(shared_out(options.vehicles, options.clients))
    ]
    with ExitStack() as stack:
        supervisor = Supervisor(folder, folder / "pids.json")
        stack.callback(supervisor.stop)
        specs = roles.of_cloud(connect, connect, store, shards)
        for spec in specs:
            supervisor.start(spec)
        auditor = Auditor(store)
        stack.callback(auditor.close)
        bus = stack.enter_context(open_bus(BusConfig(connect=(connect,), open_timeout_s=READY_S), name="load"))
        names = tuple(spec.name for spec in specs)
        running = Running(folder, store, supervisor, connect, clients, auditor, stop, names, server_of(store))
        stack.enter_context(bus.subscribe(update_keys(LAYER), running.on_update))
        for one in clients:
            supervisor.start(ProcessSpec(_name(one), client, (one,), restart=False))
        yield running


def _name(one: ClientConfig) -> str:
    return f"client-{one.number}"


def _ready(running: Running) -> int:
    """Wait until all clients are connected and all shards can work; how many reports the clients have.

    Raises:
        DeployError: that takes too long.
    """
    shards = sum(name.startswith("merger-") for name in running.names)
    with open_store(running.store, create=False) as store:
        until_s = time.monotonic() + READY_S
        is_ready = running.wait_until(
            lambda: (
                all(one.ready.exists() for one in running.clients)
                and sum(seen.is_alive for seen in store.shards()) == shards
            ),
            until_s,
            running.supervisor.poll,
        )
    if not is_ready:
        if running.stop.is_set():
            raise KeyboardInterrupt
        raise DeployError(
            f"clients and shards were not ready within {READY_S:.0f} s: read the logs in {running.folder}"
        )
    return sum(int(one.ready.read_text(encoding="utf-8")) for one in running.clients)


def _measured(running: Running, options: LoadOptions, planned: int, tell: Tell) -> LoadOutcome:
    cloud_before, own_before_s, busy_before_s = running.cloud_cpu_s(), time.process_time(), busy_s()
    measured_s = time.monotonic()
    start_s = time.monotonic() + LEAD_S
    _say_start(running.folder, start_s)
    first = running.look().received

    longest_s = options.seconds if options.pace == "max" else min(options.seconds, 3600.0 * options.km / options.kmh)

    def look() -> None:
        waits = running.look()
        done, total = waits.received - first, planned
        if options.pace == "real":
            done, total = round(min(waits.at_s - start_s, longest_s)), round(longest_s)
        tell(f"{waits.received - first} messages, {waits.items} wait", max(done, 0), total)

    until_s = start_s + longest_s + (END_S if math.isfinite(longest_s) else math.inf)
    running.wait_until(lambda: _all_offered(running), until_s, look)
    offered_s = max((one.offered.stat().st_mtime for one in running.clients if one.offered.exists()), default=None)
    offered_at_s = time.monotonic() if offered_s is None else time.monotonic() - (time.time() - offered_s)
    drained_s = _drained(running, offered_at_s + options.drain_s, look)
    cloud, own_s = running.cloud_cpu_s(), time.process_time() - own_before_s
    machine_s, measured_s = busy_s() - busy_before_s, time.monotonic() - measured_s
    accounts = _ended(running)
    return LoadOutcome(
        options=options,
        planned=planned if math.isinf(options.seconds) or options.pace == "real" else None,
        accounts=accounts,
        backlog=running.backlog,
        start_s=start_s,
        offered_s=offered_at_s,
        drained_s=drained_s,
        cpu_s={name: used_s - cloud_before[name] for name, used_s in cloud.items()},
        client_cpu_s=running.client_cpu_s() + own_s,
        machine_cpu_s=machine_s,
        capacity_s=(os.cpu_count() or 1) * measured_s,
        ledger=running.auditor.ledger(),
        notices_s=dict(running.notices_s),
        restarts=sum(running.supervisor.restarts.values()),
        interrupted=running.stop.is_set(),
    )


def _say_start(folder: Path, start_s: float) -> None:
    path = start_file(folder)
    path.with_suffix(".tmp").write_text(repr(start_s), encoding="utf-8")
    path.with_suffix(".tmp").replace(path)


def _all_offered(running: Running) -> bool:
    return all(one.offered.exists() for one in running.clients)


def _drained(running: Running, until_s: float, look: Callable[[], object]) -> float | None:
    """When nothing waited any more and every vehicle had heard all it was to hear; None: not in time."""
    while not running.stop.is_set():
        look()
        now = running.backlog[-1]
        if not now.items and running.supervisor.finished("client-"):
            return now.at_s
        if now.at_s > until_s:
            return None
        running.stop.wait(LOOK_S / 5)
    return None


def _ended(running: Running) -> list[SenderAccount]:
    """What the clients have written, after they have ended."""
    until_s = time.monotonic() + END_S
    while not running.supervisor.finished("client-") and time.monotonic() < until_s and not running.stop.is_set():
        time.sleep(LOOK_S / 5)
    running.supervisor.stop(tuple(map(_name, running.clients)))
    return [account for one in running.clients for account in read_accounts(one.accounts)]
