"""Pre-data association: which measurement belongs to which feature (SLAMCU, section 4.3.1), one to one."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from gnd.gnd_map.arrays import F64, I64

FORBIDDEN: Final = 1e9


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """Pairs and what is left.

    Attributes:
        measurement: int64 (P,), rising.
        feature: int64 (P,), column of each one's feature.
        alone: int64, measurements that belong to no feature.
    """

    measurement: I64
    feature: I64
    alone: I64


def associate(cost: F64, alone_cost: float) -> Association:
    """The assignment of least cost in which each feature takes at most one measurement.

    Args:
        cost: (Z, F) negative log likelihood of each pair; `FORBIDDEN` or more where gate or kind forbids it.
        alone_cost: negative log density of a measurement of nothing known.
    """
    z, f = cost.shape
    if z == 0 or f == 0:
        return Association(np.zeros(0, np.int64), np.zeros(0, np.int64), np.arange(z, dtype=np.int64))
    padded = np.full((z, f + z), FORBIDDEN)
    padded[:, :f] = np.minimum(cost, FORBIDDEN)
    padded[np.arange(z), f + np.arange(z)] = alone_cost
    rows, columns = linear_sum_assignment(padded)
    paired = columns < f
    return Association(rows[paired].astype(np.int64), columns[paired].astype(np.int64), rows[~paired].astype(np.int64))


def pair_costs(innovation: F64, cov: F64, same_kind: NDArray[np.bool_], gate: float) -> F64:
    """Negative log likelihood of each pair.

    Args:
        innovation: (Z, F, 2) measured minus predicted range [m] and bearing [rad].
        cov: (Z, F, 2, 2) their covariances.
        same_kind: (Z, F).
        gate: largest squared Mahalanobis distance.

    Returns:
        (Z, F), `FORBIDDEN` outside the gate or between kinds.
    """
    a, b, c = cov[..., 0, 0], cov[..., 0, 1], cov[..., 1, 1]
    det = a * c - b * b
    x, y = innovation[..., 0], innovation[..., 1]
    squared = (c * x * x - 2.0 * b * x * y + a * y * y) / det
    cost = 0.5 * squared + 0.5 * np.log((2.0 * np.pi) ** 2 * det)
    return np.where(same_kind & (squared <= gate), cost, FORBIDDEN)
