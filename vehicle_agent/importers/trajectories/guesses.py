"""What numbers are, found from their size and from how the body moves."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.importers.trajectories.pose_table import Coordinates

F64 = NDArray[np.float64]

EARTH_M: Final = (6.33e6, 6.42e6)
"""Distances from the Earth's centre at which vehicles drive."""
UTM_EAST_M: Final = (100_000.0, 900_000.0)
UTM_NORTH_M: Final = (100_000.0, 10_000_000.0)
FORWARD: Final = 0.9
LEAST_WAY_M: Final = 3.0


def coordinates_of(p: F64) -> Coordinates:
    """What positions (N, 3) in metres count from; local where they are too small to be anything else."""
    middle = np.median(p, axis=0)
    if EARTH_M[0] < np.linalg.norm(middle) < EARTH_M[1]:
        return "ecef"
    if UTM_EAST_M[0] < middle[0] < UTM_EAST_M[1] and UTM_NORTH_M[0] < middle[1] < UTM_NORTH_M[1]:
        return "utm"
    return "local"


def forward(p: F64, R: F64) -> F64:
    """(3,) in the body's axes, the way that it mostly moves: a unit vector, or zeros where it hardly moves."""
    step = np.diff(p, axis=0)
    if np.linalg.norm(step, axis=1).sum() < LEAST_WAY_M:
        return np.zeros(3)
    in_body = np.einsum("nji,nj->i", R[:-1], step)
    return np.asarray(in_body / np.linalg.norm(step, axis=1).sum())


def looks_like_camera(p: F64, R: F64) -> bool:
    """Whether the body moves along its z: a camera's axes (x right, y down, z forward)."""
    return bool(abs(forward(p, R)[2]) > FORWARD)
