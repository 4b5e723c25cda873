"""The laboratory while it runs: who starts again what dies, and leaves alone what is lost."""

import logging
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import psutil
import psycopg

from gnd.deploy.chaos.street import LAYER
from gnd.deploy.errors import LabError
from gnd.deploy.fleet_identities import FLEET
from gnd.deploy.lab.groups import Group
from gnd.deploy.lab.hosts.bucket import PLACE, make_bucket
from gnd.deploy.lab.hosts.cloud import (
    LabFolders,
    ShardOf,
    bucket_processes,
    cloud_processes,
    database_processes,
    identity_of,
    shard_config,
    state_of_witness,
    with_identities,
)
from gnd.deploy.lab.hosts.data import data_folder
from gnd.deploy.lab.hosts.network import build_network
from gnd.deploy.lab.hosts.plan import DATABASE_PORT, DATABASES, HostsPlan, client_names
from gnd.deploy.lab.hosts.postgres import DATABASE, OWNER
from gnd.deploy.lab.hosts.wrong_clock import HostClocks
from gnd.deploy.lab.lab import Lab, open_lab
from gnd.deploy.lab.run import relay_processes
from gnd.deploy.processes import ProcessSpec, Supervisor
from gnd.deploy.repeating import repeated
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import PLAIN_VARIABLE, BusConfig
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import tile_key
from gnd.tile_store.bodies import move_out
from gnd.tile_store.location import open_store
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqlStore

READY_S: Final = 300.0
POLL_S: Final = 0.1
_LOOK_S: Final = 0.1
_LOG: Final = logging.getLogger(__name__)


@dataclass(slots=True)
class HostsCloud:
    """A running laboratory.

    Attributes:
        plan: which part is on which host.
        lab: namespaces and links.
        folders: where it writes.
        supervisor: starts again what dies.
        clocks: of the hosts; None: all are right.
        died: why the supervisor has given up, if it has.
    """

    plan: HostsPlan
    lab: Lab
    folders: LabFolders
    supervisor: Supervisor
    clocks: HostClocks | None = None
    died: list[str] = field(default_factory=list)
    _specs: dict[str, ProcessSpec] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def host_clocks(self) -> HostClocks:
        """The clocks of the hosts.

        Raises:
            LabError: none may be wrong in this run.
        """
        if self.clocks is None:
            raise LabError("the clocks of this laboratory cannot be set")
        return self.clocks

    def start(self, specs: Iterable[ProcessSpec]) -> None:
        """Start parts; they are started again when they die."""
        with self._lock:
            for spec in specs:
                self._specs[spec.name] = self._by_its_clock(spec)
                self.supervisor.start(self._specs[spec.name])

    def _by_its_clock(self, spec: ProcessSpec) -> ProcessSpec:
        """A part by the clock of its host, a client by one of its own."""
        own = [host.name for host in self.plan.hosts if spec.name in host.parts]
        own += [spec.name for region in range(self.plan.size.regions) if spec.name in client_names(self.plan, region)]
        return replace(spec, environment=self.clocks.environment(own[0])) if self.clocks and own else spec

    def lose(self, parts: Iterable[str], first: Callable[[], None] = lambda: None) -> None:
        """Kill parts with all that they have started; they stay away. `first` comes before, and nothing between."""
        with self._lock:
            first()
            pids = self.supervisor.pids()
            names = tuple(part for part in parts if part in pids)
            for name in names:
                children = _children(pids[name])
                self.supervisor.kill(name)
                for child in children:
                    with suppress(psutil.NoSuchProcess):
                        child.kill()
            if names:
                self.supervisor.stop(names)

    def give_back(self, parts: Iterable[str]) -> None:
        """Start parts again that were lost."""
        with self._lock:
            for part in parts:
                if part not in self.supervisor.pids():
                    self.supervisor.start(self._specs[part])

    def stop(self, parts: Iterable[str]) -> None:
        """End parts in order."""
        with self._lock:
            self.supervisor.stop(tuple(parts))

    def poll(self) -> None:
        """Start again what has died."""
        with self._lock:
            try:
                self.supervisor.poll()
            except GndError as error:
                if str(error) not in self.died:
                    self.died.append(str(error))


def _children(pid: int) -> list[psutil.Process]:
    try:
        found: list[psutil.Process] = psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []
    return found


@contextmanager
def opened_hosts(plan: HostsPlan, groups: tuple[Group, ...], folder: Path) -> Iterator[tuple[Lab, LabFolders]]:
    """Make namespaces, links, the network between hosts, and folders; all but `folder` is removed with the block.

    Args:
        plan: which part is on which host.
        groups: of clients.
        folder: of the run.

    Raises:
        LabError: the name is taken, or the kernel refuses.
    """
    name = plan.hosts[0].lab
    with open_lab(name, groups) as lab, data_folder(name) as data:
        build_network(plan, lab.links, lab.cloud_namespace)
        folders = LabFolders(folder, data)
        folders.make()
        yield lab, folders


@contextmanager
def running_hosts(
    plan: HostsPlan,
    lab: Lab,
    folders: LabFolders,
    put_map: Callable[[SqlStore], TileId],
    shard: ShardOf = shard_config,
    *,
    has_clocks: bool = False,
) -> Iterator[HostsCloud]:
    """Start database, routers, tile servers and shards, and end all with the block, clients too that are started in it.

    The calling thread must be in the middle's namespace; with certificates these must have been made.

    Args:
        plan: which part is on which host.
        lab: its namespaces and links are there.
        folders: made.
        put_map: writes the map that is there first, and gives one of its tiles.
        shard: the configuration of a shard.
        has_clocks: whether the hosts' clocks may be set wrong, within `clocks_may_be_wrong`.

    Raises:
        LabError: the database does not become ready.
        BusError: no tile server answers.
    """
    with ExitStack() as stack:
        stack.enter_context(nullcontext() if plan.size.is_secure else _plain())
        supervisor = Supervisor(folders.logs, folders.root / "pids.json")
        stack.callback(supervisor.stop)
        clocks = HostClocks(folders.data / "clocks") if has_clocks else None
        cloud = HostsCloud(plan, lab, folders, supervisor, clocks)
        cloud.start(relay_processes(lab, folders.relays))
        cloud.start([*database_processes(plan, folders), *bucket_processes(plan, folders)])
        _make_database(plan)
        own = identity_of(plan, folders, FLEET)
        with open_store(plan.database_url, signing=None if own is None else Signing(own)) as store:
            tile = put_map(store)
            if plan.size.has_bucket:
                make_bucket()
                move_out(store, PLACE)
        _until(lambda: _has_standby(cloud), "the standby follows")
        parts = with_identities(plan, folders, cloud_processes(plan, shard))
        stack.callback(cloud.stop, [spec.name for spec in parts])  # before the database, for which shards would wait
        cloud.start(parts)
        with open_bus(BusConfig(connect=(plan.hub,), open_timeout_s=READY_S, identity=own), name="probe") as bus:
            bus.request(tile_key(LAYER, tile), b"", kind="tile", timeout_s=READY_S)
        stack.enter_context(repeated(lambda _n: cloud.poll(), POLL_S, "supervisor"))
        yield cloud


@contextmanager
def _plain() -> Iterator[None]:
    """This process may talk to the hosts without TLS, as theirs do: a lab's namespaces reach nobody else."""
    before = os.environ.get(PLAIN_VARIABLE)
    os.environ[PLAIN_VARIABLE] = "1"
    try:
        yield
    finally:
        os.environ.pop(PLAIN_VARIABLE)
        if before is not None:
            os.environ[PLAIN_VARIABLE] = before


def _make_database(plan: HostsPlan) -> None:
    address = plan.host_of(DATABASES[0]).address

    def made() -> bool:
        try:
            with psycopg.connect(
                host=address, port=DATABASE_PORT, user=OWNER, dbname="postgres", connect_timeout=2, autocommit=True
            ) as owner:
                owner.execute(f"CREATE DATABASE {DATABASE}")
        except psycopg.errors.DuplicateDatabase:
            return True
        except psycopg.Error:
            return False
        return True

    _until(made, "the database answers")


def _has_standby(cloud: HostsCloud) -> bool:
    if cloud.plan.has_witness:
        state = state_of_witness(cloud.folders)
        return state is not None and not state["is_alone"]
    with psycopg.connect(cloud.plan.database_url) as connection:
        row = connection.execute("SELECT count(*) FROM pg_stat_replication WHERE sync_state = 'sync'").fetchone()
    return row is not None and bool(row[0])


def _until(condition: Callable[[], bool], what: str) -> None:
    deadline_s = time.monotonic() + READY_S
    while not condition():
        if time.monotonic() > deadline_s:
            raise LabError(f"not within {READY_S:g} s: {what}")
        time.sleep(_LOOK_S)
