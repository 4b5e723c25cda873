"""Does a healed map stay healed? The reports of a finished run of `gnd fleet`, then thousands of partial passes.

The passes are cut from the run's own reports with their errors, of one tile each. In a run with `--headway 0` most of
them were made against the stale base map:

- `other`: what the vehicle saw of the voxels that it did not find changed;
- `half`: the western half of what it observed and reported;
- `fifth`: a fifth of what it observed and reported, at random.

They come from vehicles of their own, seconds to minutes apart by the clock of the cloud, through the real store and the
real worker. Printed: F1 before and after, versions published, and the CPU time of a report by its number.

With `--drives N` whole drives follow on the healing instead: those of the run again, each as another vehicle's, ten
minutes after the one before. Printed: bytes of notices of each, and of the last ones over those of the first.
"""

import json
import random
import shutil
import sqlite3
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import click
import numpy as np
from rich.progress import track

from gnd.cloud_merger.announce import encoded, update_of
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.work import Worker
from gnd.fleet_sim.evaluate import evaluate_maps
from gnd.fleet_sim.truth import LEVELS, Truth, read_truth
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange, split
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import DEFAULT_LAYER, ReportRow, StoreConfig

KINDS: Final = ("other", "half", "fifth")
_START_NS: Final = 1_800_000_000_000_000_000
_NS_PER_S: Final = 1_000_000_000
_BETWEEN_S: Final = (1, 30, 120)
_VEHICLES: Final = 500
_AT_ONCE: Final = 100
"""So many reports make one figure of CPU time."""


class _MergedCloud:
    """A store and a worker with a clock of their own."""

    def __init__(self, base: Path, path: Path) -> None:
        shutil.copy(base, path)
        self.now_ns = _START_NS
        self.store = SqliteStore(path, StoreConfig(merge_delay_s=0.0), now_ns=lambda: self.now_ns)
        self.config = ShardConfig(store_path=path)
        self._worker = Worker(self.store, self.config)

    def hear(self, report: ChangeReport) -> int:
        """Keep and merge a report; how many versions came of it."""
        rows = [
            ReportRow(
                report.report_id, report.layer, tile, report.vehicle, self.now_ns, body, change.base_sha,
                is_quiet=not len(change.changed),
            )
            for change, (tile, body) in zip(report.tiles, split(report), strict=True)
        ]  # fmt: skip
        self.store.put_reports(rows)
        published = 0
        while claims := self.store.claim("benchmark", 64, 600.0):
            for one in self._worker.merge(claims):
                published += sum(result.status == "published" for result in self.store.publish([one]))
        return published

    def notices(self) -> int:
        """Bytes of the notices of what has been published since the last call."""
        found, waiting = 0, self.store.notices()
        for one in waiting:
            stored = self.store.get(one.layer, one.tile, one.version)
            assert stored is not None
            parent = self.store.get(one.layer, one.tile, stored.parent) if stored.parent else None
            found += len(encoded(update_of(stored, parent)))
        self.store.announced(waiting)
        return found

    def tiles(self, version: int | None = None) -> dict[TileId, Gaussians]:
        """Every tile as it is, or as it was in one version."""
        found = {}
        for head in self.store.heads():
            stored = self.store.get(DEFAULT_LAYER, head.tile, version=version)
            if stored is not None and (version is None or stored.kind == "base"):
                found[head.tile] = stored.decode_gaussians().gaussians
        return found


def reports_of_run(run: Path) -> list[ChangeReport]:
    """The whole reports of a run's vehicles, by vehicle and id."""
    found = []
    for path in sorted(run.glob("agents/*/outbox.sqlite")):
        with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as box:
            rows = box.execute("SELECT body FROM report ORDER BY report_id").fetchall()
        found += [ChangeReport.decode(body) for (body,) in rows]
    return [one for one in found if one.layer == DEFAULT_LAYER]


def passes(reports: Sequence[ChangeReport], n: int, seed: int) -> Iterator[tuple[str, ChangeReport, int]]:
    """(kind, report about one tile, seconds since the one before), `n` times."""
    chosen, numbers = random.Random(seed), np.random.default_rng(seed)
    parts = [(report, change) for report in reports for change in report.tiles if change.base_sha]
    now_ns = _START_NS + 3600 * _NS_PER_S
    for k in range(n):
        report, change = chosen.choice(parts)
        kind, later_s = KINDS[k % len(KINDS)], chosen.choice(_BETWEEN_S)
        now_ns += later_s * _NS_PER_S
        yield kind, replace(
            report,
            report_id=deterministic_report_id(now_ns // 1_000_000, "pass", str(k)),
            vehicle=f"pass-{k % _VEHICLES}",
            first_ns=now_ns - _NS_PER_S,
            last_ns=now_ns,
            tiles=(_part(change, kind, numbers),),
            course=None,
        ), later_s  # fmt: skip


def _part(change: TileChange, kind: str, numbers: np.random.Generator) -> TileChange:
    seen = change.observed
    if kind == "other":
        keep = ~np.isin(seen, change.changed.voxel_id)
    elif kind == "half":
        east = VoxelGrid.of(change.tile).unravel(seen)[0]
        keep = east < np.median(east)
    else:
        keep = numbers.random(len(seen)) < 0.2
    ids = np.ascontiguousarray(seen[keep])
    stated = np.isin(change.changed.voxel_id, ids)
    return replace(
        change,
        observed=ids,
        changed=change.changed.take(stated),
        change_class=change.change_class[stated],
        evidence=change.evidence[stated],
        doubt=None,
    )


def study(run: Path, n: int, seed: int, folder: Path) -> dict[str, Any]:
    """Heal, then `n` passes; see the module's head."""
    reports, truth = reports_of_run(run), read_truth(run / "world" / "truth.npz")
    cloud = _MergedCloud(run / "world" / "base.sqlite", folder / "memory.sqlite")
    base = cloud.tiles()
    healing, cpu = [], []
    for report in reports:
        cloud.now_ns += 20 * _NS_PER_S
        begun = time.process_time()
        healing.append(cloud.hear(report))
        cpu.append(1e3 * (time.process_time() - begun))
    healed = _f1(truth, base, cloud.tiles())
    cloud.now_ns = _START_NS + 3600 * _NS_PER_S
    each: list[float] = []
    published: list[int] = []
    kinds: Counter[str] = Counter()
    for kind, report, later_s in track(passes(reports, n, seed), "passes", total=n, transient=True):
        cloud.now_ns += later_s * _NS_PER_S
        begun = time.process_time()
        published.append(cloud.hear(report))
        each.append(1e3 * (time.process_time() - begun))
        kinds[kind] += published[-1]
    after = _f1(truth, base, cloud.tiles())
    verified = Counter(one.status for one in Verifier(cloud.store, cloud.config).heads(DEFAULT_LAYER))
    cloud.store.close()
    return {
        "run": str(run),
        "reports": len(reports),
        "passes": n,
        "seed": seed,
        "f1_healed": healed,
        "f1_after": after,
        "versions": {"healing": sum(healing), "passes": sum(published), "by_kind": dict(kinds)},
        "versions_of_last_tenth": sum(published[-max(n // 10, 1) :]),
        "cpu_ms": {
            "healing_report": round(float(np.median(cpu)), 2),
            "first_passes": round(float(np.mean(each[:_AT_ONCE])), 3),
            "last_passes": round(float(np.mean(each[-_AT_ONCE:])), 3),
            "ratio": round(float(np.mean(each[-_AT_ONCE:]) / max(float(np.mean(each[:_AT_ONCE])), 1e-9)), 3),
        },
        "verified": dict(verified),
    }


def drives(run: Path, n: int, folder: Path, base_path: Path) -> dict[str, Any]:
    """Heal the map at `base_path`, then `n` of the run's own drives again; bytes of notices of each."""
    reports, truth_path = reports_of_run(run), run / "world" / "truth.npz"
    truth = read_truth(truth_path) if truth_path.exists() else None  # drives that were given have none
    by_vehicle: dict[str, list[ChangeReport]] = {}
    for report in reports:
        by_vehicle.setdefault(report.vehicle, []).append(report)
    own = list(by_vehicle.values())
    cloud = _MergedCloud(base_path, folder / "memory.sqlite")
    base, healing = cloud.tiles(), []
    for drive in own:
        for report in drive:
            cloud.now_ns += 20 * _NS_PER_S
            cloud.hear(report)
        healing.append(cloud.notices())
    healed, repeated = truth and _f1(truth, base, cloud.tiles()), []
    for k in range(n):
        cloud.now_ns += 600 * _NS_PER_S
        for report in _as_another(own[k % len(own)], f"again-{k}", cloud.now_ns):
            cloud.hear(report)
        repeated.append(cloud.notices())
    after = truth and _f1(truth, base, cloud.tiles())
    cloud.store.close()
    some = min(len(own), n // 2)
    return {
        "run": str(run),
        "drives": len(own),
        "bytes of notices, healing": healing,
        "f1_healed": healed,
        "bytes of notices, again": repeated,
        "f1_after": after,
        f"last {some} / first {some} again": round(sum(repeated[-some:]) / max(sum(repeated[:some]), 1), 4),
        f"last {some} again / first {some} of all": round(sum(repeated[-some:]) / max(sum(healing[:some]), 1), 4),
    }


def _as_another(drive: Sequence[ChangeReport], vehicle: str, begin_ns: int) -> Iterator[ChangeReport]:
    """The reports of a drive as those of another vehicle that begins now."""
    first_ns = min(report.first_ns for report in drive)
    for number, report in enumerate(drive):
        yield replace(
            report,
            report_id=deterministic_report_id(begin_ns // 1_000_000, vehicle, str(number)),
            vehicle=vehicle,
            first_ns=begin_ns + report.first_ns - first_ns,
            last_ns=begin_ns + report.last_ns - first_ns,
        )


def _f1(truth: Truth, base: dict[TileId, Gaussians], tiles: dict[TileId, Gaussians]) -> dict[str, float]:
    scores = evaluate_maps(truth, base, tiles)
    return {level: round(scores.f1(level), 2) for level in LEVELS}


@click.command()
@click.argument("run", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--passes", "n", default=1000, show_default=True, help="Partial passes after the run's reports.")
@click.option("--seed", default=1, show_default=True)
@click.option("--drives", "n_drives", default=0, show_default=True, help="Whole drives in place of partial passes.")
@click.option("--base", type=click.Path(path_type=Path), help="Map that --drives begin on; default: the run's own.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write the result there.")
def memory(run: Path, n: int, seed: int, n_drives: int, base: Path | None, json_path: Path | None) -> None:
    """Thousands of partial passes over the healed map of RUN (a folder of `gnd fleet`): F1, versions, CPU a report."""
    with tempfile.TemporaryDirectory() as folder:
        if n_drives:
            found = drives(run, n_drives, Path(folder), base or run / "world" / "base.sqlite")
        else:
            found = study(run, n, seed, Path(folder))
    if json_path is not None:
        json_path.write_text(json.dumps(found, indent=1))
    for name, value in found.items():
        click.echo(f"{name:>24}  {json.dumps(value)}")


if __name__ == "__main__":
    memory()
