"""A reproduction from options to scores: worlds, vehicles, merges, each stage in worker processes, resumable."""

import logging
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from rich.progress import Progress

from gnd.gnd_map.config import to_mapping
from studies.simulation.errors import FolderError
from studies.simulation.folder import RunFolder
from studies.simulation.options import RunOptions
from studies.simulation.pool import Job, run_jobs
from studies.simulation.result import VehicleResult, read_result
from studies.simulation.scoring import Scored, VehicleFile, score_fleet, score_pcd, score_single, sent_bytes
from studies.simulation.tasks import shots_a_second, vehicle_tasks
from studies.simulation.vehicle import VehicleTask, run_vehicle
from studies.simulation.worlds import WorldFiles, prepare_cloud, prepare_world, world_files

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
        sent: bytes that each vehicle sends, in their order: to the fleet's cloud, and to a cloud of its own.
        pcd: score of the point-cloud baseline: of each vehicle alone by name, of the fleet by number; empty without it.
    """

    seed: int
    files: WorldFiles
    vehicles: tuple[VehicleResult, ...]
    kept: tuple[VehicleFile, ...]
    single: dict[str, Scored]
    fleet: dict[int, Scored]
    sent: tuple[list[int], list[int]]
    pcd: dict[str | int, Scored]


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
    jobs = [Job(f"world {seed}", prepare_world, (files[seed], seed, options)) for seed in files]
    if options.pcd:
        jobs += [Job(f"point cloud {seed}", prepare_cloud, (files[seed], seed, options)) for seed in files]
    run_jobs(jobs, processes, progress, "worlds")
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
    missing = [task for of_world in tasks.values() for task in of_world if not is_done(task)]
    missing.sort(key=shots_a_second, reverse=True)  # the longest first, so that no core waits at the end
    jobs = [Job(f"{t.drive.vehicle} {t.sensor}, world {_seed_of(t)}", run_vehicle, (t,), ticks=True) for t in missing]
    run_jobs(jobs, processes, progress, "vehicles")
    return {seed: [VehicleFile(task.result, task.key) for task in of_world] for seed, of_world in tasks.items()}


def is_done(task: VehicleTask) -> bool:
    """Return whether a vehicle's result is in the cache; a damaged one is not."""
    if not task.result.exists() or (task.recording is not None and not task.recording.exists()):
        return False
    try:
        read_result(task.result, task.key)
        return True
    except FolderError as error:
        _log.warning("%s: it is made again", error)
        return False


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
    jobs, merge, upload = [], options.method.merge, options.upload
    for seed, of_world in vehicles.items():
        jobs.append(Job(f"single drives, world {seed}", score_single, (files[seed], of_world)))
        jobs += [
            Job(f"merges, world {seed}", score_fleet, (files[seed], of_world, share, merge, upload)) for share in shares
        ]
        jobs.append(Job(f"uploads, world {seed}", sent_bytes, (files[seed], of_world, merge, upload)))
        if options.pcd:
            jobs.append(Job(f"baseline, world {seed}", score_pcd, (files[seed], of_world, options.vehicles)))
    results = iter(run_jobs(jobs, processes, progress, "merges and scores"))
    found = []
    for seed, of_world in vehicles.items():
        single = next(results)
        fleet = {n: scored for _ in shares for n, scored in next(results).items()}
        sent = next(results)
        pcd = next(results) if options.pcd else {}
        read = tuple(vehicle.read() for vehicle in of_world)
        fleet = dict(sorted(fleet.items()))
        found.append(WorldOutcome(seed, files[seed], read, tuple(of_world), single, fleet, sent, pcd))
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
