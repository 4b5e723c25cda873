"""How high over the ground of the map the Gaussians of a tile lie."""

from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.jit import kernel

FLAT_SIGMA_M: Final = 0.12
"""A Gaussian no thicker than this from bottom to top is a piece of ground, where it lies below what stands."""


def places_m(grid: VoxelGrid, gaussians: Gaussians) -> F64:
    """(N, 3) means, east, north, up, against one corner of the tile at sea level."""
    ix, iy, floor = grid.unravel(gaussians.voxel_id)
    middle = np.stack([(ix + 0.5) * grid.dx_m, (iy + 0.5) * grid.dy_m, (floor + 0.5) * grid.dz_m], axis=1)
    return np.asarray(middle + gaussians.mean_m)


def flat_places_m(grid: VoxelGrid, gaussians: Gaussians) -> F64:
    """(K, 3) the same of those that may be pieces of ground."""
    return places_m(grid, gaussians.take(np.flatnonzero(gaussians.cov_m2[:, 5] < FLAT_SIGMA_M**2)))


@kernel
def ground_m(place: F64, flat: F64, reach_m: float, below_m: float) -> F64:
    """(N,) height of the ground under each place: the median of what is flat near and below; NaN where nothing is."""
    ground = np.full(len(place), np.nan)
    near = np.empty(len(flat))
    for k in range(len(place)):
        n = 0
        x, y, z = place[k]
        for j in range(len(flat)):
            if z - below_m < flat[j, 2] < z and (flat[j, 0] - x) ** 2 + (flat[j, 1] - y) ** 2 <= reach_m**2:
                near[n] = flat[j, 2]
                n += 1
        if n:
            ground[k] = np.median(near[:n])
    return ground


def warm_up() -> None:
    """Compile or load the kernel."""
    place = np.zeros((1, 3))
    ground_m(place, place, 1.0, 1.0)
