"""What the worker of a shard does for the reports of a load, without a bus and in simulated time.

    python -m studies.scale.replay --changed-share 1        costs by part, and a digest of the map

Drives, streets and timetable are those of `gnd load`; store, expander and worker are the real ones, in one thread, by a
clock that only the timetable moves. So a run gives the same map each time, whatever the machine does: the digest says
whether two programs publish the same bits.
"""

import hashlib
import json
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import click
from rich.console import Console

from gnd.cloud_merger.announce import encoded, update_of
from gnd.cloud_merger.checking import IngestLimits
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import Expander
from gnd.cloud_merger.ingest import Ingest
from gnd.cloud_merger.merger import TILES_AT_ONCE
from gnd.cloud_merger.stored import Bases
from gnd.cloud_merger.warm import warm_up
from gnd.cloud_merger.work import Worker, in_turn
from gnd.deploy.load.drives import KeptReport, KeptRuns
from gnd.deploy.load.making import kept_runs
from gnd.deploy.load.plan import Due, LoadOptions
from gnd.deploy.load.sending import SendingMeasured
from gnd.deploy.load.shift import DistrictShift, shifted_district
from gnd.deploy.load.streets import Streets
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import change_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportState
from gnd.tile_store.sqlite_store import SqliteStore
from studies.frame.errors import ReproduceError

PARTS: Final = ("to the ack", "flags", "second halves", "merges", "notices")
_START_NS: Final = 1_800_000_000_000_000_000
_NS_PER_S: Final = 1_000_000_000
_DRAIN_S: Final = 60


@dataclass(slots=True)
class ReplayCosts:
    """CPU seconds of parts, and how often things happened."""

    cpu_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))
    count: Counter[str] = field(default_factory=Counter)

    @contextmanager
    def of(self, part: str) -> Iterator[None]:
        """Count the CPU time of the block, of all threads."""
        began_s = time.process_time()
        yield
        self.cpu_s[part] += time.process_time() - began_s


class _Cloud:
    """Store, expander and worker, by a clock that only `until` moves."""

    def __init__(self, path: Path, costs: ReplayCosts) -> None:
        self.now_ns, self._costs = _START_NS, costs
        self.store = SqliteStore(path, now_ns=self._now, steady_ns=self._now)
        config = ShardConfig("replay", path)
        # as `gnd load` has it
        confirmation = replace(config.confirmation, copies=False)
        self._config = replace(config, ingest=IngestLimits(speeds=False), confirmation=confirmation)
        self._bases, self.told = Bases(self.store), list[ReportState]()
        self._journaled = Counter[int]()  # of each tile, what was there when it was merged last
        self._ingest = Ingest(self.store, "replay", now_ns=self._now)
        self._expander = Expander(self.store, self._config, lambda _, state: self.told.append(state), bases=self._bases)
        self._worker = Worker(self.store, self._config, self._bases)

    def _now(self) -> int:
        return self.now_ns

    def put(self, part: str, key: str, body: bytes) -> None:
        """A message that comes, up to the journal."""
        with self._costs.of("to the ack"):
            ack = self._ingest.answer(key, body)
        if ack.status != "stored":
            raise ReproduceError(f"{part}: {ack.status} {ack.reason}")
        with self._costs.of(part):
            while self._expander.work():
                pass

    def until(self, end_ns: int) -> None:
        """Merge and announce what becomes ready up to a time."""
        while (ready_in_s := self.store.ready_in_s()) is not None:
            ready_ns = self.now_ns + max(round(ready_in_s * _NS_PER_S), 0)
            if ready_ns > end_ns:
                break
            self.now_ns = ready_ns
            self._merge()
        self.now_ns = max(self.now_ns, end_ns)

    def _merge(self) -> None:
        with self._costs.of("merges"):
            claims = self.store.claim("replay", TILES_AT_ONCE, self._config.lease_s)
            self._worker.begin(claims)
        self._costs.count["merges of what was known"] += sum(not self._is_news(one.tile) for one in claims)
        for some in in_turn(claims):
            before = self._marks()
            with self._costs.of("merges"):
                results = self._worker.settle_some(some)
            self._costs.count["marked again"] += self._marks() - before
            self._costs.count["merges"] += len(results)
            self._costs.count["versions"] += sum(one is not None and one.status == "published" for one in results)
        with self._costs.of("notices"):
            self._announce()

    def _is_news(self, tile: TileId) -> bool:
        """Whether something has come about a tile since it was merged."""
        asked = "SELECT COUNT(*) FROM report WHERE layer = 'ndt' AND tile = ?"
        ((parts,),) = self.store.look(lambda c: list(c.execute(asked, (tile.morton,))))  # type: ignore[attr-defined]
        before, self._journaled[tile.morton] = self._journaled[tile.morton], int(parts)
        return int(parts) > before

    def _marks(self) -> int:
        """Numbers that were given to reports and to marks in the journals; a publication gives them to marks alone."""
        ((given,),) = self.store.look(lambda c: list(c.execute("SELECT TOTAL(seq) FROM journal")))  # type: ignore[attr-defined]
        return int(given)

    def _announce(self) -> None:
        notices = self.store.notices()
        for one in notices:
            stored = self.store.get(one.layer, one.tile, one.version)
            if stored is None:
                raise ReproduceError(f"{one.tile} version {one.version} went before it was announced")
            parent = self.store.get(one.layer, one.tile, stored.parent) if stored.parent else None
            encoded(update_of(stored, parent, self._bases.tile))
        if notices:
            self.store.announced(notices)

    def digest(self) -> str:
        """Of the newest version of every tile."""
        heads = sorted((one.tile.morton, one.sha) for one in self.store.heads())
        return hashlib.sha256(repr(heads).encode()).hexdigest()[:16]


def replayed(runs: KeptRuns, options: LoadOptions, folder: Path) -> tuple[ReplayCosts, str]:
    """Replay a load: what it has cost, and a digest of the map that came of it.

    Raises:
        ReproduceError: a report is refused.
    """
    warm_up()
    streets, costs = Streets.of(runs, options), ReplayCosts()
    measured, cloud = SendingMeasured(streets.bases), _Cloud(folder / "replay.sqlite", costs)
    with cloud.store:
        for street in range(options.streets):
            cloud.store.put_tiles(streets.tiles(street))
        for due in streets.timetable().due(range(options.vehicles)):
            cloud.until(_START_NS + round(due.at_s * _NS_PER_S))
            kept = streets.edition(due.street).drives[due.drive].reports[due.report]
            _send(cloud, due, kept, streets.shift(due.street), measured)
            costs.count["reports"] += 1
        cloud.until(cloud.now_ns + _DRAIN_S * _NS_PER_S)
        return costs, cloud.digest()


def _send(cloud: _Cloud, due: Due, kept: KeptReport, shift: DistrictShift, measured: SendingMeasured) -> None:
    """What a vehicle sends of one report: flags, and the Gaussians that are wanted."""
    vehicle, packed = f"v{due.vehicle}", shift.packed(kept.packed, kept.bases)
    first_ns = cloud.now_ns - packed.length_ns
    names = (vehicle, str(due.passage), str(due.street), packed.report_id)
    report_id = deterministic_report_id(first_ns // 1_000_000, *names)
    packed = replace(packed, report_id=report_id, vehicle=vehicle, first_ns=first_ns)
    key = change_key(kept.whole.layer, shifted_district(kept.whole.district, shift.districts))
    cloud.told.clear()
    cloud.put("flags", key, packed.encode())
    for wanted in [state.wanted for state in cloud.told if state.status == "wanted"]:
        cloud.put("second halves", key, measured.half(kept, wanted, report_id))


@click.command(help=__doc__)
@click.option("--vehicles", default=8, show_default=True, type=click.IntRange(1))
@click.option("--km", default=0.8, show_default=True, type=click.FloatRange(0.1), help="Way of each.")
@click.option("--changed-share", default=1.0, show_default=True, type=click.FloatRange(0.0, 1.0))
def main(vehicles: int, km: float, changed_share: float) -> None:
    """Replay, and tell."""
    runs = kept_runs(None, None, Console(stderr=True))
    options = LoadOptions(vehicles=vehicles, km=km, kmh=60.0, changed_share=changed_share)
    with tempfile.TemporaryDirectory() as folder:
        costs, digest = replayed(runs, options, Path(folder))
    told = {name: round(1e3 * used_s / costs.count["reports"], 2) for name, used_s in costs.cpu_s.items()}
    click.echo(json.dumps(dict(costs.count) | {"ms_a_report": told, "map": digest}))


if __name__ == "__main__":
    main(prog_name="python -m studies.scale.replay")
