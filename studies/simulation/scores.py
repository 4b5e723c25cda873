"""Maps against the truth, the paper's figures and our targets; a finished reproduction as plain values."""

import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.merge import MergeParameters
from gnd.fleet_sim.evaluate import CLASSES, Evaluation, Score, Tiles, evaluate_maps, false_elsewhere, kept_changes
from gnd.fleet_sim.parking import near_lanes, on_parking
from gnd.fleet_sim.truth import CHANGES, LEVELS, Level, read_truth
from gnd.fleet_sim.world import read_world
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.config import to_mapping
from studies.frame.command import plain_options
from studies.simulation.cloud import arrived, map_of_one, merged_map
from studies.simulation.options import RunOptions, Upload
from studies.simulation.result import VehicleResult, read_result
from studies.simulation.worlds import WorldFiles, read_world_base

PAPER_STALE: Final = 37.36
SINGLE: Final = 88.05
FLEET: Final = {20: 99.62}
"""By number of vehicles. Figure 17 shows the curve at about 99 from nine vehicles on."""
FLEET_READ_OFF: Final = {9: 99.0}

TARGET_SENSORS: Final = ("vlp16", "hdl32e", "rs16", "rs32")
"""The target of a single drive is the mean over the sensors of 16 and 32 layers."""
MUST: Final = {"single": 94.0, "fleet.20": 97.0, "fleet.20.all": 90.0, "fleet.9.scored": 96.0, "fleet.20.scored": 97.0}
AIM: Final = {"single": 96.0, "fleet.20": 98.5, "fleet.20.all": 92.0, "fleet.9.scored": 99.0, "fleet.20.scored": 99.62}
"""Of observable voxels where no level is named. The paper's own F1 stands beside the scored ones."""


STALE = "stale"
FALSE_WHERE: Final = ("false_on_parking", "false_seasonal", "false_elsewhere")
"""Called new on parking lanes; called changed where only leaves or snow came or went; called new near the lanes where
no ray of the truth's dense scan came, as behind glass or under a wet road."""


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """One map compared with the truth.

    Attributes:
        confusion: matrices int64 (5, 5) by level, rows true, columns predicted.
        false_where: number of unchanged voxels that are called changed, by what is there, see `FALSE_WHERE`; of all
            voxels that the truth holds, and beside them.
    """

    confusion: dict[Level, NDArray[np.int64]]
    false_where: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, evaluation: Evaluation, false_where: Mapping[str, int] | None = None) -> "Scored":
        """Keep the matrices of an evaluation."""
        return cls({level: evaluation.scores[level].confusion for level in LEVELS}, false_where or {})

    def score(self, level: Level) -> Score:
        """Return the score of a level."""
        return Score(level, self.confusion[level])

    def f1(self, level: Level = "observable") -> float:
        """Return the macro F1 of a level, percent."""
        return self.score(level).macro_f1

    @property
    def kept(self) -> dict[Level, dict[str, float]]:
        """Share of the true changes that each level keeps, percent by class."""
        return kept_changes(self.confusion)


@dataclass(frozen=True, slots=True)
class VehicleFile:
    """A vehicle's result in the cache."""

    path: Path
    key: str

    def read(self) -> VehicleResult:
        """Read it."""
        return read_result(self.path, self.key)


class MapScorer:
    """Compares maps of one world with its truth."""

    def __init__(self, files: WorldFiles) -> None:
        self.base = read_world_base(files)
        self._truth, self._world = read_truth(files.truth), read_world(files.world)
        self._parking = on_parking(self._world, self._truth)

    def score(self, final: Tiles) -> Scored:
        """Return the score of what became of the base map."""
        truth, base = self._truth, self.base.tiles
        evaluation = evaluate_maps(truth, base, final)
        false = np.isin(evaluation.predicted, CHANGES) & ~np.isin(truth.change_class, CHANGES)
        parked = false & self._parking & (evaluation.predicted == ChangeClass.NEW)
        elsewhere = false_elsewhere(truth, base, final, partial(near_lanes, self._world))
        where = {"false_on_parking": parked, "false_seasonal": false & truth.seasonal}
        return Scored.of(evaluation, {n: int(v.sum()) for n, v in where.items()} | {"false_elsewhere": elsewhere})


def score_single(
    files: WorldFiles, vehicles: Sequence[VehicleFile], merge: MergeParameters, parked_h: float
) -> dict[str, Scored]:
    """Return the stale map's score and that of each vehicle alone, by name."""
    scorer = MapScorer(files)
    found = {STALE: scorer.score(scorer.base.tiles)}
    for vehicle in vehicles:
        result = vehicle.read()
        found[result.vehicle] = scorer.score(map_of_one(scorer.base, result.reports, merge, parked_h))
    return found


def score_fleet(
    files: WorldFiles,
    vehicles: Sequence[VehicleFile],
    numbers: Sequence[int],
    merge: MergeParameters,
    upload: Upload,
    parked_h: float,
) -> dict[int, Scored]:
    """Return the score of the merged map of the first n vehicles, for each n asked for."""
    scorer = MapScorer(files)
    base = scorer.base
    held = arrived(base, [vehicle.read() for vehicle in vehicles[: max(numbers)]], merge, upload)
    found = {}
    for n in numbers:
        bodies = [body for one in held[:n] for body in one.bodies]
        found[n] = scorer.score(merged_map(base, bodies, merge, parked_h))
    return found


def sent_bytes(
    files: WorldFiles, vehicles: Sequence[VehicleFile], merge: MergeParameters, upload: Upload
) -> tuple[list[int], list[int]]:
    """Return what each vehicle sends: one after the other to the same cloud, and each alone to a cloud of its own."""
    base, results = read_world_base(files), [vehicle.read() for vehicle in vehicles]
    together = [one.sent_bytes for one in arrived(base, results, merge, upload)]
    return together, [arrived(base, [result], merge, upload)[0].sent_bytes for result in results]


def score_pcd(files: WorldFiles, vehicles: Sequence[VehicleFile], numbers: Sequence[int]) -> dict[str | int, Scored]:
    """Return the baseline's scores: of each vehicle alone by name, of the first n vehicles by number."""
    from studies.simulation.baseline import Clouds, read_cloud

    clouds = Clouds(read_truth(files.truth), read_cloud(files.cloud))
    results = [vehicle.read() for vehicle in vehicles]
    found: dict[str | int, Scored] = {r.vehicle: Scored.of(clouds.score([r.pcd])) for r in results if r.pcd}
    return found | {n: Scored.of(clouds.score([r.pcd for r in results[:n] if r.pcd])) for n in numbers}


def target_single(found: Mapping[str, Any]) -> dict[str, float] | None:
    """Return the mean F1 of one drive over the 16- and 32-layer sensors that drove, by level; None if none did."""
    stages = [found["single"][sensor] for sensor in TARGET_SENSORS if sensor in found["single"]]
    if not stages:
        return None
    return {level: sum(stage["f1"][level] for stage in stages) / len(stages) for level in LEVELS}


def targets_of(found: Mapping[str, Any]) -> dict[str, dict[str, float | bool]]:
    """Return each target that this run can judge: our value, what it must reach and aims at, and whether it does."""
    values: dict[str, float] = {}
    single = target_single(found)
    if single is not None:
        values["single"] = single["observable"]
    for n, stage in found["fleet"].items():
        values[f"fleet.{n}"] = stage["f1"]["observable"]
        values |= {f"fleet.{n}.{level}": stage["f1"][level] for level in LEVELS}
    return {
        name: {"value": round(values[name], 4), "must": must, "aim": AIM[name], "met": values[name] >= must}
        for name, must in MUST.items()
        if name in values
    }


_DIGITS = 4
_OF_A_DRIVE = (
    "scans", "scans_used", "scans_uncertain", "points", "moving_points", "changed_voxels", "way_m", "poses",
    "segmentation",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class WorldOutcome:
    """What came of one world.

    Attributes:
        seed: the world's.
        files: where it lies.
        vehicles: results in the order of the fleet.
        kept: their files.
        asked: the numbers of vehicles that are reported.
        single: score of the stale map and of each vehicle alone, by name.
        fleet: score of the merged map by number of vehicles.
        sent: bytes that each vehicle sends, in their order: to the fleet's cloud, and to a cloud of its own.
        pcd: score of the point-cloud baseline: of each vehicle alone by name, of the fleet by number; empty without it.
    """

    seed: int
    files: WorldFiles
    vehicles: tuple[VehicleResult, ...]
    kept: tuple[VehicleFile, ...]
    asked: tuple[int, ...]
    single: dict[str, Scored]
    fleet: dict[int, Scored]
    sent: tuple[list[int], list[int]]
    pcd: dict[str | int, Scored]


@dataclass(frozen=True, slots=True, eq=False)
class SimulationOutcome:
    """A finished reproduction."""

    options: RunOptions
    worlds: tuple[WorldOutcome, ...]
    runtime_s: dict[str, float]


def summary_of(outcome: SimulationOutcome) -> dict[str, Any]:
    """Return everything as plain values; of several seeds the means, and each below `by_seed`."""
    by_seed = {str(world.seed): _world_summary(world) for world in outcome.worlds}
    found = mean_of(list(by_seed.values()))
    found["targets"] = targets_of(found)
    found["confusion"] = confusion_of(outcome.worlds)
    found["parameters"] = parameters_of(outcome)
    found["seeds"] = list(outcome.options.seeds)
    found["runtime_s"] = {name: round(value, 1) for name, value in outcome.runtime_s.items()}
    if len(by_seed) > 1:
        found["by_seed"] = by_seed
    return found


def parameters_of(outcome: SimulationOutcome) -> dict[str, Any]:
    """Return options and method; what decides the numbers."""
    options = plain_options(outcome.options)
    method = to_mapping(outcome.options.method)
    return {**{k: v for k, v in options.items() if k not in ("method", "seeds")}, "method": method}


def _world_summary(world: WorldOutcome) -> dict[str, Any]:
    by_sensor, largest = _by_sensor(world), world.fleet[max(world.asked)]
    return {
        "stale": _stage([world.single[STALE]]),
        "single": {sensor: _stage([world.single[name] for name in names]) for sensor, names in by_sensor.items()},
        "fleet": {str(n): _stage([scored]) for n, scored in world.fleet.items()},
        "kept": largest.kept,
        "false_per_1000": largest.score("observable").false_per_1000,
        **{name: largest.false_where[name] for name in FALSE_WHERE},
        "upload_bytes": _uploads(world, by_sensor),
        **({"pcd": _pcd(world, by_sensor)} if world.pcd else {}),
        "drives": {sensor: _drives(world, names) for sensor, names in by_sensor.items()},
    }


def _by_sensor(world: WorldOutcome) -> dict[str, list[str]]:
    """Names of the vehicles of each sensor."""
    found: dict[str, list[str]] = defaultdict(list)
    for vehicle in world.vehicles:
        found[vehicle.sensor].append(vehicle.vehicle)
    return dict(sorted(found.items()))


def _stage(maps: Sequence[Scored]) -> dict[str, Any]:
    """Mean over maps of F1 at the three levels and of the classes' scores at each, and of false changes."""
    return {
        "f1": {level: _mean(scored.f1(level) for scored in maps) for level in LEVELS},
        "changes_f1": {level: _mean(scored.score(level).changes_f1 for scored in maps) for level in LEVELS},
        "false_per_1000": mean_of([scored.score("observable").false_per_1000 for scored in maps]),
        **{name: _mean(float(scored.false_where.get(name, 0)) for scored in maps) for name in FALSE_WHERE},
        "classes": {level: mean_of([_classes(scored, level) for scored in maps]) for level in LEVELS},
    }


def _classes(scored: Scored, level: Any) -> dict[str, Any]:
    return {
        name: {"precision": s.precision, "recall": s.recall, "f1": s.f1}
        for name, s in scored.score(level).classes.items()
    }


def _uploads(world: WorldOutcome, by_sensor: Mapping[str, list[str]]) -> dict[str, Any]:
    """Bytes of the reports: a drive of each sensor, and the first n vehicles together."""
    together, alone = world.sent
    size = {vehicle.vehicle: size for vehicle, size in zip(world.vehicles, alone, strict=True)}
    return {
        "single": {sensor: _mean(float(size[name]) for name in names) for sensor, names in by_sensor.items()},
        "fleet": {str(n): sum(together[:n]) for n in world.fleet},
    }


def _pcd(world: WorldOutcome, by_sensor: Mapping[str, list[str]]) -> dict[str, Any]:
    """The baseline: scores, and bytes of its uploads by codec ("points" is the paper's)."""
    numbers = sorted(n for n in world.pcd if isinstance(n, int))
    size = [vehicle.stats["pcd_bytes"] for vehicle in world.vehicles]
    by_name = {vehicle.vehicle: vehicle.stats["pcd_bytes"] for vehicle in world.vehicles}
    return {
        "single": {sensor: _stage([world.pcd[name] for name in names]) for sensor, names in by_sensor.items()},
        "fleet": {str(n): _stage([world.pcd[n]]) for n in numbers},
        "upload_bytes": {
            "single": {sensor: mean_of([by_name[name] for name in names]) for sensor, names in by_sensor.items()},
            "fleet": {str(n): {codec: sum(one[codec] for one in size[:n]) for codec in size[0]} for n in numbers},
        },
    }


def _drives(world: WorldOutcome, names: Sequence[str]) -> dict[str, Any]:
    """Counts and pose errors, mean over the drives of one sensor."""
    stats = [vehicle.stats for vehicle in world.vehicles if vehicle.vehicle in names]
    return mean_of([{name: s[name] for name in _OF_A_DRIVE if s[name] is not None} for s in stats])


def confusion_of(worlds: Sequence[WorldOutcome]) -> dict[str, Any]:
    """Return the confusion matrices (Table 3), summed over worlds and vehicles: rows true, columns predicted."""
    stages: dict[str, Any] = {
        "classes": [c.name.lower() for c in CLASSES],
        "stale": _summed([world.single[STALE] for world in worlds]),
        "single": {},
        "fleet": {},
    }
    for sensor in sorted({vehicle.sensor for world in worlds for vehicle in world.vehicles}):
        maps = [w.single[v.vehicle] for w in worlds for v in w.vehicles if v.sensor == sensor]
        stages["single"][sensor] = _summed(maps)
    for n in worlds[0].fleet:
        stages["fleet"][str(n)] = _summed([world.fleet[n] for world in worlds])
    return stages


def _summed(maps: Sequence[Scored]) -> dict[str, list[list[int]]]:
    return {level: np.sum([scored.confusion[level] for scored in maps], axis=0).tolist() for level in LEVELS}


def mean_of(many: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the mean of nested tables of numbers, key by key; a key that some lack is the mean over the others."""
    keys = dict.fromkeys(key for one in many for key in one)
    return {key: _mean_value([one[key] for one in many if key in one]) for key in keys}


def _mean_value(values: Sequence[Any]) -> Any:
    if isinstance(values[0], Mapping):
        return mean_of(values)
    return values[0] if len(values) == 1 and isinstance(values[0], int) else _mean(float(value) for value in values)


def _mean(values: Iterable[float]) -> float:
    return round(statistics.fmean(values), _DIGITS)


# --- poses of several sources ----------------------------------------------------------------------------------------

MUST_LOSE_AT_MOST: Final = 1.0
"""Points of macro F1 that detection with the vehicles' own poses may lose against true poses."""


def rows_of(found: Mapping[str, Any]) -> dict[str, Mapping[str, float]]:
    """Return macro F1 by level of every row of a finished run's table: single drives by sensor, fleets by number."""
    rows: dict[str, Mapping[str, float]] = {f"single.{name}": stage["f1"] for name, stage in found["single"].items()}
    target = target_single(found)
    if target is not None:
        rows["single"] = target
    return rows | {f"fleet.{n}": stage["f1"] for n, stage in found["fleet"].items()}


def comparison_of(runs: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return all runs beside each other.

    Args:
        runs: the JSON of each run by the name of its source of poses; the first is compared with.

    Returns:
        `poses.<name>`: the run; `loss.<name>.<row>.<level>`: points of F1 that it loses against the first, negative
        where it gains; `worst.<name>`: the largest loss among observable voxels, its row, and whether that is little
        enough.
    """
    against, *others = runs
    exact, loss = rows_of(runs[against]), dict[str, dict[str, dict[str, float]]]()
    for name in others:
        rows = rows_of(runs[name])
        same = [row for row in exact if row in rows]
        loss[name] = {row: {k: round(exact[row][k] - rows[row][k], _DIGITS) for k in LEVELS} for row in same}
    worst = {name: worst_loss(rows) for name, rows in loss.items()}
    return {"against": against, "poses": dict(runs), "loss": loss, "worst": worst}


def worst_loss(loss: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Return the row that loses most among observable voxels, its points, and whether it meets `MUST_LOSE_AT_MOST`."""
    row = max(loss, key=lambda name: loss[name]["observable"])
    points = loss[row]["observable"]
    return {"row": row, "loss": points, "must": MUST_LOSE_AT_MOST, "met": points <= MUST_LOSE_AT_MOST}
