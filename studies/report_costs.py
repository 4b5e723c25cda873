"""What a real short report costs, receipt to published tile: the load of `gnd load`, without a bus, in simulated time.

The same drives, streets and timetable; the same store, expander and worker, in one thread, by a clock of its own. So
tiles wait for each other as on the street, nothing depends on the machine, and a run gives the same map each time: its
digest tells whether two programs publish the same bits.
"""

import hashlib
import json
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import click

from gnd.cloud_merger.announce import encoded, update_of
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import Expander
from gnd.cloud_merger.ingest import Ingest
from gnd.cloud_merger.merger import TILES_AT_ONCE
from gnd.cloud_merger.stored import Bases
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.warm import warm_up
from gnd.cloud_merger.work import Worker, in_turn
from gnd.deploy.load.drives import KeptReport, KeptRuns
from gnd.deploy.load.making import DRIVES
from gnd.deploy.load.plan import Due, LoadOptions
from gnd.deploy.load.sending import SendingMeasured
from gnd.deploy.load.shift import DistrictShift, shifted_district
from gnd.deploy.load.streets import Streets
from gnd.schemas.keys import change_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportState
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import DEFAULT_LAYER

_START_NS: Final = 1_800_000_000_000_000_000
_NS_PER_S: Final = 1_000_000_000
_PARTS: Final = ("to the ack", "flags to the journal", "Gaussians to the journal", "merges", "notices")


@dataclass(slots=True)
class _Costs:
    """CPU seconds by part, and how often things happened."""

    cpu_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(_PARTS, 0.0))
    count: Counter[str] = field(default_factory=Counter)

    @contextmanager
    def of(self, part: str) -> Iterator[None]:
        """Count the CPU time of the block, of all threads."""
        began_s = time.process_time()
        yield
        self.cpu_s[part] += time.process_time() - began_s


class _Cloud:
    """Store, expander and worker, by a clock that only `until` moves."""

    def __init__(self, path: Path, costs: _Costs) -> None:
        self.now_ns, self.costs = _START_NS, costs
        clock = lambda: self.now_ns  # noqa: E731 - one clock for both
        self.store = SqliteStore(path, now_ns=clock, steady_ns=clock)
        self.config = ShardConfig("replay", path)
        self._bases = Bases(self.store)
        self.told: list[tuple[str, ReportState]] = []
        self.ingest = Ingest(self.store, self.config.shard_id, now_ns=clock)
        self._expander = Expander(self.store, self.config, lambda *told: self.told.append(told), bases=self._bases)
        self._worker = Worker(self.store, self.config, self._bases)

    def put(self, part: str, key: str, body: bytes) -> None:
        """A message that comes, up to the journal."""
        with self.costs.of("to the ack"):
            ack = self.ingest.answer(key, body)
        if ack.status != "stored":
            raise click.ClickException(f"{part}: {ack.status} {ack.reason}")
        with self.costs.of(part):
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
        config = self.config
        with self.costs.of("merges"):
            claims = self.store.claim(config.shard_id, TILES_AT_ONCE, config.lease_s, self._expander.districts)
            self._worker.begin(claims)
            results = [one for some in in_turn(claims) for one in self._worker.settle_some(some)]
        self.costs.count["merges"] += len(results)
        self.costs.count["versions"] += sum(one is not None and one.status == "published" for one in results)
        with self.costs.of("notices"):
            notices = self.store.notices()
            for one in notices:
                stored = self.store.get(one.layer, one.tile, one.version)
                assert stored is not None
                parent = self.store.get(one.layer, one.tile, stored.parent) if stored.parent else None
                self.costs.count["bytes of notices"] += len(encoded(update_of(stored, parent, self._bases.tile)))
            if notices:
                self.store.announced(notices)

    def digest(self) -> str:
        """Of the newest version of every tile."""
        heads = sorted((one.tile.morton, one.sha) for one in self.store.heads())
        return hashlib.sha256(repr(heads).encode()).hexdigest()[:16]


def replay(runs: KeptRuns, options: LoadOptions, folder: Path, *, verify: bool = False) -> dict[str, Any]:
    """Replay a load; see the module's head."""
    warm_up()
    streets = Streets.of(runs, options)
    costs, measured = _Costs(), SendingMeasured(streets.bases)
    cloud = _Cloud(folder / "replay.sqlite", costs)
    for street in range(options.streets):
        cloud.store.put_tiles(streets.tiles(street))
    shifts = [streets.shift(street) for street in range(options.streets)]
    for due in streets.timetable().due(range(options.vehicles)):
        cloud.until(_START_NS + round(due.at_s * _NS_PER_S))
        kept = streets.edition(due.street).drives[due.drive].reports[due.report]
        _send(cloud, due, kept, shifts[due.street], measured)
    cloud.until(cloud.now_ns + 60 * _NS_PER_S)
    n = max(costs.count["reports"], 1)
    found: dict[str, Any] = {
        "reports": costs.count["reports"],
        "second halves": costs.count["second halves"],
        "merges a report": round(costs.count["merges"] / n, 2),
        "versions a report": round(costs.count["versions"] / n, 2),
        "bytes of notices a report": round(costs.count["bytes of notices"] / n),
        "CPU a report, ms": round(1e3 * sum(costs.cpu_s.values()) / n, 2),
        **{f"  {part}": round(1e3 * cpu_s / n, 2) for part, cpu_s in costs.cpu_s.items()},
        "CPU a merge, ms": round(1e3 * costs.cpu_s["merges"] / max(costs.count["merges"], 1), 2),
        "digest of the map": cloud.digest(),
    }
    if verify:
        found["verified"] = dict(
            Counter(one.status for one in Verifier(cloud.store, cloud.config).heads(DEFAULT_LAYER))
        )
    cloud.store.close()
    return found


def _send(cloud: _Cloud, due: Due, kept: KeptReport, shift: DistrictShift, measured: SendingMeasured) -> None:
    """What a vehicle sends of one report: flags, and the Gaussians that are wanted."""
    vehicle, packed = f"v{due.vehicle}", shift.packed(kept.packed, kept.bases)
    first_ns = cloud.now_ns - packed.length_ns
    names = (vehicle, str(due.passage), str(due.street), packed.report_id)
    packed = replace(
        packed,
        report_id=deterministic_report_id(first_ns // 1_000_000, *names),
        vehicle=vehicle,
        first_ns=first_ns,
    )
    key = change_key(kept.whole.layer, shifted_district(kept.whole.district, shift.districts))
    cloud.put("flags to the journal", key, packed.encode())
    cloud.costs.count["reports"] += 1
    told, cloud.told = cloud.told, []
    for wanted in _wanted(told):
        cloud.costs.count["second halves"] += 1
        cloud.put("Gaussians to the journal", key, measured.half(kept, wanted, packed.report_id))
    cloud.told.clear()


def _wanted(told: Sequence[tuple[str, ReportState]]) -> list[bytes]:
    return [state.wanted for _, state in told if state.status == "wanted"]


@click.command()
@click.option("--vehicles", default=20, show_default=True)
@click.option("--km", default=0.4, show_default=True, help="Way of each.")
@click.option("--changed-share", default=1.0, show_default=True, help="Of the streets, how many have changed.")
@click.option("--per-street", default=4, show_default=True, help="Vehicles that share a street.")
@click.option("--drives", type=click.Path(path_type=Path), default=DRIVES / "changed", show_default=True)
@click.option("--settled", type=click.Path(path_type=Path), default=DRIVES / "settled", show_default=True)
@click.option("--verify", is_flag=True, help="Compute every tile anew afterwards, as `gnd map verify` does.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write the result there.")
def report_costs(
    vehicles: int,
    km: float,
    changed_share: float,
    per_street: int,
    drives: Path,
    settled: Path,
    verify: bool,
    json_path: Path | None,
) -> None:
    """CPU of a real short report by part. The drives are those that `gnd load` makes."""
    options = LoadOptions(vehicles=vehicles, km=km, changed_share=changed_share, per_street=per_street)
    runs = KeptRuns(drives, settled if changed_share < 1.0 else None)
    with tempfile.TemporaryDirectory() as folder:
        found = replay(runs, options, Path(folder), verify=verify)
    if json_path is not None:
        json_path.write_text(json.dumps(found, indent=1))
    for name, value in found.items():
        click.echo(f"{name:>28}  {value}")


if __name__ == "__main__":
    report_costs()
