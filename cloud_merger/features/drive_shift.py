"""The shift that each drive has in common with itself: by how much drives disagree beyond what they claim.

A drive's errors of localisation and calibration move all that it measures near a place alike, and are the first to be
missing from its covariances. So a measured place is y_i = x + s_i + e_i with e_i ~ N(0, C_i) as reported and a shift
s_i ~ N(0, S I), one of each drive, of which nobody tells the size. S follows from the drives' scatter about their mean
(DerSimonian and Laird 1986, "Meta-analysis in clinical trials", of vectors). The shifts are marginalised: the
covariance of the estimate is that of Σ K_i y_i under C_i + S I.
"""

from typing import Final

import numpy as np

from gnd.cloud_merger.features.rls import PlaceEstimate
from gnd.gnd_map.arrays import F64

FEATURE_SHIFT_DOUBTED_FROM: Final = 8.0
"""Degrees of freedom that speak for the drives' covariances before any are compared: two drives that happen to disagree
say little of how far drives are off in common, ten say much."""


class DriveShift:
    """Scatter of the places (x, y) that drives measured of one feature, about their mean. Constant work a drive."""

    def __init__(self) -> None:
        self._n = 0
        self._W, self._WW = np.zeros((2, 2)), np.zeros((2, 2))
        self._Wy, self._yWy, self._trace = np.zeros(2), 0.0, 0.0
        self._first = np.zeros(2)

    def add(self, place: PlaceEstimate, drives: int = 1) -> None:
        """One more measurement of a point: a drive's, or what so many drives together have left of theirs, whose shifts
        have averaged out by as much.
        """
        W, y = np.linalg.inv(place.cov_m2[:2, :2]), place.points_m[0, :2]
        if not self._n:
            self._first = y.copy()  # differences of near places: no digits are lost in squares
        y = y - self._first
        self._n += 1
        self._W, self._WW, self._trace = self._W + W, self._WW + W @ W / drives, self._trace + np.trace(W) / drives
        self._Wy, self._yWy = self._Wy + W @ y, self._yWy + float(y @ W @ y)

    @property
    def variance_m2(self) -> float:
        """S, of each axis; 0 where drives agree as well as they claim."""
        if self._n < 2:
            return 0.0
        C, free = np.linalg.inv(self._W), 2.0 * (self._n - 1)
        scatter = self._yWy - float(self._Wy @ C @ self._Wy)
        spent = float(self._trace - np.trace(C @ self._WW))
        return max(scatter - free, 0.0) / max(spent, 1e-12) * free / (free + FEATURE_SHIFT_DOUBTED_FROM)

    def added_m2(self) -> F64:
        """(2, 2) by how much the shifts make the mean of all drives less certain: Σ K_i S K_iᵀ with K_i = C W_i."""
        variance = self.variance_m2
        if variance == 0.0:
            return np.zeros((2, 2))
        C = np.linalg.inv(self._W)
        return np.asarray(variance * C @ self._WW @ C)
