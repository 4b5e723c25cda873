"""What a report costs a store in a file and a store in PostgreSQL, in turns: seconds, and CPU of both sides.

    python -m studies.scale.room --with PID -- python -m studies.stores_study postgresql://…/empty_database --server PID

CPU is that of this process and of the server (PID: its first process, on this machine). Without a room, on a busy
machine, both are dearer than they are, and seconds measure who else waits.
"""

import json
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import click
import numpy as np

from gnd.cloud_merger.work import SETTLED_TOGETHER
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store.location import open_store
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.uploads import Settled, Upload
from gnd.tile_store.values import Basis, Publication, ReportRow, StoreConfig

THREADS = 32
UPLOADS = 1000
SETTLED = 90
TILES_OF_REPORT = 8
READ = 3000
PUBLISHED = 160
BODY_BYTES = 865
"""Of a real short report, as `python -m studies ingest` sends them."""
FIRST = TileId(497353963154)
AT_ONCE = StoreConfig(merge_delay_s=0.0)
"""Tiles can be claimed when their reports are journaled."""


@click.command()
@click.argument("database")
@click.option("--server", required=True, type=int, help="First process of the server.")
@click.option("--rounds", default=5, show_default=True, type=click.IntRange(1))
def main(database: str, server: int, rounds: int) -> None:
    """Measure both in turns; DATABASE gets a store and keeps what is written."""
    found: dict[str, dict[str, list[Cost]]] = {}
    with (
        tempfile.TemporaryDirectory() as folder,
        open_store(Path(folder) / "store.sqlite", AT_ONCE) as file,
        open_store(database, AT_ONCE) as there,
    ):
        for number in range(-1, rounds):  # the first warms both up
            for name, store in (("sqlite", file), ("postgresql", there))[:: 1 if number % 2 else -1]:
                for what, cost in _round(store, number + 1, server).items():
                    if number >= 0:
                        found.setdefault(what, {}).setdefault(name, []).append(cost)
    for what, both in found.items():
        pairs = list(zip(both["sqlite"], both["postgresql"], strict=True))
        wall = sorted(file.wall_s / there.wall_s for file, there in pairs)
        cpu = sorted(file.cpu_s / there.cpu_s for file, there in pairs)
        told: dict[str, Any] = {
            f"{name} ms CPU": round(1e3 * median(cost.cpu_s for cost in costs), 3) for name, costs in both.items()
        }
        told |= {"by CPU, worst to best": _ends(cpu), "by seconds, worst to best": _ends(wall)}
        click.echo(json.dumps({"what": what} | told))


@dataclass(frozen=True, slots=True)
class Cost:
    """Of one thing: seconds, and CPU seconds of this process and of the server."""

    wall_s: float
    cpu_s: float


def _ends(ratios: Sequence[float]) -> list[float]:
    return [round(ratios[0], 2), round(median(ratios), 2), round(ratios[-1], 2)]


def _cpu_s(server: int) -> float:
    """CPU of this process and of the server's processes, s, those that have ended left out."""
    ticks = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = stat.read_text().rpartition(")")[2].split()
            if int(fields[1]) == server or stat.parent.name == str(server):
                ticks += int(fields[11]) + int(fields[12])
    return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")


def _round(store: SqlStore, number: int, server: int) -> dict[str, Cost]:
    rng = np.random.default_rng(number)
    names = [deterministic_report_id(1_700_000_000_000 + n, f"round-{number}") for n in range(UPLOADS)]
    vehicles = [f"vehicle-{n % 100}" for n in range(UPLOADS)]
    uploads = [
        Upload("gnd/v1/change/ndt/x", rng.bytes(BODY_BYTES), name, vehicle, "packed", 1)
        for name, vehicle in zip(names, vehicles, strict=True)
    ]
    stored = _cost(server, lambda one: store.put_upload(one, "study"), uploads)
    claims = [claim for _ in range(3) for claim in store.claim_uploads("study", SETTLED // 3, 600.0)]
    settled = [Settled(claim, "released", _rows(claim.upload, rng)) for claim in claims]
    journaled = _cost(server, store.settle_upload, settled, threads=2)
    for claim in store.claim_uploads("study", UPLOADS, 600.0):
        store.settle_upload(Settled(claim, "released"))
    tiles = [TileId(FIRST.morton + n) for n in range(64)]
    store.put_tiles([_tile(tile) for tile in tiles])
    read = _cost(server, lambda n: store.get("ndt", tiles[n % 64]), range(READ), threads=4)
    groups = _publications(store, number)
    published = _cost(server, store.publish, groups, threads=1)
    return {
        "uploads acknowledged": stored,
        "reports journaled": journaled,
        "tiles read": read,
        f"{SETTLED_TOGETHER} tiles published together": published,
    }


def _publications(store: SqlStore, number: int) -> list[list[Publication]]:
    """What a worker publishes at once, of the tiles about which reports were journaled."""
    works = [store.load(claim) for claim in store.claim("study", PUBLISHED, 600.0)]
    ready = [
        Publication(
            work.claim,
            work.base_version,
            _tile(work.claim.tile, 0.001 * (number + 1)),
            report_ids=tuple(row.report_id for row in work.reports),
            basis=Basis(work.journal.window, work.journal.seq),
        )
        for work in works
    ]
    return [ready[n : n + SETTLED_TOGETHER] for n in range(0, len(ready), SETTLED_TOGETHER)]


def _rows(upload: Upload, rng: np.random.Generator) -> tuple[ReportRow, ...]:
    first = FIRST.morton + 8 * int(rng.integers(50))
    return tuple(
        ReportRow(upload.report_id, "ndt", TileId(first + n), upload.vehicle, 1, rng.bytes(300))
        for n in range(TILES_OF_REPORT)
    )


def _tile(tile: TileId, height_m: float = 0.0) -> Tile:
    n = 400
    ids, many = np.arange(n, dtype=np.int32), np.full(n, 30, np.int32)
    mean_m, cov_m2 = (
        np.full((n, 3), height_m, np.float32),
        np.tile(np.array([0.01, 0, 0, 0.01, 0, 0.01], np.float32), (n, 1)),
    )
    return Tile(tile, 0, Gaussians(ids, many, many, mean_m, cov_m2))


def _cost(server: int, work: Callable[[Any], object], things: Sequence[Any], threads: int = THREADS) -> Cost:
    began_s, cpu_s = time.perf_counter(), _cpu_s(server)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, things))
    return Cost((time.perf_counter() - began_s) / len(things), (_cpu_s(server) - cpu_s) / len(things))


if __name__ == "__main__":
    main()
