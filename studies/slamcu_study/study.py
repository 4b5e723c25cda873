"""`gnd reproduce slamcu`: drives in worker processes, what is kept is not driven again."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from gnd.fleet_sim.drives import EPOCH_NS
from gnd.fleet_sim.roads.drive import RoadDriveOptions, drive_route
from gnd.fleet_sim.roads.hard_noise import HardNoise
from gnd.fleet_sim.roads.motorway import motorway
from gnd.fleet_sim.roads.route import Route
from gnd.schemas.features import FeatureReport
from studies.feature_study.pipelines import read_reports, write_reports
from studies.frame.command import Bench, StudyReport, study
from studies.frame.kept import Kept, key_of, sources_sha
from studies.frame.options import check, option, seeds
from studies.frame.pool import Job, Tick
from studies.slamcu_study.driving import driven_by, measured_signs, merged_signs, sign_truth, verdicts_of
from studies.slamcu_study.faults import FAULTS, with_faults
from studies.slamcu_study.scores import summary_of, tables_of
from studies.slamcu_study.signs import FULL, VARIANTS, MergedSigns, SignTruth, SlamcuSeed, Verdicts

SOURCES: Final = (
    *("fleet_sim/roads", "fleet_sim/drives.py", "gnd_map", "schemas", "vehicle_agent"),
    "studies/feature_study",
    *(f"studies/slamcu_study/{name}.py" for name in ("driving", "faults", "signs")),
)
"""What a drive's result depends on."""
NOISES: Final = ("hard", "kind")
_HOUR_NS: Final = 3_600 * 1_000_000_000


@dataclass(frozen=True, slots=True)
class SlamcuOptions:
    """One study: everything that decides its numbers. The first vehicle's drive is the paper's one drive."""

    seeds: tuple[int, ...] = seeds(11, text="Seeds of routes: 1,2,3 or 1000-1049; each has its own signs and drives.")
    drives: int = option(10, "Vehicles whose reports are merged.", span=(1, 100))
    km: float = option(20.0, "Length of the motorway; signs in proportion.", span=(5, 100))
    ablations: bool = option(True, "The first drive in all variants.")
    noise: str = option(
        "hard",
        "hard: errors that stay with each sign and each drive, confused kinds, look-alikes, an occlusion profile that"
        " errs; kind: the paper's white noise of known sigma.",
        known=NOISES,
    )
    faults: tuple[str, ...] = option(
        (),
        f"What the vehicle knows nothing of, put into every drive: {', '.join(FAULTS)}.",
        known=FAULTS,
        some=False,
        read=lambda text: tuple(sorted({name for part in text.split(",") if (name := part.strip())})),
    )

    def __post_init__(self) -> None:
        check(self)


@study(SlamcuOptions, out="runs/reproduce-slamcu", jobs=1)
def slamcu(options: SlamcuOptions, bench: Bench) -> StudyReport:
    """Signs that have gone or are new, found by single cars on a motorway: Figures 8 and 9 and Table 1 of the SLAMCU
    paper, and what ten cars make of it.

    A second start with the same options and folder continues where the first ended.
    """
    tasks = {seed: tasks_of(options, seed, bench.folder.root) for seed in options.seeds}
    missing = [task for of_seed in tasks.values() for task in of_seed if not task.done]
    bench.run("drives", [Job(task.name, run_drive, (task,), ticks=True) for task in missing])
    with bench.timed("merge"):
        outcomes = [_read(seed, options, of_seed) for seed, of_seed in tasks.items()]
    found = summary_of(options, outcomes, bench.spent_s)

    def draw(folder: Path) -> None:
        from studies.slamcu_study.figures import draw_figures

        draw_figures(outcomes, options.km, folder)

    return StudyReport(found, tables_of(found), draw)


@dataclass(frozen=True, slots=True)
class DriveTask:
    """One drive in one variant.

    Attributes:
        seed, km: of the route.
        vehicle: 1, 2, 3 …; its drive has its own noise, traffic and speed.
        variant: of `VARIANTS`.
        noise: of `NOISES`.
        faults: of `FAULTS`.
        home: folder of results.
    """

    seed: int
    km: float
    vehicle: int
    variant: str
    noise: str
    faults: tuple[str, ...]
    home: Path

    @property
    def verdicts(self) -> Kept:
        """Where its verdicts are kept, with the truth."""
        return self._kept("verdicts")

    @property
    def reports(self) -> Kept:
        """Where its reports are kept."""
        return self._kept("reports")

    def _kept(self, what: str) -> Kept:
        decides = {"seed": self.seed, "km": self.km, "vehicle": self.vehicle, "variant": self.variant}
        decides |= {"noise": self.noise}
        key = key_of(sources=sources_sha(SOURCES), faults=",".join(self.faults), **decides)
        return Kept(self.home, "-".join([what, str(self.vehicle), self.variant, self.noise, *self.faults]), key)

    @property
    def done(self) -> bool:
        """Whether both are there."""
        return self.verdicts.done and self.reports.done

    @property
    def name(self) -> str:
        """Its name in the progress bar."""
        return f"seed {self.seed}, car {self.vehicle}" + ("" if self.variant == FULL else f", {self.variant}")


def tasks_of(options: SlamcuOptions, seed: int, root: Path) -> list[DriveTask]:
    """Return the drives of a route: all vehicles, then the first once more in each variant."""
    vehicles = [(vehicle, FULL) for vehicle in range(1, options.drives + 1)]
    variants = [(1, variant) for variant in VARIANTS if variant != FULL and options.ablations]
    bare = DriveTask(seed, options.km, 0, FULL, options.noise, options.faults, root / f"seed-{seed}")
    return [replace(bare, vehicle=vehicle, variant=variant) for vehicle, variant in [*vehicles, *variants]]


def run_drive(task: DriveTask, tick: Tick) -> None:
    """Drive, classify, report; runs in a worker process."""
    route = motorway(task.seed, 1e3 * task.km)
    hard = HardNoise() if task.noise == "hard" else None
    drive = drive_route(route, task.vehicle, RoadDriveOptions(hard=hard, start_ns=EPOCH_NS + task.vehicle * _HOUR_NS))
    drive = with_faults(drive, task.faults, task.seed)
    driven = driven_by(drive, task.variant, task.vehicle, tick)
    write_reports(driven.reports, task.reports)
    task.verdicts.write((verdicts_of(drive, driven), sign_truth(route)))


def _read(seed: int, options: SlamcuOptions, tasks: list[DriveTask]) -> SlamcuSeed:
    """Results of a route from the folder, and what the cloud makes of the reports."""
    read = {task: task.verdicts.read(tuple[Verdicts, SignTruth]) for task in tasks}
    fleet = [task for task in tasks if task.variant == FULL]
    found = {task.variant: verdicts for task, (verdicts, _) in read.items() if task.vehicle == 1}
    drives = tuple(read[task][0] for task in fleet)
    route, reports = motorway(seed, 1e3 * options.km), [read_reports(task.reports) for task in fleet]
    measured = tuple(measured_signs(route, of_drive) for of_drive in reports)
    return SlamcuSeed(seed, read[fleet[0]][1], found, drives, _merged(route, options, reports), measured)


def _merged(route: Route, options: SlamcuOptions, reports: list[list[FeatureReport]]) -> Mapping[int, MergedSigns]:
    """What is published after 2, 5 and all drives."""
    return {
        n: merged_signs(route, [report for of_drive in reports[:n] for report in of_drive])
        for n in sorted({2, 5, options.drives})
        if 2 <= n <= options.drives
    }
