"""How wrong the map makes a pose, from what each piece of the map was seen to pull it by.

Points on the same piece of a surface share its error, whichever scan of a stretch saw them, so the inverse Hessian of
the matches is no covariance: it takes points as independent. Here the pull of each piece on a pose is summed over all
its points, and the squares of these sums are the variance (cluster-robust "sandwich" covariance, Liang and Zeger 1986).
Nothing is assumed of how large the errors are or how many points share one.

A piece that decides alone fits itself: its pull is zero and shows nothing. So the squares of few pieces count for
less than those of all directions together (`FEW`), and each piece is asked how it disagrees with the others
(leave-one-out, `MOST_LEVERAGE`).
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, numbered_rows
from gnd.vehicle_agent.localise.kernels import pulls
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.registration import REGISTRATION_GATE_PER_SCALE, Linearised

PIECE_M: Final = 2.0
"""Side of a piece of the map: neighbouring Gaussians of a wall share what its survey and its voxels are wrong by."""
FEW: Final = 10.0
"""Pieces whose squares count as much as those of all directions together."""
MOST_LEVERAGE: Final = 0.5


class SeenScan(NamedTuple):
    """A scan as it was matched: points (K, 3) in the vehicle frame, the match, and `v` (D, 6): how D quantities answer
    to a gradient of its cost (rotation first, vehicle frame).
    """

    points_m: F64
    match: Linearised
    v: F64


class Influence(NamedTuple):
    """Of D quantities: `factor` (D,), variance as seen in units of what points that are independent would make it;
    `pieces` (D,), how many pieces of the map decide each.
    """

    factor: F64
    pieces: F64


def influence(seen: Sequence[SeenScan], match_map: MatchMap) -> Influence:
    """What the errors of the map, as residuals show them, do to quantities that are estimated from scans.

    Args:
        seen: the scans, each at its present pose.
        match_map: the map that they were matched with.
    """
    n = seen[0].v.shape[0] if seen else 0
    pull, weight = np.zeros((len(match_map), n)), np.zeros((len(match_map), n))
    for scan in seen:
        _add(pull, weight, scan, match_map)
    touched = np.flatnonzero(weight.any(axis=1))
    if not len(touched):
        return Influence(np.ones(n), np.zeros(n))
    cells = np.floor(match_map.mean_m[touched] / PIECE_M).astype(np.int64)
    piece = numbered_rows(cells)
    pull, weight = (_summed(piece, of[touched]) for of in (pull, weight))
    return _of_pieces(pull, weight)


def _of_pieces(pull: F64, weight: F64) -> Influence:
    """From the pull of P pieces on D quantities (P, D), and the variance it would have if points were independent."""
    total = np.maximum(weight.sum(axis=0), 1e-300)
    share = weight / total
    alone = pull / (1.0 - np.minimum(share, MOST_LEVERAGE))
    pieces = 1.0 / np.maximum((share**2).sum(axis=0), 1e-300)
    seen = (alone**2).sum(axis=0) / total
    usual = float((pieces * seen).sum() / pieces.sum())
    return Influence((pieces * seen + FEW * usual) / (pieces + FEW), pieces)


def _add(pull: F64, weight: F64, scan: SeenScan, match_map: MatchMap) -> None:
    R, t = scan.match.T_map_vehicle[:3, :3], scan.match.T_map_vehicle[:3, 3]
    v = scan.v @ scan.match.constrained.T
    along_map = np.concatenate([v[:, :3] @ R.T, v[:, 3:] @ R.T], axis=1)
    m, scale = match_map, scan.match.scale
    pulls(
        np.ascontiguousarray(scan.points_m), np.ascontiguousarray(R), np.ascontiguousarray(t), m.index, m.A, m.b,
        m.mean_m, m.information, scale**2, (REGISTRATION_GATE_PER_SCALE * scale) ** 2, along_map, pull, weight,
    )  # fmt: skip


def _summed(piece: NDArray[np.int64], values: F64) -> F64:
    return np.stack([np.bincount(piece, column) for column in values.T], axis=1)
