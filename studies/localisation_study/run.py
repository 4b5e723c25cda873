"""A study from options to results: worlds and drives, fleet and runs, merge and runs on the updated map; resumable."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter

from rich.progress import Progress

from studies.localisation_study.kept import read_localised, read_trials
from studies.localisation_study.localising import Localised
from studies.localisation_study.options import StudyOptions
from studies.localisation_study.plan import OUTDATED, UPDATED, WITHOUT, Run, SeedPlan, SensorPlan, plan_of
from studies.localisation_study.trials import Trial
from studies.localisation_study.work import make_fresh, make_updated, record, run_all, run_trials
from studies.simulation.folder import RunFolder
from studies.simulation.pool import Job, run_jobs
from studies.simulation.run import is_done
from studies.simulation.scoring import VehicleFile
from studies.simulation.tasks import shots_a_second, vehicle_tasks
from studies.simulation.vehicle import VehicleTask, run_vehicle
from studies.simulation.worlds import prepare_world

Stage = Callable[[StudyOptions, list[SeedPlan]], Iterator[list[Job]]]
"""Gives lists of jobs; the next list when the jobs of the one before are done."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorOutcome:
    """What came of one sensor: runs by name, trials."""

    sensor: str
    runs: dict[str, Localised]
    cpu_s: dict[str, float]
    trials: list[Trial]


@dataclass(frozen=True, slots=True, eq=False)
class SeedOutcome:
    """What came of one seed."""

    plan: SeedPlan
    sensors: tuple[SensorOutcome, ...]


@dataclass(frozen=True, slots=True, eq=False)
class StudyOutcome:
    """A finished study."""

    options: StudyOptions
    seeds: tuple[SeedOutcome, ...]
    runtime_s: dict[str, float]


def study(
    options: StudyOptions, folder: RunFolder, processes: int, progress: Progress, *, keep_drives: bool = False
) -> StudyOutcome:
    """Run everything that is not yet in the folder.

    Args:
        options: what to run.
        folder: keeps worlds, maps and results for the next start.
        processes: worker processes.
        progress: gets the bars.
        keep_drives: keep the recorded drives, too.

    Raises:
        GndError: something cannot be made as asked.
    """
    plans = [plan_of(folder, seed, options) for seed in options.seeds]
    spent = {}
    stages: Sequence[tuple[str, Stage]] = (
        ("worlds and drives", _worlds),
        ("fleet and runs", _runs),
        ("updated map", _updated),
    )
    for title, stage in stages:
        begun_s = perf_counter()
        for jobs in stage(options, plans):
            run_jobs(jobs, processes, progress, title)
        spent[title] = perf_counter() - begun_s
    for plan in plans:
        for sensor in plan.sensors if not keep_drives else ():
            sensor.recording.unlink(missing_ok=True)
    return StudyOutcome(options, tuple(_read(plan) for plan in plans), {**spent, "total": sum(spent.values())})


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
    if options.base == "driven":
        yield [*worlds, *fresh, *drives]
    else:  # the truth, which the fresh map is taken from, is made with the world
        yield [*worlds, *drives]
        yield fresh


def _runs(options: StudyOptions, plans: list[SeedPlan]) -> Iterator[list[Job]]:
    """The fleet's vehicles, the longest first, and the runs that need no fleet."""
    fleet = [task for plan in plans if not plan.updated.done for task in _fleet(options, plan) if not is_done(task)]
    fleet.sort(key=shots_a_second, reverse=True)
    jobs = [Job(f"{t.drive.vehicle} {t.sensor}", run_vehicle, (t,), ticks=True) for t in fleet]
    for plan in plans:
        for one in plan.sensors:
            jobs += _trials_jobs(options, plan, one)
            groups = _grouped([run for run in one.runs if run.name != UPDATED])
            jobs += [_job(options, plan, one, group) for group in groups]
    yield jobs


def _updated(options: StudyOptions, plans: list[SeedPlan]) -> Iterator[list[Job]]:
    """The merge of the fleet's reports, then the runs on the updated map."""
    merge = options.method.merge
    yield [
        Job(f"merge, world {plan.seed}", make_updated, (plan.files.base, _files(options, plan), merge, plan.updated))
        for plan in plans
        if not plan.updated.done
    ]
    runs = [(plan, one, run) for plan in plans for one in plan.sensors if (run := one.run(UPDATED)) is not None]
    yield [_job(options, plan, one, [run]) for plan, one, run in runs if not run.kept.done]


def _fleet(options: StudyOptions, plan: SeedPlan) -> list[VehicleTask]:
    return vehicle_tasks(options.of_fleet(plan.seed), plan.seed, plan.files)[: options.fleet]


def _files(options: StudyOptions, plan: SeedPlan) -> list[VehicleFile]:
    return [VehicleFile(task.result, task.key) for task in _fleet(options, plan)]


def _grouped(runs: list[Run]) -> list[list[Run]]:
    """Runs that read the recording together, those that are done left out."""
    missing = [run for run in runs if not run.kept.done]
    first = [run for run in missing if run.name in (WITHOUT, OUTDATED)]
    variants = [run for run in missing if run.variant]
    others = [run for run in missing if run not in first and run not in variants]
    return [group for group in (first, others, variants) if group]


def _job(options: StudyOptions, plan: SeedPlan, one: SensorPlan, runs: list[Run]) -> Job:
    name = f"{one.sensor}, world {plan.seed}: {', '.join(run.name for run in runs)}"
    return Job(name, run_all, (one.recording, runs, options.method.localise, plan.seed), ticks=True)


def _trials_jobs(options: StudyOptions, plan: SeedPlan, one: SensorPlan) -> list[Job]:
    if one.trials is None or one.trials.done:
        return []
    parameters = options.method.localise
    arguments = (one.recording, plan.files.base, options.trials, parameters, plan.seed, one.trials)
    return [Job(f"{one.sensor}, world {plan.seed}: starts", run_trials, arguments, ticks=True)]


def _read(plan: SeedPlan) -> SeedOutcome:
    found = []
    for one in plan.sensors:
        runs = {run.name: read_localised(run.kept) for run in one.runs}
        localised, cpu_s = {name: r for name, (r, _) in runs.items()}, {name: s for name, (_, s) in runs.items()}
        trials = read_trials(one.trials) if one.trials is not None else []
        found.append(SensorOutcome(one.sensor, localised, cpu_s, trials))
    return SeedOutcome(plan, tuple(found))
