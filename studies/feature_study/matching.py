"""Estimated features against true ones: one to one, within a radius; what is left over is missed or false."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from gnd.gnd_map.arrays import F64, I64

RADIUS_M: Final = 5.0
"""An estimate farther than this from every free true feature is false, and the true feature missed."""


@dataclass(frozen=True, slots=True, eq=False)
class Matching:
    """P pairs of a true and an estimated feature.

    Attributes:
        true: int64 (P,), sorted indices of true features.
        estimate: int64 (P,), indices of the estimates that belong to them.
        missed: int64, indices of true features without an estimate.
        false: int64, indices of estimates without a true feature.
    """

    true: I64
    estimate: I64
    missed: I64
    false: I64


def match_one_to_one(estimates_m: F64, truth_m: F64, radius_m: float = RADIUS_M) -> Matching:
    """Pair estimates (N, 2) with true positions (M, 2), both [m] in one frame.

    The pairs minimise the sum of distances, where a feature without partner costs half the radius: no pair is farther
    apart than the radius, and a nearest neighbour is only left for another where that serves both better.
    """
    apart = np.linalg.norm(truth_m[:, None, :] - estimates_m[None, :, :], axis=2)
    true, estimate = linear_sum_assignment(np.minimum(apart, radius_m))
    paired = apart[true, estimate] < radius_m
    true, estimate = true[paired].astype(np.int64), estimate[paired].astype(np.int64)
    return Matching(true, estimate, _others(len(truth_m), true), _others(len(estimates_m), estimate))


def _others(n: int, taken: I64) -> I64:
    return np.setdiff1d(np.arange(n, dtype=np.int64), taken)
