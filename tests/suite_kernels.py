"""Compile the kernels that most tests use, in one process before the suite's processes start.

On a new machine each of them would compile for itself, a minute of work in as many copies; and numba takes no lock on
its index of a kernel: of two signatures written at the same moment it may mix up the files.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

from gnd.cloud_merger.warm import warm_up as warm_up_cloud
from gnd.fleet_sim.drives import DriveConfig, simulate_drive
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.traffic import Traffic
from gnd.fleet_sim.truth import ScanPlan, make_truth
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.warm import warm_up as warm_up_vehicle


def warm_up_simulator(folder: Path) -> None:
    """A few scans through a street with cars and people in rain, a map of them, and the street's truth."""
    world = street(1, StreetOptions(length_m=100.0))
    busy = DriveConfig("warm", "VLP-16", scans=3, traffic=Traffic(10.0, 10.0), weather="rain", beams="real")
    plain = DriveConfig("warm", "VLP-16", scans=3)
    drives = [simulate_drive(world, config, folder / f"{n}.mcap") for n, config in enumerate((busy, plain))]
    with SqliteStore(folder / "map.sqlite") as store:
        build_map(drives, store)
    make_truth(world, plan=ScanPlan(spacing_m=16.0, step_rad=0.02))


if __name__ == "__main__":
    warm_up_vehicle()
    warm_up_cloud()
    with TemporaryDirectory() as made:
        warm_up_simulator(Path(made))
