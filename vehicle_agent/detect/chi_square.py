"""Chi-square with three degrees of freedom in closed form (scipy.stats would cost a second at every start)."""

import math
from functools import lru_cache


def confidence(r2: float) -> float:
    """Probability mass inside the ellipsoid of squared Mahalanobis distance `r2`, GND Eq. (3) with k = 3."""
    return math.erf(math.sqrt(r2 / 2)) - math.sqrt(2 * r2 / math.pi) * math.exp(-r2 / 2)  # Eq. (3)


@lru_cache(maxsize=64)
def quantile(eta: float) -> float:
    """The r² whose `confidence` is `eta` (0 < eta < 1): "inside" becomes one comparison, computed once."""
    low, high = 0.0, 60.0
    while high - low > 1e-12:
        middle = (low + high) / 2
        low, high = (middle, high) if confidence(middle) < eta else (low, middle)
    return (low + high) / 2
