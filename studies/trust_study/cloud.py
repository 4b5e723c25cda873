"""The cloud of the study: a real store and the shard's own worker, one vehicle after the other."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import rows_of
from gnd.cloud_merger.merge import MergeParameters
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore
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
        shifted: named for shifts of their poses, at the end.
        unbelieved: not believed alone, in general or on the day, at the end.
        grouped: named as saying the same false things as others, at the end.
        unheard: of which statements of some kind do not count in some tile, at the end.
        alone: the most voxels that one vehicle has changed alone, beyond those that others confirm of it.
    """

    tiles: dict[TileId, Gaussians]
    named_after: dict[str, int] = field(default_factory=dict)
    quarantined: frozenset[str] = frozenset()
    shifted: frozenset[str] = frozenset()
    unbelieved: frozenset[str] = frozenset()
    grouped: frozenset[str] = frozenset()
    unheard: frozenset[str] = frozenset()
    alone: int = 0

    def judgements(self, vehicles: frozenset[str] | set[str]) -> dict[str, int]:
        """How many of some vehicles were judged how."""
        found = {"quarantined": self.quarantined, "shifted": self.shifted, "unbelieved": self.unbelieved}
        found |= {"grouped": self.grouped, "unheard": self.unheard}
        return {f"honest_{name}": len(those & vehicles) for name, those in found.items()}


def run_cloud(base: BaseMap, fleet: Sequence[Sequence[ChangeReport]], merge: MergeParameters | None = None) -> CloudRun:
    """Take the reports of vehicles in the order in which they come, merge after each vehicle; `merge`: how."""
    rules = merge or MergeParameters()
    with _store(base, rules) as (store, worker):
        run, told = CloudRun({}), dict[str, int]()
        for reports in fleet:
            for one in sorted(reports, key=lambda report: report.last_ns):
                store.put_reports(rows_of(one, one.last_ns + _LATE_NS, together=rules.together))
                told[one.vehicle] = told.get(one.vehicle, 0) + len(one.tiles)
            merge_all(store, worker)
            run.quarantined = store.quarantined_vehicles()
            for vehicle in run.quarantined - run.named_after.keys():
                run.named_after[vehicle] = told[vehicle]
        run.shifted = store.shifted_vehicles()
        run.unbelieved = frozenset(one.vehicle for one in store.lone_words())
        run.grouped = frozenset(name for one in store.pairs_of_groups() for name in (one.one, one.other))
        run.unheard = frozenset(store.unheard_vehicles())
        run.alone = max((one.alone - one.shared for one in store.days_alone()), default=0)
        heads = [store.get("ndt", head.tile) for head in store.heads("ndt")]
        run.tiles = {head.tile: head.decode_gaussians().gaussians for head in heads if head is not None}
        return run


def merge_all(store: SqlStore, worker: Worker) -> None:
    """Merge until nothing waits."""
    while claims := store.claim("study", 16, 60.0):
        worker.begin(claims)
        worker.settle_some(claims)


@contextmanager
def _store(base: BaseMap, merge: MergeParameters) -> Iterator[tuple[SqlStore, Worker]]:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "map.sqlite"
        config = ShardConfig("study", path, merge=merge, store=StoreConfig(merge_delay_s=0.0))
        with SqliteStore(path, config.store) as store:
            store.put_tiles([Tile(tile, 0, gaussians) for tile, gaussians in base.tiles.items()])
            yield store, Worker(store, config)
