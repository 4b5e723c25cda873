"""The drives of a fleet: each its own sensor, direction, parked cars and traffic, all from the world's seed."""

import numpy as np

from gnd.fleet_sim.drives import EPOCH_NS, DriveConfig
from gnd.fleet_sim.prepare import mapping_configs
from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.fleet_sim.traffic import Traffic
from studies.simulation.options import RunOptions

_HOUR_NS = 3_600 * 1_000_000_000


def fleet_sensors(options: RunOptions, seed: int) -> tuple[str, ...]:
    """Return the sensor of each vehicle, short names: the sensors in a seeded order, again and again."""
    order = np.random.default_rng([seed, 0xF1EE7]).permutation(len(options.sensors)).tolist()
    return tuple(options.sensors[order[index % len(order)]] for index in range(options.fleet_size))


def fleet_configs(options: RunOptions, seed: int) -> tuple[DriveConfig, ...]:
    """Return the drive of each vehicle through the world of a seed, in the order in which the fleet grows.

    Directions alternate, and each sensor drives both ways.
    """
    sensors, round_trip = fleet_sensors(options, seed), len(options.sensors)
    return tuple(
        DriveConfig(
            vehicle=f"vehicle-{index:02d}",
            sensor=SHORT_NAMES[sensor],
            direction=1 if (index + index // round_trip * (round_trip % 2 == 0)) % 2 == 0 else -1,
            seed=1_000_003 * seed + index,
            car_share=options.parking,
            traffic=Traffic.urban() if options.traffic else Traffic(),
            scans=options.scans,
            start_ns=EPOCH_NS + index * _HOUR_NS,
        )
        for index, sensor in enumerate(sensors)
    )


def survey_configs(seed: int) -> tuple[DriveConfig, ...]:
    """Return the mapping drives of the state before, for the base map "driven"."""
    return mapping_configs(seed)
