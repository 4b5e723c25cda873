"""Reports acknowledged per second: a real router, real merger shards, reports that are durable before their ack."""

import concurrent.futures
import multiprocessing
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from benchmarks.figures import Figure
from cloud_merger.merger import ShardConfig, run_shard
from fleet_bus.bus import Bus, open_bus
from fleet_bus.config import BusConfig
from fleet_bus.router import open_router
from gnd_map.gaussian import Gaussians
from gnd_map.tile import Tile
from gnd_map.tile_id import TileId
from schemas.changes import ChangeAck, ChangeReport, TileChange
from schemas.keys import change_key
from schemas.report_id import deterministic_report_id
from tile_store.sqlite_store import SqliteStore

COMMAND = "python -m benchmarks ingest"
TILE = TileId(497353963154)
VOXELS = 2_000
CHANGED = 40
CLIENTS = 4
IN_FLIGHT = 16
REPORTS = 2_000
T0_MS = 1_700_000_000_000


def run() -> list[Figure]:
    """Measure reports acknowledged per second with one and with two shards."""
    return [_measure(shards) for shards in (1, 2)]


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
        report_id=deterministic_report_id(T0_MS + number, "benchmark"),
        vehicle=f"bench-{number % 100}",
        sensor_model="VLP-16",
        software="benchmark",
        district=TILE.district,
        first_ns=T0_MS * 1_000_000,
        last_ns=T0_MS * 1_000_000 + 1,
        tiles=(change,),
    )


def _measure(shards: int) -> Figure:
    with tempfile.TemporaryDirectory() as folder, _cloud(Path(folder), shards) as (connect, base):
        payloads = [change_report(number, base).encode() for number in range(REPORTS)]
        start_s = time.perf_counter()
        acknowledged = _send_all(connect, payloads)
        rate = acknowledged / (time.perf_counter() - start_s)
    detail = f"{acknowledged} of {REPORTS} acked, {len(payloads[0])} B each, {CLIENTS} clients x {IN_FLIGHT} in flight"
    return Figure(f"reports acknowledged, {shards} shard{'s' * (shards > 1)}", rate, "1/s", detail)


def _send_all(connect: str, payloads: list[bytes]) -> int:
    key = change_key("ndt", TILE.district)

    def send(bus: Bus, payload: bytes) -> bool:
        return ChangeAck.decode(bus.request(key, payload, kind="change")).status == "stored"

    buses = [open_bus(BusConfig(connect=(connect,)), name=f"client-{n}") for n in range(CLIENTS)]
    with concurrent.futures.ThreadPoolExecutor(CLIENTS * IN_FLIGHT) as pool:
        results = list(pool.map(send, (buses[n % CLIENTS] for n in range(len(payloads))), payloads))
    for bus in buses:
        bus.close()
    return sum(results)


@contextmanager
def _cloud(folder: Path, shards: int) -> Iterator[tuple[str, Tile]]:
    connect, base = f"tcp/127.0.0.1:{_free_port()}", base_tile()
    with SqliteStore(folder / "store.sqlite") as store:
        store.put_tiles([base])
    context = multiprocessing.get_context("spawn")
    with open_router((connect,)):
        processes = [
            context.Process(target=_shard, args=(ShardConfig(f"shard-{n}", folder / "store.sqlite", (connect,)),))
            for n in range(shards)
        ]
        for process in processes:
            process.start()
        _await_shards(connect, base)
        try:
            yield connect, base
        finally:
            for process in processes:
                process.terminate()
                process.join()


def _shard(config: ShardConfig) -> None:
    run_shard(config, threading.Event())


def _await_shards(connect: str, base: Tile) -> None:
    with open_bus(BusConfig(connect=(connect,)), name="probe") as bus:
        payload = change_report(REPORTS + 1, base).encode()
        bus.request(change_key("ndt", TILE.district), payload, kind="change", timeout_s=60.0)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
