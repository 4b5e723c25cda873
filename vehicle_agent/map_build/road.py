"""How high the LiDAR stands over the road: the plane of the ground around the vehicle, from one scan."""

from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64

RING_M: Final = (2.5, 15.0)
"""Where the ground is looked for, from the LiDAR, horizontally."""
CELL_M: Final = 1.0
MIN_CELLS: Final = 25
GATE_M: Final = 0.12
"""Half of the thickness in which the ground lies, once it is roughly known."""
ROUGH_M: Final = 0.5
MAX_SLOPE: Final = 0.2
MIN_SPREAD_M: Final = 2.0
"""One sd of where the ground was seen, across: along the foot of a wall any plane fits."""


def road_below(points_vehicle_m: F64, lidar_vehicle_m: F64) -> float | None:
    """Height z [m] of the road under the LiDAR in the vehicle frame; None where too little ground is seen.

    The lowest points of metre squares around the vehicle, of which most lie on the ground; a plane through them, robust
    against kerbs, cars and echoes by taking again and again what lies near it.

    Args:
        points_vehicle_m: (N, 3) of one scan, vehicle frame.
        lidar_vehicle_m: (3,) where the LiDAR is.
    """
    low = _lowest(points_vehicle_m - lidar_vehicle_m)
    if len(low) < MIN_CELLS:
        return None
    plane = np.array([0.0, 0.0, float(np.median(low[:, 2]))])
    A = np.c_[low[:, :2], np.ones(len(low))]
    for gate_m in (ROUGH_M, ROUGH_M, 2 * GATE_M, GATE_M, GATE_M):
        near = np.abs(low[:, 2] - A @ plane) < gate_m
        if near.sum() < MIN_CELLS:
            return None
        plane = np.linalg.lstsq(A[near], low[near, 2], rcond=None)[0]
    spread_m = np.sqrt(np.linalg.eigvalsh(np.cov(low[near, :2].T))[0])
    if np.hypot(plane[0], plane[1]) > MAX_SLOPE or near.sum() < len(low) / 3 or spread_m < MIN_SPREAD_M:
        return None
    return float(plane[2] + lidar_vehicle_m[2])


def _lowest(points_m: F64) -> F64:
    """(K, 3) the second lowest point of each square of the ring: the lowest may be an echo."""
    distance = np.hypot(points_m[:, 0], points_m[:, 1])
    # nothing near the road stands a metre above the LiDAR
    points = points_m[(distance > RING_M[0]) & (distance < RING_M[1]) & (points_m[:, 2] < 1.0)]
    cells = np.floor(points[:, :2] / CELL_M).astype(np.int64) + 64
    key = cells[:, 0] * 128 + cells[:, 1]
    order = np.lexsort((points[:, 2], key))
    key, points = key[order], points[order]
    if len(key) < 2:
        return np.empty((0, 3))
    before, two_before = np.r_[-1, key[:-1]], np.r_[-1, -1, key[:-2]]
    return np.asarray(points[(before == key) & (two_before != key)])
