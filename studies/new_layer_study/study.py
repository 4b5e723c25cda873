"""A study of new feature layers from options to results: drives in worker processes; what is kept stays."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Final

import numpy as np
from rich.progress import Progress

from gnd.gnd_map.config import to_mapping
from gnd.schemas.features import FeatureReport
from studies.feature_study.reporting import read_reports, write_reports
from studies.localisation_study.kept import Kept, read_arrays, write_arrays
from studies.new_layer_study.driving import (
    MOTORWAY,
    STRAIGHT,
    TRACK,
    RouteTask,
    integrated,
    layer_truth,
    localised,
    mapped,
)
from studies.new_layer_study.layers import Layer
from studies.new_layer_study.options import NewLayerOptions
from studies.new_layer_study.outcome import (
    DriveLayers,
    Localised,
    MotorwayOutcome,
    RouteOutcome,
    SeedOutcome,
    StudyOutcome,
)
from studies.simulation.folder import RunFolder
from studies.simulation.pool import Job, run_jobs
from studies.simulation.sources import key_of, sources_sha

SOURCES: Final = (
    "fleet_sim/roads",
    "fleet_sim/drives.py",
    "gnd_map",
    "schemas",
    "vehicle_agent/features",
    "studies/feature_study",
    "studies/new_layer_study/driving.py",
)
"""What a drive's result depends on."""
MERGE_SOURCES: Final = (*SOURCES, "cloud_merger/features")
"""What localisation with a layer depends on."""


@dataclass(frozen=True, slots=True)
class MappingTask:
    """One drive on a route.

    Attributes:
        route: which, and how noisy.
        vehicle: 1, 2, 3 …; its drive has its own luck.
        home: folder of results.
    """

    route: RouteTask
    vehicle: int
    home: Path

    @property
    def key(self) -> str:
        """Hash of all that decides the result."""
        return key_of(sources=sources_sha(SOURCES), route=to_mapping(self.route), vehicle=self.vehicle)

    @property
    def layers(self) -> Kept:
        """Where its layers are kept."""
        return Kept(self.home / self.route.name, f"layers-{self.vehicle}", self.key)

    @property
    def reports(self) -> Kept:
        """Where its reports are kept."""
        return Kept(self.home / self.route.name, f"reports-{self.vehicle}", self.key)

    @property
    def done(self) -> bool:
        """Whether both are there."""
        return self.layers.done and self.reports.done


@dataclass(frozen=True, slots=True)
class LocalisingTask:
    """A fresh drive on a motorway, localised without and with the layer of those before.

    Attributes:
        route: which.
        before: the drives that made the layer.
        home: folder of results.
    """

    route: RouteTask
    before: tuple[MappingTask, ...]
    home: Path

    @property
    def kept(self) -> Kept:
        """Where the result is kept."""
        keys = [task.key for task in self.before]
        return Kept(self.home / self.route.name, "localised", key_of(sources=sources_sha(MERGE_SOURCES), before=keys))


@dataclass(frozen=True, slots=True)
class SeedTasks:
    """All drives of one seed: by route, and the fresh ones."""

    seed: int
    routes: dict[RouteTask, tuple[MappingTask, ...]]
    fresh: tuple[LocalisingTask, ...]


def study(options: NewLayerOptions, folder: RunFolder, processes: int, progress: Progress) -> StudyOutcome:
    """Run everything that is not yet in the folder.

    Args:
        options: what to run.
        folder: keeps the results of the drives for the next start.
        processes: worker processes.
        progress: gets the bars.

    Raises:
        GndError: something cannot be made as asked.
    """
    plans, spent = [tasks_of(options, seed, folder) for seed in options.seeds], {}
    for title, jobs in (("drives", _drives(plans)), ("localisation", _fresh(plans))):
        begun_s = perf_counter()
        run_jobs(list(jobs), processes, progress, title)
        spent[title] = perf_counter() - begun_s
    begun_s = perf_counter()
    outcomes = tuple(_read(options, plan) for plan in plans)
    return StudyOutcome(options, outcomes, {**spent, "merge": perf_counter() - begun_s})


def _drives(plans: list[SeedTasks]) -> Iterator[Job]:
    tasks = [task for plan in plans for of_route in plan.routes.values() for task in of_route]
    return (Job(_name(task), map_drive, (task,)) for task in tasks if not task.done)


def _name(task: MappingTask) -> str:
    return f"seed {task.route.seed}, {task.route.name}, drive {task.vehicle}"


def _fresh(plans: list[SeedTasks]) -> Iterator[Job]:
    tasks = [task for plan in plans for task in plan.fresh]
    return (Job(f"seed {t.route.seed}, {t.route.name}", localise_drive, (t,)) for t in tasks if not t.kept.done)


def tasks_of(options: NewLayerOptions, seed: int, folder: RunFolder) -> SeedTasks:
    """Return all drives of a seed; the noise level 1 of both sensors is the usual track's."""
    home = folder.root / f"seed-{seed}"
    tracks = [
        RouteTask(TRACK, seed, options.lap_m / 1e3),
        *(task for of in noisy_tracks(options, seed).values() for task in of.values()),
    ]
    kinds = (MOTORWAY, STRAIGHT) if seed in options.seeds[: options.straight_seeds] else (MOTORWAY,)
    roads = [RouteTask(kind, seed, options.km, gnss_bias_m=options.gnss_bias_m) for kind in kinds]
    numbers = dict.fromkeys(tracks, options.drives) | dict.fromkeys(roads, options.motorway_drives)
    routes = {task: tuple(MappingTask(task, n + 1, home) for n in range(many)) for task, many in numbers.items()}
    return SeedTasks(seed, routes, tuple(LocalisingTask(task, routes[task], home) for task in roads))


def noisy_tracks(options: NewLayerOptions, seed: int) -> dict[str, dict[float, RouteTask]]:
    """Return the test track at each noise level of each sensor, the other's at 1."""
    if not options.levels or seed not in options.seeds[: options.sweep_seeds]:
        return {}
    levels, km = sorted(options.levels), options.lap_m / 1e3
    return {
        "beacon": {level: RouteTask(TRACK, seed, km, beacon=level) for level in levels},
        "lane": {level: RouteTask(TRACK, seed, km, lane=level) for level in levels},
    }


def map_drive(task: MappingTask) -> None:
    """Drive, map, report; runs in a worker process."""
    layers, reports = mapped(task.route, task.vehicle)
    write_reports(reports, task.reports)
    cases = {"with_map": layers.with_map} | ({} if layers.without_map is None else {"without_map": layers.without_map})
    arrays = {f"{case}_{column}": getattr(one, column) for case, one in cases.items() for column in ("xy_m", "cov_m2")}
    write_arrays(task.layers, {"cases": list(cases)}, arrays)


def read_layers(kept: Kept) -> DriveLayers:
    """Read what a drive has made.

    Raises:
        FolderError: it is missing or damaged.
    """
    head, arrays = read_arrays(kept)
    found = {case: Layer(arrays[f"{case}_xy_m"], arrays[f"{case}_cov_m2"]) for case in head["cases"]}
    return DriveLayers(found.get("without_map"), found["with_map"])


def localise_drive(task: LocalisingTask) -> None:
    """Merge, localise a fresh drive without and with the layer; runs in a worker process."""
    layer = integrated(task.route.route, _all_reports(task.before))
    vehicle = len(task.before) + 1
    found = {"without": localised(task.route, vehicle, None), "with_layer": localised(task.route, vehicle, layer)}
    columns: dict[str, Any] = {
        f"{name}_{c}": getattr(one, c) for name, one in found.items() for c in ("t_s", "error_m")
    }
    write_arrays(task.kept, {"vehicle": vehicle}, columns)


def _all_reports(tasks: tuple[MappingTask, ...]) -> list[FeatureReport]:
    return [report for task in tasks for report in read_reports(task.reports)]


def _read(options: NewLayerOptions, plan: SeedTasks) -> SeedOutcome:
    routes = {task: _read_route(task, drives) for task, drives in plan.routes.items()}
    noisy = {
        sensor: {level: routes[task] for level, task in levels.items()}
        for sensor, levels in noisy_tracks(options, plan.seed).items()
    }
    roads = {one.route.kind: _read_motorway(routes[one.route], one.kept) for one in plan.fresh}
    track = routes[RouteTask(TRACK, plan.seed, options.lap_m / 1e3)]
    return SeedOutcome(plan.seed, track, noisy, roads[MOTORWAY], roads.get(STRAIGHT))


def _read_route(task: RouteTask, drives: tuple[MappingTask, ...]) -> RouteOutcome:
    """Drives of a route, and the cloud's layer after each: after the first one's its own, for one alone publishes
    nothing.
    """
    route, layers = task.route, tuple(read_layers(one.layers) for one in drives)
    reports = [read_reports(one.reports) for one in drives]
    merged = {1: layers[0].with_map}
    numbers = range(2, len(drives) + 1) if task.is_usual else [len(drives)] if len(drives) > 1 else []
    for n in numbers:
        merged[n] = integrated(route, [report for of_drive in reports[:n] for report in of_drive])
    return RouteOutcome(layer_truth(route), layers, merged)


def _read_motorway(route: RouteOutcome, kept: Kept) -> MotorwayOutcome:
    _, arrays = read_arrays(kept)
    series = [
        Localised(np.asarray(arrays[f"{name}_t_s"]), np.asarray(arrays[f"{name}_error_m"]))
        for name in ("without", "with_layer")
    ]
    return MotorwayOutcome(route, series[0], series[1])
