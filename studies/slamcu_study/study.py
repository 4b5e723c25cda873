"""A study of SLAMCU from options to results: drives in worker processes, what is kept is not driven again."""

from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Final

from rich.progress import Progress

from gnd.fleet_sim.drives import EPOCH_NS
from gnd.fleet_sim.roads.drive import RoadDriveOptions, drive_route
from gnd.fleet_sim.roads.motorway import motorway
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from studies.feature_study.reporting import read_reports, write_reports
from studies.localisation_study.kept import Kept
from studies.simulation.folder import RunFolder
from studies.simulation.pool import Job, run_jobs
from studies.simulation.sources import key_of, sources_sha
from studies.simulation.streams import Tick
from studies.slamcu_study.driving import run_slamcu, sign_truth, verdicts_of
from studies.slamcu_study.faults import with_faults
from studies.slamcu_study.merging import merged_signs, sign_reports
from studies.slamcu_study.options import FULL, SlamcuOptions
from studies.slamcu_study.outcome import MergedSigns, SeedOutcome, StudyOutcome
from studies.slamcu_study.verdicts import read_verdicts, write_verdicts

SOURCES: Final = (
    "fleet_sim/roads",
    "fleet_sim/drives.py",
    "gnd_map",
    "schemas",
    "vehicle_agent/features",
    "studies/feature_study",
    "studies/slamcu_study/driving.py",
    "studies/slamcu_study/faults.py",
    "studies/slamcu_study/merging.py",
    "studies/slamcu_study/verdicts.py",
)
"""What a drive's result depends on."""
_HOUR_NS: Final = 3_600 * 1_000_000_000


@dataclass(frozen=True, slots=True)
class DriveTask:
    """One drive in one variant.

    Attributes:
        seed: of the route.
        km: its length.
        vehicle: 1, 2, 3 …; its drive has its own noise, traffic and speed.
        variant: of `VARIANTS`.
        faults: of `FAULTS`.
        home: folder of results.
        key: hash of all that decides them.
    """

    seed: int
    km: float
    vehicle: int
    variant: str
    faults: tuple[str, ...]
    home: Path
    key: str

    @property
    def verdicts(self) -> Kept:
        """Where what it says is kept."""
        return Kept(self.home, f"verdicts-{self._label}", self.key)

    @property
    def reports(self) -> Kept:
        """Where its reports are kept."""
        return Kept(self.home, f"reports-{self._label}", self.key)

    @property
    def _label(self) -> str:
        return "-".join([str(self.vehicle), self.variant, *self.faults])

    @property
    def done(self) -> bool:
        """Whether both are there."""
        return self.verdicts.done and self.reports.done

    @property
    def name(self) -> str:
        """What the progress bar says."""
        return f"seed {self.seed}, car {self.vehicle}" + ("" if self.variant == FULL else f", {self.variant}")


def study(options: SlamcuOptions, folder: RunFolder, processes: int, progress: Progress) -> StudyOutcome:
    """Run everything that is not yet in the folder.

    Args:
        options: what to run.
        folder: keeps the results of the drives for the next start.
        processes: worker processes.
        progress: gets the bars.

    Raises:
        GndError: something cannot be made as asked.
    """
    begun_s = perf_counter()
    tasks = {seed: tasks_of(options, seed, folder) for seed in options.seeds}
    missing = [task for of_seed in tasks.values() for task in of_seed if not task.done]
    run_jobs([Job(task.name, run_drive, (task,), ticks=True) for task in missing], processes, progress, "drives")
    driven_s = perf_counter()
    outcomes = tuple(_read(seed, options, of_seed) for seed, of_seed in tasks.items())
    return StudyOutcome(options, outcomes, {"drives": driven_s - begun_s, "merge": perf_counter() - driven_s})


def tasks_of(options: SlamcuOptions, seed: int, folder: RunFolder) -> list[DriveTask]:
    """Return the drives of a route: all vehicles, then the first once more in each variant."""
    home = folder.root / f"seed-{seed}"
    vehicles = [(vehicle, FULL) for vehicle in range(1, options.drives + 1)]
    variants = [(1, variant) for variant in options.variants if variant != FULL]
    bare = DriveTask(seed, options.km, 0, FULL, options.faults, home, "")
    return [_keyed(replace(bare, vehicle=vehicle, variant=variant)) for vehicle, variant in [*vehicles, *variants]]


def _keyed(task: DriveTask) -> DriveTask:
    what = {"seed": task.seed, "km": task.km, "vehicle": task.vehicle, "variant": task.variant}
    what["faults"] = ",".join(task.faults)
    return replace(task, key=key_of(sources=sources_sha(SOURCES), **what))


def run_drive(task: DriveTask, tick: Tick) -> None:
    """Drive, classify, report; runs in a worker process."""
    route, parameters = motorway(task.seed, 1e3 * task.km), SlamcuParameters()
    drive = drive_route(route, task.vehicle, RoadDriveOptions(start_ns=EPOCH_NS + task.vehicle * _HOUR_NS))
    drive = with_faults(drive, task.faults, task.seed)
    driven = run_slamcu(drive, task.variant, parameters, task.vehicle, tick)
    write_reports(sign_reports(drive, driven, task.vehicle, parameters), task.reports)
    write_verdicts(verdicts_of(drive, driven), sign_truth(route), task.verdicts)


def _read(seed: int, options: SlamcuOptions, tasks: list[DriveTask]) -> SeedOutcome:
    """Results of a route from the folder, and what the cloud makes of the reports."""
    fleet = [task for task in tasks if task.variant == FULL]
    found = {task.variant: read_verdicts(task.verdicts)[0] for task in tasks if task.vehicle == 1}
    drives = tuple(read_verdicts(task.verdicts)[0] for task in fleet)
    truth = read_verdicts(fleet[0].verdicts)[1]
    return SeedOutcome(seed, truth, found, drives, _merged(seed, options, fleet))


def _merged(seed: int, options: SlamcuOptions, fleet: list[DriveTask]) -> dict[int, MergedSigns]:
    """What is published after all drives, and on the way there."""
    route, reports = motorway(seed, 1e3 * options.km), [read_reports(task.reports) for task in fleet]
    return {
        n: merged_signs(route, [report for of_drive in reports[:n] for report in of_drive])
        for n in merged_counts(options.drives)
    }


def merged_counts(drives: int) -> list[int]:
    """Return after how many vehicles the map is scored: 2, 5 and all."""
    return [n for n in sorted({2, 5, drives}) if 2 <= n <= drives]
