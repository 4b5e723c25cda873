"""A load run: streets into a store, the processes of a cloud, clients that send, and what it came to."""

import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from gnd.cloud_merger.checking import IngestLimits
from gnd.cloud_merger.config import ShardConfig
from gnd.deploy import roles
from gnd.deploy.chaos.checks import Findings, find_unsigned
from gnd.deploy.errors import DeployError, LoadError
from gnd.deploy.fleet import shard_config
from gnd.deploy.fleet_config import FleetConfig
from gnd.deploy.fleet_identities import FLEET, issue_identities, of_cloud, sign_map
from gnd.deploy.load.audit import Auditor, Backlog
from gnd.deploy.load.client import ClientConfig, client, read_accounts, start_file, vehicle_name
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
from gnd.fleet_bus.identity.names import MemberName
from gnd.schemas.keys import parse_update_key, update_keys
from gnd.schemas.updates import TileUpdate
from gnd.tile_store.location import StoreLocation, open_store, shown
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqlStore

LOOK_S: Final = 0.5
READY_S: Final = 120.0
LEAD_S: Final = 1.0
"""Time between the start signal and the first report."""
END_S: Final = 30.0
"""Clients that have not ended so long after their time are ended."""

Tell = Callable[[str, float, float], None]
"""Called with what is being done, how much of it is done, and of how much."""


@dataclass(frozen=True, slots=True)
class LoadCloud:
    """A cloud that has been started, before anybody sends.

    Attributes:
        store: where its map is.
        supervisor: of all processes.
        start: starts processes of clients.
        stop: ends processes by name.
        poll: starts again what has died.
        names: of its processes.
        shards: how many of them are shards.
        places: where clients are, one after the other: endpoints of routers, and the network namespace.
        identities: folder of the identities; None: there are no certificates.
        hosts: what runs where, on several hosts.
    """

    store: StoreLocation
    supervisor: Supervisor
    start: Callable[[Iterable[ProcessSpec]], None]
    stop: Callable[[tuple[str, ...]], None]
    poll: Callable[[], None]
    names: tuple[str, ...]
    shards: int
    places: tuple[tuple[tuple[str, ...], str | None], ...]
    identities: Path | None = None
    hosts: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def identity_of(self, process: str) -> Path | None:
        """Its identity folder; None: there are no certificates."""
        return None if self.identities is None else self.identities / process


@dataclass(slots=True)
class Running:
    """A cloud with its clients while they run.

    Attributes:
        folder: of accounts, and of logs.
        cloud: started.
        clients: what was started.
        auditor: of the store.
        stop: ends the run early.
        server: first process of the database server; None: there is none on this machine, or it is a part of the cloud.
        notices_s: when each (tile, version) was heard of here, s UTC.
        backlog: what was waiting when.
    """

    folder: Path
    cloud: LoadCloud
    clients: list[ClientConfig]
    auditor: Auditor
    stop: threading.Event
    server: int | None = None
    notices_s: dict[tuple[int, int], float] = field(default_factory=dict)
    backlog: list[Backlog] = field(default_factory=list)

    def on_update(self, key: str, payload: bytes) -> None:
        """Note a notice."""
        now_s = time.time()
        self.notices_s.setdefault((parse_update_key(key)[1].morton, TileUpdate.decode(payload).version), now_s)

    def look(self) -> Backlog:
        """Supervise, and note what waits."""
        self.cloud.poll()
        now = self.auditor.backlog(time.monotonic())
        self.backlog.append(now)
        return now

    def cloud_cpu_s(self) -> dict[str, float]:
        """CPU of the cloud's parts so far."""
        pids = self.cloud.supervisor.pids()
        of_database = {} if self.server is None else {DATABASE: self.server}
        return by_part({name: pids[name] for name in self.cloud.names if name in pids} | of_database)

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
    *,
    secure: bool = False,
) -> LoadOutcome:
    """Replay kept drives as many vehicles, on a cloud of one machine.

    Args:
        options: what to replay.
        runs: the kept drives.
        folder: empty; for store, logs and accounts.
        tell: is told how far it is.
        stop: ends the run early: what was measured until then is the outcome.
        store: a new one, which keeps what is written; None: a file in the folder.
        secure: give every process and every vehicle a certificate, and the bus TLS and rights.

    Raises:
        LoadError: the drives cannot be replayed, or the store holds a map.
        DeployError: the cloud does not start, or does not stay alive.
    """
    streets = Streets.of(runs, options)
    location = folder / "store.sqlite" if store is None else store
    members = of_cloud(options.shards) | vehicles_of(options)
    identities = issue_identities(folder, members) if secure else None
    with open_store(location, signing=None if identities is None else Signing(identities / FLEET)) as opened:
        if any(True for _ in opened.heads(LAYER)):
            raise LoadError(f"{shown(location)} holds a map; a load needs a store of its own")
        put_streets(streets, opened, tell, stop)
    start_fork_server()
    with _cloud(options, folder, location, identities) as cloud:
        return measured(cloud, options, runs, folder, tell, stop)


def vehicles_of(options: LoadOptions) -> dict[str, MemberName]:
    """Who the vehicles of a load are, where there are certificates."""
    shared = enumerate(shared_out(options.vehicles, options.clients))
    names = (vehicle_name(number, vehicle) for number, vehicles in shared for vehicle in vehicles)
    return {name: MemberName("vehicle", name) for name in names}


def put_streets(streets: Streets, store: SqlStore, tell: Tell, stop: threading.Event) -> None:
    """Write the map of all streets, signed where the store's process has an identity."""
    count = streets.options.streets
    for street in range(count):
        if stop.is_set():
            raise KeyboardInterrupt
        store.put_tiles(streets.tiles(street))
        tell("streets", street + 1, count)
    if store.signing is not None:
        sign_map(store)


def shard_of_load(name: str, store: StoreLocation, connect: tuple[str, ...]) -> ShardConfig:
    """A shard of a load: streets lie districts apart, and vehicles that follow each other send the same drives."""
    one = shard_config(FleetConfig(), name, store, connect[0])
    confirmation = replace(one.confirmation, copies=False)
    return replace(one, connect=connect, ingest=IngestLimits(speeds=False), confirmation=confirmation)


@contextmanager
def _cloud(options: LoadOptions, folder: Path, store: StoreLocation, identities: Path | None) -> Iterator[LoadCloud]:
    connect = f"{'tcp' if identities is None else 'tls'}/127.0.0.1:{claim_port(0)}"
    shards = [shard_of_load(f"shard-{n}", store, (connect,)) for n in range(options.shards)]
    supervisor = Supervisor(folder, folder / "pids.json")

    def start(specs: Iterable[ProcessSpec]) -> None:
        for spec in specs:
            supervisor.start(spec)

    specs = roles.of_cloud(connect, connect, store, shards)
    names, places = tuple(spec.name for spec in specs), (((connect,), None),)
    cloud = LoadCloud(
        store, supervisor, start, supervisor.stop, supervisor.poll, names, options.shards, places, identities
    )
    try:
        start(replace(spec, identity=cloud.identity_of(spec.name)) for spec in specs)
        yield cloud
    finally:
        supervisor.stop()


def measured(
    cloud: LoadCloud, options: LoadOptions, runs: KeptRuns, folder: Path, tell: Tell, stop: threading.Event
) -> LoadOutcome:
    """Let clients send to a cloud that has been started, and tell what it came to; see `run_load`."""
    with _with_clients(cloud, options, runs, folder, stop) as running:
        tell("start", 0, 1)
        planned = _ready(running)
        outcome = _measured(running, options, planned, tell)
    own = cloud.identity_of(FLEET)
    if own is None:
        return outcome
    found = Findings()
    with open_store(cloud.store, create=False) as store:
        find_unsigned(found, store, own)
    return replace(outcome, unsigned=len(found.damages))


@contextmanager
def _with_clients(
    cloud: LoadCloud, options: LoadOptions, runs: KeptRuns, folder: Path, stop: threading.Event
) -> Iterator[Running]:
    clients, specs = [], []
    for number, vehicles in enumerate(shared_out(options.vehicles, options.clients)):
        connect, namespace = cloud.places[number % len(cloud.places)]
        clients.append(ClientConfig(number, vehicles, options, runs, connect, folder, cloud.identities))
        specs.append(ProcessSpec(clients[-1].name, client, (clients[-1],), restart=False, namespace=namespace))
    own = BusConfig(connect=cloud.places[0][0], open_timeout_s=READY_S, identity=cloud.identity_of(FLEET))
    with ExitStack() as stack:
        auditor = Auditor(cloud.store)
        stack.callback(auditor.close)
        bus = stack.enter_context(open_bus(own, name="load"))
        running = Running(folder, cloud, clients, auditor, stop, server_of(cloud.store))
        stack.enter_context(bus.subscribe(update_keys(LAYER), running.on_update))
        cloud.start(specs)
        yield running


def _ready(running: Running) -> int:
    """Wait until all clients are connected and all shards can work; how many reports the clients have.

    Raises:
        DeployError: that takes too long.
    """
    with open_store(running.cloud.store, create=False) as store:
        until_s = time.monotonic() + READY_S
        is_ready = running.wait_until(
            lambda: (
                all(one.ready.exists() for one in running.clients)
                and sum(seen.is_alive for seen in store.shards()) == running.cloud.shards
            ),
            until_s,
            running.cloud.poll,
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
        restarts=sum(running.cloud.supervisor.restarts.values()),
        interrupted=running.stop.is_set(),
        hosts=running.cloud.hosts,
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
        if not now.items and running.cloud.supervisor.finished("client-"):
            return now.at_s
        if now.at_s > until_s:
            return None
        running.stop.wait(LOOK_S / 5)
    return None


def _ended(running: Running) -> list[SenderAccount]:
    """What the clients have written, after they have ended."""
    until_s = time.monotonic() + END_S
    while not running.cloud.supervisor.finished("client-") and time.monotonic() < until_s and not running.stop.is_set():
        time.sleep(LOOK_S / 5)
    running.cloud.stop(tuple(one.name for one in running.clients))
    return [account for one in running.clients for account in read_accounts(one.accounts)]
