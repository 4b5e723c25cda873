"""The processes of a chaos run: router, tile server and shards as `gnd fleet` starts them, vehicles and followers."""

import logging
import os
import struct
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.confirmation import ConfirmationParameters
from gnd.deploy import roles
from gnd.deploy.chaos import clients
from gnd.deploy.chaos.street import LAYER, ChaosStreet
from gnd.deploy.chaos.wire import Wires
from gnd.deploy.ports import claim_port
from gnd.deploy.processes import ProcessSpec, Supervisor, start_fork_server
from gnd.deploy.repeating import repeated
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import tile_key
from gnd.tile_store import clocks
from gnd.tile_store.errors import StoreError
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore

SHARDS: Final = 2
VEHICLES: Final = 3
FOLLOWERS: Final = 3
REPORT_EVERY_S: Final = 1.0
POLL_S: Final = 0.1
SHARD_POLL_S: Final = 0.02
LEASE_S: Final = 2.0
"""Short, so that a worker that is stopped for a few seconds finds its tiles in other hands."""
BUS_LEASE_MS: Final = 2_000
BEACON_EVERY_S: Final = 0.05
BEACON_VOXELS: Final = 40
READY_S: Final = 90.0
_LOG: Final = logging.getLogger(__name__)


@dataclass(slots=True)
class ChaosCloud:
    """A running cloud with its clients.

    Attributes:
        folder: of everything that it writes.
        connect: endpoint of the router.
        supervisor: starts again what dies.
        wires: lines of the clients, by their names.
        store: opened here, too: new bases of the beacon are published by it.
        beacon: a tile that no vehicle reports about; it changes all the time, so that there is always a notice to hear.
        died: why the supervisor has given up, if it has.
        beacons: versions of the beacon that were published.
        is_shining: whether there are more to come.
    """

    folder: Path
    connect: str
    supervisor: Supervisor
    wires: Wires
    store: SqlStore
    beacon: Tile
    died: list[str] = field(default_factory=list)
    beacons: int = 0
    is_shining: bool = True

    @property
    def path(self) -> Path:
        """The store."""
        return self.folder / "store.sqlite"

    @property
    def vehicles(self) -> Path:
        """Folder of the outboxes."""
        return self.folder / "vehicles"

    @property
    def receipts(self) -> Path:
        """Folder of what the followers received."""
        return self.folder / "received"

    def names(self, part: str) -> list[str]:
        """The processes of a part, in order; of "worker" the shards whose they are."""
        prefix = "shard" if part == "worker" else part
        return sorted(name for name in self.supervisor.pids() if name.split("-")[0] == prefix)

    def step_clock(self, by_s: float) -> None:
        """Set the cloud's time of day wrong by so much; 0 = right."""
        _write_offset(self.folder / "clock", by_s)

    def shine(self, number: int) -> None:
        """Publish another version of the beacon; a store that is busy is asked again the next time."""
        if not self.is_shining:
            return
        try:
            self.store.put_tiles([_changed(self.beacon, number)])
            self.beacons += 1
        except StoreError as error:
            _LOG.info("no beacon: %s", error)


@contextmanager
def running(folder: Path, street: ChaosStreet, seed: int) -> Iterator[ChaosCloud]:
    """Start a cloud and its clients, wait until it answers, end all with the block.

    Raises:
        BusError: it does not answer.
    """
    (folder / "vehicles").mkdir(parents=True)
    (folder / "received").mkdir()
    (folder / "logs").mkdir()
    port = claim_port(0)
    connect = f"tcp/127.0.0.1:{port}"
    beacon = _beacon(street.tiles[-1].tile_id)
    with ExitStack() as stack:
        stack.enter_context(_one_clock(folder / "clock"))
        start_fork_server()
        store = stack.enter_context(SqliteStore(folder / "store.sqlite"))
        store.put_tiles([*street.tiles, beacon])
        supervisor = Supervisor(folder / "logs", folder / "pids.json")
        stack.callback(supervisor.stop)
        wires = stack.enter_context(Wires(port))
        cloud = ChaosCloud(folder, connect, supervisor, wires, store, beacon)
        for spec in _cloud_processes(cloud):
            supervisor.start(spec)
        with open_bus(BusConfig(connect=(connect,), open_timeout_s=READY_S), name="probe") as bus:
            bus.request(tile_key(LAYER, beacon.tile_id), b"", kind="tile", timeout_s=READY_S)
        for spec in _client_processes(cloud, seed):
            supervisor.start(spec)
        stack.enter_context(repeated(lambda _n: _poll(cloud), POLL_S, "supervisor"))
        stack.enter_context(repeated(cloud.shine, BEACON_EVERY_S, "beacon"))
        yield cloud


def _cloud_processes(cloud: ChaosCloud) -> list[ProcessSpec]:
    path = cloud.path
    configs = [
        ShardConfig(
            f"shard-{n}",
            path,
            (cloud.connect,),
            bus_lease_ms=BUS_LEASE_MS,
            confirmation=ConfirmationParameters(copies=False),  # all reports are parts of one drive
            lease_s=LEASE_S,
            poll_s=SHARD_POLL_S,
        )
        for n in range(SHARDS)
    ]
    return [
        ProcessSpec("router", roles.router, (cloud.connect,)),
        ProcessSpec("store", roles.store, (path, cloud.connect)),
        *(ProcessSpec(config.shard_id, roles.merger, (config,)) for config in configs),
    ]


def _client_processes(cloud: ChaosCloud, seed: int) -> list[ProcessSpec]:
    specs = []
    for n in range(VEHICLES):
        name = f"vehicle-{n}"
        task = clients.ChaosVehicleTask((cloud.wires.open(name),), name, cloud.vehicles, seed, REPORT_EVERY_S)
        specs.append(ProcessSpec(name, clients.vehicle, (task,)))
    for n in range(FOLLOWERS):
        name = f"follower-{n}"
        specs.append(
            ProcessSpec(name, clients.follower, (cloud.wires.open(name), name, cloud.receipts / f"{name}.jsonl"))
        )
    return specs


def _poll(cloud: ChaosCloud) -> None:
    try:
        cloud.supervisor.poll()
    except GndError as error:
        if str(error) not in cloud.died:
            cloud.died.append(str(error))


@contextmanager
def _one_clock(path: Path) -> Iterator[None]:
    """This process, and all that are started while the block runs, have the time of day that the file makes wrong."""
    _write_offset(path, 0.0)
    os.environ[clocks.OFFSET_FILE] = str(path)
    try:
        yield
    finally:
        del os.environ[clocks.OFFSET_FILE]


def _write_offset(path: Path, by_s: float) -> None:
    with path.open("r+b" if path.exists() else "w+b") as file:
        file.write(struct.pack("<q", round(by_s * 1e9)))


def _beacon(beside: TileId) -> Tile:
    """A small tile in the middle of a district that no drive has touched."""
    at = TileId.from_indices(beside.lon_index + 32, beside.lat_index)
    voxel_id = np.arange(BEACON_VOXELS, dtype=np.int32)
    cov_m2 = np.tile(np.array([0.08, 0, 0, 0.08, 0, 0.0009], np.float32), (BEACON_VOXELS, 1))
    count = np.full(BEACON_VOXELS, 60, np.int32)
    return Tile(at, 1, Gaussians(voxel_id, count, count.copy(), np.zeros((BEACON_VOXELS, 3), np.float32), cov_m2))


def _changed(beacon: Tile, number: int) -> Tile:
    g = beacon.gaussians
    mean_m = np.random.default_rng(number).uniform(-0.1, 0.1, g.mean_m.shape).astype(np.float32)
    return Tile(beacon.tile_id, 1, Gaussians(g.voxel_id, g.count, g.cells, mean_m, g.cov_m2))
