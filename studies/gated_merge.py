"""Reports of vehicles merged as the cloud merges them, both gates included: what is published, what waits."""

import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, split
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow, StoreConfig


@dataclass(frozen=True, slots=True)
class Merged:
    """Voxels published by tile; how many wait, by reason; the vehicles that are named as shifted."""

    published: Mapping[TileId, frozenset[int]]
    waiting: Mapping[str, int]
    named: tuple[str, ...]

    @property
    def voxels(self) -> int:
        """How many are published."""
        return sum(map(len, self.published.values()))


def merged(base: Mapping[TileId, Gaussians], bodies: Sequence[bytes]) -> Merged:
    """Merge reports (gnd.v1.ChangeReport) into a map until nothing is left to do."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "store.sqlite"
        with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
            store.put_tiles([Tile(tile, 1, gaussians) for tile, gaussians in base.items()])
            for body in bodies:
                _put(store, ChangeReport.decode(body))
            worker = Worker(store, ShardConfig(store_path=path))
            while claims := store.claim("one", 64, 60.0):
                store.publish(worker.merge(claims))
            waiting = Counter[str]()
            for one in store.waiting_changes():
                waiting[one.reason] += one.voxels
            heads = [(head.tile, head.version) for head in store.heads()]
            published = {tile: frozenset(store.voxel_provenance("ndt", tile, version)) for tile, version in heads}
            return Merged(published, dict(waiting), tuple(sorted(store.shifted_vehicles())))


def _put(store: SqliteStore, report: ChangeReport) -> None:
    for change, (tile, part) in zip(report.tiles, split(report), strict=True):
        row = ReportRow(report.report_id, report.layer, tile, report.vehicle, 1, part, base_sha=change.base_sha)
        store.put_reports([row])
