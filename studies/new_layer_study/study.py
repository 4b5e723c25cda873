"""`gnd reproduce new-feature-layer`: drives in worker processes; what is kept stays."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from gnd.gnd_map.config import to_mapping
from studies.feature_study.pipelines import read_reports, write_reports
from studies.frame.command import Bench, StudyReport, study
from studies.frame.errors import OptionError
from studies.frame.kept import Kept, key_of, sources_sha
from studies.frame.options import check, list_of, option, seeds
from studies.frame.pool import Job
from studies.new_layer_study.driving import (
    MOTORWAY,
    NOISES,
    STRAIGHT,
    TRACK,
    RouteTask,
    integrated,
    layer_truth,
    localised,
    mapped,
)
from studies.new_layer_study.layers import DriveLayers, LayerLocalised, MotorwayOutcome, NewLayerSeed, RouteOutcome
from studies.new_layer_study.summary import summary_of, tables_of

SOURCES: Final = (
    "fleet_sim/roads",
    "fleet_sim/drives.py",
    "gnd_map",
    "schemas",
    "vehicle_agent",
    "studies/feature_study",
    "studies/new_layer_study/driving.py",
)
"""What a drive's result depends on."""
MERGE_SOURCES: Final = (*SOURCES, "cloud_merger/features")
"""What localisation with a layer depends on."""


@dataclass(frozen=True, slots=True)
class NewLayerOptions:
    """One study: everything that decides its numbers. Of several seeds the first ones run the sweep and the straight
    motorway.
    """

    seeds: tuple[int, ...] = seeds(11, text="Seeds of routes, such as 1,2,5-9; each has its own features and drives.")
    drives: int = option(6, "Drives on the test track.", span=(1, 60))
    motorway_drives: int = option(11, "Drives on the motorway; one more localises.", span=(1, 60))
    lap_m: float = option(0.0, "Way driven on the test track, metres; 0: one lap.", "--lap", span=(0, 10_000))
    levels: tuple[float, ...] = option(
        (0.5, 1.0, 2.0),
        "Noise levels of Figure 8, of beacons and of lanes; none: no sweep.",
        span=(0.1, 5),
        read=lambda text: () if text == "none" else list_of("--levels", text, float),
    )
    sweep_seeds: int = option(1, "The sweep runs on so many of the seeds.", span=(0, None))
    km: float = option(4.0, "Length of the motorway.", span=(0.5, 20))
    gnss_bias_m: float = option(
        0.0, "Constant error of each motorway drive's GNSS, metres (one sigma).", "--gnss-bias", span=(0, 20)
    )
    straight_seeds: int = option(1, "The straight motorway, on so many of the seeds.", span=(0, None))
    noise: str = option(
        "hard",
        "hard: errors that stay with each feature and each drive, misses by range, look-alikes; kind: the paper's white"
        " noise of known sigma.",
        known=NOISES,
    )

    def __post_init__(self) -> None:
        check(self)
        if 0 < self.lap_m < 100:
            raise OptionError(f"--lap must be 0 or 100 … 10000 m, got {self.lap_m:g}")
        if len(set(self.levels)) != len(self.levels):
            raise OptionError(f"--levels must be different numbers, got {self.levels}")


@study(NewLayerOptions, out="runs/reproduce-new-layer")
def new_feature_layer(options: NewLayerOptions, bench: Bench) -> StudyReport:
    """A layer of beacons or streetlights that many cars map while driving, and localisation with it: Figures 6 to 8, 10
    to 12 and Tables 2 and 3 of the paper on new feature layers.

    A second start with the same options and folder continues where the first ended.
    """
    plans = [tasks_of(options, seed, bench.folder.root) for seed in options.seeds]
    bench.run("drives", list(_drives(plans)))
    bench.run("localisation", list(_fresh(plans)))
    with bench.timed("merge"):
        outcomes = [_read(options, plan) for plan in plans]
    found = summary_of(options, outcomes, bench.spent_s)

    def draw(folder: Path) -> None:
        from studies.new_layer_study.figures import draw_figures

        draw_figures(outcomes, options.km, found, folder)

    return StudyReport(found, tables_of(found), draw)


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


def _drives(plans: list[SeedTasks]) -> Iterator[Job]:
    tasks = [task for plan in plans for of_route in plan.routes.values() for task in of_route]
    return (Job(_name(task), map_drive, (task,)) for task in tasks if not task.done)


def _name(task: MappingTask) -> str:
    return f"seed {task.route.seed}, {task.route.name}, drive {task.vehicle}"


def _fresh(plans: list[SeedTasks]) -> Iterator[Job]:
    tasks = [task for plan in plans for task in plan.fresh]
    return (Job(f"seed {t.route.seed}, {t.route.name}", localise_drive, (t,)) for t in tasks if not t.kept.done)


def tasks_of(options: NewLayerOptions, seed: int, root: Path) -> SeedTasks:
    """Return all drives of a seed; the noise level 1 of both sensors is the usual track's."""
    home = root / f"seed-{seed}"
    tracks = [
        usual_track(options, seed),
        *(task for of in noisy_tracks(options, seed).values() for task in of.values()),
    ]
    kinds = (MOTORWAY, STRAIGHT) if seed in options.seeds[: options.straight_seeds] else (MOTORWAY,)
    roads = [RouteTask(kind, seed, options.km, gnss_bias_m=options.gnss_bias_m, noise=options.noise) for kind in kinds]
    numbers = dict.fromkeys(tracks, options.drives) | dict.fromkeys(roads, options.motorway_drives)
    routes = {task: tuple(MappingTask(task, n + 1, home) for n in range(many)) for task, many in numbers.items()}
    return SeedTasks(seed, routes, tuple(LocalisingTask(task, routes[task], home) for task in roads))


def usual_track(options: NewLayerOptions, seed: int) -> RouteTask:
    """Return the test track with both sensors at noise level 1."""
    return RouteTask(TRACK, seed, options.lap_m / 1e3, noise=options.noise)


def noisy_tracks(options: NewLayerOptions, seed: int) -> dict[str, dict[float, RouteTask]]:
    """Return the test track at each noise level of each sensor, the other's at 1."""
    if not options.levels or seed not in options.seeds[: options.sweep_seeds]:
        return {}
    levels, usual = sorted(options.levels), usual_track(options, seed)
    return {
        "beacon": {level: replace(usual, beacon=level) for level in levels},
        "lane": {level: replace(usual, lane=level) for level in levels},
    }


def map_drive(task: MappingTask) -> None:
    """Drive, map, report; runs in a worker process."""
    layers, reports = mapped(task.route, task.vehicle)
    write_reports(reports, task.reports)
    task.layers.write(layers)


def localise_drive(task: LocalisingTask) -> None:
    """Merge, localise a fresh drive without and with the layer; runs in a worker process."""
    before, vehicle = [report for one in task.before for report in read_reports(one.reports)], len(task.before) + 1
    found = {"without": localised(task.route, vehicle, None), "with_layer": localised(task.route, vehicle, before)}
    task.kept.write(found)


def _read(options: NewLayerOptions, plan: SeedTasks) -> NewLayerSeed:
    routes = {task: _read_route(task, drives) for task, drives in plan.routes.items()}
    noisy = {
        sensor: {level: routes[task] for level, task in levels.items()}
        for sensor, levels in noisy_tracks(options, plan.seed).items()
    }
    roads = {one.route.kind: _read_motorway(routes[one.route], one.kept) for one in plan.fresh}
    track = routes[usual_track(options, plan.seed)]
    return NewLayerSeed(plan.seed, track, noisy, roads[MOTORWAY], roads.get(STRAIGHT))


def _read_route(task: RouteTask, drives: tuple[MappingTask, ...]) -> RouteOutcome:
    """Drives of a route, and the cloud's layer after each: after the first one's its own, for one alone publishes
    nothing.
    """
    route, layers = task.route, tuple(one.layers.read(DriveLayers) for one in drives)
    reports = [read_reports(one.reports) for one in drives]
    merged = {1: layers[0].with_map}
    numbers = range(2, len(drives) + 1) if task.is_usual else [len(drives)] if len(drives) > 1 else []
    for n in numbers:
        merged[n] = integrated(route, [report for of_drive in reports[:n] for report in of_drive])
    return RouteOutcome(layer_truth(route), layers, merged)


def _read_motorway(route: RouteOutcome, kept: Kept) -> MotorwayOutcome:
    return MotorwayOutcome(route, **kept.read(dict[str, LayerLocalised]))
