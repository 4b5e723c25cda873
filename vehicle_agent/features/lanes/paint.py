"""Paint on the road in one scan of a LiDAR, by its reflectivity.

What an intensity means differs from sensor to sensor, and within one with range, incidence and laser. So nothing here
knows an absolute value: a point is bright against its neighbours on the same ring, which have nearly its range and
incidence, by what points of that ring scatter. A marking is a short run of bright points across the way.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from gnd.gnd_map.arrays import F64, I64
from gnd.schemas.limits import MAX_POINTS_OF_SCAN
from gnd.vehicle_agent.features.errors import BadLook

PAINT_RANGE_M: Final = 20.0
"""Farther out rings lie so far apart and shots so flat that a marking is met by one shot or none."""
_GROUND_BAND_M: Final = (0.5, 0.15, 0.08)
"""About the fitted road, in three rounds."""
_LEAST_GROUND: Final = 100
_NEIGHBOURS: Final = 41
"""Points of a ring of which the median is the road's own brightness there."""
_BRIGHT_SIGMAS: Final = 4.0
_BRIGHT_SHARE: Final = 0.5
"""A point is bright if it exceeds its neighbours' median by all: so many sigmas of the ring, absolute and as a share of
the median, and this share."""
_GAP_M: Final = 0.25
_LEAST_SLANT: Final = 0.3
"""A run counts where its ring crosses the way: where it runs along it, the run's middle is not that of the paint."""
_SIDE_POINTS: Final = 3
"""So many beside a run are compared in brightness, ..."""
_FAR_POINTS: Final = 8
"""... and so many in height: a kerb may begin a hand's breadth beside a bright stone."""
_LIKE: Final = 1.5
_STEP_M: Final = 0.06
PAINT_WIDTH_M: Final = (0.05, 0.45)
"""Of one run across the way, with the width of the last shot; markings are 0.1 to 0.3 m wide."""


@dataclass(frozen=True, slots=True, eq=False)
class PaintLook:
    """What one scan shows of the road.

    Attributes:
        runs_m: (R, 3) middles of bright runs, vehicle frame.
        width_m: (R,) their extent across the vehicle's x axis.
        ground_m: (G, 3) points on the road, vehicle frame: where paint would have been seen.
    """

    runs_m: F64
    width_m: F64
    ground_m: F64


def paint_look(points_m: F64, intensity: F64, ring: NDArray[np.integer] | None) -> PaintLook:
    """Find runs of paint in a scan.

    Args:
        points_m: (N, 3) vehicle frame, freed of the vehicle's motion; rows that are not finite are left out.
        intensity: (N,) as the sensor gives it, in any unit, linear in the power that returns, >= 0.
        ring: (N,) laser of each point; None: points come ring after ring, each a turn (`rings_of_order`).

    Raises:
        BadLook: lengths differ, too many points, or intensities that are negative or not finite.
    """
    points_m, intensity, ring = _checked(points_m, intensity, ring)
    near = (np.hypot(points_m[:, 0], points_m[:, 1]) < PAINT_RANGE_M) & (np.abs(points_m[:, 2]) < 2.0)
    rows = np.flatnonzero(near)
    rows = rows[_on_road(points_m[rows])]
    order = np.lexsort((np.arctan2(points_m[rows, 1], points_m[rows, 0]), ring[rows]))
    rows = rows[order]
    if len(rows) < _LEAST_GROUND:
        return PaintLook(np.zeros((0, 3)), np.zeros(0), points_m[rows])
    bright = _bright(intensity[rows], ring[rows])
    middles, width = _runs(points_m[rows], intensity[rows], ring[rows], bright)
    return PaintLook(middles, width, points_m[rows])


def _checked(points_m: F64, intensity: F64, ring: NDArray[np.integer] | None) -> tuple[F64, F64, I64]:
    points_m, intensity = np.asarray(points_m, np.float64), np.asarray(intensity, np.float64)
    if points_m.ndim != 2 or points_m.shape[1] != 3 or intensity.shape != (len(points_m),):
        raise BadLook(f"points of shape {points_m.shape} with intensities of shape {intensity.shape}: (N, 3) and (N,)")
    if len(points_m) > MAX_POINTS_OF_SCAN:
        raise BadLook(f"a scan of {len(points_m)} points, at most {MAX_POINTS_OF_SCAN}")
    if ring is not None and np.shape(ring) != (len(points_m),):
        raise BadLook(f"{len(points_m)} points with rings of shape {np.shape(ring)}")
    good = np.isfinite(points_m).all(axis=1)
    wrong = good & ~(np.isfinite(intensity) & (intensity >= 0.0))
    if wrong.any():
        raise BadLook(f"{int(wrong.sum())} of {len(points_m)} intensities are negative or not finite")
    numbers = rings_of_order(points_m) if ring is None else np.asarray(ring, np.int64)
    return points_m[good], intensity[good], numbers[good]


def rings_of_order(points_m: F64) -> I64:
    """(N,) number of the turn that each point is in, of a scan that lists its lasers one after the other (KITTI)."""
    azimuth = np.nan_to_num(np.arctan2(points_m[:, 1], points_m[:, 0])) % (2.0 * np.pi)
    jump = np.abs(np.diff(azimuth, prepend=azimuth[:1]))
    return np.cumsum(jump > np.pi).astype(np.int64)


def _on_road(points_m: F64) -> NDArray[np.bool_]:
    """Which points lie on the road: a surface z = a + b x + c y + d y², fitted in rounds of a narrower band."""
    x, y, z = points_m.T
    A = np.column_stack([np.ones_like(x), x, y, y * y])
    on = np.abs(z) < _GROUND_BAND_M[0]
    for band in _GROUND_BAND_M[1:]:
        if on.sum() < _LEAST_GROUND:
            return np.zeros(len(points_m), np.bool_)
        surface = A @ np.linalg.lstsq(A[on], z[on], rcond=None)[0]
        on = np.abs(z - surface) < band
    return np.asarray(on)


def _bright(intensity: F64, ring: I64) -> NDArray[np.bool_]:
    """Which points of a road, ring after ring, are brighter than their neighbours."""
    usual = median_filter(intensity, _NEIGHBOURS, mode="nearest")
    above = intensity - usual
    _, number = np.unique(ring, return_inverse=True)
    ends = np.flatnonzero(np.diff(number, prepend=-1, append=number[-1] + 1))
    noise = np.zeros(len(above))
    share = above / np.maximum(usual, 1e-9)
    for first, last in pairwise(ends):
        absolute, relative = (1.4826 * np.median(np.abs(one[first:last])) for one in (above, share))
        noise[first:last] = np.maximum(absolute, relative * usual[first:last])
    steps = np.diff(np.unique(intensity))
    quantum = float(steps.min()) if len(steps) else 0.0
    return np.asarray(above > np.maximum(np.maximum(_BRIGHT_SIGMAS * noise, _BRIGHT_SHARE * usual), quantum))


def _between_equals(points_m: F64, intensity: F64, ring: I64, starts: I64, ends: I64) -> NDArray[np.bool_]:
    """Whether the road goes on beside a run on both sides, as high and as dark: a kerb, a seam of surfaces is none."""
    before = np.clip(starts[:, None] - np.arange(1, _FAR_POINTS + 1), 0, len(ring) - 1)
    after = np.clip(ends[:, None] + np.arange(1, _FAR_POINTS + 1), 0, len(ring) - 1)
    same = (ring[before[:, :_SIDE_POINTS]] == ring[starts][:, None]).all(axis=1)
    same &= (ring[after[:, :_SIDE_POINTS]] == ring[ends][:, None]).all(axis=1)
    near = [
        np.hypot(*(points_m[side[:, 0], :2] - points_m[end, :2]).T) < _GAP_M
        for side, end in ((before, starts), (after, ends))
    ]
    dark, other = (intensity[side[:, :_SIDE_POINTS]].mean(axis=1) for side in (before, after))
    step = np.abs(points_m[before, 2].mean(axis=1) - points_m[after, 2].mean(axis=1))
    alike = np.maximum(dark, other) < _LIKE * np.minimum(dark, other) + 1e-9
    return np.asarray(same & near[0] & near[1] & alike & (step < _STEP_M))


def _runs(points_m: F64, intensity: F64, ring: I64, bright: NDArray[np.bool_]) -> tuple[F64, F64]:
    """Middles (R, 3) and widths (R,) of the bright runs that may be markings."""
    step = np.diff(points_m, axis=0, append=points_m[-1:])
    length = np.hypot(step[:, 0], step[:, 1])
    linked = bright[:-1] & bright[1:] & (ring[:-1] == ring[1:]) & (length[:-1] < _GAP_M)
    starts = np.flatnonzero(bright & ~np.concatenate([[False], linked]))
    ends = np.flatnonzero(bright & ~np.concatenate([linked, [False]]))
    if not len(starts):
        return np.zeros((0, 3)), np.zeros(0)
    middle = 0.5 * (points_m[starts] + points_m[ends])
    before = np.maximum(starts - 1, 0)  # the step from the point before stands for the spacing of shots
    spacing = np.minimum(length[before], length[ends])
    slant = np.abs(step[before, 1]) / np.maximum(length[before], 1e-9)
    width = np.abs(points_m[ends, 1] - points_m[starts, 1]) + spacing * slant
    apart = length[before] < _GAP_M
    fits = (slant > _LEAST_SLANT) & apart & (width > PAINT_WIDTH_M[0]) & (width < PAINT_WIDTH_M[1])
    fits &= _between_equals(points_m, intensity, ring, starts, ends)
    return middle[fits], width[fits]
