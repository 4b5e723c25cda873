"""Looks at lane markings against the map's: how far off each polyline lies, and which marking it is.

A polyline of a look errs as a whole: it is moved sideways by N(0, l²) m and turned by N(0, (2.5 l)²)° about the vehicle
(Kim et al. 2018, Table 1). Hence it measures two numbers, not as many as it has points. Which marking it is, is decided
for all polylines of a look together, as they lie side by side: alone, one that is 2 m off belongs to the next marking.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import radians
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.schemas.drive import LaneLook
from gnd.vehicle_agent.features.mapping.dead_reckoning import composed, rotated
from gnd.vehicle_agent.features.mapping.lane_map import SAMPLE_M, LaneMap

_SIGMA_M: Final = 1.0
_SIGMA_RAD: Final = radians(2.5)
"""Of a polyline of one look: how far off it lies beside the vehicle, and how far it is turned (Table 1 of the paper
with l = 1); used where the look has no sigmas."""
_BESIDE_M: Final = 15.0
"""Lanes this far beside the vehicle are looked at."""
LANE_GATE: Final = 3.5
"""A polyline farther than this many sigmas from a line is none of it."""

POINTS = 8  # of a polyline that are compared with the map
MAX_LANES = 8  # beside each other that are looked at
LEAST_M = 5.0  # a polyline whose compared points span less gives no direction
IMPOSSIBLE = 1e6
SLACK = np.array([0.3, np.radians(1.0)])  # what poses may be off by beside the sensor's noise, across and turned


@dataclass(frozen=True, slots=True, eq=False)
class Polylines:
    """All polylines of a drive's lane looks, P in all.

    look: (P,) rising. xy_m: (P, Q, 2) vehicle frame, Q points of each. sigma: (P, 2) of offset [m] and turn [rad].
    """

    look: I64
    xy_m: F64
    sigma: F64

    @classmethod
    def of(cls, looks: Sequence[LaneLook]) -> "Polylines":
        """Sample each polyline at `POINTS` of its points."""
        rows = [(n, line) for n, look in enumerate(looks) for line in look.polylines]
        sigmas = [(look.sigma_m or _SIGMA_M, look.sigma_rad or _SIGMA_RAD) for look in looks]
        points = [line[np.linspace(0, len(line) - 1, POINTS).round().astype(np.int64)] for _, line in rows]
        look = np.array([n for n, _ in rows], np.int64)
        xy = np.array(points, np.float64).reshape(-1, POINTS, 2)
        return cls(look, xy, np.array(sigmas, np.float64).reshape(-1, 2)[look])

    def __len__(self) -> int:
        return len(self.look)

    @property
    def tolerance(self) -> F64:
        """(P, 2) sigmas of offset and turn when the pose, too, is not known well."""
        return np.asarray(np.hypot(self.sigma, SLACK))


class Offsets(NamedTuple):
    """Polylines against the map's lanes beside them, M at most; those of a look by their place from right to left."""

    lane: I64
    """(P, M) lane of the map, -1 = none."""
    left_m: F64
    """(P, M) how far left of the vehicle the lane is."""
    residual: F64
    """(P, M, 2) offset [m] and turn [rad] of the polyline against the lane."""
    by_pose: F64
    """(P, M, 2, 3) of residual by x, y, yaw of the window's pose, in its frame."""
    cost: F64
    """(P, M), `IMPOSSIBLE` where the lane is none or too short."""


def offsets(lines: Polylines, lanes: LaneMap, at: F64, base: F64) -> Offsets:
    """Compare each polyline with each lane beside the vehicle.

    Args:
        lines: P polylines.
        lanes: of the map.
        at: (L, 3) poses of the looks in the map frame, as believed.
        base: (L, 3) poses of their windows.
    """
    beside = _beside(lanes, at)
    lane, sample, left = beside[0][lines.look], beside[1][lines.look], beside[2][lines.look]
    at, base = at[lines.look], base[lines.look]
    valid_lane = np.maximum(lane, 0)
    row = lanes.first[valid_lane] + sample
    along = (lanes.tangent[row] * np.stack([np.cos(at[:, 2]), np.sin(at[:, 2])], axis=1)[:, None]).sum(axis=2)
    start = sample[..., None] + np.sign(along)[..., None] * lines.xy_m[:, None, :, 0] / SAMPLE_M
    here = composed(at[:, None], _as_poses(lines.xy_m))[..., :2]
    every = np.broadcast_to(valid_lane[..., None], start.shape)
    feet = lanes.feet(every, start, np.broadcast_to(here[:, None], (*start.shape, 2)))
    normal = rotated(np.broadcast_to(-at[:, None, None, 2], start.shape), feet.normal)
    E = np.stack([normal[..., 1], _turning(normal, lines.xy_m[:, None])], axis=-1) * feet.valid[..., None]
    fit, enough = _fit(E, feet.valid, lines.xy_m)
    residual = np.einsum("pmiq,pmq->pmi", fit, np.where(feet.valid, feet.off_m, 0.0))
    N = _by_pose(feet.normal, here[:, None], base) * feet.valid[..., None]
    cost = ((residual / lines.tolerance[:, None]) ** 2).sum(axis=2)
    cost = np.where(enough & (lane >= 0), cost, IMPOSSIBLE)
    return Offsets(lane, left, residual, fit @ N, cost)


def _as_poses(xy_m: F64) -> F64:
    return np.concatenate([xy_m, np.zeros((*xy_m.shape[:-1], 1))], axis=-1)


def _turning(normal: F64, xy_m: F64) -> F64:
    """(...,) how far points move along the normals when all turns about the origin."""
    return np.asarray(normal[..., 1] * xy_m[..., 0] - normal[..., 0] * xy_m[..., 1])


def _by_pose(normal: F64, here: F64, base: F64) -> F64:
    """(P, M, Q, 3): how offsets grow when the window's pose moves, in its own frame."""
    yaw = -base[:, None, None, 2]
    n = rotated(np.broadcast_to(yaw, normal.shape[:-1]), normal)
    place = rotated(np.broadcast_to(yaw, here.shape[:-1]), here - base[:, None, None, :2])
    return np.concatenate([n, _turning(n, place)[..., None]], axis=-1)


def _fit(E: F64, valid: NDArray[np.bool_], xy_m: F64) -> tuple[F64, NDArray[np.bool_]]:
    """(P, M, 2, Q) least squares of offset and turn, and where (P, M) there are points enough for both."""
    x = np.broadcast_to(xy_m[:, None, :, 0], valid.shape)
    span = np.where(valid, x, -np.inf).max(axis=2) - np.where(valid, x, np.inf).min(axis=2)
    enough = (valid.sum(axis=2) >= 3) & (span >= LEAST_M)
    A = np.swapaxes(E, 2, 3) @ E + np.where(enough, 1e-9, 1.0)[..., None, None] * np.eye(2)
    return np.asarray(np.linalg.solve(A, np.swapaxes(E, 2, 3))), np.asarray(enough)


def _beside(lanes: LaneMap, at: F64) -> tuple[I64, I64, F64]:
    """(L, M) lanes beside each pose, from right to left, -1 = none; of each the nearest sample, and how far left."""
    n_looks = len(at)
    distance = np.full((n_looks, len(lanes)), np.inf)
    sample = np.zeros((n_looks, len(lanes)), np.int64)
    for lane in range(len(lanes)):
        distance[:, lane], sample[:, lane] = lanes.nearest(lane, at[:, :2], _BESIDE_M)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :MAX_LANES]
    row = lanes.first[nearest] + np.take_along_axis(sample, nearest, axis=1)
    left = rotated(np.broadcast_to(-at[:, None, 2], nearest.shape), lanes.xy_m[row] - at[:, None, :2])[..., 1]
    is_there = np.isfinite(np.take_along_axis(distance, nearest, axis=1))
    order = np.argsort(np.where(is_there, left, np.inf), axis=1, kind="stable")
    beside: I64 = np.take_along_axis(np.where(is_there, nearest, -1), order, axis=1)
    used = max(1, int((beside >= 0).sum(axis=1).max(initial=1)))
    ordered = np.take_along_axis(np.take_along_axis(sample, nearest, axis=1), order, axis=1)
    left = np.take_along_axis(left, order, axis=1)
    return beside[:, :used], np.where(beside >= 0, ordered, 0)[:, :used], left[:, :used]


def choices(lines: Polylines, o: Offsets, aside_m: F64) -> tuple[I64, F64]:
    """Which lane each polyline of a look is, side by side, for each of G sideways moves of the vehicle.

    Args:
        lines: P polylines.
        o: theirs against the lanes.
        aside_m: (G,) or (L, G) moves tried.

    Returns:
        (P, G) column of `o` for each, -1 = none; (L, G) cost of each look in squared sigmas.
    """
    n_looks = int(lines.look.max(initial=-1)) + 1
    aside = np.broadcast_to(aside_m, (n_looks, aside_m.shape[-1]))
    column = np.full((len(lines), aside.shape[1]), -1, np.int64)
    cost = np.zeros(aside.shape)
    seen = np.bincount(lines.look, minlength=n_looks)
    n_beside: I64 = np.zeros(n_looks, np.int64)
    np.maximum.at(n_beside, lines.look, (o.lane >= 0).sum(axis=1))
    first = np.concatenate([[0], np.cumsum(seen)[:-1]])
    likely = np.argmin(o.cost, axis=1)[:, None]
    left = np.take_along_axis(o.left_m + o.residual[..., 0], likely, axis=1)[:, 0]
    for n_seen, n_lanes in {(int(a), int(b)) for a, b in zip(seen, n_beside, strict=True) if a and b}:
        looks = np.flatnonzero((seen == n_seen) & (n_beside == n_lanes))
        rows = first[looks][:, None] + np.arange(n_seen)
        found, cost[looks] = _side_by_side(_pair_costs(lines, o, rows, n_lanes, aside[looks]), left[rows])
        column[rows] = found
    return column, cost


def _pair_costs(lines: Polylines, o: Offsets, rows: I64, n_lanes: int, aside: F64) -> F64:
    """(L, S, M, G) cost of each polyline for each lane and move; never more than the gate."""
    off = o.residual[rows, :n_lanes, 0, None] + aside[:, None, None]
    turn = o.residual[rows, :n_lanes, 1, None] / lines.tolerance[rows, 1][..., None, None]
    cost = (off / lines.tolerance[rows, 0][..., None, None]) ** 2 + turn**2
    cost = np.where(o.cost[rows, :n_lanes, None] >= IMPOSSIBLE, np.inf, cost)
    return np.minimum(cost, 2.0 * LANE_GATE**2)


def _side_by_side(cost: F64, left: F64) -> tuple[I64, F64]:
    """(L, S, G) lane of each polyline of looks and (L, G) the cost: the best choice that keeps their order.

    cost: (L, S, M, G). left: (L, S), which orders the polylines of a look as the lanes are ordered.
    """
    n_looks, n_seen, n_lanes, _ = cost.shape
    n_pairs = min(n_seen, n_lanes)
    ordered = np.take_along_axis(cost, np.argsort(left, axis=1, kind="stable")[:, :, None, None], axis=1)
    worst = cost.max()
    best, chosen = np.full((n_looks, cost.shape[3]), np.inf), np.full((n_looks, n_seen, cost.shape[3]), -1, np.int64)
    for some in combinations(range(n_seen), n_pairs):
        for those in combinations(range(n_lanes), n_pairs):
            total = ordered[:, some, those].sum(axis=1) + worst * (n_seen - n_pairs)
            better = total < best
            best = np.where(better, total, best)
            choice = np.full((n_seen, 1), -1)
            choice[list(some), 0] = those
            chosen = np.where(better[:, None], choice[None], chosen)
    back = np.empty_like(chosen)
    np.put_along_axis(back, np.broadcast_to(np.argsort(left, axis=1, kind="stable")[:, :, None], back.shape), chosen, 1)
    return back, best
