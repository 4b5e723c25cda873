"""The shift test on what is about to be reported: a whole tile's measured Gaussians against its map.

Each stretch of the drive has passed the same test with limits that its poses allow. What adds up over many scans is
known better: an error of a few centimetres that all of them share shows only here.
"""

from typing import Final

import numpy as np

from gnd_map.arrays import F64
from gnd_map.classes import ChangeClass
from gnd_map.gaussian import Gaussians
from gnd_map.geodesy import LocalFrame
from gnd_map.grid import VoxelGrid
from gnd_map.se3 import T_inverse, transform
from vehicle_agent.detect.classify import Classification
from vehicle_agent.detect.shift import Shift, ShiftParameters, costs_at, find_shift
from vehicle_agent.localise.match_map import MatchMapCache

LEAST_CHANGES: Final = 10
"""A tile with fewer is told as it is."""
EXPLAINED: Final = 0.5
"""Share of the changed voxels that a shift must lay onto the map, less those that it spoils."""
_PARAMETERS: Final = ShiftParameters(least_m=0.05, loosest_m=0.15, most_m=0.2, z=4.0)
"""Larger shifts would have been found while driving; in a single tile that was rebuilt they are found by chance."""
_SPREAD: Final = 1.2
"""Points of a Gaussian that stand for it: its mean, and so many sigmas to either side along each axis."""


def pose_error_of_tile(found: Classification, match_map: MatchMapCache, T_map_vehicle: F64) -> Shift | None:
    """The shift that explains most of what has changed in a tile; None where there is none.

    Args:
        found: the classes of the tile.
        match_map: the base map.
        T_map_vehicle: (4, 4) whose axes the shift is given along; its place does not matter.
    """
    base = found.evidence.base
    if not base.version or int(found.changed.sum()) < LEAST_CHANGES:
        return None
    rows = np.flatnonzero(found.observed & (found.evidence.measured.count > 0))
    frame = match_map.local_map.grid_frame.frame
    points = _points_of(found.evidence.measured.take(rows), found, frame)
    T = T_map_vehicle.copy()
    T[:3, 3] = points.reshape(-1, 3).mean(axis=0)  # a turn about the tile, not about a vehicle far away
    near = match_map.near(T[:3, 3])
    points_vehicle_m = transform(T_inverse(T), points.reshape(-1, 3))
    shift = find_shift(points_vehicle_m, T, near, planar=True)
    if not shift.checked or not shift.is_pose_error(_PARAMETERS, found.evidence.pose):
        return None
    was, now = (costs_at(points_vehicle_m, pose, near).reshape(len(rows), -1).mean(axis=1) for pose in (T, T @ shift.T))
    changed = np.isin(found.change_class[rows], (ChangeClass.NEW, ChangeClass.MODIFIED))
    explained = changed & (was > 0.5) & (now < 0.5)
    spoiled = ~changed & (was < 0.5) & (now > 0.5)
    enough = explained.sum() - spoiled.sum() >= EXPLAINED * max(int((changed & (was > 0.5)).sum()), 1)
    return shift if enough else None


def _points_of(gaussians: Gaussians, found: Classification, frame: LocalFrame) -> F64:
    """(N, 7, 3) map frame: mean and three pairs of points of each Gaussian."""
    tile = found.evidence.base.tile_id
    values, vectors = np.linalg.eigh(gaussians.full_cov())
    arms = np.swapaxes(vectors * (_SPREAD * np.sqrt(values.clip(0.0)))[:, None, :], 1, 2)
    mean = (VoxelGrid.of(tile).centre_m(gaussians.voxel_id) + gaussians.mean_m)[:, None, :]
    points = np.concatenate([mean, mean + arms, mean - arms], axis=1)
    return np.asarray(transform(frame.T_self_other(LocalFrame.of_tile(tile)), points.reshape(-1, 3)).reshape(-1, 7, 3))
