"""What the contests are run on: a simulated street, its map from one drive, and drives of a car through it."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gnd.fleet_sim.drives import DriveConfig, simulate_drive
from gnd.fleet_sim.street import StreetOptions, street
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import DriveItem
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.vehicle_agent.local_map import LocalMap
from studies.frame.options import check, option
from studies.localisation_scenes import MAPPING, map_of, reference_of, true_scans


@dataclass(frozen=True, slots=True)
class SpeedOptions:
    """What decides the figures, but for the machine."""

    rounds: int = option(7, "Rounds of each contest.", span=(1, 1000))
    scans: int = option(10, "Scans for rays and matching, taken evenly from the drives.", span=(2, 100))
    length_m: float = option(200.0, "Length of the street.", span=(100.0, 1000.0))
    seed: int = option(1, "World of the street.")

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True, eq=False)
class SpeedScene:
    """A street and the drives of one sensor.

    Attributes:
        sensor: its name.
        cloud: (N, 3) float64 points of the mapping drive, m, map frame, in the order of scanning.
        local_map: their Gaussians.
        unchanged: scans before anything changed: points (N, 3), m, in the vehicle frame, and T_map_vehicle (4, 4).
        changed: the same after it changed, with sensor errors and parked cars.
        drive: all that the car measured on the changed street.
        reference: where it truly was, T_map_vehicle.
        T_vehicle_lidar: (4, 4).
    """

    sensor: str
    cloud: F64
    local_map: LocalMap
    unchanged: list[tuple[F64, F64]]
    changed: list[tuple[F64, F64]]
    drive: list[DriveItem]
    reference: Trajectory
    T_vehicle_lidar: F64


def scene_of(options: SpeedOptions, sensor: str, folder: Path) -> SpeedScene:
    """Simulate the drives and build the map."""
    world = street(options.seed, StreetOptions(options.length_m))
    cloud, local_map = map_of(simulate_drive(world, MAPPING, folder / "mapping.mcap"))
    before = DriveConfig("car", sensor, "before", seed=1, car_share=0.0, cruise_mps=12.0)
    unchanged = simulate_drive(world, before, folder / "before.mcap")
    changed = simulate_drive(world, replace(before, state="after", seed=2, car_share=0.5), folder / "after.mcap")
    return SpeedScene(
        sensor,
        cloud,
        local_map,
        _evenly(list(true_scans(unchanged)), options.scans),
        _evenly(list(true_scans(changed)), options.scans),
        list(read_drive(changed)),
        reference_of(changed),
        read_header(changed).T_vehicle_lidar,
    )


def _evenly(scans: list[tuple[F64, F64]], count: int) -> list[tuple[F64, F64]]:
    return [scans[k] for k in np.linspace(0, len(scans) - 1, min(count, len(scans))).astype(int)]
