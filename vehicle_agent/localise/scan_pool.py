"""The last scans together, in the frame of the newest: one view of a place that is wider than one scan's."""

from collections import deque
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.vehicle_agent.localise.initialise import STANDING_ABOVE_M, ground_below, thinned

_EVERY_M: Final = 0.7
"""A scan is kept every so many metres ..."""
_REACH_M: Final = 10.0
"""... for so much way."""
_N_POINTS: Final = 400

STANDING_M = 0.02  # between two scans


class ScanPool:
    """Points of the newest scan and of some before it, moved along by odometry: a four-layer scan alone holds little.

    Scans enter every so many metres, and leave after so many; a standing vehicle's pool is its newest scan.
    """

    def __init__(self, every_m: float = _EVERY_M, reach_m: float = _REACH_M) -> None:
        self._every_m, self._reach_m = every_m, reach_m
        self._older: deque[tuple[F64, F64, float]] = deque()  # points, those that stand, way since
        self._newest: tuple[F64, F64] = (np.empty((0, 3)), np.empty((0, 3)))
        self._since_m = np.inf
        self.stands = True

    def push(self, points_m: F64, T_before_now: F64) -> bool:
        """Take a scan, (N, 3) in the vehicle frame, and the motion (4, 4) since the one before; True when it is a new
        part of the view, not the last one seen again.
        """
        way_m = float(np.hypot(T_before_now[0, 3], T_before_now[1, 3]))
        T = T_inverse(T_before_now)
        moved = [(transform(T, p), transform(T, s), way + way_m) for p, s, way in self._older]
        self._older = deque(one for one in moved if one[2] <= self._reach_m)
        self.stands = way_m < STANDING_M
        self._since_m += way_m
        self._newest = points_m, standing_points(points_m, STANDING_ABOVE_M)
        if self._since_m < self._every_m:
            return False
        self._since_m = 0.0
        few = _N_POINTS
        self._older.append((thinned(self._newest[0], few), thinned(self._newest[1], few), 0.0))
        return True

    @property
    def newest_standing_m(self) -> F64:
        """(N, 3) points of the newest scan that stand above the ground, vehicle frame."""
        return self._newest[1]

    @property
    def points_m(self) -> F64:
        """(N, 3) all points, the newest scan's first, newest vehicle frame."""
        return np.concatenate([self._newest[0], *(p for p, _, way in self._older if way > 0.0)])

    @property
    def standing_m(self) -> F64:
        """(N, 3) those that stand above the ground; the ground fits everywhere."""
        return np.concatenate([self._newest[1], *(s for _, s, way in self._older if way > 0.0)])


def standing_points(points_m: F64, above_ground_m: float, slope: float = 0.0) -> F64:
    """The points (N, 3) of a scan in the vehicle frame that stand so high above the ground, and so much more for each
    metre of distance.
    """
    if not len(points_m):
        return points_m
    rise_m = above_ground_m + slope * np.hypot(points_m[:, 0], points_m[:, 1])
    return points_m[points_m[:, 2] > ground_below(points_m) + rise_m]
