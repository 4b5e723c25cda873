"""How much of what is around the vehicle has changed, along its way."""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnd.fleet_sim.drives import DriveConfig, DriveSimulation
from gnd.fleet_sim.ellipsoids import ellipsoids_of_truth
from gnd.fleet_sim.truth import Truth
from gnd.fleet_sim.world import World
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.classes import ChangeClass

NEAR_M: Final = 20.0
STEP_S: Final = 0.25


def changed_share_along(world: World, truth: Truth, drive: DriveConfig) -> tuple[F64, F64]:
    """Return times (K,) [s] since the drive began and the share (K,) of Gaussians within `NEAR_M` that changed."""
    simulation = DriveSimulation(world, drive)
    t_s = np.arange(0.0, simulation.scans / drive.model.rate_hz, STEP_S)
    ellipsoids = ellipsoids_of_truth(truth)
    changed = ellipsoids.change_class != int(ChangeClass.NORMAL)
    way_m = simulation.motion.T_map_vehicle(t_s)[:, :2, 3]
    return t_s, share_near(ellipsoids.mean_m[:, :2], changed, way_m)


def share_near(p_m: F64, changed: NDArray[np.bool_], way_m: F64) -> F64:
    """Share (K,) of the points (M, 2) near each place (K, 2) that are marked; 0 where there is none."""
    near = cKDTree(p_m).query_ball_point(way_m, NEAR_M)
    return np.array([changed[index].mean() if index else 0.0 for index in near])
