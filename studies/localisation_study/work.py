"""What worker processes do: record a drive, make a map, run the localiser."""

from pathlib import Path
from time import process_time

from gnd.cloud_merger.merge import MergeParameters
from gnd.fleet_sim.drives import DriveConfig, simulate_drive
from gnd.fleet_sim.street import street
from gnd.fleet_sim.truth import read_truth
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from studies.localisation_study.kept import Kept, write_localised, write_trials
from studies.localisation_study.localising import localise, without_submaps
from studies.localisation_study.options import StudyOptions
from studies.localisation_study.plan import Run
from studies.localisation_study.trials import begin_times, run_trial
from studies.localisation_study.variants import variant_of
from studies.simulation.base_map import BaseMap, driven, read_base, surveyed, write_base
from studies.simulation.cloud import merged_map
from studies.simulation.scoring import VehicleFile
from studies.simulation.streams import Tick, ticking


def record(options: StudyOptions, seed: int, drive: DriveConfig, path: Path, tick: Tick) -> None:
    """Simulate a drive, once for all that use it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    simulate_drive(street(seed, options.street), drive, path, tick)


def make_fresh(options: StudyOptions, seed: int, truth: Path, kept: Kept) -> None:
    """Make the map of the state after as that of the state before was made."""
    kept.home.mkdir(parents=True, exist_ok=True)
    if options.base == "driven":
        write_base(driven(street(seed, options.street), "after"), kept.path)
    else:
        write_base(surveyed(read_truth(truth).after), kept.path)


def make_updated(base: Path, fleet: list[VehicleFile], merge: MergeParameters, kept: Kept) -> None:
    """Make the map that the cloud makes of the fleet's reports."""
    kept.home.mkdir(parents=True, exist_ok=True)
    bodies = [body for vehicle in fleet for body in vehicle.read().reports]
    tiles = merged_map(read_base(base), bodies, merge)
    write_base(BaseMap({tile: tiles[tile] for tile in sorted(tiles) if len(tiles[tile])}), kept.path)


def run_all(recording: Path, runs: list[Run], parameters: LocaliserParameters, seed: int, tick: Tick) -> None:
    """Run the localiser over a recorded drive, once for each run."""
    header, items = read_header(recording), list(read_drive(recording))
    scans = sum(isinstance(item, Scan) for item in items)
    for number, run in enumerate(runs):

        def tick_all(done: int, total: int, before: int = number * scans) -> None:
            tick(before + done, total * len(runs))

        begun_s = process_time()
        of_run = parameters if run.submaps else without_submaps(parameters)
        stream = ticking(items, tick_all, scans)
        found = localise(header, stream, read_base(run.base), of_run, variant_of(run.variant, seed))
        write_localised(found, process_time() - begun_s, run.kept)


def run_trials(
    recording: Path, base: Path, n: int, parameters: LocaliserParameters, seed: int, kept: Kept, tick: Tick
) -> None:
    """Start the localiser n times at random in a recorded drive."""
    header, items, tiles = read_header(recording), list(read_drive(recording)), read_base(base)
    begun_s, trials = process_time(), []
    for begin_ns in begin_times(items, n, seed):
        trials.append(run_trial(header, items, begin_ns, tiles, parameters, seed))
        tick(len(trials), n)
    write_trials(trials, process_time() - begun_s, kept)
