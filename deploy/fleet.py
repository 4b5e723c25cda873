"""A fleet run on one machine: the route from a stale map to a healed one, and its account.

world -> base map -> router, store, shards, watcher -> agents drive, detect, upload -> merges settle -> evaluation
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from rich.console import Console

from gnd.cloud_merger.merger import ShardConfig
from gnd.deploy import roles
from gnd.deploy.errors import DeployError
from gnd.deploy.fleet_config import FleetConfig
from gnd.deploy.fleet_page import page_process
from gnd.deploy.live import FleetState, LiveView, live_view
from gnd.deploy.live_traffic import LiveLedgers
from gnd.deploy.map_use import Versions, map_use, read_ways
from gnd.deploy.prepare import PreparedRun
from gnd.deploy.processes import ProcessSpec, Supervisor
from gnd.deploy.run_folder import RunFolder
from gnd.deploy.site import SiteFrame, VehicleSite, loopback_site
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.links import load_link
from gnd.gnd_map.settings import from_settings, merged
from gnd.schemas.keys import traffic_keys
from gnd.tile_store.location import StoreLocation
from gnd.tile_store.sql_inbox import HALVES_WAIT
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore
from gnd.vehicle_agent.agent import AgentConfig
from gnd.vehicle_agent.settings import agent_of
from gnd.vehicle_agent.sources.world_clock import Departure, WorldClock, make_clock

POLL_S = 0.2
LOOK_S = 2.0
SETTLE_S = 60.0
EARLY_S = 3.0
"""A process is started so long before its vehicle, in time of the drives: the others would have to wait for it."""
LATE = "the agents did not finish"
WATCHER_GRACE_S = 15.0
SHARD_DEFAULTS: Final = {"store": {"merge_delay_s": 0.5, "merge_after_reports": 16}}
"""What a fleet's shards have for the defaults of `gnd merger`: somebody is watching."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FleetOutcome:
    """What a run left behind for its summary.

    Attributes:
        wall_s: from the start of the first process to the settled map.
        published: tile versions published by the run.
        restarts: how often each process was started again.
    """

    wall_s: float
    published: int
    restarts: dict[str, int]


def run_fleet(
    config: FleetConfig,
    folder: RunFolder,
    prepared: PreparedRun,
    console: Console,
    stop: threading.Event,
    site: SiteFrame | None = None,
    *,
    page: bool = False,
) -> FleetOutcome:
    """Run the processes of a fleet until every drive is done and every report is merged.

    Args:
        config: what to run.
        folder: where the run writes.
        prepared: the drives, and a store that holds the base map.
        console: where the live table appears.
        stop: ends the run early and in order.
        site: where the processes run; by default all on the loopback interface.
        page: show the run in the browser, too.

    Returns:
        How long it took and what had to be restarted.

    Raises:
        DeployError: a process cannot be kept alive, the port is taken, or the deadline has passed.
    """
    started_s = time.monotonic()
    config = for_drives(config, prepared)
    site = site or loopback_site(config, len(prepared.agent_drives), prepared.identities)
    folder.endpoint.write_text(f"{site.connect}\n", encoding="utf-8")
    links = {vehicle_name(n): load_link(place.link) for n, place in enumerate(site.vehicles)}
    state = FleetState(links=links, ledgers=LiveLedgers(folder.root))
    with ExitStack() as stack:
        supervisor = stack.enter_context(supervised(folder, state))
        start_cloud(supervisor, config, folder, site)
        if page and (shown := page_process(folder, site, lambda text: console.print(text, soft_wrap=True))):
            supervisor.start(shown)
        opened = stack.enter_context(SqliteStore(folder.store))
        own = BusConfig(connect=(site.connect,), identity=site.identity_of("fleet"))
        bus = stack.enter_context(open_bus(own, name="fleet"))
        stack.enter_context(bus.subscribe(traffic_keys(), state.on_traffic))
        view = stack.enter_context(live_view(state, console))
        run = _FleetRun(
            config, folder, supervisor, opened, view, state, stop, opened.counts().versions, Versions(opened)
        )
        run.wait_until(run.watcher_ready, SETTLE_S, "the watcher did not start")
        waiting = Departures(supervisor, agent_processes(config, folder, prepared, site), folder, prepared.starts_s)
        run.wait_until(lambda: waiting.all_gone() and supervisor.finished("vehicle-"), config.deadline_s, LATE)
        run.wait_until(run.settled, SETTLE_S + _longest_wait_s(config), "the merges did not settle")
        run.wait_until(run.watcher_caught_up, WATCHER_GRACE_S, None)
    return FleetOutcome(time.monotonic() - started_s, state.published, dict(supervisor.restarts))


def for_drives(config: FleetConfig, prepared: PreparedRun) -> FleetConfig:
    """The configuration, in which vehicles that drive the same recording confirm each other all the same."""
    if not prepared.repeats:
        return config
    return replace(config, merger=merged({"confirmation": {"copies": False}}, config.merger))


@contextmanager
def supervised(folder: RunFolder, state: FleetState) -> Iterator[Supervisor]:
    """Give a supervisor whose processes all end with the block: page and agents first, router and links last."""
    supervisor = Supervisor(
        folder.logs, folder.pids, lambda name, code: state.note(f"{name} ended with code {code}, started again")
    )
    try:
        yield supervisor
    finally:
        names = tuple(supervisor.pids())
        for group in ("page", "vehicle-", "merger-", "watcher", "store", "router", "link-"):
            supervisor.stop(tuple(name for name in names if name.startswith(group)))


def start_cloud(supervisor: Supervisor, config: FleetConfig, folder: RunFolder, site: SiteFrame) -> None:
    """Start links, router, tile server, merger shards and watcher; each connects as soon as the router listens."""
    for carrier in site.carriers:
        supervisor.start(carrier)
    for spec in cloud_processes(config, folder, site):
        supervisor.start(spec)


def cloud_processes(config: FleetConfig, folder: RunFolder, site: SiteFrame) -> list[ProcessSpec]:
    """Return the processes of the cloud in the order of their start."""
    connect, where = site.connect, site.namespace
    shards = [shard_config(config, f"shard-{number}", folder.store, connect) for number in range(config.shards)]
    specs = [
        *roles.of_cloud(site.listen, connect, folder.store, shards, where),
        ProcessSpec("watcher", roles.watcher, (connect, folder.updates, config.layers), namespace=where),
    ]
    return [replace(spec, identity=site.identity_of(spec.name)) for spec in specs]


def agent_processes(
    config: FleetConfig, folder: RunFolder, prepared: PreparedRun, site: SiteFrame
) -> list[ProcessSpec]:
    """Return one agent process a drive, by the number of its vehicle."""
    specs = []
    for number, (drive, place) in enumerate(zip(prepared.agent_drives, site.vehicles, strict=True)):
        name = vehicle_name(number)
        departure = Departure(folder.clock, number, prepared.starts_s[number]) if prepared.starts_s else None
        agent = replace(agent_config(config, name, drive, folder, place), departure=departure)
        identity = site.identity_of(name)
        specs.append(ProcessSpec(name, roles.agent, (agent,), namespace=place.namespace, identity=identity))
    return specs


class Departures:
    """Starts the processes of vehicles when their time comes, a little early: they drive off on time.

    Args:
        supervisor: starts them.
        specs: one process a vehicle.
        folder: where their common clock is written.
        starts_s: when each starts; empty: all at once, each in a time of its own.
    """

    def __init__(
        self, supervisor: Supervisor, specs: list[ProcessSpec], folder: RunFolder, starts_s: tuple[float, ...]
    ) -> None:
        self._supervisor = supervisor
        self._waiting = list(zip(starts_s or (0.0,) * len(specs), specs, strict=True))
        if starts_s:
            make_clock(folder.clock, starts_s)
        self._clock = WorldClock(folder.clock) if starts_s else None

    def all_gone(self) -> bool:
        """Start those whose time has come; tell whether none is left."""
        now_s = self._clock.now_s if self._clock is not None else None
        until_s = math.inf if now_s is None else now_s + EARLY_S
        for start_s, spec in self._waiting:
            if start_s <= until_s:
                self._supervisor.start(spec)
        self._waiting = [(start_s, spec) for start_s, spec in self._waiting if start_s > until_s]
        if not self._waiting and self._clock is not None:
            self._clock.close()
            self._clock = None
        return not self._waiting


def vehicle_name(number: int) -> str:
    """Return the name of a vehicle and of its process."""
    return f"vehicle-{number:02d}"


def shard_config(config: FleetConfig, shard_id: str, store: StoreLocation, connect: str) -> ShardConfig:
    """Return the configuration of one merger shard."""
    of_fleet = {**SHARD_DEFAULTS, "feature_layer": list(config.feature_layer)}
    own = {"shard_id": shard_id, "store_path": str(store), "connect": [connect]}
    return from_settings(ShardConfig, merged(of_fleet, config.merger, own), where="fleet: merger")


def _longest_wait_s(config: FleetConfig) -> float:
    """So long a tile may wait for the other half of a report before it is merged."""
    return HALVES_WAIT * shard_config(config, "any", Path("any"), "tcp/localhost:1").store.merge_delay_s


def agent_config(config: FleetConfig, vehicle: str, drive: Path, folder: RunFolder, place: VehicleSite) -> AgentConfig:
    """Return the configuration of one vehicle agent."""
    of_fleet = {
        "features": {"layers": list(config.feature_layers)},
        "feature_layer": list(config.feature_layer),
    }
    own = {
        "vehicle": vehicle,
        "drive": str(drive),
        "work_dir": str(folder.agents / vehicle),
        "connect": [place.connect],
        "ledger_dir": str(folder.ledger),
    }
    return replace(agent_of(merged(of_fleet, config.agent, own), where="fleet: agent"), link=place.link)


@dataclass(slots=True)
class _FleetRun:
    """What the waiting loops of a run look at."""

    config: FleetConfig
    folder: RunFolder
    supervisor: Supervisor
    store: SqlStore
    view: LiveView
    state: FleetState
    stop: threading.Event
    versions_before: int
    versions: Versions
    looked_s: float = 0.0

    def wait_until(self, done: Callable[[], bool], timeout_s: float, complaint: str | None) -> None:
        """Supervise and draw until a condition holds.

        Raises:
            DeployError: the time is over and `complaint` is given.
            KeyboardInterrupt: the run was told to stop.
        """
        deadline_s = time.monotonic() + timeout_s
        while not done():
            if self.stop.wait(POLL_S):
                raise KeyboardInterrupt
            if time.monotonic() > deadline_s:
                if complaint is None:
                    return
                raise DeployError(f"{complaint} within {timeout_s:.0f} s: read the logs in {self.folder.logs}")
            self.supervisor.poll()
            self._observe()

    def watcher_ready(self) -> bool:
        """Tell whether the watcher has opened its file, so that no update can precede it."""
        return self.folder.updates.exists()

    def settled(self) -> bool:
        """Tell whether no tile waits for a merge."""
        return "waiting" not in self.store.upload_counts().by_state and self.store.dirty_count() == 0

    def watcher_caught_up(self) -> bool:
        """Tell whether the watcher has seen every published version."""
        self._observe()
        return self.state.updates >= self.state.published

    def _observe(self) -> None:
        counts = self.store.counts()
        self.state.published, self.state.reports = counts.versions - self.versions_before, counts.reports
        self.state.waiting = counts.dirty
        self.state.updates = count_lines(self.folder.updates)
        if time.monotonic() - self.looked_s >= LOOK_S:
            self._observe_ways()
        self.view.refresh()

    def _observe_ways(self) -> None:
        self.looked_s = time.monotonic()
        found = {vehicle: map_use(way, self.versions) for vehicle, way in read_ways(self.folder).items()}
        self.state.maps = {vehicle: use for vehicle, use in found.items() if use is not None}


def count_lines(path: Path) -> int:
    """Return the number of complete lines of a file, 0 where there is none."""
    return path.read_bytes().count(b"\n") if path.exists() else 0
