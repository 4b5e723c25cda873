"""Values for the tests of the store, and the factories of the stores that the shared suite runs on."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.store import Store
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

    def open(self, config: StoreConfig = EAGER, clock: Clock | None = None) -> Store:
        clock = clock or Clock()
        return SqliteStore(self.path, config, now_ns=clock, steady_ns=clock)


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
