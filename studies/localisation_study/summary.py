"""A finished study as plain values: the JSON of `gnd reproduce localisation`."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from gnd.fleet_sim.street import street
from gnd.fleet_sim.truth import read_truth
from gnd.fleet_sim.world_summary import summary
from gnd.gnd_map.config import to_mapping
from studies.localisation_study import reference
from studies.localisation_study.options import StudyOptions
from studies.localisation_study.plan import FRESH, OUTDATED, UPDATED, WITHOUT
from studies.localisation_study.reference import QUANTITIES, STATISTICS
from studies.localisation_study.run import SeedOutcome, SensorOutcome, StudyOutcome
from studies.localisation_study.targets import targets_of, update_ratio
from studies.localisation_study.trials import trials_row
from studies.localisation_study.variants import VARIANTS
from studies.simulation.base_map import read_base
from studies.simulation.worlds import read_world_base

ROWS: Final[Mapping[str, tuple[str, str]]] = {
    "without_submap": (WITHOUT, "final"),
    "with_submap": (OUTDATED, "final"),
    "online": (OUTDATED, "online"),
    "after_update": (UPDATED, "online"),
    "after_update_with_submap": (UPDATED, "final"),
    "fresh": (FRESH, "online"),
    "fresh_with_submap": (FRESH, "final"),
}
"""Each row of the result: which run, and which of its poses."""
_DIGITS: Final = 6
_CHANGED: Final = ("new", "modified", "deleted")


def summary_of(outcome: StudyOutcome) -> dict[str, Any]:
    """Return everything as plain values: a sensor's rows at the top level, of several seeds the worst; each seed below
    `seeds`.
    """
    seeds = {str(one.plan.seed): seed_summary(one, outcome.options) for one in outcome.seeds}
    first = next(iter(seeds.values()))
    sensors = {sensor: worst_of([one[sensor] for one in seeds.values()]) for sensor in outcome.options.sensors}
    found: dict[str, Any] = rounded(sensors)
    found["targets"] = targets_of(found)
    found["paper"] = {name: limit.plain() for name, limit in reference.PAPER.items()}
    found["limits"] = {"paper": reference.PAPER_LIMITS.plain(), "ford_local": reference.FORD_LOCAL.plain()}
    found["world"] = first["world"] if len(seeds) == 1 else {name: one["world"] for name, one in seeds.items()}
    found["seeds"] = rounded(seeds)
    found["parameters"] = to_mapping(outcome.options) | {"poses": str(outcome.options.poses)}
    found["runtime_s"] = {name: round(value, 1) for name, value in outcome.runtime_s.items()}
    return found


def seed_summary(outcome: SeedOutcome, options: StudyOptions) -> dict[str, Any]:
    """Return the rows of each sensor and the facts of the world."""
    found: dict[str, Any] = {one.sensor: _sensor(one) for one in outcome.sensors}
    return found | {"world": _world(outcome, options)}


def _sensor(outcome: SensorOutcome) -> dict[str, Any]:
    runs = outcome.runs
    found: dict[str, Any] = {
        row: getattr(runs[name], which).row(runs[name].scans) for row, (name, which) in ROWS.items()
    }
    found["update_ratio"] = update_ratio(found)
    variants = {name: runs[name].final.row(runs[name].scans) for name in VARIANTS if name in runs}
    if variants:
        found["variants"] = variants
    if outcome.trials:
        found["reinitialisation"] = trials_row(outcome.trials)
    found["cpu_s"] = outcome.cpu_s
    return found


def _world(outcome: SeedOutcome, options: StudyOptions) -> dict[str, Any]:
    """What the world is like, and how large the three maps are."""
    plan = outcome.plan
    facts = summary(street(plan.seed, options.street))
    counts = read_truth(plan.files.truth).counts("all")
    changed = sum(counts[name] for name in _CHANGED)
    maps = {"outdated": read_world_base(plan.files), "updated": read_base(plan.updated.path)}
    maps["fresh"] = read_base(plan.fresh.path)
    return {
        "length_m": facts["length_m"],
        "edits": facts["edits"],
        "changed_share": changed / (changed + counts["normal"]),
        "voxels": counts,
        "gaussians": {name: sum(len(g) for g in one.tiles.values()) for name, one in maps.items()},
    }


def worst_of(many: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the worst of nested tables over seeds: errors and times at their largest, shares and counts of poses at
    their smallest; None (no pose at all) is worst.
    """
    return {key: _worst([one[key] for one in many if key in one], key) for key in many[0]}


_SMALLEST_IS_WORST: Final = frozenset({"coverage", "good_share", "poses", "right", "right_share"})


def _worst(values: Sequence[Any], key: str) -> Any:
    if any(value is None for value in values):
        return None
    if isinstance(values[0], Mapping):
        return worst_of(values)
    return min(values) if key in _SMALLEST_IS_WORST else max(values)


def rounded(value: Any) -> Any:
    """Return plain values with their floats rounded."""
    if isinstance(value, Mapping):
        return {key: rounded(one) for key, one in value.items()}
    return round(value, _DIGITS) if isinstance(value, float) else value


def triple(row: Mapping[str, Any], statistic: str) -> tuple[float, ...] | None:
    """Return longitudinal, lateral and heading error of a row; None where it has no pose."""
    assert statistic in STATISTICS
    if row[QUANTITIES[0]] is None:
        return None
    return tuple(row[quantity][statistic] for quantity in QUANTITIES)
