"""The roles of the processes of a fleet run: module-level functions, so that a fork server can call them."""

import threading
from collections.abc import Sequence
from pathlib import Path

from gnd.cloud_merger.merger import ShardConfig, run_shard
from gnd.deploy.processes import ProcessSpec
from gnd.deploy.watch import record_updates
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.identity.following import follow_revoked
from gnd.fleet_bus.router import run_router, wait_for_stop
from gnd.gnd_map.region import Region
from gnd.tile_store.location import StoreLocation, open_store
from gnd.tile_store.server import TileServer
from gnd.vehicle_agent.agent import AgentConfig, run_agent


def of_cloud(
    listen: str, connect: str, path: StoreLocation, shards: Sequence[ShardConfig], namespace: str | None = None
) -> list[ProcessSpec]:
    """The processes of a cloud in the order of their start: router, tile server, and a shard for each configuration.

    Args:
        listen: endpoint that the router opens.
        connect: the same as the other processes reach it.
        path: of the store.
        shards: their processes are merger-0, merger-1 ...
        namespace: of network, that all of them enter; None stays in the launcher's.
    """
    return [
        ProcessSpec("router", router, (listen,), namespace=namespace),
        ProcessSpec("store", store, (path, connect), namespace=namespace),
        *(ProcessSpec(f"merger-{n}", merger, (shard,), namespace=namespace) for n, shard in enumerate(shards)),
    ]


def router(listen: str, *, stop: threading.Event) -> None:
    """Run the Zenoh router."""
    run_router((listen,), stop=stop)


def store(path: StoreLocation, connect: str, *, stop: threading.Event) -> None:
    """Serve tiles and catalogs from the store."""
    with (
        open_store(path, create=False) as opened,
        open_bus(BusConfig(connect=(connect,), patient=True), name="store") as bus,
        TileServer(opened, bus),
    ):
        follow_revoked(bus)
        wait_for_stop(stop)


def merger(config: ShardConfig, *, stop: threading.Event) -> None:
    """Run one merger shard."""
    run_shard(config, stop)


def agent(config: AgentConfig, *, stop: threading.Event) -> None:
    """Drive one vehicle to the end of its recording and upload what it found."""
    run_agent(config, stop)


def watcher(connect: str, path: Path, layers: tuple[str, ...], *, stop: threading.Event) -> None:
    """Record every tile update of the world, in these layers, as a subscriber would."""
    with open_bus(BusConfig(connect=(connect,)), name="watcher") as bus:
        record_updates(bus, Region(prefix=""), path, stop, layers)
