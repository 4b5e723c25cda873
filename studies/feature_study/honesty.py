"""Whether covariances say how large errors are: the normalised estimation error squared (NEES).

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.stats import chi2

from gnd.gnd_map.arrays import F64

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
