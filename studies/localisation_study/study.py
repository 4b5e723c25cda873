"""`gnd reproduce localisation`: worlds and drives, fleet and runs, merge and runs on the updated map; resumable.

Every result is kept under a key of all that decides it; a second start makes what is missing.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Final

from gnd.cloud_merger.merge import MergeParameters
from gnd.fleet_sim.drives import EPOCH_NS, DriveConfig, simulate_drive
from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.traffic import Traffic
from gnd.fleet_sim.truth import read_truth, world_sha
from gnd.gnd_map.config import to_mapping
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from studies.frame.command import Bench, StudyReport, study
from studies.frame.folder import StudyFolder
from studies.frame.kept import LOCALISER, SIMULATOR, Kept, key_of, sources_sha
from studies.frame.options import check, option, parts, seeds
from studies.frame.pool import Job, Tick
from studies.localisation_study.localising import (
    FRESH,
    OUTDATED,
    UPDATED,
    WITHOUT,
    LocalisedVariant,
    localise,
    without_submaps,
)
from studies.localisation_study.summary import (
    LocalisationOutcome,
    LocalisationSeed,
    SensorOutcome,
    sheets_of,
    summary_of,
)
from studies.localisation_study.trials import StartTrial, begin_times, run_trial
from studies.simulation.base_map import BaseMap, driven, read_base, surveyed, write_base
from studies.simulation.cloud import merged_map
from studies.simulation.options import (
    PARKING,
    SET,
    Base,
    MethodParameters,
    PoseSource,
    RunOptions,
    fleet_configs,
    method_of,
    sensors_option,
    street_option,
)  # fmt: skip
from studies.simulation.scores import VehicleFile
from studies.simulation.streams import ticking
from studies.simulation.study import drive_jobs
from studies.simulation.vehicle import VehicleTask
from studies.simulation.worlds import VEHICLE, WorldFiles, prepare_world, vehicle_tasks, world_files

FLEET_SENSORS: Final = ("vlp16", "hdl32e", "rs16", "rs32")
_STUDY_SEEDS: Final = 700  # drive seeds of the fleet lie below
_DAY_NS: Final = 86_400 * 1_000_000_000
_MAPS: Final = (*SIMULATOR, "studies/simulation/base_map.py")
_RUNS: Final = (
    *LOCALISER,
    *(f"studies/simulation/{name}.py" for name in ("poses", "streams")),
    *(f"studies/localisation_study/{name}.py" for name in ("localising", "series", "trials", "study")),
)
_CLOUD: Final = (*VEHICLE, "cloud_merger", "studies/simulation/cloud.py")


@dataclass(frozen=True, slots=True)
class StudyOptions:
    """One study; of several seeds, the worst counts. The maps are made by an HDL-32E with range noise on the empty
    street ("driven"), or are the truth's own ("surveyed").
    """

    seeds: tuple[int, ...] = seeds(201, text="Seeds of the world, such as 1,2,5-9.")
    street: StreetOptions = street_option(300.0)
    sensors: tuple[str, ...] = sensors_option(("vlp16", "hdl64e", "scala"), "Each drives once.")
    fleet: int = option(5, "Vehicles whose reports update the map.", span=(1, None))
    fleet_sensors: tuple[str, ...] = FLEET_SENSORS
    poses: PoseSource = option(
        PoseSource("estimated", 0.0, 0.0), "The fleet's: estimated, true, noisy:<m>:<deg>.", read=PoseSource.parse
    )
    trials: int = option(20, "Starts without a pose, for each sensor.", span=(0, None))
    parking: float = option(0.2, PARKING, span=(0, 1))
    base: Base = option("driven", "How the maps are made.")
    scans: int | None = option(None, "At most so many scans a drive, for a quick look.", span=(1, None))
    method: MethodParameters = parts(method_of, changes=SET)

    def __post_init__(self) -> None:
        check(self)

    def of_fleet(self, seed: int) -> RunOptions:
        """Return the run that maps the world of a seed and updates the map."""
        return RunOptions(
            seeds=(seed,),
            street=self.street,
            vehicles=(self.fleet,),
            sensors=self.fleet_sensors[: self.fleet],
            parking=self.parking,
            poses=self.poses,
            base=self.base,
            method=self.method,
            scans=self.scans,
            pcd=False,
        )


@study(StudyOptions, out="runs/reproduce-localisation", keeps_drives=True)
def localisation(options: StudyOptions, bench: Bench) -> StudyReport:
    """Localisation in a changed world: with and without submaps and before and after the map update.

    Errors stand beside the GND paper's and Ford's limits. A second start with the same options and folder continues
    where the first ended.
    """
    plans = [SeedPlan.of(bench.folder, seed, options) for seed in options.seeds]
    for jobs in _worlds(options, plans):
        bench.run("worlds and drives", jobs)
    bench.run("fleet and runs", _first_runs(options, plans))
    for jobs in _updated(options, plans):
        bench.run("updated map", jobs)
    for sensor in [one for plan in plans for one in plan.sensors] if not bench.keep_drives else ():
        sensor.recording.unlink(missing_ok=True)
    bench.spent_s["total"] = sum(bench.spent_s.values())
    outcome = LocalisationOutcome(options, tuple(plan.outcome() for plan in plans), bench.spent_s)
    found = summary_of(outcome)

    def draw(folder: Path) -> None:
        from studies.localisation_study.figures import draw_figures

        draw_figures(outcome, folder)

    return StudyReport(found, sheets_of(found), draw)


def drive_config(options: StudyOptions, seed: int, sensor: str) -> DriveConfig:
    """Return the drive of a sensor through the changed world; the same whichever other sensors drive."""
    index = list(SHORT_NAMES).index(sensor)
    return DriveConfig(
        vehicle=f"study-{sensor}",
        sensor=SHORT_NAMES[sensor],
        state="after",
        direction=1 if index % 2 == 0 else -1,
        seed=1_000_003 * seed + _STUDY_SEEDS + index,
        car_share=options.parking,
        traffic=Traffic.urban(),
        scans=options.scans,
        start_ns=EPOCH_NS + 10 * _DAY_NS,
    )


# --- plan ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RunResult:
    """What a run of the localiser gave, and its seconds of CPU."""

    found: LocalisedVariant
    cpu_s: float


@dataclass(frozen=True, slots=True)
class LocalisationRun:
    """One run of the localiser.

    Attributes:
        name: `WITHOUT` submaps, or on the map `OUTDATED`, `UPDATED` or `FRESH`.
        base: file of the map.
        kept: a `RunResult`.
    """

    name: str
    base: Path
    kept: Kept


@dataclass(frozen=True, slots=True)
class SensorPlan:
    """What one sensor does.

    Attributes:
        sensor: short name.
        drive: what is simulated.
        recording: the drive as MCAP, while it is needed.
        runs: of the localiser.
        trials: result of the starts without a pose, a list of `StartTrial`; None where there are none.
    """

    sensor: str
    drive: DriveConfig
    recording: Path
    runs: tuple[LocalisationRun, ...]
    trials: Kept | None

    @property
    def done(self) -> bool:
        """Whether nothing is left to do."""
        return all(run.kept.done for run in self.runs) and (self.trials is None or self.trials.done)

    def outcome(self) -> SensorOutcome:
        """What came of it."""
        read = {run.name: run.kept.read(RunResult) for run in self.runs}
        trials = self.trials.read(list[StartTrial]) if self.trials is not None else []
        localised, cpu_s = {n: r.found for n, r in read.items()}, {n: r.cpu_s for n, r in read.items()}
        return SensorOutcome(self.sensor, self.drive, localised, cpu_s, trials)


@dataclass(frozen=True, slots=True)
class SeedPlan:
    """What is done for one seed: the world with the map of the state before, that of the state after, the map that the
    fleet has brought up to date, and what each sensor does.
    """

    seed: int
    files: WorldFiles
    fresh: Kept
    updated: Kept
    sensors: tuple[SensorPlan, ...]

    @classmethod
    def of(cls, folder: StudyFolder, seed: int, options: StudyOptions) -> "SeedPlan":
        """Return the plan of a seed; nothing runs here."""
        fleet = options.of_fleet(seed)
        files, world = world_files(folder, seed, fleet), world_sha(street(seed, options.street))
        maps_by = {"world": world, "base": options.base, "sources": sources_sha(_MAPS)}
        before, home = key_of(state="before", **maps_by), files.home / "maps"
        drives = [to_mapping(drive) for drive in fleet_configs(fleet, seed)[: options.fleet]]
        by_fleet = {"drives": drives, "poses": str(options.poses), "method": to_mapping(options.method)}
        fresh = Kept(home, FRESH, key_of(state="after", **maps_by))
        updated = Kept(home, UPDATED, key_of(before=before, sources=sources_sha(_CLOUD), **by_fleet))
        maps = {OUTDATED: (files.base, before), FRESH: (fresh.path, fresh.key), UPDATED: (updated.path, updated.key)}
        sensors = tuple(_sensor_plan(files, seed, options, sensor, world, maps) for sensor in options.sensors)
        return cls(seed, files, fresh, updated, sensors)

    def fleet(self, options: StudyOptions) -> list[VehicleTask]:
        """The work of the fleet's vehicles."""
        return vehicle_tasks(options.of_fleet(self.seed), self.seed, self.files)[: options.fleet]

    def outcome(self) -> LocalisationSeed:
        """What came of it."""
        maps = {"outdated": self.files.base, "updated": self.updated.path, "fresh": self.fresh.path}
        return LocalisationSeed(self.seed, self.files.truth, maps, tuple(one.outcome() for one in self.sensors))


def _sensor_plan(
    files: WorldFiles, seed: int, options: StudyOptions, sensor: str, world: str, maps: dict[str, tuple[Path, str]]
) -> SensorPlan:
    drive, home = drive_config(options, seed, sensor), files.home / "runs"
    drive_key = key_of(world=world, drive=to_mapping(drive), sources=sources_sha(SIMULATOR))
    decides = {"drive": drive_key, "localise": to_mapping(options.method.localise), "sources": sources_sha(_RUNS)}
    runs = []
    for name in (WITHOUT, OUTDATED, UPDATED, FRESH):
        path, map_key = maps.get(name, maps[OUTDATED])
        runs.append(
            LocalisationRun(name, path, Kept(home, f"{sensor}-{name}", key_of(map=map_key, name=name, **decides)))
        )
    trials = Kept(home, f"{sensor}-trials", key_of(map=maps[OUTDATED][1], trials=options.trials, **decides))
    recording = files.home / "drives" / f"{sensor}-{drive_key}.mcap"
    return SensorPlan(sensor, drive, recording, tuple(runs), trials if options.trials else None)


# --- jobs ------------------------------------------------------------------------------------------------------------


def _worlds(options: StudyOptions, plans: list[SeedPlan]) -> Iterator[list[Job]]:
    """Worlds with truth and outdated map, fresh maps, and the drives that are still needed."""
    worlds = [Job(f"world {p.seed}", prepare_world, (p.files, p.seed, options.of_fleet(p.seed))) for p in plans]
    fresh = [
        Job(f"fresh map, world {p.seed}", make_fresh, (options, p.seed, p.files.truth, p.fresh))
        for p in plans
        if not p.fresh.done
    ]
    drives = [
        Job(f"drive {one.sensor}, world {p.seed}", record, (options, p.seed, one.drive, one.recording), ticks=True)
        for p in plans
        for one in p.sensors
        if not (one.done or one.recording.exists())
    ]
    # the truth, from which a surveyed fresh map is taken, is made with the world
    yield from ([[*worlds, *fresh, *drives]] if options.base == "driven" else [[*worlds, *drives], fresh])


def _first_runs(options: StudyOptions, plans: list[SeedPlan]) -> list[Job]:
    """The fleet's vehicles, the longest first, and the runs that need no fleet."""
    jobs = drive_jobs(task for plan in plans if not plan.updated.done for task in plan.fleet(options))
    for plan in plans:
        for one in plan.sensors:
            if one.trials is not None and not one.trials.done:
                what = (one.recording, plan.files.base, options.trials, options.method.localise, plan.seed, one.trials)
                jobs.append(Job(f"{one.sensor}, world {plan.seed}: starts", run_trials, what, ticks=True))
            for names in ((WITHOUT, OUTDATED), (FRESH,)):  # which read the recording together
                jobs += _run_job(options, plan, one, names)
    return jobs


def _updated(options: StudyOptions, plans: list[SeedPlan]) -> Iterator[list[Job]]:
    """The merge of the fleet's reports, then the runs on the updated map."""
    merging = []
    for plan in plans:
        if not plan.updated.done:
            files = [VehicleFile(task.result, task.key) for task in plan.fleet(options)]
            what = (plan.files.base, files, options.method.merge, plan.updated)
            merging.append(Job(f"merge, world {plan.seed}", make_updated, what))
    yield merging
    yield [job for plan in plans for one in plan.sensors for job in _run_job(options, plan, one, (UPDATED,))]


def _run_job(options: StudyOptions, plan: SeedPlan, one: SensorPlan, names: tuple[str, ...]) -> list[Job]:
    """The runs of these names, if one is missing."""
    runs = [run for run in one.runs if run.name in names and not run.kept.done]
    name = f"{one.sensor}, world {plan.seed}: {', '.join(run.name for run in runs)}"
    return [Job(name, run_all, (one.recording, runs, options.method.localise), ticks=True)] if runs else []


def record(options: StudyOptions, seed: int, drive: DriveConfig, path: Path, tick: Tick) -> None:
    """Simulate a drive, once for all that use it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    simulate_drive(street(seed, options.street), drive, path, tick)


def make_fresh(options: StudyOptions, seed: int, truth: Path, kept: Kept) -> None:
    """Make the map of the state after as that of the state before was made."""
    kept.home.mkdir(parents=True, exist_ok=True)
    is_driven = options.base == "driven"
    write_base(
        driven(street(seed, options.street), "after") if is_driven else surveyed(read_truth(truth).after), kept.path
    )


def make_updated(base: Path, fleet: list[VehicleFile], merge: MergeParameters, kept: Kept) -> None:
    """Make the map that the cloud makes of the fleet's reports."""
    kept.home.mkdir(parents=True, exist_ok=True)
    bodies = [body for vehicle in fleet for body in vehicle.read().reports]
    tiles = merged_map(read_base(base), bodies, merge)
    write_base(BaseMap({tile: tiles[tile] for tile in sorted(tiles) if len(tiles[tile])}), kept.path)


def run_all(recording: Path, runs: list[LocalisationRun], parameters: LocaliserParameters, tick: Tick) -> None:
    """Run the localiser over a recorded drive, once for each run."""
    header, items = read_header(recording), list(read_drive(recording))
    scans = sum(isinstance(item, Scan) for item in items)
    for number, run in enumerate(runs):

        def tick_all(done: int, total: int, before: int = number * scans) -> None:
            tick(before + done, total * len(runs))

        begun_s = process_time()
        of_run = without_submaps(parameters) if run.name == WITHOUT else parameters
        found = localise(header, ticking(items, tick_all, scans), read_base(run.base), of_run)
        run.kept.write(RunResult(found, process_time() - begun_s))


def run_trials(
    recording: Path, base: Path, n: int, parameters: LocaliserParameters, seed: int, kept: Kept, tick: Tick
) -> None:
    """Start the localiser n times at random in a recorded drive."""
    header, items, tiles, trials = (
        read_header(recording),
        list(read_drive(recording)),
        read_base(base),
        list[StartTrial](),
    )
    for begin_ns in begin_times(items, n, seed):
        trials.append(run_trial(header, items, begin_ns, tiles, parameters, seed))
        tick(len(trials), n)
    kept.write(trials)
