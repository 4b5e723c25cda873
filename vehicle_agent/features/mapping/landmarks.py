"""From measurements to features of a new layer: first clusters in the map frame, assignment to features, and ties.

Kim et al. 2018, section 3.1: measurements that lie near each other in the map frame, seen from the first poses, become
a feature (section 3.1.1); c(x_t, z_i, m_new) of Eq. (4) is asked anew as poses and features become better. In one look
a feature takes at most one measurement. Measurements of a feature around a keyframe become one tie, linearised at what
is known best: the same as all of them as edges of their own, and far fewer.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.mapping.dead_reckoning import composed, relative, rotated
from gnd.vehicle_agent.features.mapping.feature_drive import Measurements
from gnd.vehicle_agent.features.mapping.graph import bearing_range
from gnd.vehicle_agent.features.mapping.graph_edges import Ties
from gnd.vehicle_agent.features.slamcu.association import FORBIDDEN, associate
from gnd.vehicle_agent.features.view import wrapped

_GATE_CHI2: Final = 13.8
"""A measurement farther than this from a feature (two degrees of freedom) is none of it; 0.1 % of the right ones
are."""
LANDMARK_MIN_HITS: Final = 5
"""A feature with fewer measurements is a ghost: it is left out."""
LANDMARK_REVISIT_M: Final = 1.5
"""Sigma of what the first poses are off by against those of a passage `revisit_way_m` before."""
_REVISIT_WAY_M: Final = 150.0
LANDMARK_DRIFT_M: Final = 0.1
"""Sigma of what the first poses are off by within a passage."""
_MERGE_CHI2: Final = 9.2
"""Two of one kind that are nearer than this, and not seen side by side, are one."""
_APART_SHARE: Final = 0.3
"""They count as seen side by side in more than this share of the looks of the rarer."""

NONE = -1  # a measurement of no feature
FAR_M = 25.0  # a feature farther than this from a measurement's place is not looked at


class Sight(NamedTuple):
    """Where each of M measurements was made from."""

    key: I64
    """(M,) nearest keyframe."""
    offset: F64
    """(M, 3) the vehicle in the frame of that keyframe, by dead reckoning."""
    way_m: F64
    """(M,) driven until then."""


@dataclass(slots=True, eq=False)
class _Clusters:
    """Features as they grow, N so far, look after look."""

    xy_m: F64
    cov: F64
    kind: I64
    way_m: F64
    hits: I64


class LandmarkPlaces(NamedTuple):
    """N features as they stand."""

    xy_m: F64
    """(N, 2)"""
    cov: F64
    """(N, 2, 2) of the place."""
    spread: F64
    """(N, 2, 2) of a single measurement of it."""
    kind: I64
    """(N,)"""


class KnownPlaces(NamedTuple):
    """N features that measurements may be of."""

    xy_m: F64
    """(N, 2)"""
    kind: I64
    """(N,)"""
    slack_m: F64
    """(N,) sigma of where a feature is as seen from the poses around, beside the sensor's noise."""
    errors: F64
    """(N, 2) errors of range (share) and bearing [rad] that stay with it."""


def places(m: Measurements, sight: Sight, pose: F64) -> tuple[F64, F64]:
    """(M, 2) where measurements lie in the map frame, and (M, 2, 2) how certain by the sensor's noise alone."""
    at = composed(pose[sight.key], sight.offset)
    direction = at[:, 2] + m.bearing_rad
    ahead = np.stack([np.cos(direction), np.sin(direction)], axis=1)
    # The mean of noisy bearings lies short of the place: what a bearing's noise takes off the range is given back.
    xy = at[:, :2] + (m.range_m * np.exp(0.5 * m.sigma_bearing_rad**2))[:, None] * ahead
    R = np.stack([ahead, np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)], axis=2)
    variance = np.stack([m.sigma_range_m**2, (m.range_m * m.sigma_bearing_rad) ** 2], axis=1)
    return xy, np.asarray(np.einsum("mij,mj,mkj->mik", R, variance, R))


def _lasting(m: Measurements, sight: Sight, pose: F64, held: F64) -> F64:
    """(M, 2, 2) how far from each other two measurements of a feature may lie by errors that stay with it, variances
    (2,) of range (share) and bearing [rad]: one was made from another side or range.
    """
    direction = composed(pose[sight.key], sight.offset)[:, 2] + m.bearing_rad
    c, s = np.cos(direction), np.sin(direction)
    R = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    return np.asarray(np.einsum("mij,mj,mkj->mik", R, m.range_m[:, None] ** 2 * held, R))


def clustered(m: Measurements, sight: Sight, pose: F64, held: F64) -> tuple[I64, F64]:
    """The first association: (M,) feature of each measurement, and (N, 2) features; all hits count, ghosts too. `held`:
    variances (2,) of the errors of range (share) and bearing [rad] that stay with a feature.
    """
    (xy, cov), lasting = places(m, sight, pose), _lasting(m, sight, pose, held)
    c = _Clusters(np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0, np.int64), np.empty(0), np.empty(0, np.int64))
    owner = np.full(len(m), NONE, np.int64)
    for rows in _looks(m.look):
        at = xy[rows], cov[rows], lasting[rows]
        owner[rows] = _take(c, at, m.kind[rows], float(sight.way_m[rows[0]]))
    return owner, c.xy_m


def _looks(look: I64) -> list[I64]:
    """The rows of each look that found something."""
    if len(look) == 0:
        return []
    return np.split(np.arange(len(look)), np.flatnonzero(np.diff(look)) + 1)


def _take(c: _Clusters, at: tuple[F64, F64, F64], kind: I64, way_m: float) -> I64:
    """The clusters of the measurements of one look, which join them or begin new ones; `at`: their places (Z, 2),
    covariances (Z, 2, 2) by the sensor's noise, and by what stays with a feature.
    """
    xy, cov, lasting = at
    near = np.flatnonzero((np.abs(c.xy_m[None] - xy[:, None]).max(axis=2) < FAR_M).any(axis=0))
    cost = _squared(xy, cov + lasting, c, near, way_m)
    cost[kind[:, None] != c.kind[near]] = FORBIDDEN
    cost[cost > _GATE_CHI2] = FORBIDDEN
    pairs = associate(cost, _GATE_CHI2)
    owner = np.full(len(xy), NONE, np.int64)
    for row, column in zip(pairs.measurement, near[pairs.feature], strict=True):
        _join(c, int(column), xy[row], cov[row], way_m)
        owner[row] = column
    for row in pairs.alone:
        owner[row] = _begin(c, xy[row], cov[row], int(kind[row]), way_m)
    return owner


def _squared(xy: F64, cov: F64, c: _Clusters, near: I64, way_m: float) -> F64:
    """(Z, C) squared Mahalanobis distances of measurements and clusters, with what the poses may be off by."""
    again = way_m - c.way_m[near] > _REVISIT_WAY_M
    drift = np.where(again, LANDMARK_REVISIT_M, LANDMARK_DRIFT_M) ** 2
    S = cov[:, None] + c.cov[near][None] + (drift[:, None, None] * np.eye(2))[None]
    off = xy[:, None] - c.xy_m[near][None]
    return np.asarray(np.einsum("zci,zcij,zcj->zc", off, np.linalg.inv(S), off))


def _join(c: _Clusters, n: int, xy: F64, cov: F64, way_m: float) -> None:
    gain = c.cov[n] @ np.linalg.inv(c.cov[n] + cov)
    c.xy_m[n] += gain @ (xy - c.xy_m[n])
    c.cov[n] -= gain @ c.cov[n]
    c.way_m[n] = way_m
    c.hits[n] += 1


def _begin(c: _Clusters, xy: F64, cov: F64, kind: int, way_m: float) -> int:
    c.xy_m, c.cov = np.concatenate([c.xy_m, xy[None]]), np.concatenate([c.cov, cov[None]])
    c.kind, c.way_m, c.hits = np.append(c.kind, kind), np.append(c.way_m, way_m), np.append(c.hits, 1)
    return len(c.xy_m) - 1


def assigned(m: Measurements, sight: Sight, pose: F64, at: KnownPlaces) -> I64:
    """Measurements given to known features anew, from better poses: (M,) feature, `NONE` = of none.

    Args:
        m: M measurements.
        sight: where from.
        pose: (K, 3) of the keyframes.
        at: N features.
    """
    owner = np.full(len(m), NONE, np.int64)
    stood = composed(pose[sight.key], sight.offset)
    seen, _ = places(m, sight, pose)
    for rows in _looks(m.look):
        near = np.flatnonzero((np.abs(at.xy_m[None] - seen[rows][:, None]).max(axis=2) < FAR_M).any(axis=0))
        cost = _polar_squared(m, rows, stood[rows[0]], at, near)
        cost[m.kind[rows][:, None] != at.kind[near]] = FORBIDDEN
        cost[cost > _GATE_CHI2] = FORBIDDEN
        pairs = associate(cost, _GATE_CHI2)
        owner[rows[pairs.measurement]] = near[pairs.feature]
    return owner


def _polar_squared(m: Measurements, rows: I64, stood: F64, at: KnownPlaces, near: I64) -> F64:
    """(Z, N) squared distances in sigmas of bearing and range."""
    slack_m, errors = at.slack_m[near], at.errors[near]
    off = rotated(np.full(len(near), -stood[2]), at.xy_m[near] - stood[:2])
    distance, bearing = np.maximum(np.hypot(*off.T), 0.1), np.arctan2(off[:, 1], off[:, 0]) + errors[:, 1]
    sigma_range = m.sigma_range_m[rows][:, None] ** 2 + slack_m**2
    sigma_bearing = m.sigma_bearing_rad[rows][:, None] ** 2 + (slack_m / distance) ** 2
    by_range = (m.range_m[rows][:, None] - distance * (1.0 + errors[:, 0])) ** 2 / sigma_range
    return np.asarray(by_range + wrapped(m.bearing_rad[rows][:, None] - bearing) ** 2 / sigma_bearing)


def tied(m: Measurements, sight: Sight, owner: I64, pose: F64, xy_m: F64) -> Ties:
    """Measurements (M,) of features (N, 2) put together, one tie for a feature and keyframe."""
    rows = np.flatnonzero(owner >= 0)
    key, landmark = sight.key[rows], owner[rows]
    expected = relative(pose[key], np.concatenate([xy_m[landmark], np.zeros((len(rows), 1))], axis=1))[:, :2]
    H, off = _linearised(m, rows, sight.offset[rows], expected)
    weight = np.stack([m.sigma_bearing_rad[rows] ** -2.0, m.sigma_range_m[rows] ** -2.0], axis=1)
    pairs, group = np.unique(np.stack([key, landmark], axis=1), axis=0, return_inverse=True)
    first = np.zeros(len(pairs), np.int64)
    first[group.ravel()] = np.arange(len(rows))
    A = _grouped(group.ravel(), len(pairs), np.einsum("tji,tj,tjk->tik", H, weight, H))
    g = _grouped(group.ravel(), len(pairs), np.einsum("tji,tj,tj->ti", H, weight, off))
    cov = np.asarray(np.linalg.inv(A), np.float64)
    polar, polar_cov = bearing_range(expected[first] + np.einsum("tij,tj->ti", cov, g), cov)
    return Ties(pairs[:, 0], pairs[:, 1], polar, polar_cov)


def _linearised(m: Measurements, rows: I64, offset: F64, expected: F64) -> tuple[F64, F64]:
    """(T, 2, 2) Jacobians of bearing and range by the feature's place in the keyframe, and (T, 2) what is off."""
    d = expected - offset[:, :2]
    distance = np.maximum(np.hypot(*d.T), 0.1)
    across = np.stack([-d[:, 1], d[:, 0]], axis=1) / distance[:, None] ** 2
    H = np.stack([across, d / distance[:, None]], axis=1)
    bearing = m.bearing_rad[rows] - (np.arctan2(d[:, 1], d[:, 0]) - offset[:, 2])
    return H, np.stack([wrapped(bearing), m.range_m[rows] - distance], axis=1)


def _grouped(group: I64, n: int, values: F64) -> F64:
    """(n, ...) sums of rows (T, ...) by group."""
    sums = np.zeros((n, *values.shape[1:]))
    np.add.at(sums, group, values)
    return sums


def spread(m: Measurements, sight: Sight, pose: F64, owner: I64, n: int) -> F64:
    """(n, 2, 2) covariance of a single measurement of each feature, on average."""
    rows = np.flatnonzero(owner >= 0)
    count = np.bincount(owner[rows], minlength=n)
    return np.asarray(_grouped(owner[rows], n, places(m, sight, pose)[1][rows]) / np.maximum(count, 1)[:, None, None])


def kept(owner: I64, hits_needed: int) -> I64:
    """(M,) the same association without ghosts, features numbered anew without gaps."""
    hits = np.bincount(owner[owner >= 0], minlength=int(owner.max(initial=NONE)) + 1)
    number = np.where(hits >= hits_needed, np.cumsum(hits >= hits_needed) - 1, NONE)
    return np.where(owner >= 0, np.append(number, NONE)[owner], NONE)


def doubles(m: Measurements, owner: I64, at: LandmarkPlaces) -> list[tuple[int, int]]:
    """Pairs of features (first, second) that are one: near each other, of one kind, and not seen side by side.

    Two that are in view at the same time and never seen in one look are one if a measurement could be of either. Two of
    different passages are one if their places agree.

    Args:
        m: M measurements.
        owner: (M,) features of them, of N.
        at: N features.
    """
    looks = [np.unique(m.look[owner == n]) for n in range(len(at.xy_m))]
    distance = np.hypot(*np.moveaxis(at.xy_m[:, None] - at.xy_m[None], 2, 0))
    near = np.triu(distance < FAR_M, 1) & (at.kind[:, None] == at.kind[None])
    return [(int(a), int(b)) for a, b in np.argwhere(near) if _same(at, looks, int(a), int(b))]


def _same(at: LandmarkPlaces, looks: list[I64], a: int, b: int) -> bool:
    first, second = looks[a], looks[b]
    together = len(np.intersect1d(first, second))
    if together > _APART_SHARE * min(len(first), len(second)):
        return False
    low, high = max(first[0], second[0]), min(first[-1], second[-1])
    both = min(int(((x >= low) & (x <= high)).sum()) for x in (first, second))
    S = at.cov[a] + at.cov[b]
    if both >= LANDMARK_MIN_HITS:
        S = S + at.spread[a] + at.spread[b]
    off = at.xy_m[a] - at.xy_m[b]
    return bool(off @ np.linalg.solve(S, off) <= _MERGE_CHI2)
