"""A reproduction from options to scores: worlds, vehicles, merges, each stage in worker processes, resumable."""

import logging
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from rich.progress import Progress

from benchmarks.simulation.errors import FolderError
from benchmarks.simulation.fleet import fleet_configs, fleet_sensors
from benchmarks.simulation.folder import RunFolder
from benchmarks.simulation.masses import choose
from benchmarks.simulation.options import RunOptions
from benchmarks.simulation.pool import Job, run_jobs
from benchmarks.simulation.result import VehicleResult, read_result
from benchmarks.simulation.scoring import Scored, VehicleFile, score_fleet, score_single
from benchmarks.simulation.sources import SIMULATOR, VEHICLE, key_of, sources_sha
from benchmarks.simulation.vehicle import VehicleTask, run_vehicle
from benchmarks.simulation.worlds import WorldFiles, prepare_world, read_world_base, world_files
from fleet_sim.truth import read_truth
from gnd_map.config import to_mapping

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class WorldOutcome:
    """What came of one world.

    Attributes:
        seed: the world's.
        files: where it lies.
        vehicles: results in the order of the fleet.
        kept: their files.
        single: score of the stale map and of each vehicle alone, by name.
        fleet: score of the merged map by number of vehicles.
    """

    seed: int
    files: WorldFiles
    vehicles: tuple[VehicleResult, ...]
    kept: tuple[VehicleFile, ...]
    single: dict[str, Scored]
    fleet: dict[int, Scored]


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A finished reproduction."""

    options: RunOptions
    worlds: tuple[WorldOutcome, ...]
    runtime_s: dict[str, float]


def reproduce(
    options: RunOptions, folder: RunFolder, processes: int, progress: Progress, *, keep_drives: bool = False
) -> Outcome:
    """Run everything that is not yet in the folder, merge and score.

    Args:
        options: what to run.
        folder: keeps worlds and vehicles' results for the next start.
        processes: worker processes.
        progress: gets the bars.
        keep_drives: write every drive as MCAP, too.

    Raises:
        GndError: something cannot be made as asked.
    """
    started_s = perf_counter()
    files = {seed: world_files(folder, seed, options) for seed in options.seeds}
    run_jobs([Job(f"world {s}", prepare_world, (files[s], s, options)) for s in files], processes, progress, "worlds")
    worlds_s = perf_counter()
    vehicles = _vehicles(options, files, processes, progress, keep_drives)
    vehicles_s = perf_counter()
    outcome = _scores(options, files, vehicles, processes, progress)
    spent = {"worlds": worlds_s - started_s, "vehicles": vehicles_s - worlds_s, "merges": perf_counter() - vehicles_s}
    return Outcome(options, outcome, {**spent, "total": perf_counter() - started_s})


def _vehicles(
    options: RunOptions, files: dict[int, WorldFiles], processes: int, progress: Progress, keep_drives: bool
) -> dict[int, list[VehicleFile]]:
    """The result of every vehicle, in the cache now."""
    tasks = {seed: vehicle_tasks(options, seed, files[seed], keep_drives) for seed in files}
    missing = [task for of_world in tasks.values() for task in of_world if not _is_done(task)]
    missing.sort(key=_work, reverse=True)  # the longest first, so that no core waits at the end
    jobs = [Job(f"{t.drive.vehicle} {t.sensor}, world {_seed_of(t)}", run_vehicle, (t,), ticks=True) for t in missing]
    run_jobs(jobs, processes, progress, "vehicles")
    return {seed: [VehicleFile(task.result, task.key) for task in of_world] for seed, of_world in tasks.items()}


def vehicle_tasks(options: RunOptions, seed: int, files: WorldFiles, keep_drives: bool = False) -> list[VehicleTask]:
    """Return the work of each vehicle of a world, with the key under which its result is kept."""
    base_sha = read_world_base(files).sha
    watch = choose(read_truth(files.truth))
    method = options.method
    tasks = []
    for index, (sensor, drive) in enumerate(
        zip(fleet_sensors(options, seed), fleet_configs(options, seed), strict=True)
    ):
        watched = watch if index == _watching(options, seed) else None
        key = key_of(
            sources=sources_sha(VEHICLE), world=files.home.name, made_by=sources_sha(SIMULATOR), base=base_sha,
            drive=to_mapping(drive), poses=str(options.poses), watch=watched,
            method={name: to_mapping(getattr(method, name)) for name in ("localise", "segment", "detect", "report")},
        )  # fmt: skip
        kept = files.home / "vehicles" / f"{drive.vehicle}-{sensor}-{key}"
        recording = files.home / "drives" / f"{drive.vehicle}-{sensor}-{key}.mcap" if keep_drives else None
        if recording is not None:
            recording.parent.mkdir(exist_ok=True)
        tasks.append(
            VehicleTask(
                files.world, files.base, files.voxels, sensor, drive, options.poses, method,
                kept.with_suffix(".npz"), key, watched, recording,
            )
        )  # fmt: skip
    return tasks


def _watching(options: RunOptions, seed: int) -> int:
    """The vehicle whose masses are drawn: the first with an HDL-32E, else the first."""
    sensors = fleet_sensors(options, seed)
    return sensors.index("hdl32e") if "hdl32e" in sensors else 0


def _is_done(task: VehicleTask) -> bool:
    if not task.result.exists() or (task.recording is not None and not task.recording.exists()):
        return False
    try:
        read_result(task.result, task.key)
        return True
    except FolderError as error:
        _log.warning("%s: it is made again", error)
        return False


def _work(task: VehicleTask) -> float:
    """Shots a second: what a drive costs."""
    model = task.drive.model
    return len(model.elevations_rad) / model.cycle_ns


def _seed_of(task: VehicleTask) -> str:
    return task.world.parent.name.split("-")[1]


def _scores(
    options: RunOptions,
    files: dict[int, WorldFiles],
    vehicles: dict[int, list[VehicleFile]],
    processes: int,
    progress: Progress,
) -> tuple[WorldOutcome, ...]:
    """Scores of every world; the curve over the number of vehicles is shared out among the processes."""
    shares = _shares(range(1, max(options.vehicles) + 1), processes)
    jobs, merge = [], options.method.merge
    for seed, of_world in vehicles.items():
        jobs.append(Job(f"single drives, world {seed}", score_single, (files[seed], of_world)))
        jobs += [Job(f"merges, world {seed}", score_fleet, (files[seed], of_world, share, merge)) for share in shares]
    results = iter(run_jobs(jobs, processes, progress, "merges and scores"))
    found = []
    for seed, of_world in vehicles.items():
        single = next(results)
        fleet = {n: scored for _ in shares for n, scored in next(results).items()}
        read = tuple(vehicle.read() for vehicle in of_world)
        found.append(WorldOutcome(seed, files[seed], read, tuple(of_world), single, dict(sorted(fleet.items()))))
    return tuple(found)


def _shares(numbers: range, processes: int) -> list[list[int]]:
    """Numbers dealt out so that every share has small and large ones."""
    shares = [list(numbers[k::processes]) for k in range(max(processes, 1))]
    return [share for share in shares if share]


def plain_options(options: RunOptions) -> dict[str, Any]:
    """Return the options as plain values, for files and JSON."""
    return {**to_mapping(options), "poses": str(options.poses)}


def plain_worlds(outcome: Outcome, folder: RunFolder) -> list[dict[str, Any]]:
    """Return where the results of each world lie, relative to the folder."""
    return [
        {
            "seed": world.seed,
            "folder": str(world.files.home.relative_to(folder.root)),
            "vehicles": [{"file": str(v.path.relative_to(folder.root)), "key": v.key} for v in world.kept],
        }
        for world in outcome.worlds
    ]
