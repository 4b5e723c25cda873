"""`gnd reproduce hard-cases`: maps of the places, drives of the cases, in worker processes; what is done is kept."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any, Final

from gnd.fleet_sim.courses.course import CoursePlace
from gnd.fleet_sim.courses.drive import CourseConfig, CourseDrive
from gnd.fleet_sim.courses.places import place_of
from gnd.fleet_sim.courses.survey import survey_points
from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.config import to_mapping
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import covering_circle
from gnd.schemas.drive_mcap import DriveWriter
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from studies.frame.command import Bench, StudyReport, study
from studies.frame.kept import LOCALISER, SIMULATOR, Kept, key_of, sources_sha
from studies.frame.options import check, option, parts, seeds
from studies.frame.pool import Job
from studies.frame.tables import Sheet, sheet
from studies.hard_cases.cases import CASES
from studies.hard_cases.localising import run_case
from studies.hard_cases.scores import CaseResult, sensor_figures
from studies.localisation_study.localising import without_submaps
from studies.simulation.base_map import read_base, surveyed, write_base
from studies.simulation.options import SET, MethodParameters
from studies.simulation.streams import as_recorded

FORMAT: Final = "gnd.hard-cases"
SEEN_M: Final = 80.0
_VEHICLE: Final = (*LOCALISER, *(f"studies/hard_cases/{name}.py" for name in ("cases", "localising", "study")))
_MAPS: Final = (*SIMULATOR, "studies/hard_cases/study.py", "studies/simulation/base_map.py")


@dataclass(frozen=True, slots=True)
class HardOptions:
    """What to run."""

    seeds: tuple[int, ...] = seeds(11, text="Of places and drives, such as 11,12,13.")
    sensors: tuple[str, ...] = option(("vlp16", "scala"), "Each drives every case.", known=SHORT_NAMES)
    cases: tuple[str, ...] = option(tuple(CASES), "Only these, with commas between.", known=CASES)
    localise: LocaliserParameters = parts(
        lambda changes: MethodParameters().with_changes(changes).localise, changes=SET
    )
    shorter: float = option(1.0, "Share of the places' length, for a quick look.", span=(0.65, 1))

    def __post_init__(self) -> None:
        check(self)


@study(HardOptions, out="runs/hard-cases", keeps_drives=True)
def hard_cases(options: HardOptions, bench: Bench) -> StudyReport:
    """Localisation where it is hard: errors, wrong poses called good, honesty of the covariance, case by case.

    A second start with the same folder continues where the first ended, and drives again only what has changed.
    """
    root = bench.folder.root
    whole = [(case, sensor, seed) for seed in options.seeds for case in options.cases for sensor in options.sensors]
    tasks = {which: task_of(root, *which, options.localise, options.shorter) for which in whole}
    if bench.keep_drives:
        tasks = {w: replace(t, recording=root / "drives" / f"{'-'.join(map(str, w))}.mcap") for w, t in tasks.items()}
    missing = [t for t in tasks.values() if not t.kept.done or (t.recording and not t.recording.is_file())]
    maps = {task.base: task for task in missing if not task.base.is_file()}
    bench.run("maps", [Job(f"map {path.stem}", make_map, (task,)) for path, task in maps.items()])
    bench.run("drives", [Job(task.name, run_task, (task,)) for task in missing])
    found = figures_of(options, {which: task.kept.read(CaseResult) for which, task in tasks.items()})
    return StudyReport(found, [table_of(found)])


def figures_of(options: HardOptions, results: Mapping[tuple[str, str, int], CaseResult]) -> dict[str, Any]:
    """Return all figures as plain values, by case and sensor."""
    return {
        "format": FORMAT,
        "version": 1,
        "seeds": list(options.seeds),
        "sensors": list(options.sensors),
        "about": {case: CASES[case].about for case in options.cases},
        "cases": {
            case: {
                sensor: sensor_figures({seed: results[case, sensor, seed] for seed in options.seeds})
                for sensor in options.sensors
            }
            for case in options.cases
        },
    }


# --- work of the processes -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CaseTask:
    """One case, driven by one sensor over the place of one seed.

    Attributes:
        case, sensor, seed: which; of the sensor its short name.
        base: file of the map.
        kept: the result.
        parameters: of the localiser.
        shorter: share of the usual length of the place.
        recording: where to keep the drive as MCAP, None for nowhere.
    """

    case: str
    sensor: str
    seed: int
    base: Path
    kept: Kept
    parameters: LocaliserParameters
    shorter: float = 1.0
    recording: Path | None = None

    @property
    def name(self) -> str:
        """What the task is called."""
        return f"{self.case} {self.sensor} {self.seed}"

    def place(self) -> CoursePlace:
        """Return the place, made anew."""
        case = CASES[self.case]
        return place_of(case.place, self.seed, case.length_m * self.shorter)


def task_of(
    root: Path, case: str, sensor: str, seed: int, parameters: LocaliserParameters, shorter: float = 1.0
) -> CaseTask:
    """Return a task with the files of its map and its result under a folder."""
    hard = CASES[case]
    name, length_m = ("street" if hard.place == "rebuilt" else hard.place), hard.length_m * shorter
    map_key = key_of(place=name, seed=seed, length_m=length_m, sources=sources_sha(_MAPS))
    base = Kept(root / "maps", f"{name}-{seed}", map_key).path
    decides = {"case": case, "sensor": sensor, "seed": seed, "localise": to_mapping(parameters)}
    key = key_of(map=map_key, sources=sources_sha(_VEHICLE), **decides)
    return CaseTask(case, sensor, seed, base, Kept(root / "runs", f"{case}-{sensor}-{seed}", key), parameters, shorter)


def make_map(task: CaseTask) -> None:
    """Survey the state before of a task's place, once for all that drive there."""
    place = task.place()
    world, reach_m = place.world, place.world.half_length_m + 2 * SEEN_M
    grid = GridFrame.around(world.frame, covering_circle(world.lat_rad, world.lon_rad, reach_m))
    accumulator = VoxelAccumulator(grid)
    for points_m in survey_points(place):
        accumulator.add(points_m)
    task.base.parent.mkdir(parents=True, exist_ok=True)
    write_base(surveyed(accumulator.finish()), task.base)


def run_task(task: CaseTask) -> None:
    """Drive a case and run the localiser over it, with and without submaps."""
    hard, begun_s = CASES[task.case], process_time()
    seed = 1_000_003 * task.seed + list(SHORT_NAMES).index(task.sensor)  # the same whatever else is driven
    drive = CourseDrive(hard.course(task.place(), task.seed), CourseConfig(SHORT_NAMES[task.sensor], seed))
    header, items = drive.header(), [as_recorded(item) for item in drive.items()]
    if task.recording is not None:
        task.recording.parent.mkdir(parents=True, exist_ok=True)
        with DriveWriter(task.recording, header) as writer:
            for item in items:
                writer.add(item)
    seconds, base = {"simulated": process_time() - begun_s}, read_base(task.base)
    run, begun_s = partial(run_case, header, items, base, kidnap=hard.kidnap, seed=task.seed), process_time()
    with_submaps, middle_s = run(parameters=task.parameters), process_time()
    without = run(parameters=without_submaps(task.parameters))
    seconds |= {"with": middle_s - begun_s, "without": process_time() - middle_s}
    task.kept.write(CaseResult(with_submaps, without, seconds))


# --- table -----------------------------------------------------------------------------------------------------------


def table_of(found: Mapping[str, Any]) -> Sheet:
    """Return the table; rows with a wrong pose called good are bold."""
    title = f"Hard cases, seeds {', '.join(map(str, found['seeds']))}: 95 % along / across / heading"
    poses = ("{} cm, °", "wrong called good", "right called bad %", "NEES")
    heads = [head.format(name) for name in ("refined", "online") for head in poses]
    table = sheet(title, "case", "sensor", *heads, "no submaps cm, °", "CPU s")
    for case, sensors in found["cases"].items():
        for sensor, row in sensors.items():
            cells = [cell for name in ("refined", "online") for cell in _cells(row[name])]
            lies = any(row[name]["wrong_called_good"] for name in ("refined", "online"))
            last = _errors(row["without_submaps"]["refined"]), f"{row['cpu_s']:.0f}"
            table.add(case, sensor, *cells, *last, style="bold" if lies else "")
    return table


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    wrong, nees = row["wrong_called_good"], row["nees"]
    shown = "" if nees is None else f"{nees['place']:.1f} / {nees['heading']:.1f}"
    return _errors(row), f"{wrong} of {row['poses']}", f"{100 * row['right_called_bad']:.1f}", shown


def _errors(row: Mapping[str, Any]) -> str:
    if row["longitudinal_m"] is None:
        return "no pose"
    along, across, heading = (row[name]["p95"] for name in ("longitudinal_m", "lateral_m", "heading_deg"))
    return f"{100 * along:.1f} / {100 * across:.1f} / {heading:.2f}"
