"""The true motion of a vehicle that rides along a path over uneven ground."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.fleet_sim.courses.path import Path
from gnd.fleet_sim.courses.ride import Ride
from gnd.fleet_sim.courses.terrain import TerrainGround
from gnd.fleet_sim.trajectory import swaying
from gnd.fleet_sim.world import World
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse, exp_so3, log_so3

_STEP_S: Final = 0.5e-3


@dataclass(frozen=True, eq=False)
class CourseMotion:
    """Rear axle on the path, wheels on the ground, body swaying a little; in closed form at any time.

    Attributes:
        world: whose frames these are.
        ground: what it drives on.
        path: along which its rear axle goes.
        ride: how far it has come.
        sway_rad: nine phases of roll, pitch and heave.
    """

    world: World
    ground: TerrainGround
    path: Path
    ride: Ride
    sway_rad: tuple[float, ...]

    def T_map_vehicle(self, t_s: F64) -> F64:
        """Return the true poses, float64 (K, 4, 4), at times (K,) [s] after the first scan."""
        t_s = np.asarray(t_s, dtype=np.float64)
        place, ahead = self.path.at(self.ride.way_m(t_s))
        return self.standing(place, ahead, swaying(t_s, self.sway_rad))

    def standing(self, place_m: F64, ahead: F64, sway: tuple[F64, F64, F64]) -> F64:
        """Return the poses (K, 4, 4) of a vehicle at places (K, 2), heading `ahead` (K, 2), with roll, pitch and heave.

        Both in the street frame.
        """
        rise = self.ground.gradient(place_m)
        zero, one = np.zeros(len(place_m)), np.ones(len(place_m))
        along, across = np.stack([one, zero, rise[:, 0]], axis=1), np.stack([zero, one, rise[:, 1]], axis=1)
        up = _unit(np.cross(self.world.map_of_street(along), self.world.map_of_street(across)))
        forward = np.column_stack([ahead, (rise * ahead).sum(axis=1)])
        x_axis = _unit(self.world.map_of_street(forward))
        roll, pitch, heave = sway
        T = np.tile(np.eye(4), (len(place_m), 1, 1))
        R_map_road = np.stack([x_axis, np.cross(up, x_axis), up], axis=2)
        T[:, :3, :3] = R_map_road @ exp_so3(np.stack([roll, pitch, zero], axis=1))
        ground = np.column_stack([place_m, self.ground.height_m(place_m)])
        T[:, :3, 3] = self.world.map_of_street(ground) + heave[:, None] * up
        return T

    def speed_and_yaw_rate(self, t_s: F64) -> tuple[F64, F64]:
        """Return true speed along the vehicle's x [m/s] and rate about its z [rad/s] at times (K,) [s]."""
        step = T_inverse(self.T_map_vehicle(t_s - _STEP_S)) @ self.T_map_vehicle(t_s + _STEP_S)
        return step[:, 0, 3] / (2 * _STEP_S), log_so3(step[:, :3, :3])[:, 2] / (2 * _STEP_S)


def _unit(vectors: F64) -> F64:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
