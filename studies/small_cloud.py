"""Router, tile server and merger shards as `gnd fleet` starts them, with a map that changes: for studies of service.

What its tiles and reports hold no vehicle has measured: here it does not matter.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gnd.cloud_merger.config import ShardConfig
from gnd.deploy import roles
from gnd.deploy.fleet import POLL_S
from gnd.deploy.ports import claim_port
from gnd.deploy.processes import ProcessSpec, Supervisor, start_fork_server
from gnd.deploy.repeating import repeated
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.keys import tile_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store.sqlite_store import SqliteStore

READY_S = 60.0
SHARD_POLL_S = 0.02
TILES = 8
TILE = TileId(497353963154)
VOXELS = 2_000
CHANGED = 40
_T0_MS = 1_700_000_000_000


@dataclass(slots=True)
class SmallCloud:
    """A running cloud of one machine.

    Attributes:
        connect: endpoint of its router.
        supervisor: starts again what dies, from a thread of its own.
        store: open here too, to publish by.
        base: the tiles as they were first.
        folder: of logs and whatever clients write.
        identities: folder of the processes' identities; None: the bus is plain.
        put_s: when each (tile, version) was committed here, by the monotonic clock, s.
    """

    connect: str
    supervisor: Supervisor
    store: SqliteStore
    base: Sequence[Tile]
    folder: Path
    identities: Path | None = None
    put_s: dict[tuple[int, int], float] = field(default_factory=dict)

    def pid(self, name: str) -> int:
        """The process that bears this name now."""
        return self.supervisor.pids()[name]

    def identity_of(self, name: str) -> Path | None:
        """The identity folder of a process or vehicle; None where the bus is plain."""
        return None if self.identities is None else self.identities / name

    def publish(self, number: int) -> None:
        """Commit another version of one of the tiles: half of its voxels have another mean."""
        tile = self.base[number % len(self.base)]
        (result,) = self.store.put_tiles([_changed(tile, number)])
        self.put_s[tile.tile_id.morton, result.version] = time.monotonic()


@contextmanager
def small_cloud(folder: Path, shards: int = 1, identities: Path | None = None) -> Iterator[SmallCloud]:
    """Start a cloud, wait until it answers, end it with the block.

    Args:
        folder: of store and logs.
        shards: merger shards.
        identities: of `make_identities`, for a bus with certificates, rights and seals; None: a plain one.
    """
    start_fork_server()
    connect = f"{'tcp' if identities is None else 'tls'}/127.0.0.1:{claim_port(0)}"
    base = tiles()
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        store = stack.enter_context(SqliteStore(folder / "store.sqlite"))
        store.put_tiles(base)
        supervisor = Supervisor(folder, folder / "pids.json")
        stack.callback(supervisor.stop)
        cloud = SmallCloud(connect, supervisor, store, base, folder, identities)
        for spec in _processes(connect, folder, shards):
            supervisor.start(replace(spec, identity=cloud.identity_of(spec.name)))
        stack.enter_context(_supervised(supervisor))
        own = BusConfig(connect=(connect,), open_timeout_s=READY_S, identity=cloud.identity_of("fleet"))
        with open_bus(own, name="probe") as bus:
            bus.request(tile_key("ndt", base[0].tile_id), b"", kind="tile", timeout_s=READY_S)
        yield cloud


def tiles() -> list[Tile]:
    """Neighbouring tiles of flat Gaussians."""
    first = base_tile()
    ids = [TileId(first.tile_id.morton + n) for n in range(TILES)]
    return [Tile(tile_id, 1, first.gaussians) for tile_id in ids]


def _processes(connect: str, folder: Path, shards: int) -> list[ProcessSpec]:
    store = folder / "store.sqlite"
    configs = [ShardConfig(f"shard-{n}", store, (connect,), poll_s=SHARD_POLL_S) for n in range(shards)]
    return [
        ProcessSpec("router", roles.router, (connect,)),
        ProcessSpec("store", roles.store, (store, connect)),
        *(ProcessSpec(f"merger-{n}", roles.merger, (config,)) for n, config in enumerate(configs)),
    ]


@contextmanager
def _supervised(supervisor: Supervisor) -> Iterator[None]:
    with repeated(lambda _number: supervisor.poll(), POLL_S):
        yield


def _changed(tile: Tile, number: int) -> Tile:
    g = tile.gaussians
    mean_m = g.mean_m.copy()
    half = mean_m[::2]
    half[:] = np.random.default_rng(number).uniform(-0.1, 0.1, half.shape)
    return Tile(tile.tile_id, 1, Gaussians(g.voxel_id, g.count, g.cells, mean_m, g.cov_m2))


def base_tile(voxels: int = VOXELS) -> Tile:
    """Return a tile of flat Gaussians on the ground floor."""
    voxel_id = np.arange(-voxels // 2, voxels // 2, dtype=np.int32)
    cov = np.tile(np.array([0.08, 0, 0, 0.08, 0, 0.0009], np.float32), (voxels, 1))
    full = np.full(voxels, 200, np.int32), np.full(voxels, 60, np.int32)
    return Tile(TILE, 1, Gaussians(voxel_id, *full, np.zeros((voxels, 3), np.float32), cov))


def change_report(number: int, base: Tile) -> ChangeReport:
    """Return one vehicle's report about one tile: 500 voxels observed, 40 of them changed."""
    observed = base.gaussians.voxel_id[:500]
    changed = base.gaussians.take(np.arange(CHANGED))
    change = TileChange(
        tile=TILE,
        base_version=1,
        base_sha=base.sha,
        observed=observed,
        changed=changed,
        change_class=np.full(CHANGED, 2, np.uint8),
        evidence=np.full((CHANGED, 4), 9, np.int32),
        pose_sigma_m=0.03,
        pose_sigma_rad=0.001,
    )
    return ChangeReport(
        report_id=deterministic_report_id(_T0_MS + number, "benchmark"),
        vehicle=f"bench-{number % 100}",
        sensor_model="VLP-16",
        software="benchmark",
        district=TILE.district,
        first_ns=_T0_MS * 1_000_000,
        last_ns=_T0_MS * 1_000_000 + 1,
        tiles=(change,),
    )
