"""Covariances of positions on a lattice that is always positive definite: levels of a Cholesky factor.

cov = L Lᵀ with L_ii = 1 mm · 1.05^k and L_ij = L_ii · t / 16: six small integers (k0, k1, k2, t10, t20, t21) say a
covariance to some 3 % of each standard deviation, from 1 mm to 250 m.
"""

from functools import lru_cache
from math import ceil, log
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, check_array
from gnd.gnd_map.errors import FeatureError

SMALLEST_SIGMA_M: Final = 1e-3
LEVEL_RATIO: Final = 1.05
TOP_LEVEL: Final = 255
STEPS_OF_RATIO: Final = 16
MAX_RATIO: Final = 1000
MAX_RATIO_STEPS: Final = STEPS_OF_RATIO * MAX_RATIO
MAX_VARIANCE_M2: Final = 6e4
_ORDER: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_TOLERANCE: Final = 1e-9


def full_covariance(cov_m2: F64) -> F64:
    """(3, 3) of the six values xx, xy, xz, yy, yz, zz."""
    xx, xy, xz, yy, yz, zz = cov_m2
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def six_of(cov: F64) -> F64:
    """(6,) xx, xy, xz, yy, yz, zz of a (3, 3) covariance."""
    return np.array([cov[i, j] for i, j in _ORDER], dtype=np.float64)


def check_covariance(name: str, cov_m2: F64) -> None:
    """`FeatureError` unless the six values are a covariance: finite, positive semi-definite, below 250 m squared."""
    check_array(f"covariance of {name}", cov_m2, np.float64, (6,))
    cov = full_covariance(cov_m2)
    largest = float(np.diag(cov).max())
    if largest > MAX_VARIANCE_M2:
        raise FeatureError(f"{name}: variance {largest:.3g} m² exceeds {MAX_VARIANCE_M2:g} m²")
    smallest = float(np.linalg.eigvalsh(cov)[0])
    if smallest < -_TOLERANCE * max(largest, 1.0):
        raise FeatureError(f"{name}: covariance has the eigenvalue {smallest:.3g} m², need >= 0")


def levels_of(cov_m2: F64) -> tuple[int, int, int, int, int, int]:
    """(k0, k1, k2, t10, t20, t21) of the lattice point next to a covariance."""
    return _levels_of(cov_m2.tobytes())


@lru_cache(maxsize=4096)
def _levels_of(six: bytes) -> tuple[int, int, int, int, int, int]:
    """As `levels_of`; features of one map mostly share a few covariances."""
    L = _factor(full_covariance(np.frombuffer(six, np.float64)))
    k = [max(_level(L[i, i]), _lowest(L[i, :i])) for i in range(3)]
    t = [round(float(L[i, j]) / _sigma(k[i]) * STEPS_OF_RATIO) for i, j in ((1, 0), (2, 0), (2, 1))]
    return k[0], k[1], k[2], t[0], t[1], t[2]


def covariance_of(levels: tuple[int, int, int, int, int, int]) -> F64:
    """(6,) the covariance of a lattice point."""
    k0, k1, k2, t10, t20, t21 = levels
    a, b, c = _sigma(k0), _sigma(k1), _sigma(k2)
    L = np.array(
        [[a, 0.0, 0.0], [b * t10 / STEPS_OF_RATIO, b, 0.0], [c * t20 / STEPS_OF_RATIO, c * t21 / STEPS_OF_RATIO, c]]
    )
    return six_of(L @ L.T)


def snapped_covariance(cov_m2: F64) -> F64:
    """(6,) the lattice point next to a covariance; a second time changes nothing."""
    return covariance_of(levels_of(cov_m2))


def _factor(cov: F64) -> F64:
    """Lower Cholesky factor; of a singular covariance as if each axis had a millimetre more."""
    L = np.zeros((3, 3))
    for i in range(3):
        for j in range(i):
            L[i, j] = (cov[i, j] - L[i, :j] @ L[j, :j]) / L[j, j]
        L[i, i] = max(cov[i, i] - L[i, :i] @ L[i, :i], SMALLEST_SIGMA_M**2) ** 0.5
    return L


def _level(sigma_m: float) -> int:
    return min(max(round(log(sigma_m / SMALLEST_SIGMA_M) / log(LEVEL_RATIO)), 0), TOP_LEVEL)


def _lowest(row: F64) -> int:
    """The level from which on the ratios of a row of the factor can be said; below, the variance would shrink."""
    sigma_m = max(float(np.abs(row).max(initial=0.0)) / MAX_RATIO, SMALLEST_SIGMA_M)
    return min(ceil(log(sigma_m / SMALLEST_SIGMA_M) / log(LEVEL_RATIO) - _TOLERANCE), TOP_LEVEL)


def _sigma(level: int) -> float:
    return float(SMALLEST_SIGMA_M * LEVEL_RATIO**level)
