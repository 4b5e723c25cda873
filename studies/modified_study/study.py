"""`gnd reproduce modified`: rows of worlds and recordings never trained on, judged by each rule."""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any, Final

from gnd.fleet_sim.families.names import FAMILY_NAMES, RESERVED
from gnd.fleet_sim.truth import LEVELS
from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.detect.shape_change import SIMILARITY, Forest, fitted, forest_from
from studies.frame.command import Bench, StudyReport, study
from studies.frame.kept import SIMULATOR, Kept, key_of, sources_sha
from studies.frame.options import check, option
from studies.frame.pool import Job
from studies.frame.tables import Sheet, sheet
from studies.modified_study.recorded import RecordingSpec, rows_of_recording
from studies.modified_study.rows import Mask, Method, ShapeRows, joined
from studies.modified_study.rules import figures_of
from studies.modified_study.simulated import DriveSpec, WorldRows, WorldSpec, rows_of_world
from studies.modified_study.sources import RECORDED_TESTS, RECORDED_TRAINING, SEEN, SENSORS, TRAINING, UNSEEN
from studies.pcd.points import SIMILAR
from studies.pcd.shapes import cloud_model
from studies.real.study import RealOptions

STREET_LIMIT: Final = -0.4
"""Log-odds from which on the trees that knew simulated streets alone said "modified" (decision 42)."""
_DETECTION: Final = tuple(
    f"vehicle_agent/detect/{name}.py"
    for name in ("detector", "kernel", "fit_kernel", "evidence", "parameters", "uncertainty")
)
_SIMULATED: Final = (
    *SIMULATOR,
    *_DETECTION,
    "vehicle_agent/segment",
    *(f"studies/pcd/{name}.py" for name in ("detector", "index", "kernel", "merge", "points", "report", "shapes")),
    "studies/simulation/poses.py",
    "studies/modified_study/simulated.py",
    "studies/modified_study/rows.py",
)
_RECORDED: Final = (*_SIMULATED, "vehicle_agent/importers", "studies/real", "studies/modified_study/recorded.py")
_FAMILIES: Final = {"families": FAMILY_NAMES, "reserved": RESERVED}
Rule = Callable[[F64], Mask]


@dataclass(frozen=True, slots=True)
class ModifiedOptions:
    """What is judged."""

    recordings: Path | None = option(None, "Folder that holds kitti_raw_0027 and kitti_raw_0060, judged too.", of=Path)
    families: tuple[str, ...] = option(
        (), "Only worlds of these families, for a quick look.", known=FAMILY_NAMES, some=False
    )

    def __post_init__(self) -> None:
        check(self)


@study(ModifiedOptions, out="runs/modified")
def modified(options: ModifiedOptions, bench: Bench) -> StudyReport:
    """How well "modified" is decided: trees, trees of simulated streets alone, one threshold; the baseline beside.

    Single drives through worlds, by sensors and on recordings that nothing was fitted on. A second start with the same
    folder continues where the first ended.
    """
    wanted = options.families
    tests = [spec for spec in (*SEEN, *UNSEEN, *SENSORS) if not wanted or spec.family in wanted]
    worlds = world_rows(bench, tests)
    recordings = recording_rows(bench, RECORDED_TESTS, options.recordings)
    groups: dict[Method, dict[str, ShapeRows]] = {
        "gnd": _by_family(tests, worlds, "gnd") | _by_sensor(worlds) | recordings,
        "cloud": _by_family(tests, worlds, "cloud"),
    }
    found = {method: _judged(groups[method], rules_of(method)) for method in groups}
    return StudyReport({"rules": found}, [sheet_of_rules(method, found[method]) for method in found])


# --- rows ------------------------------------------------------------------------------------------------------------


def world_rows(bench: Bench, specs: Iterable[WorldSpec]) -> dict[WorldSpec, WorldRows]:
    """The rows of worlds, each made once in the bench's folder."""
    sources = sources_sha(_SIMULATED)
    kept = {
        spec: Kept(bench.folder.root / "worlds", f"{spec.family}-{spec.seed}", key_of(spec=asdict(spec), by=sources))
        for spec in specs
    }
    bench.run("worlds", [Job(s.name, write_world_rows, (s, one)) for s, one in kept.items() if not one.done])
    return {spec: one.read(WorldRows) for spec, one in kept.items()}


def write_world_rows(spec: WorldSpec, kept: Kept) -> None:
    """Collect the rows of a world, in a worker process."""
    kept.write(rows_of_world(spec))


def recording_rows(bench: Bench, specs: Iterable[RecordingSpec], home: Path | None) -> dict[str, ShapeRows]:
    """The rows of recordings by the recording's name, all its ways of being divided together; none without a folder."""
    if home is None:
        return {}
    sources = sources_sha(_RECORDED)
    kept = {
        spec: Kept(
            bench.folder.root / "recordings", f"{spec.folder}-{spec.split}", key_of(spec=asdict(spec), by=sources)
        )
        for spec in specs
    }
    missing = [Job(s.name, write_recording_rows, (s, home, one)) for s, one in kept.items() if not one.done]
    bench.run("recordings", missing)
    names = dict.fromkeys(spec.folder for spec in kept)
    return {n: joined(one.read(ShapeRows) for spec, one in kept.items() if spec.folder == n) for n in names}


def write_recording_rows(spec: RecordingSpec, home: Path, kept: Kept) -> None:
    """Collect the rows of a recording, in a worker process."""
    kept.write(rows_of_recording(spec, RealOptions(home / spec.folder, split=spec.split)))


def training_rows(bench: Bench, method: Method, home: Path | None) -> dict[str, ShapeRows]:
    """The sources of a fit: families of worlds and, for our detector, recordings."""
    worlds = world_rows(bench, TRAINING)
    recordings = recording_rows(bench, RECORDED_TRAINING, home) if method == "gnd" else {}
    return _by_family(TRAINING, worlds, method) | recordings


def _by_family(
    specs: Iterable[WorldSpec], worlds: Mapping[WorldSpec, WorldRows], method: Method
) -> dict[str, ShapeRows]:
    """Rows by family; of the worlds with other sensors none."""
    parts: dict[str, list[ShapeRows]] = {}
    for spec in specs:
        if spec not in SENSORS:
            parts.setdefault(spec.family, []).extend(worlds[spec].of(method))
    return {family: joined(rows) for family, rows in parts.items()}


def _by_sensor(worlds: Mapping[WorldSpec, WorldRows]) -> dict[str, ShapeRows]:
    """Rows of the sensors that no fit has seen."""
    parts: dict[DriveSpec, list[ShapeRows]] = {}
    for spec, found in worlds.items():
        for drive, rows in zip(spec.drives, found.gnd, strict=True) if spec in SENSORS else ():
            parts.setdefault(drive, []).append(rows)
    return {drive.sensor: joined(rows) for drive, rows in parts.items()}


# --- rules -----------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def street_trees() -> Forest:
    """Return the sixty trees before: of simulated streets alone, scored voxels three times."""
    text = (files("studies.modified_study") / "street_trees.json").read_text(encoding="utf-8")
    return forest_from(json.loads(text))


def rules_of(method: Method) -> dict[str, Rule]:
    """What is compared."""
    if method == "cloud":
        return {
            f"similarity below {SIMILAR:g} (before)": lambda features: features[:, SIMILARITY] < SIMILAR,
            "one threshold": cloud_model().plain.reshaped,
            "trees": cloud_model().reshaped,
        }
    return {
        "trees of streets alone (before)": lambda features: street_trees().log_odds(features) > STREET_LIMIT,
        "one threshold": fitted().plain.reshaped,
        "trees": fitted().reshaped,
    }


def _judged(groups: Mapping[str, ShapeRows], rules: Mapping[str, Rule]) -> dict[str, Any]:
    features = {name: rows.features for name, rows in groups.items()}
    return {
        label: figures_of(groups, {name: rule(held) for name, held in features.items()}, LEVELS, _FAMILIES)
        for label, rule in rules.items()
    }


def sheet_of_rules(method: str, found: Mapping[str, Any]) -> Sheet:
    """Give one row a group: precision, recall and F1 of "modified" by each rule, F1 at the other levels beside."""
    title = {"gnd": "our detector", "cloud": "the point-cloud baseline"}[method]
    columns = [f"{label}: {what}" for label in found for what in ("P / R / **F1**", "all", "scored")]
    table = sheet(f'"Modified", single drives, {title}', "", *columns)
    names = next(iter(found.values()))["observable"]["by"]
    for name in names:
        cells = []
        for rule in found.values():
            row = rule["observable"]["by"][name]
            cells.append(f"{row['precision']:.1f} / {row['recall']:.1f} / {row['f1']:.1f}")
            cells += [f"{rule[level]['by'][name]['f1']:.1f}" for level in ("all", "scored")]
        table.add(name, *cells)
    first = next(iter(found.values()))["observable"]["over"]
    for what, key in product(first, ("mean_f1", "worst_f1")):
        cells = [
            f"{rule[level]['over'][what][key]:.1f}"
            for rule in found.values()
            for level in ("observable", "all", "scored")
        ]
        table.add(f"{key.removesuffix('_f1')} of {what}", *cells, style="bold")
    return table
