"""The cloud of the study: a real store and the shard's own worker, one vehicle after the other."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import rows_of
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig
from studies.simulation.base_map import BaseMap

_LATE_NS = 20_000_000_000
"""A report is received so long after its last scan."""


@dataclass(slots=True)
class CloudRun:
    """What came of a fleet.

    Attributes:
        tiles: the map.
        named_after: of each vehicle that is quarantined, on how many tiles it had reported by then.
        quarantined: at the end.
    """

    tiles: dict[TileId, Gaussians]
    named_after: dict[str, int] = field(default_factory=dict)
    quarantined: frozenset[str] = frozenset()


def run_cloud(base: BaseMap, fleet: Sequence[Sequence[ChangeReport]]) -> CloudRun:
    """Take the reports of vehicles in the order in which they come, merge after each vehicle."""
    with _store(base) as (store, worker):
        run, told = CloudRun({}), dict[str, int]()
        for reports in fleet:
            for one in sorted(reports, key=lambda report: report.last_ns):
                store.put_reports(rows_of(one, one.last_ns + _LATE_NS))
                told[one.vehicle] = told.get(one.vehicle, 0) + len(one.tiles)
            merge_all(store, worker)
            run.quarantined = store.quarantined_vehicles()
            for vehicle in run.quarantined - run.named_after.keys():
                run.named_after[vehicle] = told[vehicle]
        heads = [store.get("ndt", head.tile) for head in store.heads("ndt")]
        run.tiles = {head.tile: head.decode_gaussians().gaussians for head in heads if head is not None}
        return run


def merge_all(store: SqliteStore, worker: Worker) -> None:
    """Merge until nothing waits."""
    while claims := store.claim("study", 16, 60.0):
        worker.begin(claims)
        worker.settle_some(claims)


@contextmanager
def _store(base: BaseMap) -> Iterator[tuple[SqliteStore, Worker]]:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "map.sqlite"
        config = ShardConfig("study", path, store=StoreConfig(merge_delay_s=0.0))
        with SqliteStore(path, config.store) as store:
            store.put_tiles([Tile(tile, 0, gaussians) for tile, gaussians in base.tiles.items()])
            yield store, Worker(store, config)
