"""A road's centre line in the plane, by the way along it, made from its curvature or from a closed figure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import RoadError

FloatArray = NDArray[np.float64]

STEP_M: Final = 0.25
"""Centre lines are sampled this densely; straight in between, they err by < 1 mm where the radius is >= 30 m."""


@dataclass(frozen=True, slots=True, eq=False)
class Centreline:
    """A line in the map frame by the way along it.

    Attributes:
        xy_m: float64 (S, 2), a point every STEP_M of way.
        heading_rad: float64 (S,), counter-clockwise from east, not wrapped.
        closed: the way goes on past the end where it began; the last sample lies one step before the first.
    """

    xy_m: FloatArray
    heading_rad: FloatArray
    closed: bool = False

    def __post_init__(self) -> None:
        count = len(self.heading_rad)
        if self.xy_m.shape != (count, 2) or count < 2:
            raise RoadError(f"a centre line needs (S, 2) points and (S,) headings, got {self.xy_m.shape}, {count}")
        if not (np.isfinite(self.xy_m).all() and np.isfinite(self.heading_rad).all()):
            raise RoadError("a centre line must be finite")

    @property
    def length_m(self) -> float:
        """Way from the first sample to the last; once around when closed."""
        return (len(self.xy_m) - (0 if self.closed else 1)) * STEP_M

    def at(self, way_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return points float64 (K, 2) and headings float64 (K,), not wrapped, at ways (K,) [m].

        An open line goes on straight beyond its ends.
        """
        way = np.asarray(way_m, dtype=np.float64)
        return self._around(way) if self.closed else self._along(way)

    def offset(self, way_m: FloatArray, left_m: FloatArray | float) -> FloatArray:
        """Return the points float64 (K, 2) that lie `left_m` to the left of the line at ways (K,)."""
        xy, heading = self.at(way_m)
        return np.asarray(xy + np.asarray(left_m)[..., None] * np.stack([-np.sin(heading), np.cos(heading)], axis=-1))

    def curvature(self, way_m: FloatArray) -> FloatArray:
        """Return the curvature float64 (K,), left positive [1/m]."""
        way = np.asarray(way_m, dtype=np.float64)
        return np.asarray((self.at(way + STEP_M)[1] - self.at(way - STEP_M)[1]) / (2 * STEP_M))

    def _along(self, way: FloatArray) -> tuple[FloatArray, FloatArray]:
        samples = STEP_M * np.arange(len(self.xy_m))
        inside = np.clip(way, 0.0, samples[-1])
        heading = np.interp(inside, samples, self.heading_rad)
        xy = np.stack([np.interp(inside, samples, column) for column in self.xy_m.T], axis=-1)
        beyond = (way - inside)[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        return xy + beyond, heading

    def _around(self, way: FloatArray) -> tuple[FloatArray, FloatArray]:
        laps = np.floor(way / self.length_m)
        position = (way - laps * self.length_m) / STEP_M
        low = np.minimum(np.floor(position).astype(np.int64), len(self.xy_m) - 1)
        share = position - low
        turn = self._turn_rad
        xy = np.concatenate([self.xy_m, self.xy_m[:1]])
        heading = np.append(self.heading_rad, self.heading_rad[0] + turn)
        points = xy[low] * (1.0 - share)[..., None] + xy[low + 1] * share[..., None]
        return points, heading[low] * (1.0 - share) + heading[low + 1] * share + laps * turn

    @property
    def _turn_rad(self) -> float:
        """What the heading gains in a lap: one turn, to the left or to the right."""
        return float(2 * np.pi * np.sign(self.heading_rad[-1] - self.heading_rad[0]))


def of_curvature(pieces: Sequence[tuple[float, float]], heading_rad: float) -> Centreline:
    """Return the open line that starts at the origin and runs through pieces of (length [m], curvature at its end).

    The curvature changes linearly within a piece (a clothoid), from 0 at the start.
    """
    ends = np.concatenate([[0.0], np.cumsum([length for length, _ in pieces])])
    curvature = np.array([0.0, *(c for _, c in pieces)])
    way = np.arange(0.0, ends[-1] + STEP_M / 2, STEP_M)
    middle = np.interp(way[:-1] + STEP_M / 2, ends, curvature)
    heading = heading_rad + np.concatenate([[0.0], np.cumsum(middle * STEP_M)])
    between = 0.5 * (heading[:-1] + heading[1:])
    steps = STEP_M * np.stack([np.cos(between), np.sin(between)], axis=1)
    return Centreline(np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)]), heading)


def of_figure(xy_m: FloatArray) -> Centreline:
    """Return the closed line through a dense closed figure, float64 (P, 2), sampled anew by its way."""
    ring = np.concatenate([xy_m, xy_m[:1]])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    count = round(way[-1] / STEP_M)
    # Resized so that a whole number of steps fits: by less than one step in the whole length.
    at = np.arange(count) * way[-1] / count
    points = np.stack([np.interp(at, way, column) for column in ring.T], axis=1) * (count * STEP_M / way[-1])
    ahead = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    return Centreline(points, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])), closed=True)
