"""From slices to columns: what lies one above the other, its axis and its diameter, and how well both are known."""

from math import pi
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.poles.slices import Slices, take

_AXIS_M: Final = 0.25
"""Slices one above the other lie so near to each other in plan."""
POLE_LAYERS_APART: Final = 1.6
"""A pole goes on where the next slice is so many layers of the sensor away …"""
POLE_GAP_M: Final = 0.6
"""… or so far above."""
_WIDER_M: Final = 0.15
"""Slices that are wider than the thin ones of their pole by this much are a plate or a foot."""
_MIN_SLICES: Final = 3
_MIN_POINTS: Final = 4
_MIN_LENGTH_M: Final = 0.8
"""Length of the thin part that is visible."""
_SIGMA_RANGE_M: Final = 0.03
"""Noise of a range: VLP-16 user manual 63-9243, ±3 cm."""
_SIGMA_FLOOR_M: Final = 0.015
"""What more points do not improve: calibration of the lasers, the pose within the sweep."""

FRONT = pi / 4
"""Of the radius: mean distance from the visible half of a cylinder to the plane through its axis, seen from afar."""
EDGE_SIGMA = 24.0**-0.5
"""Of the rays' distance: error of the middle between the first and the last ray that met something. Either edge lies
evenly within one step of its ray: variance (1/12 + 1/12) / 4."""
THIN_QUANTILE = 0.3
"""Of the widths of a column's slices, the one that is its thin part's."""
SMALLEST_M = 0.02
WIDTH_SIGMA = 6.0**-0.5
"""The same for the width: 1/12 + 1/12."""


class PoleColumns(NamedTuple):
    """C columns of slices.

    Attributes:
        xy_m: (C, 2) axis at the mean height of its slices.
        height_m: (C,) that height, over the ground.
        cov_m2: (C, 2, 2) of the axis.
        lean: (C, 2) metres a metre upwards.
        toward: (C, 2) mean direction from the sensor.
        diameter_m: (C,) mean of the slices.
        sigma_diameter_m: (C,).
        scatter_m: (C,) standard deviation of the slices about the axis, beside what the sensor makes.
        bottom_m: (C,) lowest slice, over the ground.
        top_m: (C,) highest slice, over the ground.
        range_m: (C,) mean distance from the sensor.
        step_m: (C,) distance of two rays.
        points: (C,).
        slices: (C,).
        scans: (C,) that saw it.
        hidden: (C,) share of its slices beside something nearer.
    """

    xy_m: F64
    height_m: F64
    cov_m2: F64
    lean: F64
    toward: F64
    diameter_m: F64
    sigma_diameter_m: F64
    scatter_m: F64
    bottom_m: F64
    top_m: F64
    range_m: F64
    step_m: F64
    points: I64
    slices: I64
    scans: I64
    hidden: F64


def stacked(slices: Slices, layer_tan: float) -> tuple[Slices, I64]:
    """Which slices lie one above the other: those that do, sorted by column, and their column (S,) 0 … C - 1.

    Columns that are too short, or of too few slices, are left out, and slices off their column's axis.
    """
    label = _linked(slices, layer_tan)
    for _ in range(2):
        slices, label = _large(slices, _on_one_axis(slices, label))
        off = slices.xy_m - _axis_at(slices, label)
        near = np.flatnonzero((np.hypot(*off.T) <= _AXIS_M) & ~_much_wider(slices, label))
        slices, label = take(slices, near), label[near]
    return _large(slices, label)


def _linked(slices: Slices, layer_tan: float) -> I64:
    n = len(slices.z_m)
    if n < _MIN_SLICES:
        return np.zeros(n, np.int64)
    a, b = cKDTree(slices.xy_m).query_pairs(_AXIS_M, output_type="ndarray").T
    gap = np.maximum(POLE_GAP_M, POLE_LAYERS_APART * layer_tan * slices.range_m[a])
    close = np.abs(slices.z_m[a] - slices.z_m[b]) <= gap
    return _components(np.column_stack([a[close], b[close]]), n)


def _on_one_axis(slices: Slices, label: I64) -> I64:
    """Labels with columns about one axis joined: a post goes on above its plate."""
    if not len(label):
        return label
    order = np.argsort(label, kind="stable")
    axes = _axes(take(slices, order), label[order])
    pairs = cKDTree(axes).query_pairs(0.5 * _AXIS_M, output_type="ndarray")
    return _components(pairs, len(axes))[np.unique(label, return_inverse=True)[1]]


def _components(pairs: I64, n: int) -> I64:
    graph = coo_matrix((np.ones(len(pairs), np.bool_), pairs.T), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1].astype(np.int64))


def _large(slices: Slices, label: I64) -> tuple[Slices, I64]:
    """Columns with enough slices over enough height, numbered anew, sorted."""
    if not len(label):
        return slices, label
    order = np.argsort(label, kind="stable")
    slices, label = take(slices, order), label[order]
    at = np.flatnonzero(np.diff(label, prepend=-1))
    count = np.diff(at, append=len(label))
    length = np.maximum.reduceat(slices.height_m, at) - np.minimum.reduceat(slices.height_m, at)
    points = np.add.reduceat(slices.points, at)
    good = (count >= _MIN_SLICES) & (length >= _MIN_LENGTH_M) & (points >= _MIN_POINTS)
    kept = np.flatnonzero(np.repeat(good, count))
    return take(slices, kept), np.repeat(np.cumsum(good) - 1, count)[kept]


def _axis_at(slices: Slices, label: I64) -> F64:
    """(S, 2) median place of each slice's column."""
    return _axes(slices, label)[label] if len(label) else np.empty((0, 2))


def _axes(slices: Slices, label: I64) -> F64:
    """(C, 2) median place of each column; `label` sorted."""
    return np.column_stack([_medians(slices.xy_m[:, 0], label), _medians(slices.xy_m[:, 1], label)])


def _much_wider(slices: Slices, label: I64) -> NDArray[np.bool_]:
    """(S,) whether slices are too wide for the thin ones of their column: small plates, feet."""
    width = slices.extent_m + slices.step_m
    thin = _medians(width, label, THIN_QUANTILE)[label] if len(label) else width
    return np.asarray(width > thin + _WIDER_M + slices.step_m)


def _medians(values: F64, label: I64, quantile: float = 0.5) -> F64:
    """(C,) lower median, or quantile, of the values (S,) of each column; `label` sorted."""
    by_value = values[np.lexsort((values, label))]
    at = np.flatnonzero(np.diff(label, prepend=-1))
    last = np.diff(at, append=len(label)) - 1
    return np.asarray(by_value[at + (quantile * last).astype(np.int64)])


def columns_of(slices: Slices, label: I64) -> PoleColumns:
    """Axes and diameters of columns, from slices (S,) sorted by their column (S,) as `stacked` gives them."""
    at = np.flatnonzero(np.diff(label, prepend=-1))
    n = np.diff(at, append=len(label)).astype(np.int64)
    points = np.add.reduceat(slices.points, at) if len(at) else n
    diameter, sigma_diameter, scans = _diameters(slices, label)
    centre = slices.xy_m + FRONT * 0.5 * diameter[label, None] * slices.toward
    height = _sums(slices.height_m, label, n) / n
    lean = _leans(slices, label, centre, height, n)
    upright = centre - lean[label] * (slices.height_m - height[label])[:, None]
    xy, cov, toward = _fused(slices, label, upright, len(n))
    spread = _scatter(slices, label, upright - xy[label], n)
    cov += (FRONT * 0.5 * sigma_diameter)[:, None, None] ** 2 * toward[:, :, None] * toward[:, None, :]
    cov += (spread**2 / n)[:, None, None] * np.eye(2)
    return PoleColumns(
        xy, height, cov, lean, toward, diameter, sigma_diameter, spread,
        np.minimum.reduceat(slices.height_m, at) if len(at) else height,
        np.maximum.reduceat(slices.height_m, at) if len(at) else height,
        _sums(slices.range_m, label, n) / n, _sums(slices.step_m, label, n) / n,
        points, n, scans, _sums(slices.hidden.astype(np.float64), label, n) / n,
    )  # fmt: skip


def _sums(values: F64, label: I64, n: I64) -> F64:
    return np.asarray(np.bincount(label, values, len(n)), np.float64)


def _diameters(slices: Slices, label: I64) -> tuple[F64, F64, I64]:
    """Diameters, their sigmas, and how many scans saw each column.

    A width of w is met by w / step rays on average, which span w - step. Rays of all layers of a scan lie at nearly the
    same azimuths, so that more slices do not help, only more scans.
    """
    count = len(np.unique(label))
    pair = np.unique(label * (slices.scan.max(initial=0) + 1) + slices.scan)
    scans = np.bincount(pair // (slices.scan.max(initial=0) + 1), minlength=count).astype(np.int64)
    if not count:
        return np.empty(0), np.empty(0), scans
    step = _medians(slices.step_m, label)
    n = np.bincount(label)
    width = np.maximum(_sums(slices.extent_m + slices.step_m, label, n) / n, SMALLEST_M)
    sigma = np.maximum(WIDTH_SIGMA * step / np.sqrt(scans), 0.5 * _SIGMA_FLOOR_M)
    return width, sigma, scans


def _leans(slices: Slices, label: I64, centre: F64, height: F64, n: I64) -> F64:
    """(C, 2) lean of the line through the slices, drawn towards upright where the column is short."""
    up = slices.height_m - height[label]
    prior = 4.0 * np.bincount(label, slices.step_m**2 + 0.02**2, len(n)) / n / 0.05**2
    moment = _sums(up * up, label, n) + prior
    middle = np.column_stack([_sums(centre[:, k], label, n) / n for k in range(2)])
    return np.column_stack([_sums(up * (centre[:, k] - middle[label, k]), label, n) / moment for k in range(2)])


def _fused(slices: Slices, label: I64, places: F64, count: int) -> tuple[F64, F64, F64]:
    """Axes (C, 2), their covariances (C, 2, 2), mean direction from the sensors (C, 2): fused over scans.

    A scan knows the axis along its rays by the mean of its ranges, across them by the place between two rays.
    """
    scans = int(slices.scan.max(initial=0)) + 1
    group, member = np.unique(label * scans + slices.scan, return_inverse=True)
    n = np.bincount(member, minlength=len(group))
    mean = np.column_stack([np.bincount(member, places[:, k], len(group)) / n for k in range(2)])
    toward = np.column_stack([np.bincount(member, slices.toward[:, k], len(group)) / n for k in range(2)])
    own = [np.bincount(member, s, len(group)) / n for s in (slices.sigma_along_m, slices.sigma_across_m)]
    along = _SIGMA_RANGE_M**2 / np.bincount(member, slices.points, len(group)) + _SIGMA_FLOOR_M**2 + own[0] ** 2
    across = (EDGE_SIGMA * np.bincount(member, slices.step_m, len(group)) / n) ** 2 + _SIGMA_FLOOR_M**2 + own[1] ** 2
    uu = toward[:, :, None] * toward[:, None, :]
    information = uu / along[:, None, None] + (np.eye(2) - uu) / across[:, None, None]
    total, weighted, middle = np.zeros((count, 2, 2)), np.zeros((count, 2)), np.zeros((count, 2))
    np.add.at(total, group // scans, information)
    np.add.at(weighted, group // scans, (information @ mean[:, :, None])[:, :, 0])
    np.add.at(middle, group // scans, toward)
    cov = np.asarray(np.linalg.inv(total), np.float64) if count else total
    middle /= np.bincount(group // scans, minlength=count)[:, None] if count else 1.0
    return (cov @ weighted[:, :, None])[:, :, 0], cov, middle


def _scatter(slices: Slices, label: I64, off: F64, n: I64) -> F64:
    """(C,) standard deviation of the slices about the axis, less what noise of range and distance of rays make."""
    made = _SIGMA_RANGE_M**2 / slices.points + (EDGE_SIGMA * slices.step_m) ** 2 + _SIGMA_FLOOR_M**2
    made = made + slices.sigma_along_m**2 + slices.sigma_across_m**2
    return np.sqrt(np.maximum(_sums((off**2).sum(axis=1) - made, label, n) / n, 0.0))
