"""New voxels where the map knows nothing at all: they extend it, and are no evidence against the pose or the map.

A tile holds what its survey met, not where it looked. But a survey that saw a place met something there, the ground at
least. So where the map holds nothing above, below or beside a column of voxels, it has not been surveyed: ground behind
the last house, behind what has gone since, beyond the end of the survey's road.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.grid import VoxelGrid
from gnd.vehicle_agent.detect.classify import Classification


def beyond_map(found: Classification) -> NDArray[np.bool_]:
    """(K,) the new voxels in whose column, and in the eight around it, the map of the tile holds nothing."""
    base = found.evidence.base
    grid = VoxelGrid.of(base.tile_id)
    known = np.zeros((grid.nx, grid.ny), np.bool_)
    x, y, _ = grid.unravel(base.gaussians.voxel_id)
    known[x, y] = True
    beside = binary_dilation(known, np.ones((3, 3), np.bool_))
    x, y, _ = grid.unravel(found.evidence.voxel_id)
    return np.asarray((found.change_class == ChangeClass.NEW) & ~beside[x, y])
