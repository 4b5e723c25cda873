"""A finished study: plain values (the JSON of `gnd reproduce localisation`), what it reached, and its tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import tau
from pathlib import Path
from typing import Any, Final

from gnd.fleet_sim.drives import DriveConfig
from gnd.fleet_sim.sensors import MODELS, SHORT_NAMES
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.truth import read_truth
from gnd.fleet_sim.world_summary import summary
from gnd.gnd_map.config import to_mapping
from studies.frame.averages import rounded, worst_of
from studies.frame.tables import Sheet, sheet
from studies.localisation_study.localising import FRESH, OUTDATED, UPDATED, WITHOUT, LocalisedVariant
from studies.localisation_study.series import (
    AIM_REINITIALISED,
    AIM_TURNING,
    AIM_WINDOW,
    FORD_LOCAL,
    MUST_REINITIALISED,
    MUST_TURNING,
    MUST_UPDATE_RATIO,
    MUST_WINDOW,
    PAPER,
    PAPER_LIMITS,
    PAPER_OF_ROW,
    QUANTITIES,
    STATISTICS,
    ErrorLimit,
)  # fmt: skip
from studies.localisation_study.trials import WITHIN_S, StartTrial, trials_row
from studies.simulation.base_map import read_base


@dataclass(frozen=True, slots=True, eq=False)
class SensorOutcome:
    """What came of one sensor: runs by name, their seconds of CPU, trials."""

    sensor: str
    drive: DriveConfig
    runs: Mapping[str, LocalisedVariant]
    cpu_s: Mapping[str, float]
    trials: Sequence[StartTrial]


@dataclass(frozen=True, slots=True, eq=False)
class LocalisationSeed:
    """What came of one seed: the files of its truth and of its maps (outdated, updated, fresh), and its sensors."""

    seed: int
    truth: Path
    maps: Mapping[str, Path]
    sensors: tuple[SensorOutcome, ...]


@dataclass(frozen=True, slots=True, eq=False)
class LocalisationOutcome:
    """A finished study; `options` are those of `studies.localisation_study.study`."""

    options: Any
    seeds: tuple[LocalisationSeed, ...]
    runtime_s: Mapping[str, float]


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


def summary_of(outcome: LocalisationOutcome) -> dict[str, Any]:
    """Return everything as plain values: a sensor's rows at the top level, of several seeds the worst; each seed below
    `seeds`.
    """
    seeds = {str(one.seed): seed_summary(one, outcome.options.street) for one in outcome.seeds}
    first = next(iter(seeds.values()))
    sensors = {
        sensor: worst_of([one[sensor] for one in seeds.values()], SMALLEST_IS_WORST)
        for sensor in outcome.options.sensors
    }
    found: dict[str, Any] = rounded(sensors)
    found["targets"] = targets_of(found)
    found["paper"] = {name: limit.plain() for name, limit in PAPER.items()}
    found["limits"] = {"paper": PAPER_LIMITS.plain(), "ford_local": FORD_LOCAL.plain()}
    found["world"] = first["world"] if len(seeds) == 1 else {name: one["world"] for name, one in seeds.items()}
    found["seeds"] = rounded(seeds)
    found["parameters"] = to_mapping(outcome.options) | {"poses": str(outcome.options.poses)}
    found["runtime_s"] = {name: round(value, 1) for name, value in outcome.runtime_s.items()}
    return found


def seed_summary(outcome: LocalisationSeed, options: StreetOptions) -> dict[str, Any]:
    """Return the rows of each sensor and the facts of the world."""
    found: dict[str, Any] = {one.sensor: _sensor(one) for one in outcome.sensors}
    return found | {"world": _world(outcome, options)}


def _sensor(outcome: SensorOutcome) -> dict[str, Any]:
    runs = outcome.runs
    found: dict[str, Any] = {
        row: getattr(runs[name], which).row(runs[name].scans) for row, (name, which) in ROWS.items()
    }
    found["update_ratio"] = update_ratio(found)
    if outcome.trials:
        found["reinitialisation"] = trials_row(outcome.trials)
    found["cpu_s"] = outcome.cpu_s
    return found


def _world(outcome: LocalisationSeed, options: StreetOptions) -> dict[str, Any]:
    """What the world is like, and how large the three maps are."""
    facts = summary(street(outcome.seed, options))
    counts = read_truth(outcome.truth).counts("all")
    changed = sum(counts[name] for name in _CHANGED)
    maps = {name: read_base(path) for name, path in outcome.maps.items()}
    return {
        "length_m": facts["length_m"],
        "edits": facts["edits"],
        "changed_share": changed / (changed + counts["normal"]),
        "voxels": counts,
        "gaussians": {name: sum(len(g) for g in one.tiles.values()) for name, one in maps.items()},
    }


SMALLEST_IS_WORST: Final = ("coverage", "good_share", "poses", "right", "right_share")


def sensors_of(found: Mapping[str, Any]) -> list[str]:
    """Return the sensors of a result."""
    return [name for name in found if name in SHORT_NAMES]


def within(row: Mapping[str, Any], limit: ErrorLimit, *statistics: str) -> bool:
    """Return whether a row's errors lie within a limit; a row without poses does not."""
    if row[QUANTITIES[0]] is None:
        return False
    return all(
        row[quantity][statistic] <= getattr(limit, statistic)[i]
        for i, quantity in enumerate(QUANTITIES)
        for statistic in statistics or STATISTICS
    )


def targets_of(found: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return for each sensor which targets it meets, and the ratio of errors after the update to those on a fresh map.

    Args:
        found: rows of each sensor by name.
    """
    return {sensor: _of_sensor(sensor, found[sensor]) for sensor in sensors_of(found)}


def _of_sensor(sensor: str, rows: Mapping[str, Any]) -> dict[str, Any]:
    around = MODELS[SHORT_NAMES[sensor]].span_rad == tau
    must = MUST_TURNING if around else MUST_WINDOW
    aim = AIM_TURNING if around else AIM_WINDOW
    ratio = rows["update_ratio"]
    with_submap = rows["with_submap"]
    targets: dict[str, Any] = {
        "with_submap": {"must": within(with_submap, must), "aim": within(with_submap, aim)},
        "paper_limits": {name: within(row, PAPER_LIMITS) for name, row in _error_rows(rows).items()},
        "ford_local": {name: within(row, FORD_LOCAL) for name, row in _error_rows(rows).items()},
        "after_update": {"ratio": ratio, "must": ratio is not None and _not_worse(ratio)},
    }
    starts = rows.get("reinitialisation")
    if starts:
        safe = starts["wrong_called_good"] == 0
        targets["reinitialisation"] = {
            "must": safe and starts["right_share"] >= MUST_REINITIALISED,
            "aim": safe and starts["right_share"] >= AIM_REINITIALISED,
        }
    return targets


def _error_rows(rows: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    return {name: row for name, row in rows.items() if isinstance(row, Mapping) and "coverage" in row}


def update_ratio(rows: Mapping[str, Any]) -> dict[str, float] | None:
    """Return by quantity the online 95 % error on the updated map over that on the fresh map; None without poses."""
    after, fresh = rows["after_update"], rows["fresh"]
    if after[QUANTITIES[0]] is None or fresh[QUANTITIES[0]] is None:
        return None
    return {q: round(after[q]["p95"] / max(fresh[q]["p95"], 1e-9), 4) for q in QUANTITIES}


def _not_worse(ratio: Mapping[str, float]) -> bool:
    return all(value <= MUST_UPDATE_RATIO for value in ratio.values())


ROW_LABELS: Final[Mapping[str, str]] = {
    "without_submap": "without submap",
    "with_submap": "with submap",
    "online": "online, outdated map",
    "after_update": "online, updated map",
    "after_update_with_submap": "with submap, updated map",
    "fresh": "online, fresh map",
    "fresh_with_submap": "with submap, fresh map",
}
HEAD: Final = (
    "",
    "longitudinal m",
    "lateral m",
    "heading °",
    "coverage",
    "paper's limits",
    "Ford, local street",
    "good, but wrong",
)


def sheets_of(found: Mapping[str, Any]) -> list[Sheet]:
    """Return the tables: the worlds, then one a sensor, the paper's rows below ours."""
    worlds = {seed: one["world"] for seed, one in found["seeds"].items()}
    head = Sheet("Localisation in a changed world")
    head.notes += [f"world {seed}: {world_line(world)}" for seed, world in worlds.items()]
    head.notes += ["Of every number the worst of the worlds."] if len(worlds) > 1 else []
    return [head, *(_sheet(sensor, found[sensor]) for sensor in sensors_of(found))]


def _sheet(sensor: str, rows: Mapping[str, Any]) -> Sheet:
    table = sheet(f"{sensor}: 95 % / maximum", *HEAD)
    for name, label in ROW_LABELS.items():
        table.add(*_cells(label, rows[name]))
        for paper in PAPER_OF_ROW.get(name, ()):
            number, _, what = paper.partition("_")
            theirs = f"paper, {number.replace('table', 'Table ')}, {what.replace('_', ' ')}"
            table.add(*_cells(theirs, PAPER[paper].plain()), style="dim")
    table.notes += [line for line in (update_line(rows), starts_line(rows)) if line]
    return table


def _cells(label: str, row: Mapping[str, Any]) -> list[str]:
    """A row of ours, or one of the paper's, which tells neither coverage nor health."""
    pairs = [row[q] for q in QUANTITIES]
    errors = ["no pose" if one is None else f"{one['p95']:.4f} / {one['max']:.4f}" for one in pairs]
    limits = [
        " / ".join("pass" if within(row, limit, statistic) else "FAIL" for statistic in STATISTICS)
        for limit in (PAPER_LIMITS, FORD_LOCAL)
    ]
    coverage = f"{100 * row['coverage']:.1f} %" if "coverage" in row else ""
    return [label, *errors, coverage, *limits, str(row.get("wrong_called_good", ""))]


def starts_line(rows: Mapping[str, Any]) -> str:
    """Return a sentence about the starts without a pose; empty where there were none."""
    row = rows.get("reinitialisation")
    if not row:
        return ""
    after = row["good_after_s"]
    seconds = "" if after["p50"] is None else f"; good after {after['p50']:.1f} s (half), {after['p95']:.1f} s (95 %)"
    return (
        f"{row['trials']} starts 2.5 m off, any heading: {row['right']} right within {WITHIN_S:g} s"
        f" ({100 * row['right_share']:.1f} %), {row['never_good']} never good,"
        f" {row['wrong_called_good']} ever good while wrong{seconds}"
    )


def update_line(rows: Mapping[str, Any]) -> str:
    """Return a sentence on the updated map against a fresh one."""
    ratio = rows["update_ratio"]
    if ratio is None:
        return "updated map against a fresh one: no poses"
    shown = " / ".join(f"{ratio[quantity]:.2f}" for quantity in QUANTITIES)
    return f"95 % online, updated map over fresh map: {shown} (at most {MUST_UPDATE_RATIO})"


def world_line(world: Mapping[str, Any]) -> str:
    """Return a sentence on a world."""
    edits = sum(n for edit, n in world["edits"].items() if edit != "kept")
    return f"{world['length_m']:g} m, {edits} edits, {100 * world['changed_share']:.1f} % of the Gaussians changed"
