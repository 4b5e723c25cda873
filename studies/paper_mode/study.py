"""`gnd reproduce paper-mode`: the paper's rules, once with ξ as printed and once with the observers as denominator.

GND 5.3: "the ratio of the number of merged voxels to the number of information uploads must be higher than ξ_update".
*As printed* the denominator is the uploads about the voxel: a car that one vehicle met has all of the uploads. With the
*observers as denominator* it is the vehicles that observed the voxel. The vehicles and their reports are the same.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from gnd.fleet_sim.street import StreetOptions
from gnd.fleet_sim.truth import read_truth
from gnd.schemas.changes import ChangeReport
from studies.frame.command import Bench, StudyReport, study
from studies.frame.folder import StudyFolder
from studies.frame.options import check, numbers, option, seeds
from studies.frame.pool import Job
from studies.paper_mode.figures import draw_curves, draw_localisation, draw_traffic
from studies.paper_mode.tables import sheets_of
from studies.simulation.base_map import BaseMap, write_base
from studies.simulation.cloud import merged_map
from studies.simulation.figures import draw_changes
from studies.simulation.options import (
    PARKING,
    MethodParameters,
    Mode,
    PoseSource,
    RunOptions,
    sensors_option,
    street_option,
)
from studies.simulation.result import read_result
from studies.simulation.scores import SimulationOutcome, WorldOutcome, mean_of, summary_of
from studies.simulation.study import is_done, reproduce
from studies.simulation.vehicle import VehicleTask, run_vehicle
from studies.simulation.worlds import read_world_base, vehicle_tasks

READINGS: Final[Mapping[str, Mode]] = {"as printed": "paper", "observers as denominator": "paper-observers"}
"""The names of the readings, and the mode of each."""


@dataclass(frozen=True, slots=True)
class PaperModeOptions:
    """One run of the paper's rules."""

    seeds: tuple[int, ...] = seeds(2001, text="Seeds of the world, such as 2001,2005-2009.")
    street: StreetOptions = street_option(100.0)
    vehicles: tuple[int, ...] = option(
        (1, 5, 9, 14), "Sizes of the fleet that are reported.", span=(1, 200),
        read=lambda text: tuple(sorted(set(numbers("--vehicles", text)))),
    )  # fmt: skip
    sensors: tuple[str, ...] = sensors_option(
        ("vlp16", "hdl32e", "rs16", "scala"), "Sensors that the fleet cycles through."
    )
    parking: float | None = option(None, PARKING, span=(0, 1))
    poses: PoseSource = option(
        PoseSource("estimated", 0.0, 0.0), "estimated, true, or noisy:<m>:<deg>.", read=PoseSource.parse
    )
    scans: int | None = option(None, "At most so many scans a drive, for a quick look.", span=(1, None))

    def __post_init__(self) -> None:
        check(self)

    def run(self, mode: Mode) -> RunOptions:
        """The simulation of a mode."""
        return RunOptions(
            self.seeds, self.street, self.vehicles, self.sensors, self.parking, mode=mode, poses=self.poses,
            method=MethodParameters.of_mode(mode), scans=self.scans, pcd=False,
        )  # fmt: skip


@study(PaperModeOptions, out="runs/reproduce-paper-mode")
def paper_mode(options: PaperModeOptions, bench: Bench) -> StudyReport:
    """Run the GND paper's rules in both readings of ξ, and set Figures 15 to 17 and 23 beside the paper's points."""
    outcomes = {name: reproduce(options.run(mode), bench.folder, bench) for name, mode in READINGS.items()}
    found: dict[str, Any] = {name: summary_of(outcome) for name, outcome in outcomes.items()}
    localised = _localised(outcomes, bench)
    found |= {"localisation": localised, "upload": _uploads(outcomes["as printed"]), "seeds": list(options.seeds)}
    if bench.pictures:
        _draw(outcomes, found, bench.folder)
    return StudyReport(found, sheets_of(found, options.vehicles, list(READINGS)))


def _draw(outcomes: Mapping[str, SimulationOutcome], found: Mapping[str, Any], folder: StudyFolder) -> None:
    draw_curves(found, list(READINGS), folder.root / "paper_mode_f1.png")
    draw_localisation(found, folder.root / "paper_mode_localisation.png")
    draw_traffic(found, folder.root / "paper_mode_upload.png")
    for name, outcome in outcomes.items():
        home = folder.root / name.replace(" ", "-")
        home.mkdir(exist_ok=True)
        world = outcome.worlds[0]
        draw_changes(outcome, world, read_truth(world.files.truth), home)


# --- Figure 15: a vehicle that localises on the maps ----------------------------------------------------------------


def _localised(outcomes: Mapping[str, SimulationOutcome], bench: Bench) -> dict[str, Any]:
    """Errors of a further vehicle's own localiser on the stale map and on the map of each reading, mean over worlds."""
    printed = outcomes["as printed"]
    tasks = {"stale map": [_further(printed, world, "") for world in printed.worlds]}
    for name, outcome in outcomes.items():
        tasks[f"healed, {name}"] = [_further(outcome, world, name) for world in outcome.worlds]
    jobs = [Job(f"localise, {name}", run_vehicle, (task,), ticks=True)
            for name, many in tasks.items() for task in many if not is_done(task)]  # fmt: skip
    bench.run("localisation", jobs)
    return {name: mean_of([_errors(task) for task in many]) for name, many in tasks.items()}


def _errors(task: VehicleTask) -> dict[str, float]:
    return dict(read_result(task.result, task.key).stats["poses"] or {})


def _further(outcome: SimulationOutcome, world: WorldOutcome, reading: str) -> VehicleTask:
    """The drive of a vehicle after the fleet, a VLP-16, on the map of a reading; "": on the stale map."""
    options, files = outcome.options, world.files
    largest = max(options.vehicles)
    run = replace(options, vehicles=(largest + 1,), sensors=("vlp16",), poses=PoseSource("estimated", 0.0, 0.0))
    task = vehicle_tasks(run, world.seed, files)[largest]
    if not reading:
        return replace(task, result=task.result.with_name(f"further-stale-{task.key}.npz"))
    base = read_world_base(files)
    bodies = [body for vehicle in world.vehicles[:largest] for body in vehicle.reports]
    healed = BaseMap(merged_map(base, bodies, options.method.merge, options.method.parked_h))
    path = files.home / f"healed-{options.method.merge.mode}.npz"
    write_base(healed, path)
    key = f"{task.key}-{healed.sha[:12]}"
    return replace(task, base=path, key=key, result=task.result.with_name(f"further-{key}.npz"))


# --- Figure 23: what the readings cost on the way -------------------------------------------------------------------


def _uploads(outcome: SimulationOutcome) -> dict[str, Any]:
    """Bytes that each vehicle sends in either reading, and per km of its way; mean over worlds, in their order.

    The observers as denominator need to be known: the report names every voxel that the drive observed. As printed it
    names the changed ones alone.
    """
    each = [_upload_of(world) for world in outcome.worlds]
    return {name: np.mean([one[name] for one in each], axis=0).round(3).tolist() for name in each[0]}


def _upload_of(world: WorldOutcome) -> dict[str, list[float]]:
    """KB a km of each vehicle, in the order of the fleet, by reading."""
    number = max(world.asked)
    found: dict[str, list[float]] = {name: [] for name in READINGS}
    for vehicle in world.vehicles[:number]:
        km = vehicle.stats["way_m"] / 1e3
        whole = [ChangeReport.decode(body) for body in vehicle.reports]
        found["as printed"].append(sum(len(changes_alone(one).encode()) for one in whole) / 1e3 / km)
        found["observers as denominator"].append(sum(map(len, vehicle.reports)) / 1e3 / km)
    return found


def changes_alone(report: ChangeReport) -> ChangeReport:
    """The report without the voxels that were observed and not changed; tiles without a change are left out."""
    tiles = [replace(one, observed=one.changed.voxel_id) for one in report.tiles if len(one.changed)]
    return replace(report, tiles=tuple(tiles))
