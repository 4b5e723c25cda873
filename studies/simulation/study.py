"""`gnd reproduce simulation`: worlds, vehicles, merges and scores, each stage in worker processes, resumable."""

import logging
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

from studies.frame.command import Bench, StudyReport, plain_options, study
from studies.frame.errors import FolderError
from studies.frame.folder import StudyFolder
from studies.frame.pool import Job
from studies.simulation.options import PoseSource, RunOptions
from studies.simulation.result import read_result
from studies.simulation.scores import (
    SimulationOutcome,
    VehicleFile,
    WorldOutcome,
    comparison_of,
    score_fleet,
    score_pcd,
    score_single,
    sent_bytes,
    summary_of,
)  # fmt: skip
from studies.simulation.tables import comparison_sheets, sheets_of
from studies.simulation.vehicle import VehicleTask, run_vehicle
from studies.simulation.worlds import (
    WorldFiles,
    prepare_cloud,
    prepare_world,
    shots_a_second,
    vehicle_tasks,
    world_files,
)

_log = logging.getLogger(__name__)


@study(RunOptions, out="runs/reproduce-simulation", keeps_drives=True)
def simulation(options: RunOptions, bench: Bench) -> StudyReport:
    """Reproduce the simulation of the GND paper: worlds with known truth, single drives, fleets, and their scores.

    A second start with the same options and folder continues where the first ended.
    """
    sources, asked = PoseSource.several(bench.given["poses"]), sorted(options.vehicles)
    runs = {source: replace(options, poses=source) for source in sources}
    if len(sources) == 1:
        found = run_one(options, bench, bench.folder)
        return StudyReport(found, sheets_of(found, asked))
    bench.folder.write_mark({"compared": {str(source): plain_options(run) for source, run in runs.items()}})
    results: dict[str, Any] = {}
    for source, run in runs.items():
        home = bench.folder.root / str(source).replace(":", "-")
        StudyFolder.begun(home)
        if results:
            share_worlds(bench.folder.root / str(sources[0]).replace(":", "-"), home)
        results[str(source)] = run_one(run, bench, StudyFolder(home))
    compared = comparison_of(results)
    return StudyReport(compared, comparison_sheets(compared, asked))


def run_one(options: RunOptions, bench: Bench, folder: StudyFolder) -> dict[str, Any]:
    """Run everything for poses of one source, write result and figures into the folder, and return the result."""
    folder.write_mark({"options": plain_options(options)})
    outcome = reproduce(options, folder, bench)
    folder.write_mark({"options": plain_options(options), "worlds": _plain_worlds(outcome, folder)})
    found = summary_of(outcome)
    folder.write_json("result.json", found)
    if bench.pictures:
        from studies.simulation.figures import draw_figures

        draw_figures(outcome, found, folder.root)
    return found


def reproduce(options: RunOptions, folder: StudyFolder, bench: Bench) -> SimulationOutcome:
    """Run everything that is not yet in the folder, merge and score.

    Raises:
        GndError: something cannot be made as asked.
    """
    bench.spent_s.clear()
    started_s = perf_counter()
    files = {seed: world_files(folder, seed, options) for seed in options.seeds}
    jobs = [Job(f"world {seed}", prepare_world, (files[seed], seed, options)) for seed in files]
    if options.pcd:
        jobs += [Job(f"point cloud {seed}", prepare_cloud, (files[seed], seed, options)) for seed in files]
    bench.run("worlds", jobs)
    tasks = {seed: vehicle_tasks(options, seed, files[seed], bench.keep_drives) for seed in files}
    bench.run("vehicles", drive_jobs(task for of_world in tasks.values() for task in of_world))
    kept = {seed: [VehicleFile(task.result, task.key) for task in of_world] for seed, of_world in tasks.items()}
    worlds = _scores(options, files, kept, bench)
    return SimulationOutcome(options, worlds, {**bench.spent_s, "total": perf_counter() - started_s})


def drive_jobs(tasks: Iterable[VehicleTask]) -> list[Job]:
    """The drives that are not in the cache yet; the longest first, so that no core waits at the end."""
    missing = sorted((task for task in tasks if not is_done(task)), key=shots_a_second, reverse=True)
    return [Job(f"{t.drive.vehicle} {t.sensor}, {t.world.parent.name}", run_vehicle, (t,), ticks=True) for t in missing]


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


def _scores(
    options: RunOptions, files: dict[int, WorldFiles], vehicles: dict[int, list[VehicleFile]], bench: Bench
) -> tuple[WorldOutcome, ...]:
    """Scores of every world; the curve over the number of vehicles is shared out among the processes."""
    many = range(1, max(options.vehicles) + 1)  # dealt out so that every share has small and large ones
    shares = [share for k in range(bench.processes) if (share := list(many[k :: bench.processes]))]
    jobs, merge, upload, parked_h = [], options.method.merge, options.upload, options.method.parked_h
    for seed, of_world in vehicles.items():
        jobs.append(Job(f"single drives, world {seed}", score_single, (files[seed], of_world, merge, parked_h)))
        jobs += [
            Job(f"merges, world {seed}", score_fleet, (files[seed], of_world, share, merge, upload, parked_h))
            for share in shares
        ]
        jobs.append(Job(f"uploads, world {seed}", sent_bytes, (files[seed], of_world, merge, upload)))
        if options.pcd:
            jobs.append(Job(f"baseline, world {seed}", score_pcd, (files[seed], of_world, options.vehicles)))
    results = iter(bench.run("merges", jobs))
    found = []
    for seed, of_world in vehicles.items():
        single = next(results)
        fleet = dict(sorted((n, scored) for _ in shares for n, scored in next(results).items()))
        sent = next(results)
        pcd = next(results) if options.pcd else {}
        read = tuple(vehicle.read() for vehicle in of_world)
        found.append(WorldOutcome(seed, files[seed], read, tuple(of_world), options.vehicles, single, fleet, sent, pcd))
    return tuple(found)


def _plain_worlds(outcome: SimulationOutcome, folder: StudyFolder) -> list[dict[str, Any]]:
    """Where the results of each world lie, relative to the folder."""
    return [
        {
            "seed": world.seed,
            "folder": str(world.files.home.relative_to(folder.root)),
            "vehicles": [{"file": str(v.path.relative_to(folder.root)), "key": v.key} for v in world.kept],
        }
        for world in outcome.worlds
    ]


# --- poses of several sources ----------------------------------------------------------------------------------------


def share_worlds(of: Path, to: Path) -> None:
    """Copy the worlds of one run into another that has none of them yet: street, truth, base map, not the vehicles."""
    for world in of.glob("seed-*"):
        partial = to / f".{world.name}.part"
        if not (to / world.name).exists():
            shutil.rmtree(partial, ignore_errors=True)
            shutil.copytree(world, partial, ignore=shutil.ignore_patterns("vehicles", "drives")).rename(to / world.name)
