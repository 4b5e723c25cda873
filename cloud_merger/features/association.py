"""Which measurement is of which feature: one-to-one for a report, by likelihood, inside gates."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from gnd.cloud_merger.features.parameters import FeatureMergeParameters, gate_of
from gnd.cloud_merger.features.rls import PlaceEstimate
from gnd.cloud_merger.features.shapes import across
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features.lane_pieces import beside, is_lane_piece, left_of

FEATURE_LINE_REACH_M: Final = 1.5
"""The same for polylines, across the line: less than half the width of a lane."""

_NEVER: Final = 1e9
HEIGHT_KNOWN_M2: Final = 100.0
"""Where the variance of a difference of heights is larger, it is not a dimension that was measured."""
_LEAST_OVERLAP: Final = 0.5


def pairs(
    measured: Sequence[PlaceEstimate],
    known: Sequence[PlaceEstimate],
    witnesses: Sequence[int],
    parameters: FeatureMergeParameters,
) -> list[tuple[int, int]]:
    """The most likely one-to-one association of measurements with features, as (measurement, feature).

    A feature is the likelier the more vehicles know it: one that began with an outlier must not draw to itself what
    belongs to its neighbour. A measurement without a partner costs as much as one at the very edge of the gate.

    Args:
        measured: M places.
        known: N places, all points or all polylines as `measured` are.
        witnesses: how many vehicles each of them rests on, at least 1.
        parameters: gate and reach.
    """
    if not measured or not known:
        return []
    cost = costs(measured, known, parameters) - 2.0 * np.log(np.array(witnesses, np.float64))
    possible = np.isfinite(cost)
    if not possible.any():
        return []
    from scipy.optimize import linear_sum_assignment  # here because the import is dear, and few shards merge features

    alone = np.full((len(measured), len(measured)), cost[possible].max() + gate_of(3))
    rows, columns = linear_sum_assignment(np.hstack([np.where(possible, cost, _NEVER), alone]))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if j < len(known) and possible[i, j]]


def costs(measured: Sequence[PlaceEstimate], known: Sequence[PlaceEstimate], parameters: FeatureMergeParameters) -> F64:
    """(M, N) -2 ln likelihood but for a constant; infinite outside the gates."""
    offset, reach_m = _offsets(measured, known)
    of_point = len(known[0].points_m) == 1
    S = np.stack([one.cov_m2 for one in known])[None] + np.stack([one.cov_m2 for one in measured])[:, None]
    near = reach_m <= (parameters.reach_m if of_point else FEATURE_LINE_REACH_M)
    offset = np.where(near[..., None], offset, 0.0)
    square = np.einsum("ijk,ijk->ij", offset, np.linalg.solve(S, offset[..., None])[..., 0])
    gate = np.where(S[..., 2, 2] > HEIGHT_KNOWN_M2, gate_of(2), gate_of(3))
    area = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] ** 2
    return np.where(near & (square <= gate), square + np.log(area), np.inf)


def _offsets(measured: Sequence[PlaceEstimate], known: Sequence[PlaceEstimate]) -> tuple[F64, F64]:
    """(M, N, 3) from features to measurements, and (M, N) how far apart they are horizontally."""
    if len(known[0].points_m) == 1:
        offset = np.stack([m.points_m[0] for m in measured])[:, None] - np.stack([k.points_m[0] for k in known])[None]
        return offset, np.hypot(offset[..., 0], offset[..., 1])
    beside = [[_beside(k.points_m, m.points_m) for k in known] for m in measured]
    return np.array([[one[0] for one in row] for row in beside]), np.array([[one[1] for one in row] for row in beside])


def _beside(line_m: F64, other_m: F64) -> tuple[F64, float]:
    """Mean and largest displacement between two polylines of which one lies beside at least half of the other."""
    if is_lane_piece(line_m) and is_lane_piece(other_m):
        overlap, left_m = beside(line_m, other_m)
        return (np.zeros(3), np.inf) if overlap < _LEAST_OVERLAP else (left_m * left_of(line_m), abs(left_m))
    there, back = across(line_m, other_m), across(other_m, line_m)
    if max(there[2], back[2]) < _LEAST_OVERLAP:
        return np.zeros(3), np.inf
    return (there[0], there[1]) if there[2] >= back[2] else (-back[0], back[1])


def fits(measured: PlaceEstimate, known: PlaceEstimate, parameters: FeatureMergeParameters) -> bool:
    """Whether a measurement lies inside the gates of a feature."""
    return bool(np.isfinite(costs([measured], [known], parameters)[0, 0]))
