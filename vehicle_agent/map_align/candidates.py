"""Where B may lie on A: the correlation of both maps' upright surfaces over all shifts and headings of the search."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial import cKDTree

from gnd.gnd_map.arrays import F32, F64
from gnd.gnd_map.se3 import exp_so3, transform
from gnd.vehicle_agent.map_align.cloud import GaussianCloud

_CELL_M: Final = 1.0
_BLUR_CELLS: Final = 0.8
_HEADINGS: Final = 4
"""Bins of a wall's direction; posts and bushes go into all."""
_EDGE_M: Final = 1.5
"""So far the outermost surface may move from one heading to the next."""
_MOST_HEADINGS: Final = 61
_HEIGHT_STEP_M: Final = 0.25
_GROUND_NEAR_M: Final = 1.5


@dataclass(frozen=True, slots=True)
class Reach:
    """How far from where it says B may lie.

    Attributes:
        shift_m: horizontally, each way.
        heading_deg: each way.
        height_m: up and down.
    """

    shift_m: float
    heading_deg: float
    height_m: float


@dataclass(frozen=True, slots=True, eq=False)
class AlignmentStart:
    """A start for the fit: (4, 4), and the correlation there."""

    T_a_b: F64
    correlation: float


def candidates(a: GaussianCloud, b: GaussianCloud, pivot_m: F64, reach: Reach, most: int) -> list[AlignmentStart]:
    """The best distinct places of B, best first.

    Args:
        a: what stays.
        b: what is moved; in the same frame, where it says it is.
        pivot_m: (3,) about which B is turned.
        reach: what is searched.
        most: so many at most.
    """
    walls_a, walls_b = a.take(a.is_upright), b.take(b.is_upright)
    if not len(walls_a) or not len(walls_b):
        return []
    radius_m = float(np.linalg.norm(walls_b.mean_m[:, :2] - pivot_m[:2], axis=1).max())
    limit = np.radians(reach.heading_deg)
    steps = int(min(_MOST_HEADINGS // 2, max(1, np.ceil(limit * radius_m / _EDGE_M))))
    found = list[tuple[float, float, float, float]]()
    grid = _Correlation.of(walls_a, pivot_m, radius_m, reach.shift_m)
    for heading in np.linspace(-limit, limit, 2 * steps + 1).tolist():
        turned = walls_b.moved(about(pivot_m, heading))
        found += [(value, heading, east, north) for value, east, north in grid.peaks(turned, most)]
    found.sort(reverse=True)
    kept = list[tuple[float, float, float, float]]()
    for one in found:
        if all(np.hypot(one[2] - other[2], one[3] - other[3]) > 2.0 * _CELL_M for other in kept):
            kept.append(one)
    return [AlignmentStart(_with_height(a, b, pivot_m, reach, *one[1:]), one[0]) for one in kept[:most]]


def about(pivot_m: F64, heading_rad: float) -> F64:
    """(4, 4) turn about the vertical through a point (3,)."""
    T = np.eye(4)
    T[:3, :3] = exp_so3(np.array([0.0, 0.0, heading_rad]))
    T[:3, 3] = pivot_m - T[:3, :3] @ pivot_m
    return T


def _with_height(
    a: GaussianCloud, b: GaussianCloud, pivot_m: F64, reach: Reach, heading: float, east: float, north: float
) -> F64:
    """The place with the height at which most level surfaces of B meet those of A."""
    T = about(pivot_m, heading)
    T[:2, 3] += east, north
    level_a, level_b = a.mean_m[a.is_ground], transform(T, b.mean_m[b.is_ground])
    if not len(level_a) or not len(level_b):
        return T
    meet = cKDTree(level_b[:, :2]).query_ball_tree(cKDTree(level_a[:, :2]), _GROUND_NEAR_M)
    up = np.concatenate([level_a[rows, 2] - level_b[k, 2] for k, rows in enumerate(meet) if rows] or [np.empty(0)])
    bins = int(np.ceil(reach.height_m / _HEIGHT_STEP_M))
    counts, edges = np.histogram(up, np.arange(-bins, bins + 2) * _HEIGHT_STEP_M - _HEIGHT_STEP_M / 2)
    if counts.sum():
        T[2, 3] += float(edges[counts.argmax()]) + _HEIGHT_STEP_M / 2
    return T


@dataclass(frozen=True, slots=True, eq=False)
class _Correlation:
    """A's upright surfaces as spectra of images from above, one a direction."""

    low_m: F64
    shape: tuple[int, int]
    reach_cells: int
    spectra: "np.ndarray[tuple[int, ...], np.dtype[np.complex64]]"

    @classmethod
    def of(cls, walls: GaussianCloud, pivot_m: F64, radius_m: float, shift_m: float) -> "_Correlation":
        """For maps B that lie within a radius of the pivot."""
        half = radius_m + shift_m + 4.0 * _CELL_M
        side = next_fast_len(int(np.ceil((2.0 * half + shift_m) / _CELL_M)), real=True)
        low = pivot_m[:2] - half
        images = np.stack([gaussian_filter(one, _BLUR_CELLS) for one in _images(walls, low, (side, side))])
        spectra = np.asarray(rfft2(images), np.complex64)
        return cls(low, (side, side), int(np.ceil(shift_m / _CELL_M)), spectra)

    def peaks(self, walls_b: GaussianCloud, most: int) -> list[tuple[float, float, float]]:
        """Correlation and shift east and north [m] of the highest local maxima of it."""
        spectra_b = rfft2(_images(walls_b, self.low_m, self.shape))
        product = irfft2((self.spectra * np.conj(spectra_b)).sum(axis=0), self.shape)
        r = self.reach_cells
        wrapped = np.arange(-r, r + 1)
        near = np.asarray(product[np.ix_(wrapped, wrapped)])
        is_peak = (near == maximum_filter(near, 3)) & (near > 0)
        east, north = np.nonzero(is_peak)
        best = np.argsort(-near[east, north])[:most]
        return [
            (float(near[i, j]), float(i - r) * _CELL_M, float(j - r) * _CELL_M)
            for i, j in zip(east[best].tolist(), north[best].tolist(), strict=True)
        ]


def _images(walls: GaussianCloud, low_m: F64, shape: tuple[int, int]) -> F32:
    """(bins, east, north) how much stands in each cell, by the direction of its normal, spread over four cells.

    A high wall counts more than a low one, but not by its height: the square root of what stands in a cell.
    """
    at = (walls.mean_m[:, :2] - low_m) / _CELL_M - 0.5
    cell = np.floor(at).astype(np.int64)
    part = at - cell
    inside = (cell >= 0).all(axis=1) & (cell[:, 0] < shape[0] - 1) & (cell[:, 1] < shape[1] - 1)
    cell, part = cell[inside], part[inside]
    angle = np.arctan2(walls.normal[inside, 1], walls.normal[inside, 0]) % np.pi * _HEADINGS / np.pi
    lower = np.floor(angle).astype(np.int64)
    images = np.zeros((_HEADINGS, *shape), np.float32)
    for bin_, share in ((lower % _HEADINGS, 1.0 - (angle - lower)), ((lower + 1) % _HEADINGS, angle - lower)):
        for i in (0, 1):
            for j in (0, 1):
                weight = np.abs(1 - i - part[:, 0]) * np.abs(1 - j - part[:, 1]) * share
                np.add.at(images, (bin_, cell[:, 0] + i, cell[:, 1] + j), weight)
    return np.sqrt(images)
