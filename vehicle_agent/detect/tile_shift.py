"""The shift test on what is about to be reported: a whole tile's measured Gaussians against its map.

Each stretch of the drive has passed the same test with limits that its poses allow. What adds up over many scans is
known better: an error of a few centimetres that all of them share shows only here.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.vehicle_agent.detect.classify import Classification
from gnd.vehicle_agent.detect.shift import OF_SCANS, Shift, costs_at, find_shift
from gnd.vehicle_agent.localise.match_map import MatchMapCache

_LEAST_CHANGES: Final = 5
"""A tile with fewer is reported as it is."""
_MOST: Final = 0.5
"""Where a shift explains so large a share of what changed, the tile is not reported."""
_FALLS: Final = 0.05
"""A voxel whose cost falls by this, to `_FITS`, is explained."""
_FITS: Final = 0.3
_TEST: Final = replace(OF_SCANS, least_m=0.05, sigmas=0.0, most_m=0.2, z=6.0)
"""Larger shifts would have been found while driving; in a single tile that was rebuilt they are found by chance."""
_SPREAD: Final = 1.2
"""Points of a Gaussian that stand for it: its mean, and so many sigmas to either side along each axis."""


@dataclass(frozen=True, slots=True, eq=False)
class TileShift:
    """A pose error that all scans of a tile share.

    Attributes:
        shift: the correction, as if the vehicle were in the middle of the tile.
        explained: (K,) bool, voxels of the tile that seem to have changed and fit the base after the shift.
        most: whether these are most of what changed.
    """

    shift: Shift
    explained: NDArray[np.bool_]
    most: bool


def pose_error_of_tile(found: Classification, match_map: MatchMapCache, T_map_vehicle: F64) -> TileShift | None:
    """The small shift that all of a tile is off by; None where there is none, or nothing that it explains.

    Args:
        found: the classes of the tile.
        match_map: the base map.
        T_map_vehicle: (4, 4) whose axes the shift is given along; its place does not matter.
    """
    rows = np.flatnonzero(found.observed & (found.evidence.measured.count > 0))
    if not found.evidence.base.version or int(found.changed.sum()) < _LEAST_CHANGES or not len(rows):
        return None
    points_map_m = _points_of(found.evidence.measured.take(rows), found, match_map.local_map.grid_frame.frame)
    T = T_map_vehicle.copy()
    T[:3, 3] = points_map_m.mean(axis=0)  # a turn about the tile, not about a vehicle far away
    points_m, near = transform(T_inverse(T), points_map_m), match_map.near(T[:3, 3])
    shift = find_shift(points_m, T, near, planar=True)
    if not shift.checked or not shift.is_pose_error(_TEST, found.evidence.pose):
        return None
    was, now = (costs_at(points_m, pose, near).reshape(len(rows), -1).mean(axis=1) for pose in (T, T @ shift.T))
    measured = np.isin(found.change_class[rows], (ChangeClass.NEW, ChangeClass.MODIFIED))
    fits = measured & (was - now > _FALLS) & (now < _FITS)
    if not fits.any():
        return None
    explained = np.zeros(len(found.evidence), np.bool_)
    explained[rows[fits]] = True
    return TileShift(shift, explained, bool(fits.sum() >= max(_MOST * measured.sum(), _LEAST_CHANGES)))


def _points_of(gaussians: Gaussians, found: Classification, frame: LocalFrame) -> F64:
    """(7 N, 3) map frame: of each Gaussian its mean and three pairs of points."""
    tile = found.evidence.base.tile_id
    values, vectors = np.linalg.eigh(gaussians.full_cov())
    arms = np.swapaxes(vectors * (_SPREAD * np.sqrt(values.clip(0.0)))[:, None, :], 1, 2)
    mean = (VoxelGrid.of(tile).centre_m(gaussians.voxel_id) + gaussians.mean_m)[:, None, :]
    points = np.concatenate([mean, mean + arms, mean - arms], axis=1)
    return np.asarray(transform(frame.T_self_other(LocalFrame.of_tile(tile)), points.reshape(-1, 3)))
