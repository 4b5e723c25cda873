"""A store with very many tiles: one tile, a region of 1,024, the catalog of a district, a vehicle's question.

    python -m studies many-tiles --store many.sqlite --tiles 1000000
    python -m studies many-tiles --store postgresql://…/empty_database --tiles 1000000

The store is filled where it holds fewer tiles (small ones of 20 Gaussians; some 0.3 ms of CPU each), and kept. Tiles
and districts are drawn from all of it; nothing is asked twice. What is measured are the tile server's own handlers,
without the bus: by the clock, as must and aim are, and CPU of this process and of a database server of this machine.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.deploy.load.cpu import cpu_s, server_of
from gnd.deploy.ports import claim_port
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.fleet_bus.serving import Answer, Request
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import batch_key, catalog_key, tiles_key
from gnd.schemas.tiles import TileRequest
from gnd.schemas.tiles_batch import TilesRequest, digest_of
from gnd.tile_store.location import StoreLocation, file_of, open_store
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqlStore
from studies.frame.measure import Figure
from studies.frame.options import check, option

LAYER: Final = "ndt"
A_DISTRICT: Final = 1024
FIRST: Final = TileId(497353963154 // A_DISTRICT * A_DISTRICT)
GAUSSIANS: Final = 20
AT_ONCE: Final = 4096
GETS: Final = 3000
DISTRICTS: Final = 100
QUESTIONS: Final = 1000
HELD: Final = 8
"""Tiles of a question whether the map still holds."""


@dataclass(frozen=True, slots=True)
class ManyTilesOptions:
    """Which store, and how many tiles."""

    store: str = option("", "A file, or an empty PostgreSQL database, which is kept; none: a file for the time being.")
    tiles: int = option(20_000, "How many it is to hold.", span=(A_DISTRICT, 100_000_000))
    seed: int = option(1, "Of the tiles and districts that are asked for.")

    def __post_init__(self) -> None:
        check(self)


OPTIONS: Final = ManyTilesOptions


def run(chosen: ManyTilesOptions | None = None) -> list[Figure]:
    """Fill the store and measure."""
    options = chosen or OPTIONS()
    connect = f"tcp/127.0.0.1:{claim_port(0)}"
    with ExitStack() as stack:
        told = options.store or str(Path(stack.enter_context(tempfile.TemporaryDirectory())) / "store.sqlite")
        place = file_of(told) or told
        store = stack.enter_context(open_store(place))
        found = list(_filled(store, options.tiles))
        stack.enter_context(open_router((connect,)))
        bus = stack.enter_context(open_bus(BusConfig(connect=(connect,)), name="many-tiles"))
        return [*found, *_sizes(store, place, options.tiles), *_asked(TileServer(store, bus), store, place, options)]


def _filled(store: SqlStore, tiles: int) -> Iterator[Figure]:
    there = store.counts().tiles
    began_s = time.process_time()
    for first in range(there, tiles, AT_ONCE):
        store.put_tiles(_tile(n) for n in range(first, min(tiles, first + AT_ONCE)))
    if there < tiles:
        yield Figure(
            "CPU to make a tile", 1e3 * (time.process_time() - began_s) / (tiles - there), "ms", "this process"
        )


def _tile(number: int) -> Tile:
    ids, many = np.arange(GAUSSIANS, dtype=np.int32), np.full(GAUSSIANS, 30, np.int32)
    mean_m = np.zeros((GAUSSIANS, 3), np.float32)
    mean_m[:, 2] = 0.001 * (number % 200)
    cov_m2 = np.tile(np.array([0.01, 0, 0, 0.01, 0, 0.01], np.float32), (GAUSSIANS, 1))
    return Tile(TileId(FIRST.morton + number), 0, Gaussians(ids, many, many, mean_m, cov_m2))


def _sizes(store: SqlStore, place: StoreLocation, tiles: int) -> list[Figure]:
    file = file_of(place)
    if file is not None:
        size = sum(Path(f"{file}{end}").stat().st_size for end in ("", "-wal") if Path(f"{file}{end}").exists())
    else:
        import psycopg

        with psycopg.connect(str(place)) as connection:
            row = connection.execute("SELECT pg_database_size(current_database())").fetchone()
            size = 0 if row is None else int(row[0])
    stored = store.get(LAYER, FIRST)
    body = 0 if stored is None else len(stored.body)
    return [
        Figure("on the disk", size / tiles, "B/tile", f"{tiles} tiles with {body} B of body each, indexes included"),
    ]


def _asked(server: TileServer, store: SqlStore, place: StoreLocation, options: ManyTilesOptions) -> list[Figure]:
    rng = np.random.default_rng(options.seed)
    whole = options.tiles // A_DISTRICT
    tiles = [TileId(FIRST.morton + int(n)) for n in rng.choice(options.tiles, min(GETS, options.tiles), replace=False)]
    others = [TileId(FIRST.morton + A_DISTRICT * int(n)).district for n in rng.permutation(whole)]
    some, rest = others[:DISTRICTS], others[DISTRICTS : 2 * DISTRICTS] or others[:DISTRICTS]
    questions = [_question(store, tile) for tile in tiles[:QUESTIONS]]
    pid = server_of(place)
    regions = [Request(tiles_key(LAYER, one.path), TileRequest().encode()) for one in some]
    catalogs = [Request(catalog_key(LAYER, one), b"") for one in rest]
    return [
        *_figures("get a tile", lambda tile: store.get(LAYER, tile), tiles, pid),
        *_figures(f"region of {A_DISTRICT} tiles", lambda one: _consumed(server.tiles(one)), regions, pid),
        *_figures("catalog of a district", server.catalogs, catalogs, pid),
        *_figures(f"question about {HELD} tiles that are held", server.batch, questions, pid),
    ]


def _question(store: SqlStore, tile: TileId) -> Request:
    """Whether the tiles around this one are as they are held."""
    index = min(tile.morton % A_DISTRICT, A_DISTRICT - HELD)
    first = tile.morton // A_DISTRICT * A_DISTRICT + index
    held = [store.get(LAYER, TileId(first + n)) for n in range(HELD)]
    there = [(index + n, one) for n, one in enumerate(held) if one is not None]
    wanted = tuple((n, one.version) for n, one in there)
    asked = TilesRequest(wanted, digest_of([one.sha for _, one in there]))
    return Request(batch_key(LAYER, tile.district), asked.encode())


def _consumed(answer: Answer) -> int:
    return sum(1 for _ in answer)


def _figures(what: str, work: Callable[[Any], object], things: Sequence[Any], server: int | None) -> list[Figure]:
    took_s, before_s = [], _cpu_s(server)
    for one in things:
        began_s = time.perf_counter()
        work(one)
        took_s.append(time.perf_counter() - began_s)
    spent_s = _cpu_s(server) - before_s
    detail = f"{len(things)} of them, load {os.getloadavg()[0]:.1f}"
    return [
        Figure(f"{what}, p50", 1e3 * float(np.quantile(took_s, 0.5)), "ms", detail),
        Figure(f"{what}, p99", 1e3 * float(np.quantile(took_s, 0.99)), "ms", detail),
        Figure(f"{what}, CPU", 1e3 * spent_s / len(things), "ms", "this process and the database server"),
    ]


def _cpu_s(server: int | None) -> float:
    return time.process_time() + (0.0 if server is None else cpu_s(server))
