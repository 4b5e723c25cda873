"""From a scan to slices: what each row of rays sees of thin things that stand free."""

from dataclasses import dataclass
from math import ceil, radians, tan
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.poles.errors import PoleInputError
from gnd.vehicle_agent.features.poles.kernels import (
    Beside,
    Rows,
    azimuth_step,
    layer_gaps,
    polar_of,
    row_order,
    thin_slices,
)
from gnd.vehicle_agent.features.poles.place_kernels import GroundCells, cone_heights, heights_over, lowest_heights

_RANGE_MIN_M: Final = 2.0
"""Nearer points are the vehicle itself."""
POLE_RANGE_MAX_M: Final = 40.0
"""Farther points are left out: a ring hits a post once or not at all there."""
_GROUND_CELL_M: Final = 1.0
_GROUND_SLOPE: Final = 0.12
"""The ground rises no steeper than this."""
_FEET_M: Final = 0.25
"""What lies lower over the ground is the ground."""
_ROW_DEG: Final = 0.4
"""Rays whose elevations differ by less are neighbours of a row; rows are even in the tangent of the elevation."""
_LINK_M: Final = 0.25
"""Neighbours of a row whose ranges differ by less lie on one thing."""
POLE_DIAMETER_MAX_M: Final = 0.55
"""Beams have a width: 0.5 m of a trunk measure this."""
_CLEAR_M: Final = 0.35
"""So far beside a pole nothing stands at its range, on at least one side …"""
_JUMP_M: Final = 0.4
"""… nor behind it by less than this."""

U8 = NDArray[np.uint8]

TAN_MAX = 0.6
"""Steeper rays (31°) are in no row."""
COLUMNS = 360
LAYER_SHARE = 0.8
"""Of the distances of layers, the one that is not exceeded in this share of the cases."""
PIT_M = 0.5
MAX_SLICES = 20_000
"""A scan of a street has some hundred; of more, the nearest are kept."""
MIN_STEP_RAD = radians(0.02)
NEARBY = np.indices((5, 5)).reshape(2, 25) - 2
"""Cells of the ground around one."""
MIDDLE = 12


class Slices(NamedTuple):
    """S slices of thin things, one row of one scan each.

    Attributes:
        xy_m: (S, 2) middle of the visible front: mean distance, in the direction of its middle.
        z_m: (S,) mean height.
        height_m: (S,) over the ground.
        toward: (S, 2) unit vector from the sensor.
        range_m: (S,) horizontal distance from the sensor.
        extent_m: (S,) from the first to the last of its points, across.
        step_m: (S,) distance of two rays there.
        points: (S,) number of points.
        scan: (S,) which scan of a window.
        hidden: (S,) whether something nearer is beside it.
        sigma_along_m: (S,) of the scan's own place, along its rays and …
        sigma_across_m: (S,) … across them.
    """

    xy_m: F64
    z_m: F64
    height_m: F64
    toward: F64
    range_m: F64
    extent_m: F64
    step_m: F64
    points: I64
    scan: I64
    hidden: I64
    sigma_along_m: F64
    sigma_across_m: F64


@dataclass(frozen=True, slots=True, eq=False)
class GroundHeights:
    """The ground around a vehicle.

    Attributes:
        cells: squares.
        z_m: (n, n) their heights, where nothing is seen the highest that they may have.
        seen_m: (n, n) heights where the ground is seen, else inf.
    """

    cells: GroundCells
    z_m: F64
    seen_m: F64

    def under(self, points_m: F64) -> F64:
        """(N,) height of the points (N, 3) over the ground."""
        return heights_over(points_m, self.z_m, self.cells)

    def at(self, xy_m: F64) -> F64:
        """(N,) height of the ground at places (N, 2): mean of what is seen nearby, the nearer the more it weighs."""
        cell = np.floor((xy_m - [self.cells.x0, self.cells.y0]) / self.cells.cell_m).astype(np.int64)
        i, j = (np.clip(cell[:, k, None] + NEARBY[k], 0, self.cells.n - 1) for k in range(2))
        weight = np.where(np.isfinite(self.seen_m[i, j]), 1.0 / (1.0 + NEARBY[0] ** 2 + NEARBY[1] ** 2), 0.0)
        known = weight.sum(axis=1) > 0.0
        height = (weight * np.where(weight > 0.0, self.seen_m[i, j], 0.0)).sum(axis=1)
        seen = height / np.where(known, weight.sum(axis=1), 1.0)
        return np.asarray(np.where(known, seen, self.z_m[i[:, MIDDLE], j[:, MIDDLE]]))


class PoseSigma(NamedTuple):
    """Standard deviations of a scan's own place (each axis) and heading, drawn anew for each scan."""

    m: float
    rad: float


EXACT = PoseSigma(0.0, 0.0)


class SeenSlice(NamedTuple):
    """A scan after its slices are found.

    Attributes:
        slices: the slices.
        points_m: (K, 3) everything above the ground within range.
        height_m: (K,) over the ground.
        layer_tan: distance of the sensor's layers, as tangent.
    """

    slices: Slices
    points_m: F64
    height_m: F64
    layer_tan: float


def check_rays(points_m: F64, origins_m: F64) -> tuple[F64, F64]:
    """Points (N, 3) and origins (3,) or (N, 3) as contiguous float64 (N, 3) and (1 or N, 3).

    Raises:
        PoleInputError: other shapes, or an origin that is not finite.
    """
    points, origins = np.ascontiguousarray(points_m, np.float64), np.ascontiguousarray(origins_m, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise PoleInputError(f"points must be (N, 3), got {points.shape}")
    origins = origins.reshape(1, 3) if origins.shape == (3,) else origins
    if origins.shape not in ((1, 3), points.shape):
        raise PoleInputError(f"origins must be (3,) or {points.shape}, got {origins.shape}")
    if len(origins) == 1 and not np.isfinite(origins).all():
        raise PoleInputError(f"the origin of the rays is {origins[0].tolist()}, which is not finite")
    return points, origins


def ground_around(points_m: F64, centre_m: F64) -> GroundHeights:
    """The ground around a place on the road: no higher than what is seen, no steeper than it may be.

    Args:
        points_m: (N, 3) of one scan, or several.
        centre_m: (3,) the vehicle's origin: the road lies there.
    """
    half = ceil((POLE_RANGE_MAX_M + 3.0) / _GROUND_CELL_M)
    side = half * _GROUND_CELL_M
    cells = GroundCells(float(centre_m[0]) - side, float(centre_m[1]) - side, _GROUND_CELL_M, 2 * half)
    low = lowest_heights(points_m, cells, float(centre_m[2]), _GROUND_SLOPE, PIT_M)
    low[half - 1 : half + 1, half - 1 : half + 1] = centre_m[2]
    z = cone_heights(low, _GROUND_SLOPE * _GROUND_CELL_M)
    return GroundHeights(cells, z, np.where(low <= z, low, np.inf))


def slices_of(
    points_m: F64, origins_m: F64, ground: GroundHeights, number: int = 0,
    pose: PoseSigma = EXACT,
) -> SeenSlice:  # fmt: skip
    """The slices of one scan.

    Args:
        points_m: (N, 3), z up; what is not finite is left out.
        origins_m: (1 or N, 3) starts of the rays.
        ground: under the points.
        number: of the scan in its window.
        pose: how well the scan's own place is known.
    """
    kept, polar = polar_of(points_m, origins_m, _RANGE_MIN_M, POLE_RANGE_MAX_M)
    points = points_m[kept]
    height = ground.under(points)
    step_tan = tan(radians(_ROW_DEG))
    rows = Rows(-TAN_MAX, step_tan, ceil(2 * TAN_MAX / step_tan), COLUMNS)
    layer_tan = _layer_gap(layer_gaps(polar, rows)) * step_tan
    high = np.flatnonzero((height > _FEET_M) & (height < np.inf))
    everything, points, height, polar = polar, points[high], height[high], polar[high]
    order, start = row_order(polar, rows)
    step = azimuth_step(polar, order, start, _LINK_M) or azimuth_step(everything, *row_order(everything, rows), _LINK_M)
    step = max(step, MIN_STEP_RAD)
    found = thin_slices(polar, order, start, step, Beside(_LINK_M, POLE_DIAMETER_MAX_M, _CLEAR_M, _JUMP_M))
    origins = origins_m if len(origins_m) == 1 else origins_m[kept[high]]
    slices = _described(*found, points, height, polar, origins, step, number)
    if pose != EXACT:
        slices = slices._replace(
            sigma_along_m=np.full(len(slices.z_m), pose.m), sigma_across_m=np.hypot(pose.m, pose.rad * slices.range_m)
        )
    return SeenSlice(slices, points, height, layer_tan)


def _layer_gap(gaps: I64) -> int:
    """Rows from one layer to the next, from how often each number of rows was found between returns of a column."""
    return max(int(np.searchsorted(np.cumsum(gaps), LAYER_SHARE * gaps.sum())), 1)


def _described(
    members: I64, start: I64, sides: U8, points: F64, height: F64, polar: F64, origins: F64, step: float, number: int
) -> Slices:
    if len(start) < 2:
        return empty_slices()
    at, count = start[:-1], np.diff(start)
    distance = _mean(polar[members, 1], at, count)
    first = polar[members[at], 0]
    extent = (polar[members[start[1:] - 1], 0] - first) % (2 * np.pi)
    middle = first + 0.5 * extent
    toward = np.column_stack([np.cos(middle), np.sin(middle)])
    origin = origins[:, :2] if len(origins) == 1 else origins[members[at], :2]
    found = Slices(
        xy_m=origin + distance[:, None] * toward,
        z_m=_mean(points[members, 2], at, count),
        height_m=_mean(height[members], at, count),
        toward=toward,
        range_m=distance,
        extent_m=extent * distance,
        step_m=step * distance,
        points=count,
        scan=np.full(len(at), number),
        hidden=(sides != 0).any(axis=1).astype(np.int64),
        sigma_along_m=np.zeros(len(at)),
        sigma_across_m=np.zeros(len(at)),
    )
    if len(at) > MAX_SLICES:
        return take(found, np.sort(np.argsort(distance, kind="stable")[:MAX_SLICES]))
    return found


def _mean(values: F64, at: I64, count: I64) -> F64:
    return np.asarray(np.add.reduceat(values, at) / count)


def take(slices: Slices, index: I64) -> Slices:
    """Some of the slices."""
    return Slices._make(column[index] for column in slices)


def joined(parts: list[Slices]) -> Slices:
    """The slices of several scans, one after the other."""
    return Slices._make(map(np.concatenate, zip(*parts, strict=True))) if parts else empty_slices()


def empty_slices() -> Slices:
    """No slices."""
    flat, plane, whole = np.empty(0), np.empty((0, 2)), np.empty(0, np.int64)
    return Slices(plane, flat, flat, plane, flat, flat, flat, whole, whole, whole, flat, flat)
