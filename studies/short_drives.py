"""Short simulated drives through a tuning world, its outdated map, and the error of a pose against the truth."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gnd.fleet_sim.drives import EPOCH_NS, PERFECT, DriveConfig, DriveSimulation
from gnd.fleet_sim.sensors import MODELS
from gnd.fleet_sim.traffic import Traffic
from gnd.fleet_sim.trajectory import Direction
from gnd.fleet_sim.world import State, World
from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.gnd_map.tile_id import TileId, covering_circle
from gnd.schemas.drive import DriveItem, GnssFix, ReferencePose, Scan
from gnd.vehicle_agent.local_map import LocalMap
from studies.frame.scans import local_map_of, posed

GNSS_M, GNSS_WHITE_M = 2.5, 0.2
LIMIT_M, LIMIT_DEG = 0.44, 0.5
"""Ford's limits on a local street (the GND paper's section 7.2): a pose beyond one of them is wrong."""
_MARGIN_S, _TRUTH_S = 0.2, 0.01


@dataclass(frozen=True)
class MappedStreet:
    """A world and the map that was made of its state before the changes, by one drive up and one down the street."""

    world: World
    half_m: float = 70.0

    @cached_property
    def grid_frame(self) -> GridFrame:
        """The map frame is the world's."""
        radius_m = self.world.half_length_m + self.half_m
        return GridFrame.around(self.world.frame, covering_circle(self.world.lat_rad, self.world.lon_rad, radius_m))

    @cached_property
    def tiles(self) -> Mapping[TileId, Gaussians]:
        """Of the state before, by an HDL-32E with range noise and exact poses."""
        accumulator = VoxelAccumulator(self.grid_frame)
        for direction in (1, -1):
            for points in _mapped(self.world, 1 if direction > 0 else -1, self.half_m):
                accumulator.add(points)
        return {tile_id: g for tile_id, g in accumulator.finish().items() if len(g)}

    def local_map(self) -> LocalMap:
        """All tiles, held."""
        return local_map_of(self.grid_frame, self.tiles)

    def drive(self, sensor: str, state: State, direction: Direction, seed: int, *, empty: bool = False) -> "ShortDrive":
        """A drive with the default errors of its sensors, from one end of the street to the other; `empty`: of cars."""
        traffic, share = (Traffic(), 0.0) if empty else (Traffic.urban(), 0.2)
        config = DriveConfig("car", sensor, state, direction=direction, seed=seed, car_share=share, traffic=traffic)
        return ShortDrive(self, DriveSimulation(self.world, config), MODELS[sensor].rate_hz)


@dataclass(frozen=True)
class ShortDrive:
    """A simulated drive: its truth, and what its sensors give but GNSS, which each trial draws for itself."""

    street: MappedStreet
    simulation: DriveSimulation
    rate_hz: float

    @property
    def seconds(self) -> float:
        """How long it takes."""
        return self.simulation.scans / self.rate_hz

    @cached_property
    def truth(self) -> Trajectory:
        """True poses in the map frame."""
        t_s = np.arange(-_MARGIN_S, self.seconds + _MARGIN_S, _TRUTH_S)
        t_ns = EPOCH_NS + np.round(t_s * 1e9).astype(np.int64)
        return Trajectory(t_ns, np.asarray(self.simulation.motion.T_map_vehicle(t_s)))

    def items(self) -> Iterator[DriveItem]:
        """Motion and scans, in time order."""
        return (item for item in self.simulation.items() if not isinstance(item, (GnssFix, ReferencePose)))

    def fix(self, t_ns: int, offset_m: F64, rng: np.random.Generator) -> GnssFix:
        """What a GNSS tells that is off by `offset_m` (3,) and some noise."""
        p = self.truth.at(t_ns)[:3, 3] + offset_m + GNSS_WHITE_M * rng.standard_normal(3)
        lat, lon, height = self.street.world.frame.geodetic_from_enu(p)
        return GnssFix(t_ns, float(lat), float(lon), float(height), GNSS_M)

    def true_fix(self, t_ns: int) -> GnssFix:
        """Where the vehicle is, as no GNSS could tell."""
        lat, lon, height = self.street.world.frame.geodetic_from_enu(self.truth.at(t_ns)[:3, 3])
        return GnssFix(t_ns, float(lat), float(lon), float(height), GNSS_M)

    def off(self, t_ns: int, T_map_vehicle: F64) -> tuple[float, float]:
        """Horizontal distance [m] and turn about the vertical [deg] of a pose from the true one."""
        error = np.asarray(T_inverse(self.truth.at(t_ns)) @ T_map_vehicle)
        turn = np.degrees(abs(np.arctan2(error[1, 0], error[0, 0])))
        return float(np.hypot(error[0, 3], error[1, 3])), float(turn)


def gnss_offset_m(rng: np.random.Generator) -> F64:
    """(3,) error of a GNSS of 2.5 m (root mean square of both horizontal axes together)."""
    return np.asarray(GNSS_M / np.sqrt(2.0) * rng.standard_normal(3) * [1.0, 1.0, 1.5])


def is_wrong(off_m: float, off_deg: float) -> bool:
    """True when a pose is beyond a limit."""
    return off_m > LIMIT_M or off_deg > LIMIT_DEG


def _mapped(world: World, direction: Direction, reach_m: float) -> Iterator[F64]:
    """Points (N, 3) of each scan of a mapping drive, map frame."""
    config = DriveConfig("map", "HDL-32E", "before", direction, errors=PERFECT, car_share=0.0, cruise_mps=12.0)
    simulation = DriveSimulation(world, config)
    items = list(simulation.items())
    known = [item for item in items if isinstance(item, ReferencePose)]
    truth = Trajectory(np.array([r.t_ns for r in known], np.int64), np.stack([r.T_map_vehicle for r in known]))
    mount = simulation.header().T_vehicle_lidar
    for scan in items:
        if isinstance(scan, Scan):
            points, T = posed(scan, truth, mount)
            yield transform(T, points[np.linalg.norm(points, axis=1) < reach_m])
