"""The processes of the laboratory: each part on its host, vehicles and who asks for tiles behind links of their own."""

import json
import random
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TextIO

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.confirmation import ConfirmationParameters
from gnd.deploy import roles
from gnd.deploy.chaos import clients
from gnd.deploy.chaos.street import LAYER, read_street
from gnd.deploy.lab.groups import Group, LabLink, unpaced
from gnd.deploy.lab.hosts.bucket import bucket_server
from gnd.deploy.lab.hosts.database import DatabaseSide, database
from gnd.deploy.lab.hosts.plan import BUCKET, DATABASES, HUB, WITNESS, WITNESS_PORT, HostsPlan, client_names
from gnd.deploy.lab.hosts.witness import witness
from gnd.deploy.lab.lab import Lab
from gnd.deploy.processes import ProcessSpec
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusClosed, BusError
from gnd.fleet_bus.identity.following import follow_revoked
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.router import run_router, wait_for_stop
from gnd.schemas.keys import tile_key, update_keys
from gnd.tile_store.location import StoreLocation, open_store
from gnd.tile_store.server import TileServer

BUS_LEASE_MS: Final = 2_000
"""A part whose host falls silent is given up by its router after so long."""
LEASE_S: Final = 2.0
SHARD_POLL_S: Final = 0.02
REPORTS_OF_TRIP: Final = 60
"""Each outbox is looked at five times a second as long as one of its reports is not released."""
ONE_TRIP: Final = 1_000_000
"""With certificates a vehicle has one identity, and so makes one trip."""
ASK_EVERY_S: Final = 0.1
ASK_S: Final = 20.0
HEARD_SUFFIX: Final = ".heard"
ShardOf = Callable[[str, str, tuple[str, ...]], ShardConfig]
"""The configuration of a shard of that name, with the store at a URL, and these routers."""


@dataclass(frozen=True, slots=True)
class LabFolders:
    """Where the laboratory writes.

    Attributes:
        root: folder of the run.
        data: of the databases, which their user can reach.
    """

    root: Path
    data: Path

    @property
    def vehicles(self) -> Path:
        """Outboxes, and who has said that it is done."""
        return self.root / "vehicles"

    @property
    def times(self) -> Path:
        """When each client was served."""
        return self.root / "times"

    @property
    def logs(self) -> Path:
        """One log a process."""
        return self.root / "logs"

    @property
    def identities(self) -> Path:
        """Of each process, where there are certificates."""
        return self.root / "identities"

    @property
    def relays(self) -> Path:
        """Accounts of the links."""
        return self.root / "relays"

    def make(self) -> None:
        """Make them all."""
        for folder in (self.vehicles, self.times, self.logs, self.relays):
            folder.mkdir(parents=True)


def link_groups(plan: HostsPlan, profile: LinkProfile) -> tuple[Group, ...]:
    """A namespace for each vehicle of each region, and for one client a region that asks for tiles."""
    names = [name for region in range(plan.size.regions) for name in client_names(plan, region)]
    return tuple(Group(name, profile, number, 1) for number, name in enumerate(names))


def links_of_region(plan: HostsPlan, lab: Lab, region: int) -> tuple[LabLink, ...]:
    """The links of the clients of a region."""
    names = client_names(plan, region)
    return tuple(link for group in lab.groups if group.name in names for link in lab.links_of(group))


def database_processes(plan: HostsPlan, folders: LabFolders) -> list[ProcessSpec]:
    """The witness and the two database hosts, in the order of their start."""
    at = (plan.host_of(WITNESS).address, WITNESS_PORT) if plan.has_witness else None
    hosts = [plan.host_of(name) for name in DATABASES]
    sides = [
        DatabaseSide(name, own.address, other.address, folders.data / name, at)
        for name, own, other in zip(DATABASES, hosts, hosts[::-1], strict=True)
    ]
    specs = [
        ProcessSpec(side.name, database, (side,), namespace=host.namespace)
        for side, host in zip(sides, hosts, strict=True)
    ]
    if at is None:
        return specs
    args = (at, folders.root / "witness.json", DATABASES[0])
    return [ProcessSpec(WITNESS, witness, args, namespace=plan.host_of(WITNESS).namespace), *specs]


def bucket_processes(plan: HostsPlan, folders: LabFolders) -> list[ProcessSpec]:
    """The S3 server, if there is one."""
    if not plan.size.has_bucket:
        return []
    host = plan.host_of(BUCKET)
    return [ProcessSpec(BUCKET, bucket_server, (host.address, folders.data / BUCKET), namespace=host.namespace)]


def cloud_processes(plan: HostsPlan, shard_of: ShardOf) -> list[ProcessSpec]:
    """The hub, and each region's router, tile server and shard."""
    specs = [ProcessSpec(HUB, lab_router, (plan.hub, ()), namespace=plan.host_of(HUB).namespace)]
    for region in range(plan.size.regions):
        routers = plan.routers(region)
        at = {part: plan.host_of(f"{part}-{region}") for part in ("router", "tiles", "shard")}
        shard = shard_of(f"shard-{region}", plan.database_url, routers)
        specs += [
            ProcessSpec(
                f"router-{region}", lab_router, (plan.router(region), (plan.hub,)), namespace=at["router"].namespace
            ),
            ProcessSpec(f"tiles-{region}", lab_tiles, (plan.database_url, routers), namespace=at["tiles"].namespace),
            ProcessSpec(f"shard-{region}", roles.merger, (shard,), namespace=at["shard"].namespace),
        ]
    return specs


def shard_config(name: str, url: str, routers: tuple[str, ...]) -> ShardConfig:
    """Of one shard."""
    return ShardConfig(
        name,
        url,
        routers,
        bus_lease_ms=BUS_LEASE_MS,
        confirmation=ConfirmationParameters(copies=False),  # all reports are parts of one drive
        lease_s=LEASE_S,
        poll_s=SHARD_POLL_S,
    )


def with_identities(plan: HostsPlan, folders: LabFolders, specs: Iterable[ProcessSpec]) -> list[ProcessSpec]:
    """The same processes, each with its identity where there are certificates; see `identities.members_of`."""
    return [replace(spec, identity=identity_of(plan, folders, spec.name)) for spec in specs]


def identity_of(plan: HostsPlan, folders: LabFolders, process: str) -> Path | None:
    """Its identity folder; None: there are no certificates."""
    return folders.identities / process if plan.size.is_secure else None


def client_processes(plan: HostsPlan, lab: Lab, folders: LabFolders, seed: int, every_s: float) -> list[ProcessSpec]:
    """Vehicles and askers of all regions."""
    specs = []
    for region in range(plan.size.regions):
        routers = plan.routers(region)
        for name, link in zip(client_names(plan, region), links_of_region(plan, lab, region), strict=True):
            session, times = unpaced(link.profile), folders.times / f"{name}.times"
            if name.startswith("asker"):
                heard = folders.times / f"{name}{HEARD_SUFFIX}"
                spec = ProcessSpec(
                    name, asker, (routers, session, name, times, heard), namespace=link.vehicle_namespace
                )
            else:
                task = clients.ChaosVehicleTask(
                    routers,
                    name,
                    folders.vehicles,
                    seed,
                    every_s,
                    session,
                    times,
                    ONE_TRIP if plan.size.is_secure else REPORTS_OF_TRIP,
                )
                spec = ProcessSpec(name, clients.vehicle, (task,), namespace=link.vehicle_namespace)
            specs.append(spec)
    return specs


def lab_router(listen: str, connect: tuple[str, ...], *, stop: threading.Event) -> None:
    """Run a router that is linked with others."""
    run_router((listen,), stop=stop, connect=connect)


def lab_tiles(location: StoreLocation, connect: tuple[str, ...], *, stop: threading.Event) -> None:
    """Serve tiles, as `roles.store`, at several routers, and given up soon where its host falls silent."""
    config = BusConfig(connect=connect, patient=True, lease_ms=BUS_LEASE_MS)
    with open_store(location, create=False) as opened, open_bus(config, name="tiles") as bus, TileServer(opened, bus):
        follow_revoked(bus)
        wait_for_stop(stop)


def asker(
    connect: tuple[str, ...], link: LinkProfile, name: str, times: Path, heard: Path, *, stop: threading.Event
) -> None:
    """Ask for one tile after the other, and note when each came, and when a new version was heard of."""
    street, rng = read_street(), random.Random(name)
    config = BusConfig(connect=connect, link=link, patient=True)
    with (
        times.open("a", encoding="utf-8") as file,
        heard.open("a", encoding="utf-8") as notices,
        open_bus(config, name=name) as bus,
        bus.subscribe(update_keys(LAYER), lambda _key, _payload: _note(notices)),
    ):
        while not stop.wait(ASK_EVERY_S):
            try:
                bus.request(tile_key(LAYER, rng.choice(street.tiles).tile_id), b"", kind="tile", timeout_s=ASK_S)
            except BusClosed:
                return
            except BusError:  # no answer while something is down: the next one
                continue
            _note(file)


def _note(file: TextIO) -> None:
    file.write(f"{time.monotonic():.4f}\n")
    file.flush()


def read_times(files: Iterable[Path]) -> list[float]:
    """When clients were served, s of the machine's monotonic clock, in order; a kill may have cut a line off."""
    found = [float(line) for file in files if file.exists() for line in file.read_text().splitlines() if "." in line]
    return sorted(found)


def state_of_witness(folders: LabFolders) -> dict[str, object] | None:
    """What the witness remembers, None before it has been asked for something."""
    file = folders.root / "witness.json"
    return dict(json.loads(file.read_text())) if file.exists() else None
