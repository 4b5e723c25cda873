"""Values for the tests of the store, and the factories of the stores that the shared suite runs on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import apsw
import numpy as np
import pytest

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store import sql_catalogs as catalogs
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.bodies import move_out, place_of_bodies
from gnd.tile_store.connection import SqlConnection
from gnd.tile_store.location import open_store
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore
from gnd.tile_store.store import Store
from gnd.tile_store.trials import TrialTerms
from gnd.tile_store.values import Basis, Claim, Publication, ReportRow, StoreConfig, TileWork

TILE = TileId(497353963154)
"""The tile of Figure 2; its path is 13033/03021/23031/22102."""
EAST = TileId(497353963155)
FAR = TileId.from_path("03000/00000/00000/00000")
EAGER = StoreConfig(merge_delay_s=0.0)


class Clock:
    """A clock that stands still until it is moved."""

    def __init__(self) -> None:
        self.ns = 1_700_000_000_000_000_000

    def __call__(self) -> int:
        return self.ns

    def advance(self, seconds: float) -> None:
        self.ns += round(seconds * 1e9)


@dataclass(frozen=True)
class SqliteMaker:
    """Opens the same SQLite store again and again, as several processes would."""

    path: Path
    bodies: str | None = None
    """Where bodies lie; None: in the database."""

    @property
    def location(self) -> Path:
        return self.path

    def open(self, config: StoreConfig = EAGER, clock: Clock | None = None, steady: Clock | None = None) -> SqlStore:
        clock = clock or Clock()
        _move_bodies(self.path, self.bodies)
        return SqliteStore(self.path, config, now_ns=clock, steady_ns=steady or clock)

    def sql(self, command: str, *values: Any) -> list[Any]:
        """What no store does."""
        connection = apsw.Connection(str(self.path))
        try:
            return connection.execute(command, values).fetchall()
        finally:
            connection.close()


@dataclass(frozen=True)
class PostgresMaker:
    """Opens the same store in a PostgreSQL database again and again, as several processes would."""

    url: str
    bodies: str | None = None

    @property
    def location(self) -> str:
        return self.url

    def open(self, config: StoreConfig = EAGER, clock: Clock | None = None, steady: Clock | None = None) -> SqlStore:
        from gnd.tile_store.postgres_store import PostgresStore

        clock = clock or Clock()
        _move_bodies(self.url, self.bodies)
        return PostgresStore(self.url, config, now_ns=clock, steady_ns=steady or clock)

    def sql(self, command: str, *values: Any) -> list[Any]:
        """What no store does."""
        import psycopg

        with psycopg.connect(self.url, autocommit=True) as connection:
            done = connection.execute(command.replace("?", "%s"), values)
            return done.fetchall() if done.description else []


Maker = SqliteMaker | PostgresMaker


def _move_bodies(location: Path | str, place: str | None) -> None:
    if place is not None:
        with open_store(location) as store:
            if store.look(place_of_bodies) is None:
                move_out(store, place)


of_a_file = pytest.mark.parametrize("maker", ["sqlite"], indirect=True)
"""A test of what only a store in a file does."""


def tile_of_voxels(tile: TileId, *voxels: int) -> Tile:
    """A tile with one plain Gaussian in each voxel; its content depends on nothing else."""
    ids = np.unique(np.array(voxels, dtype=np.int32))
    n = len(ids)
    mean_m = np.repeat((ids % 97).astype(np.float32)[:, None] / 100, 3, axis=1)
    cov_m2 = np.tile(np.array([0.01, 0, 0, 0.01, 0, 0.01], dtype=np.float32), (n, 1))
    full = np.full(n, 25, dtype=np.int32)
    return Tile(tile, 0, Gaussians(ids, full * 4, full, mean_m, cov_m2))


def report_id(number: int, vehicle: str = "v1") -> str:
    return deterministic_report_id(1_700_000_000_000 + number, vehicle)


def report(
    number: int, tile: TileId = TILE, vehicle: str = "v1", body: bytes = b"body", layer: str = "ndt"
) -> ReportRow:
    return ReportRow(report_id(number, vehicle), layer, tile, vehicle, 1_700_000_000_000_000_000 + number, body)


def only_claim(store: Store, owner: str = "m1", lease_s: float = 10.0) -> Claim:
    """The claim of the one tile that is ready."""
    (claim,) = store.claim(owner, 10, lease_s)
    return claim


def publication(work: TileWork, *voxels: int) -> Publication:
    """A publication of what was loaded: those voxels."""
    ids = tuple(row.report_id for row in work.reports)
    content = tile_of_voxels(work.claim.tile, *voxels)
    return Publication(work.claim, work.base_version, content, report_ids=ids, basis=basis_of(work))


def basis_of(work: TileWork) -> Basis:
    """What a publication of all that was loaded rests on."""
    return Basis(work.journal.window, work.journal.seq)


def merge_once(store: Store, *voxels: int, owner: str = "m1") -> int:
    """Claim, load and publish the one tile that is ready; its new version."""
    (result,) = store.publish([publication(store.load(only_claim(store, owner)), *voxels)])
    assert result.status == "published"
    return result.version


def begin_trial(store: SqlStore, tile: TileId, terms: TrialTerms) -> None:
    """Version 2 of a tile goes on trial, as when it is published."""

    def work(c: SqlConnection, now: int) -> None:
        with catalogs.changing(c, store.signing, "ndt", tile):
            trials.begin(c, "ndt", tile, (1, 2), terms, now)

    store.transact(work)
