"""`gnd reproduce errors`: the voxels that cost F1, by true class, predicted class and cause, from a finished run."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, get_args

import click
import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.evaluate import CLASSES, ClassArray, Score, classes_of_maps
from gnd.fleet_sim.truth import LEVELS, Level, Truth, read_truth
from gnd.gnd_map.arrays import I32, I64
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.config import from_mapping
from gnd.vehicle_agent.detect.parameters import MIN_CELLS, DetectParameters
from studies.frame.errors import OptionError
from studies.frame.folder import StudyFolder
from studies.frame.options import PATH
from studies.frame.tables import print_sheets, sheet, shown
from studies.simulation.base_map import BaseMap
from studies.simulation.cloud import arrived, map_of_one, merged_map
from studies.simulation.options import MethodParameters, Upload
from studies.simulation.result import EVIDENCE, VehicleResult, read_result
from studies.simulation.worlds import WorldFiles, read_world_base

RIGHT: Final = "right"
UNSEEN: Final = "never observed"
FEW_CELLS: Final = "abstains: too few sub-cells"
EDGE: Final = "abstains: may be the edge of a neighbour"
FEW_RAYS: Final = "abstains: too few rays, or a tie"
OTHER: Final = "other"

Causes = NDArray[np.str_]
N, A, M, D, E = (
    int(c) for c in (ChangeClass.NORMAL, ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED, ChangeClass.EMPTY)
)


def columns_at(result: VehicleResult, rows: I64) -> dict[str, I32]:
    """Return the vehicle's evidence at rows (R,) of the truth: columns `EVIDENCE` and `seen` (0 or 1), int32 (R,)."""
    at = np.searchsorted(result.row, rows)
    at[at == len(result.row)] = 0
    seen = result.row[at] == rows if len(result.row) else np.zeros(len(rows), np.bool_)
    columns = {name: np.where(seen, result.evidence[name][at], 0) for name in EVIDENCE if len(result.row)}
    columns = columns or {name: np.zeros(len(rows), np.int32) for name in EVIDENCE}
    columns["change_class"] = np.where(seen, columns["change_class"], int(ChangeClass.UNMEASURED))
    columns["seen"] = seen.astype(np.int32)
    return columns


def causes(true_class: NDArray[np.uint8], e: Mapping[str, I32], p: DetectParameters) -> Causes:
    """Return for each voxel why the vehicle did not say what is true, or `RIGHT`.

    Args:
        true_class: uint8 (R,).
        e: the vehicle's evidence there, of `columns_at`.
        p: the parameters that it decided with.
    """
    predicted, t = e["change_class"], true_class
    silent = predicted == int(ChangeClass.UNMEASURED)
    weak = (e["cells"] >= p.rules.weak_cells) & (e["cells"] < np.where(e["map_cells"] > 0, MIN_CELLS, p.new_cells))
    many = (e["map_cells"] == 0) & (e["cells"] >= p.new_cells)
    part = e["cells"] < 0.5 * e["map_cells"]
    cases = (
        (e["seen"] == 0, UNSEEN),
        (predicted == t, RIGHT),
        (silent & weak, FEW_CELLS),
        (silent & many, EDGE),
        (silent, FEW_RAYS),
        ((t == A) & (predicted == E) & (e["cells"] > 0), "empty: too few sub-cells met"),
        ((t == A) & (predicted == E), "empty: rays pass, nothing met"),
        ((t == E) & (predicted == A), "new: something stood or moved there"),
        ((t == M) & (predicted == N) & (e["cells"] < MIN_CELLS), "normal: too few sub-cells for a Gaussian"),
        ((t == M) & (predicted == N) & part, "normal: only a part of it seen"),
        ((t == M) & (predicted == N), "normal: the Gaussians are too alike"),
        ((t == M) & (predicted == D), "deleted: rays pass, too few sub-cells"),
        ((t == N) & (predicted == M) & part, "modified: only a part of it seen"),
        ((t == N) & (predicted == M), "modified: unlike the map's Gaussian"),
        ((t == N) & (predicted == D), "deleted: rays pass through what stands"),
        ((t == D) & (predicted == N) & (e["cells"] >= p.rules.weak_cells), "normal: points met where it stood"),
        ((t == D) & (predicted == N), "normal: too few rays passed"),
        ((t == D) & (predicted == M), "modified: something else met there"),
    )
    return np.select([case for case, _ in cases], [name for _, name in cases], OTHER)


BASE_DIFFERS: Final = "the base map differs from the truth's"
MARGINAL: Final = "marginal in the truth"
TOO_FAR: Final = "hardly observable"
SEASON: Final = "leaves or snow"
POSES: Final = "right with true poses"


@dataclass(frozen=True, slots=True)
class Loss:
    """One kind of error at one level.

    Attributes:
        true, predicted: names of the classes.
        voxels: how many.
        f1: what macro F1 would gain, in points, were they right.
        by_cause: how many voxels by cause, the most frequent first.
    """

    true: str
    predicted: str
    voxels: float
    f1: float
    by_cause: Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class LossCase:
    """What errors are looked for in: a world with its truth, base map and vehicles."""

    truth: Truth
    base: BaseMap
    vehicles: Sequence[VehicleResult]
    method: MethodParameters
    upload: Upload = "full"
    exact: "LossCase | None" = None
    """The same world and fleet with true poses: what is right there is wrong here because of the poses."""

    def in_base(self) -> NDArray[np.bool_]:
        """Return which voxels of the truth hold a Gaussian in the base map, bool (V,)."""
        return np.asarray(classes_of_maps(self.truth, self.base.tiles, self.base.tiles) == ChangeClass.NORMAL)


def single_losses(case: LossCase, vehicle: VehicleResult, level: Level) -> list[Loss]:
    """Return what costs F1 in the map of one vehicle alone."""
    predicted = predicted_by(case, [vehicle])
    rows = _wrong(case.truth, predicted, level)
    found = causes(case.truth.change_class[rows], columns_at(vehicle, rows), case.method.detect)
    same = [v for v in case.exact.vehicles if v.vehicle == vehicle.vehicle] if case.exact else []
    exact = predicted_by(case.exact, same) if case.exact else None
    return _losses(case, predicted, rows, found, level, exact)


def fleet_losses(case: LossCase, n: int, level: Level) -> list[Loss]:
    """Return what costs F1 in the merged map of the first n vehicles."""
    vehicles = case.vehicles[:n]
    predicted = predicted_by(case, vehicles, merge=True)
    rows = _wrong(case.truth, predicted, level)
    true = case.truth.change_class[rows]
    each = np.stack([causes(true, columns_at(vehicle, rows), case.method.detect) for vehicle in vehicles])
    reported = np.stack([columns_at(vehicle, rows)["change_class"] for vehicle in vehicles])
    exact = predicted_by(case.exact, case.exact.vehicles[:n], merge=True) if case.exact else None
    return _losses(case, predicted, rows, _vote_causes(true, reported, each, case.method.merge.xi), level, exact)


def predicted_by(case: LossCase, vehicles: Sequence[VehicleResult], *, merge: bool = False) -> ClassArray:
    """Return the class, uint8 (V,), of each voxel after the vehicles' reports, merged as they were sent, or of one
    vehicle alone.
    """
    parked_h, merging = case.method.parked_h, case.method.merge
    if merge:
        held = arrived(case.base, vehicles, merging, case.upload)
        final = merged_map(case.base, [body for one in held for body in one.bodies], merging, parked_h)
    else:
        bodies = [body for vehicle in vehicles for body in vehicle.reports]
        final = map_of_one(case.base, bodies, merging, parked_h)
    return classes_of_maps(case.truth, case.base.tiles, final)


def _vote_causes(true: NDArray[np.uint8], reported: NDArray[np.int32], each: Causes, xi: float) -> Causes:
    """How the votes (vehicles, R) fell, with the commonest cause among those that did not say what is true."""
    spoke = reported != int(ChangeClass.UNMEASURED)
    right, votes = (reported == true).sum(axis=0), spoke.sum(axis=0)
    found = []
    for r in range(len(true)):
        why = Counter(c for c in each[:, r].tolist() if c not in (RIGHT, UNSEEN)).most_common(1)
        detail = f" ({why[0][0]})" if why else ""
        found.append(_pattern(int(right[r]), int(votes[r]), xi, set(each[:, r].tolist())) + detail)
    return np.array(found or [""], dtype=np.str_)[: len(found)]


def _pattern(right: int, votes: int, xi: float, each: set[str]) -> str:
    if each == {UNSEEN}:
        return "observed by nobody"
    if votes == 0:
        return "nobody decides"
    if right > xi * votes:
        return "outvoted in the cloud though most are right"
    return "votes split" if right >= (1 - xi) * votes else "most say something else"


def _wrong(truth: Truth, predicted: ClassArray, level: Level) -> I64:
    return np.flatnonzero(truth.mask(level) & (predicted != truth.change_class))


def _losses(
    case: LossCase, predicted: ClassArray, rows: I64, found: Causes, level: Level, exact: ClassArray | None
) -> list[Loss]:
    truth, true = case.truth, case.truth.change_class[rows]
    names = _with_circumstances(case, rows, found, exact)
    mask = truth.mask(level)
    n = len(CLASSES)
    confusion = np.bincount(truth.change_class[mask].astype(np.int64) * n + predicted[mask], minlength=n * n)
    confusion = confusion.reshape(n, n)
    groups = []
    for t, p in sorted({(int(a), int(b)) for a, b in zip(true, predicted[rows], strict=True)}):
        of_group = names[(true == t) & (predicted[rows] == p)]
        by_cause = {str(name): float(k) for name, k in Counter(of_group.tolist()).most_common()}
        name = [CLASSES[i].name.lower() for i in (t, p)]
        groups.append(Loss(name[0], name[1], float(len(of_group)), _gain(confusion, t, p, level), by_cause))
    return sorted(groups, key=lambda loss: -loss.f1)


def _with_circumstances(case: LossCase, rows: I64, found: Causes, exact: ClassArray | None) -> Causes:
    """Causes with what the truth, the base map and a run with true poses say about the voxels."""
    if not len(rows):
        return found
    truth, true = case.truth, case.truth.change_class[rows]
    was_there = np.isin(true, (ChangeClass.NORMAL, ChangeClass.MODIFIED, ChangeClass.DELETED))
    if exact is not None:
        found = np.where(exact[rows] == true, np.char.add(f"{POSES}; ", found), found)
    names = np.where(truth.observable[rows], found, np.char.add(f"{TOO_FAR}; ", found))
    names = np.where(truth.seasonal[rows], np.char.add(f"{SEASON}; ", names), names)
    names = np.where(truth.clear[rows], names, np.char.add(f"{MARGINAL}; ", found))
    return np.where(was_there == case.in_base()[rows], names, BASE_DIFFERS)


def _gain(confusion: NDArray[np.int64], t: int, p: int, level: Level) -> float:
    """Macro F1 with the errors (t, p) put right, less macro F1 as it is."""
    right = confusion.copy()
    right[t, t] += right[t, p]
    right[t, p] = 0
    return Score(level, right).macro_f1 - Score(level, confusion).macro_f1


def mean_losses(many: Sequence[Sequence[Loss]]) -> list[Loss]:
    """Return the mean of several analyses: worlds, or vehicles of one sensor."""
    kinds = sorted({(loss.true, loss.predicted) for losses in many for loss in losses})
    found = []
    for true, predicted in kinds:
        same = [loss for losses in many for loss in losses if (loss.true, loss.predicted) == (true, predicted)]
        by_cause: Counter[str] = Counter()
        for loss in same:
            by_cause.update(loss.by_cause)
        means = {cause: round(k / len(many), 1) for cause, k in by_cause.most_common()}
        voxels, gain = (sum(getattr(loss, name) for loss in same) / len(many) for name in ("voxels", "f1"))
        found.append(Loss(true, predicted, round(voxels, 1), round(gain, 3), means))
    return sorted(found, key=lambda loss: -loss.f1)


def plain(losses: Sequence[Loss]) -> list[dict[str, Any]]:
    """Return losses as plain values."""
    return [
        {"true": x.true, "predicted": x.predicted, "voxels": x.voxels, "f1": x.f1, "by_cause": dict(x.by_cause)}
        for x in losses
    ]


def analyse(
    out: Path, stages: Sequence[str], levels: Sequence[Level], changes: Sequence[str] = (), exact: Path | None = None
) -> dict[str, Any]:
    """Return the losses by stage and level, means over the run's worlds (and over the vehicles of a sensor).

    Args:
        out: folder of the run.
        stages: "single", "single.<sensor>" or a number of vehicles; by default all that the run reports.
        levels: of the truth.
        changes: replaced parameters of the merge.
        exact: folder of the same run with true poses, which tells what the poses cost.

    Raises:
        FolderError: no finished run is in the folder.
        OptionError: no such stage.
    """
    mark = StudyFolder(out).finished()
    cases = _cases(out, mark, changes)
    if exact is not None:
        cases = _beside(cases, mark, exact, changes)
    sensors = sorted({vehicle.sensor for case in cases for vehicle in case.vehicles})
    wanted = list(stages) or [*(f"single.{sensor}" for sensor in sensors), *map(str, mark["options"]["vehicles"])]
    return {stage: {level: plain(_losses_at(cases, stage, level, sensors)) for level in levels} for stage in wanted}


def _cases(out: Path, mark: dict[str, Any], changes: Sequence[str]) -> list[LossCase]:
    method = from_mapping(MethodParameters, mark["options"]["method"]).with_changes(changes)
    options = mark["options"]
    return [_case(out, world, options["base"], method, options["upload"]) for world in mark["worlds"]]


def _beside(cases: Sequence[LossCase], mark: dict[str, Any], exact: Path, changes: Sequence[str]) -> list[LossCase]:
    """The cases with those of the run with true poses beside them."""
    other = StudyFolder(exact).finished()
    ignored = ("poses", "method", "pcd")
    differ = [k for k, v in mark["options"].items() if k not in ignored and other["options"].get(k) != v]
    if differ or other["options"]["poses"] != "true":
        raise OptionError(f"{exact} is not the same run with --poses true: {', '.join(differ) or 'poses'} differ")
    return [replace(a, exact=b) for a, b in zip(cases, _cases(exact, other, changes), strict=True)]


def _case(out: Path, world: dict[str, Any], base: str, method: MethodParameters, upload: Upload) -> LossCase:
    files = WorldFiles(out / world["folder"], base)
    vehicles = [read_result(out / v["file"], v["key"]) for v in world["vehicles"]]
    return LossCase(read_truth(files.truth), read_world_base(files), vehicles, method, upload)


def _losses_at(cases: Sequence[LossCase], stage: str, level: Level, sensors: Sequence[str]) -> list[Loss]:
    kind, _, sensor = stage.partition(".")
    if kind == "single" and (not sensor or sensor in sensors):
        return mean_losses([single_losses(c, v, level) for c in cases for v in c.vehicles if sensor in ("", v.sensor)])
    most = min(len(case.vehicles) for case in cases)
    if stage.isdecimal() and 1 <= int(stage) <= most:
        return mean_losses([fleet_losses(case, int(stage), level) for case in cases])
    raise OptionError(f"unknown stage {stage!r}: single, single.<{'|'.join(sensors)}>, or 1 … {most} vehicles")


@click.command()
@click.argument("out", type=PATH, default=Path("runs/reproduce-simulation"))
@click.option("--stage", "stages", multiple=True, help="single, single.<sensor>, or a number of vehicles; repeatable.")
@click.option("--level", "levels", multiple=True, type=click.Choice(get_args(Level)), help="[default: all three]")
@click.option("--causes", default=4, show_default=True, help="Causes shown of each kind of error.")
@click.option("--set", "changes", multiple=True, metavar="merge.FIELD=VALUE", help="Merge with other parameters.")
@click.option("--true-poses", "exact", type=PATH, help="Folder of the same run with --poses true: what poses cost.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def errors(
    out: Path,
    stages: tuple[str, ...],
    levels: tuple[Level, ...],
    causes: int,
    changes: tuple[str, ...],
    exact: Path | None,
    as_json: bool,
) -> None:
    """Show which voxels of the finished run in OUT cost F1, by true class, predicted class and cause."""
    found = analyse(out, stages, levels or LEVELS, changes, exact)
    if as_json:
        click.echo(json.dumps(found))
        return
    columns = {"predicted": "{predicted}", "voxels": "{voxels:g}", "F1 points": "{f1:.2f}", "causes": "{causes}"}
    for stage, by_level in found.items():
        for level, losses in by_level.items():
            table = sheet(f"{stage}, {level.replace('_', ' ')}: what costs F1", "true", *columns)
            for loss in losses:
                parts = [f"{k:g} {cause}" for cause, k in list(loss["by_cause"].items())[:causes]]
                row = {**loss, "causes": "\n".join(parts)}
                table.add(loss["true"], *(shown(cell, row) for cell in columns.values()))
            print_sheets([table])
