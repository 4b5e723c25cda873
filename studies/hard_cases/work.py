"""What worker processes do: make the map of a place, drive a case."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any, Final

from gnd.fleet_sim.courses.course import Place
from gnd.fleet_sim.courses.drive import CourseConfig, CourseDrive
from gnd.fleet_sim.courses.places import place_of
from gnd.fleet_sim.courses.survey import survey_points
from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.config import to_mapping
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import covering_circle
from gnd.schemas.drive import DriveHeader, DriveItem
from gnd.schemas.drive_mcap import DriveWriter
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from studies.hard_cases.cases import CASES, HardCase
from studies.hard_cases.localising import CaseRun, ClockOffset, Poses, run_case
from studies.localisation_study.kept import Kept, read_arrays, write_arrays
from studies.localisation_study.localising import without_submaps
from studies.simulation.base_map import read_base, surveyed, write_base
from studies.simulation.errors import FolderError
from studies.simulation.sources import SIMULATOR, key_of, sources_sha
from studies.simulation.streams import as_recorded

SEEN_M: Final = 80.0
_VEHICLE: Final = (
    *SIMULATOR,
    "vehicle_agent/localise",
    *(
        f"vehicle_agent/{name}.py"
        for name in ("local_map", "pipeline", "place", "scans", "surroundings", "tiles_at_hand")
    ),
    *(f"studies/hard_cases/{name}.py" for name in ("cases", "localising", "work")),
)
_MAPS: Final = (*SIMULATOR, "studies/hard_cases/work.py", "studies/simulation/base_map.py")
_RUNS: Final = ("with", "without")
_SERIES: Final = ("refined", "online")
_COLUMNS: Final = ("t_ns", "error", "covariance", "health")


@dataclass(frozen=True, slots=True)
class CaseTask:
    """One case, driven by one sensor over the place of one seed.

    Attributes:
        case: its name.
        sensor: short name.
        seed: of place and drive.
        base: file of the map.
        kept: the result.
        parameters: of the localiser.
        shorter: share of the usual length of the place, for a quick look.
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

    def place(self) -> Place:
        """Return the place, made anew."""
        return _place(CASES[self.case], self.seed, self.shorter)


@dataclass(frozen=True, slots=True)
class CaseResult:
    """What came of a task: runs with and without submaps, seconds of CPU of simulator and of both runs."""

    with_submaps: CaseRun
    without_submaps: CaseRun
    seconds: dict[str, float]


def _place(case: HardCase, seed: int, shorter: float) -> Place:
    return place_of(case.place, seed, case.length_m * shorter)


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
    course = hard.course(task.place(), task.seed)
    drive = CourseDrive(course, CourseConfig(SHORT_NAMES[task.sensor], _drive_seed(task)))
    header, items = drive.header(), [as_recorded(item) for item in drive.items()]
    if task.recording is not None:
        _record(header, items, task.recording)
    seconds, base, runs = {"simulated": process_time() - begun_s}, read_base(task.base), list[CaseRun]()
    for name, parameters in zip(_RUNS, (task.parameters, without_submaps(task.parameters)), strict=True):
        begun_s = process_time()
        runs.append(run_case(header, items, base, parameters, hard.kidnap, task.seed))
        seconds[name] = process_time() - begun_s
    _write(CaseResult(runs[0], runs[1], seconds), task.kept)


def _record(header: DriveHeader, items: Sequence[DriveItem], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with DriveWriter(path, header) as writer:
        for item in items:
            writer.add(item)


def _drive_seed(task: CaseTask) -> int:
    """Another drive for each sensor, the same whatever else is driven."""
    return 1_000_003 * task.seed + list(SHORT_NAMES).index(task.sensor)


def _write(result: CaseResult, kept: Kept) -> None:
    runs = dict(zip(_RUNS, (result.with_submaps, result.without_submaps), strict=True))
    arrays = {
        f"{name}_{series}_{column}": getattr(getattr(run, series), column)
        for name, run in runs.items()
        for series in _SERIES
        for column in _COLUMNS
    }
    clocks = {n: None if r.clock is None else [r.clock.offset_s, r.clock.sigma_s] for n, r in runs.items()}
    head: dict[str, Any] = {"scans": result.with_submaps.scans, "seconds": result.seconds, "clocks": clocks}
    write_arrays(kept, head, arrays)


def read_result(kept: Kept) -> CaseResult:
    """Read a result.

    Raises:
        FolderError: it is missing or damaged.
    """
    head, data = read_arrays(kept)
    try:
        runs = [_run(name, head, data) for name in _RUNS]
        return CaseResult(runs[0], runs[1], dict(head["seconds"]))
    except (KeyError, TypeError) as error:
        raise FolderError(f"{kept.path} is damaged: {error}; delete it and start again") from error


def _run(name: str, head: dict[str, Any], data: dict[str, Any]) -> CaseRun:
    refined, online = (Poses(*(data[f"{name}_{series}_{column}"] for column in _COLUMNS)) for series in _SERIES)
    clock = head["clocks"][name]
    return CaseRun(refined, online, int(head["scans"]), None if clock is None else ClockOffset(*clock))
