"""Points and polylines against each other: which place of one answers to which vertex of the other."""

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features.lane_pieces import is_lane_piece


def onto(points_m: F64, other_m: F64) -> F64:
    """For each of `points_m` (N, 3) the place that answers to it on `other_m` (M, 3), seen from above.

    A point answers to a point. On a polyline it is the foot of the perpendicular; a vertex beyond the polyline's ends
    has none and stays where it is, so that nothing is learnt of it. A piece of a line (two vertices) goes on straight.
    """
    if len(other_m) == 1:
        return np.broadcast_to(other_m, points_m.shape)
    if is_lane_piece(points_m) and is_lane_piece(other_m):
        return _on_straight(points_m, other_m)
    feet, inside = _feet(points_m, other_m)
    return np.where(inside[:, None], feet, points_m)


def _on_straight(points_m: F64, line_m: F64) -> F64:
    """(N, 3) feet on the straight line through two vertices, horizontally."""
    along = line_m[1] - line_m[0]
    share = (points_m - line_m[0])[:, :2] @ along[:2] / max(float(along[:2] @ along[:2]), 1e-12)
    return np.asarray(line_m[0] + share[:, None] * along)


def across(points_m: F64, other_m: F64) -> tuple[F64, float, float]:
    """How a polyline (M, 3) lies beside another (N, 3).

    Returns:
        The mean displacement (3,), the largest horizontal distance of a vertex, and the share of the vertices that were
        compared: those of the first that have a foot on the second. Infinitely far where there are none.
    """
    feet, inside = _feet(points_m, other_m)
    if not inside.any():
        return np.full(3, np.inf), np.inf, 0.0
    apart = (feet - points_m)[inside]
    return apart.mean(axis=0), float(np.hypot(apart[:, 0], apart[:, 1]).max()), float(inside.mean())


def length_of(points_m: F64) -> float:
    """Horizontal length in metres."""
    return float(np.hypot(*np.diff(points_m[:, :2], axis=0).T).sum())


def _feet(points_m: F64, line_m: F64) -> tuple[F64, NDArray[np.bool_]]:
    """(N, 3) nearest places on a polyline, horizontally, and (N,) which are not merely its ends."""
    start, along = line_m[:-1], np.diff(line_m, axis=0)
    square = np.maximum((along[:, :2] ** 2).sum(axis=1), 1e-12)
    offset = points_m[:, None] - start[None]  # (N, M - 1, 3)
    t = (offset[..., :2] * along[None, :, :2]).sum(axis=2) / square
    feet = start[None] + np.clip(t, 0.0, 1.0)[..., None] * along[None]
    nearest = ((feet - points_m[:, None])[..., :2] ** 2).sum(axis=2).argmin(axis=1)
    row = np.arange(len(points_m))
    share = t[row, nearest]
    ends = ((nearest == 0) & (share < 0.0)) | ((nearest == len(start) - 1) & (share > 1.0))
    return feet[row, nearest], ~ends
