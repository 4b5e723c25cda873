"""What a mapping vehicle sees of a place's state before: sweeps of an HDL-32E taken standing, poses exact."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from gnd.fleet_sim.courses.company import movers_of
from gnd.fleet_sim.courses.course import CoursePlace
from gnd.fleet_sim.courses.foliage import Foliage
from gnd.fleet_sim.courses.motion import CourseMotion
from gnd.fleet_sim.courses.ride import RIDE_STEP_S, Ride
from gnd.fleet_sim.lidar import Lidar
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.sensors import HDL32E
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import transform

STEP_M: Final = 2.0
_SPEED_MPS: Final = 10.0
_MIN_RANGE_M, _MAX_RANGE_M = 2.0, 80.0


def survey_points(place: CoursePlace, step_m: float = STEP_M) -> Iterator[F64]:
    """Return the points (N, 3) of each sweep in the world's map frame, one every `step_m` of all surveyed paths."""
    world, rng = place.world, np.random.default_rng([place.world.seed, 0x5CA9])
    scene, lidar = Scene.build(world.shapes("before"), world.A_street_map), Lidar(HDL32E)
    leaves = place.foliage.get("before", ())
    foliage = Foliage(leaves, place.world.seed) if leaves else None
    T_vehicle_lidar = np.eye(4)
    T_vehicle_lidar[:3, 3] = HDL32E.mount_m
    for path in place.surveys:
        ride = _steady(path.length_m)
        motion = CourseMotion(world, place.ground, path, ride, (0.0,) * 9)
        movers = movers_of(place.mapped_behind, motion)
        for t_s in np.arange(0.0, ride.duration_s, step_m / _SPEED_MPS).tolist():
            at, ahead = path.at(ride.way_m(np.array([t_s])))
            T = (motion.standing(at, ahead, (np.zeros(1), np.zeros(1), np.zeros(1))) @ T_vehicle_lidar)[0]
            poses = np.broadcast_to(T, (HDL32E.columns + 1, 4, 4))
            points = lidar.sweep(scene, poses, rng, movers, t_s, foliage).points_lidar_m
            range_m = np.linalg.norm(points, axis=1)
            yield transform(T, points[(range_m >= _MIN_RANGE_M) & (range_m <= _MAX_RANGE_M)])


def _steady(way_m: float) -> Ride:
    """The mapping vehicle's ride: its sweeps are taken as if it stood wherever it is."""
    return Ride(np.full(round((way_m / _SPEED_MPS + 5.0) / RIDE_STEP_S), _SPEED_MPS), way_m / _SPEED_MPS)
