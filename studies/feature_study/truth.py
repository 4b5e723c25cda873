"""What estimated features are held against: pairs with true ones, honesty of covariances."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

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


_SIDES: Final = (0.025, 0.975)


def nees(error_m: F64, cov_m2: F64) -> F64:
    """Return e^T P^-1 e of errors (N, k) under covariances (N, k, k): (N,), of expectation k."""
    return np.asarray(np.einsum("ni,ni->n", error_m, np.linalg.solve(cov_m2, error_m[..., None])[..., 0]), np.float64)


@dataclass(frozen=True, slots=True)
class Honesty:
    """NEES of N features.

    Attributes:
        mean: mean of the NEES; its expectation is the dimension.
        band: what the mean lies in with 95 % were all errors independent and the covariances right.
        within: share of the features within their own 95 % ellipse, expected 0.95.
        features: N.
    """

    mean: float
    band: tuple[float, float]
    within: float
    features: int

    @classmethod
    def of(cls, error_m: F64, cov_m2: F64) -> "Honesty | None":
        """Return that of errors (N, k) under covariances (N, k, k); None of none."""
        if not len(error_m):
            return None
        values, k, n = nees(error_m, cov_m2), error_m.shape[1], len(error_m)
        low, high = (float(chi2.ppf(side, n * k) / n) for side in _SIDES)
        return cls(float(values.mean()), (low, high), float(np.mean(values <= chi2.ppf(0.95, k))), n)

    def plain(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "mean": self.mean,
            "band_low": self.band[0],
            "band_high": self.band[1],
            "within_95": self.within,
            "features": self.features,
        }
