"""The line that a vehicle follows over the ground, by the way along it: straight, swaying in its lane, or curved."""

from math import tau
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from gnd.fleet_sim.errors import DriveSimError
from gnd.gnd_map.arrays import F64

_STEP_M: Final = 1.0


class Path:
    """A smooth line in the street frame, carried on straight beyond its ends.

    Attributes:
        length_m: from its first point to its last, along it.
    """

    def __init__(self, points_m: F64) -> None:
        """Lay a spline through points.

        Args:
            points_m: float64 (N, 2), street x and y, about a metre apart, N >= 4.

        Raises:
            DriveSimError: too few points, or points that are not finite or coincide.
        """
        if points_m.ndim != 2 or points_m.shape[1] != 2 or len(points_m) < 4 or not np.isfinite(points_m).all():
            raise DriveSimError(f"a path needs at least 4 finite points (N, 2), got {points_m.shape}")
        steps = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
        if steps.min() <= 0.0:
            raise DriveSimError(f"points {int(steps.argmin())} and {int(steps.argmin()) + 1} of a path coincide")
        way = np.concatenate([[0.0], np.cumsum(steps)])
        self.length_m = float(way[-1])
        self._line = CubicSpline(way, points_m)
        self._along = self._line.derivative()

    def at(self, way_m: F64) -> tuple[F64, F64]:
        """Return places (K, 2) and unit directions (K, 2) at ways (K,) along it [m]."""
        inside = np.clip(way_m, 0.0, self.length_m)
        along = self._along(inside)
        ahead = along / np.linalg.norm(along, axis=1, keepdims=True)
        return self._line(inside) + (way_m - inside)[:, None] * ahead, ahead

    def beside(self, way_m: F64, left_m: float) -> F64:
        """Return the places (K, 2) at ways (K,), `left_m` to the left of the path."""
        place, ahead = self.at(way_m)
        return place + left_m * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)

    def shifted(self, left_m: float, *, reverse: bool = False) -> "Path":
        """Return the path `left_m` to the left of this one, or that path driven the other way."""
        points = self.beside(np.arange(0.0, self.length_m, _STEP_M), left_m)
        return Path(points[::-1] if reverse else points)


def lane(x0_m: float, x1_m: float, y_m: float, rng: np.random.Generator) -> Path:
    """Return a straight lane from x0 to x1 in which somebody sways by some decimetres."""
    x = np.linspace(x0_m, x1_m, max(4, round(abs(x1_m - x0_m) / _STEP_M)))
    wander_m, length_m, phase = rng.uniform(0.05, 0.2), rng.uniform(45.0, 75.0), rng.uniform(0.0, tau)
    return Path(np.stack([x, y_m + wander_m * np.sin(tau * x / length_m + phase)], axis=1))


def smoothed(corners_m: F64, smooth_m: float) -> Path:
    """Return a path along corners (N, 2) whose bends are rounded over some `smooth_m`."""
    steps = np.linalg.norm(np.diff(corners_m, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    even = np.arange(0.0, way[-1], _STEP_M)
    dense = np.stack([np.interp(even, way, corners_m[:, k]) for k in range(2)], axis=1)
    return Path(gaussian_filter1d(dense, smooth_m / _STEP_M, axis=0, mode="nearest")[2:-2])
