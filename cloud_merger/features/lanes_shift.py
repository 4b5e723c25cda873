"""The shift that each drive has in common with itself across a piece of a line: `drive_shift` of one dimension.

Of a piece only its place across can be measured, so drives scatter in one dimension about their mean, and there is one
degree of freedom for each drive but the first.
"""

from typing import Final

import numpy as np

from gnd.cloud_merger.features.rls import PlaceEstimate
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features.lane_pieces import beside, left_of

LANES_SHIFT_DOUBTED_FROM: Final = 1.0
"""Degrees of freedom that speak for the drives' variances before any are compared."""


class LateralShift:
    """Scatter of the places across that drives measured of one piece, about their mean. Constant work a drive."""

    def __init__(self) -> None:
        self._first: F64 | None = None
        self._n, self._w, self._ww, self._wy, self._wyy = 0, 0.0, 0.0, 0.0, 0.0

    def add(self, place: PlaceEstimate, drives: int = 1) -> None:
        """One more measurement of the piece: a drive's, or what so many drives together have left of theirs."""
        if self._first is None:
            self._first = place.points_m
        _, y = beside(self._first, place.points_m)
        if not np.isfinite(y):
            return
        left = left_of(self._first)
        w = 1.0 / float(left @ place.cov_m2 @ left)
        self._n += 1
        self._w, self._ww = self._w + w, self._ww + w * w / drives
        self._wy, self._wyy = self._wy + w * y, self._wyy + w * y * y

    @property
    def variance_m2(self) -> float:
        """S, across; 0 where drives agree as well as they claim."""
        if self._n < 2:
            return 0.0
        free = self._n - 1.0
        scatter = self._wyy - self._wy**2 / self._w
        spent = self._w - self._ww / self._w
        return max(scatter - free, 0.0) / max(spent, 1e-12) * free / (free + LANES_SHIFT_DOUBTED_FROM)

    def added_m2(self) -> F64:
        """(2, 2) by how much the shifts make the mean of all drives less certain across the piece."""
        variance = self.variance_m2
        if variance == 0.0 or self._first is None:
            return np.zeros((2, 2))
        left = left_of(self._first)[:2]
        return np.asarray(variance * self._ww / self._w**2 * np.outer(left, left))
