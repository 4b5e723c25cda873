"""`gnd reproduce trust`: a fleet in which some are bad; what becomes of the map, and who is named for it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any, Final

import numpy as np

from gnd.cloud_merger.merge import MergeParameters
from gnd.gnd_map.arrays import are_in
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from studies.frame.command import Bench, StudyReport, study
from studies.frame.options import check, option, parts, seeds
from studies.frame.pool import Job
from studies.frame.tables import sheet_of
from studies.simulation.options import SET, MethodParameters, RunOptions, method_of, street_option
from studies.simulation.scores import MapScorer, VehicleFile
from studies.simulation.study import drive_jobs
from studies.simulation.worlds import WorldFiles, prepare_world, vehicle_tasks, world_files
from studies.trust_study.attackers import KINDS, TOGETHER, Lies, claimed, lie_of
from studies.trust_study.cloud import CloudRun, run_cloud

ALL_KINDS: Final = (*KINDS, "mixed", "one_of_two", "one_of_three")
HONEST_ONLY: Final = "none"
_SMALL: Final = {"one_of_two": 2, "one_of_three": 3}
_MOVED_M: Final = 0.1
_JUDGED: Final = tuple(f"honest_{name}" for name in ("quarantined", "shifted", "unbelieved", "grouped", "unheard"))
_HONEST: Final = {
    "honest vehicles": "{honest}",
    "F1": "{f1:.1f}",
    "map changed": "{changed_share:.1%}",
    "quarantined": "{honest_quarantined}",
    "... at some time": "{ever_quarantined}",
    "shifted": "{honest_shifted}",
    "not believed alone": "{honest_unbelieved}",
    "in groups": "{honest_grouped}",
    "not heard somewhere": "{honest_unheard}",
    "most alone": "{alone}",
}
_SHOWN: Final = {
    "kind": "{kind}",
    "bad": "{bad}",
    "F1": "{f1:.1f}",
    "loss": "{loss:+.2f}",
    "false published": "{false_published_share:.2%}",
    "bad named": "{named} of {bad}",
    "after tiles": "{named_after_tiles}",
    "honest named": "{honest_quarantined} of {honest}",
}


@dataclass(frozen=True, slots=True)
class TrustOptions:
    """A street, a fleet, and what its bad vehicles do."""

    seeds: tuple[int, ...] = seeds(11, text="Seeds of the world.")
    vehicles: int = option(20, "Vehicles of the fleet.", span=(3, 200))
    bad: float = option(0.3, "Share of them that is bad.", span=(0, 0.9))
    kinds: tuple[str, ...] = option(
        ALL_KINDS, "What the bad ones do; none: all are honest.", known=(*ALL_KINDS, HONEST_ONLY)
    )
    street: Any = street_option(120.0)
    apart_min: float = option(3.0, "Minutes between the starts of two vehicles.", "--apart", span=(0, 1e5))
    parking: float | None = option(None, "Share of parking slots that are taken.", span=(0, 1))
    edits: float = option(1.0, "Share of the street's edits made; 0: nothing has changed.", span=(0, 1))
    method: MethodParameters = parts(method_of, changes=SET)

    def __post_init__(self) -> None:
        check(self)

    def run(self) -> RunOptions:
        """The simulation that makes the honest reports."""
        return RunOptions(
            seeds=self.seeds,
            street=replace(self.street, edit_share=self.edits),
            vehicles=(self.vehicles,),
            apart_min=self.apart_min,
            parking=self.parking,
            method=self.method,
            pcd=False,
        )


@study(TrustOptions, out="runs/trust")
def trust(options: TrustOptions, bench: Bench) -> StudyReport:
    """What bad vehicles of a fleet can do to the map, and who is named for it."""
    run = options.run()
    files = {seed: world_files(bench.folder, seed, run) for seed in options.seeds}
    bench.run("worlds", [Job(f"world {seed}", prepare_world, (files[seed], seed, run)) for seed in files])
    tasks = {seed: vehicle_tasks(run, seed, files[seed])[: options.vehicles] for seed in files}
    bench.run("vehicles", drive_jobs(task for of_world in tasks.values() for task in of_world))
    kept = {seed: [VehicleFile(one.result, one.key) for one in of_world] for seed, of_world in tasks.items()}
    kinds = tuple(kind for kind in options.kinds if kind != HONEST_ONLY)
    names = ("honest", *kinds)
    jobs = [
        Job(f"{kind}, world {seed}", run_kind, (files[seed], kept[seed], kind, options.bad, seed, options.method.merge))
        for seed in files
        for kind in names
    ]
    results = iter(bench.run("fleets", jobs))
    worlds = {str(seed): {kind: next(results) for kind in names} for seed in files}
    found = {"seeds": list(options.seeds), **_mean_of(list(worlds.values()), kinds), "worlds": worlds}
    rows = {kind: row | {"kind": kind} for kind, row in found["kinds"].items()}
    title = f"Bad vehicles: {options.bad:.0%} of {options.vehicles}, honest F1 {found['honest']['f1']:.1f}"
    sheets = [sheet_of("Nobody is bad", _HONEST, {"all": found["honest"]})]
    if rows:
        sheets.append(sheet_of(title, _SHOWN, rows))
    return StudyReport(found, sheets, file="trust.json")


def run_kind(
    files: WorldFiles, vehicles: Sequence[VehicleFile], kind: str, share: float, seed: int, merge: MergeParameters
) -> dict[str, Any]:
    """One fleet with its bad vehicles, and the same fleet without them."""
    scorer = MapScorer(files)
    honest = [[ChangeReport.decode(body) for body in one.read().reports] for one in vehicles[: _SMALL.get(kind)]]
    if kind == "honest":
        run = run_cloud(scorer.base, honest, merge)
        names = {one.vehicle for reports in honest for one in reports}
        told = {"f1": scorer.score(run.tiles).f1(), "honest": len(honest), "alone": run.alone}
        told |= {"ever_quarantined": len(run.named_after), "changed_share": changed_share(scorer.base.tiles, run.tiles)}
        return run.judgements(names) | told
    bad = bad_ones(len(honest), kind, share, seed)
    fleet, lies = list[Sequence[ChangeReport]](), list[list[ChangeReport]]()
    for number, reports in enumerate(honest):
        if number not in bad:
            fleet.append(reports)
            continue
        turn = bad.index(number)
        about = Lies(scorer.base.tiles, seed if kind in TOGETHER else 1000 * seed + turn, turn)
        lies.append(lie_of(kind, turn)(reports, about))
        fleet.append(lies[-1])
    clean = run_cloud(scorer.base, [reports for number, reports in enumerate(honest) if number not in bad], merge)
    dirty = run_cloud(scorer.base, fleet, merge)
    true = [one for number, reports in enumerate(honest) if number not in bad for one in reports]
    return _row(scorer, clean, dirty, lies, true, len(honest))


def bad_ones(n: int, kind: str, share: float, seed: int) -> list[int]:
    """Numbers of the bad vehicles, anywhere in the order of the fleet."""
    count = 1 if kind in _SMALL else round(share * n)
    return sorted(np.random.default_rng([seed, 0xBAD]).choice(n, count, replace=False).tolist())


def _row(
    scorer: MapScorer,
    clean: CloudRun,
    dirty: CloudRun,
    lies: Sequence[Sequence[ChangeReport]],
    true: Sequence[ChangeReport],
    n: int,
) -> dict[str, Any]:
    bad = {one.vehicle for reports in lies for one in reports}
    named = dirty.quarantined & bad
    claims, published = false_published(scorer.base.tiles, clean.tiles, dirty.tiles, lies, true)
    f1, without = scorer.score(dirty.tiles).f1(), scorer.score(clean.tiles).f1()
    return {
        "f1": f1,
        "loss": without - f1,
        "false_claims": claims,
        "false_published": published,
        "false_published_share": published / max(claims, 1),
        "bad": len(bad),
        "named": len(named),
        "named_after_tiles": median(dirty.named_after[one] for one in named) if named else None,
        "honest": n - len(bad),
    } | dirty.judgements({one.vehicle for one in true})


def false_published(
    base: Mapping[TileId, Gaussians],
    clean: Mapping[TileId, Gaussians],
    dirty: Mapping[TileId, Gaussians],
    lies: Sequence[Sequence[ChangeReport]],
    true: Sequence[ChangeReport],
) -> tuple[int, int]:
    """Voxels that bad vehicles call changed and no honest one does; how many of them the map has changed.

    What an honest vehicle has found, too, is no lie: a bad one that says the same by chance is its second witness.
    """
    claims, published = 0, 0
    found, nothing = claimed(true), np.zeros(0, np.int32)
    for tile, ids in claimed([one for reports in lies for one in reports]).items():
        was, now, then = (tiles.get(tile, Gaussians.empty()) for tiles in (base, dirty, clean))
        false = np.setdiff1d(ids[_same(was, then, ids)], found.get(tile, nothing))
        claims += len(false)
        published += int((~_same(was, now, false)).sum())
    return claims, published


def changed_share(base: Mapping[TileId, Gaussians], tiles: Mapping[TileId, Gaussians]) -> float:
    """Of the voxels that the map held before or holds after a fleet those that it has changed."""
    changed, n = 0, 0
    for tile in base.keys() | tiles.keys():
        was, now = (one.get(tile, Gaussians.empty()) for one in (base, tiles))
        ids = np.union1d(was.voxel_id, now.voxel_id)
        changed, n = changed + int((~_same(was, now, ids)).sum()), n + len(ids)
    return changed / max(n, 1)


def _same(a: Gaussians, b: Gaussians, ids: Any) -> Any:
    """Whether two states of a tile hold the same at some voxels."""
    there_a, there_b = are_in(ids, a.voxel_id), are_in(ids, b.voxel_id)
    apart = np.zeros(len(ids))
    both = there_a & there_b
    at_a, at_b = np.searchsorted(a.voxel_id, ids[both]), np.searchsorted(b.voxel_id, ids[both])
    apart[both] = np.linalg.norm(a.mean_m[at_a] - b.mean_m[at_b], axis=1)
    return (there_a == there_b) & (apart < _MOVED_M)


def _mean_of(worlds: Sequence[Mapping[str, Any]], kinds: Sequence[str]) -> dict[str, Any]:
    """Means over worlds, with the worst loss; counts are summed."""
    found: dict[str, Any] = {
        "honest": {
            "f1": float(np.mean([one["honest"]["f1"] for one in worlds])),
            **{name: sum(one["honest"][name] for one in worlds) for name in ("honest", "ever_quarantined", *_JUDGED)},
            "changed_share": float(np.mean([one["honest"]["changed_share"] for one in worlds])),
            "alone": max(one["honest"]["alone"] for one in worlds),
        }
    }
    rows = {}
    for kind in kinds:
        of = [one[kind] for one in worlds]
        after = [one["named_after_tiles"] for one in of if one["named_after_tiles"] is not None]
        counts = ("false_claims", "false_published", "bad", "named", "honest", *_JUDGED)
        sums = {name: sum(one[name] for one in of) for name in counts}
        rows[kind] = sums | {
            "f1": float(np.mean([one["f1"] for one in of])),
            "loss": float(np.mean([one["loss"] for one in of])),
            "worst_loss": max(one["loss"] for one in of),
            "false_published_share": sums["false_published"] / max(sums["false_claims"], 1),
            "named_after_tiles": median(after) if after else None,
        }
    return found | {"kinds": rows}
