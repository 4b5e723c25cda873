"""Which thing of a world a point lies at: for the analysis of errors, by kind of thing and edit."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.shapes import BALL, POST, pack
from gnd.fleet_sim.truth import Truth, grids_of
from gnd.fleet_sim.world import World

FloatArray = NDArray[np.float64]

REACH_M: Final = 0.87
"""Half the diagonal of a voxel."""
_CHUNK: Final = 512


def things_of_voxels(world: World, truth: Truth, rows: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the thing that each of some voxels lies at, as `things_at` does.

    Args:
        world: the world of the truth.
        truth: V voxels.
        rows: int64 (N,), which of them.
    """
    centre = np.empty((len(rows), 3))
    for grid in grids_of(truth):
        for tile in grid.tiles:
            mine = truth.morton[rows] == tile.morton
            centre[mine] = grid.centre_map_m(grid.grid_of_voxel(tile, truth.voxel_id[rows[mine]]))
    return things_at(world, centre)


def things_at(world: World, points_map_m: FloatArray, reach_m: float = REACH_M) -> NDArray[np.int32]:
    """Return for each point the edited thing, or else any thing, that is nearest to it and not beyond `reach_m`.

    Args:
        world: both its states.
        points_map_m: float64 (N, 3), map frame.
        reach_m: what lies farther away is not named.

    Returns:
        int32 (N,), index into `world.objects`, -1 where nothing is near.
    """
    packed = pack([shape for o in world.objects for shape in o.shapes])
    owner = np.array([index for index, o in enumerate(world.objects) for _ in o.shapes], dtype=np.int32)
    kept = np.array([world.objects[index].edit == "kept" for index in owner])
    points = world.street_of_map(points_map_m)
    found = np.full(len(points), -1, dtype=np.int32)
    for start in range(0, len(points), _CHUNK):
        gap = _gaps(packed, points[start : start + _CHUNK])
        near = gap.min(axis=1) <= reach_m
        best = np.argmin(np.where(gap <= reach_m, gap + 2 * reach_m * kept, np.inf), axis=1)
        found[start : start + _CHUNK] = np.where(near, owner[best], -1)
    return found


def _gaps(packed: FloatArray, points: FloatArray) -> FloatArray:
    """Distance (N, M) of points (N, 3) from M packed primitives, 0 inside."""
    kind, x, y = packed[:, 0], packed[:, 1], packed[:, 2]
    dx, dy, z = points[:, 0:1] - x, points[:, 1:2] - y, points[:, 2:3]
    flat = np.hypot(dx, dy)
    c, s = packed[:, 7], packed[:, 8]
    u, v = c * dx + s * dy, c * dy - s * dx
    top = packed[:, 6] + packed[:, 9] * u + packed[:, 10] * v
    above = np.maximum(np.maximum(z - top, packed[:, 5] - z), 0.0)
    beside = np.hypot(np.maximum(np.abs(u) - packed[:, 3], 0.0), np.maximum(np.abs(v) - packed[:, 4], 0.0))
    block = np.hypot(above, beside)
    post = np.hypot(above, np.maximum(flat - packed[:, 3], 0.0))
    ball = np.maximum(np.hypot(flat, z - packed[:, 3]) - packed[:, 4], 0.0)
    return np.asarray(np.where(kind == BALL, ball, np.where(kind == POST, post, block)))
