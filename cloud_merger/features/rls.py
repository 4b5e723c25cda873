"""Recursive least squares of a feature's place (NFL, "Crowd-Sourced Mapping of New Feature Layer", Eq. (11)-(12)).

A state is the points (N, 3) of a feature with one covariance (3, 3) of each of them; a point has N = 1. Of a polyline
only what lies across the line can be measured, so a measured line is first brought to the state's own vertices.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.cloud_merger.features.shapes import onto
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import UNKNOWN_HEIGHT_M2, full_covariance, six_of

_I3: Final = np.eye(3)
_NOTHING_M2: Final = 1e12


@dataclass(frozen=True, slots=True, eq=False)
class PlaceEstimate:
    """Where something is.

    Attributes:
        points_m: (N, 3) in the tile's ENU frame.
        cov_m2: (3, 3) of each point; 10^12 m² and no correlation for a height that nobody measured.
    """

    points_m: F64
    cov_m2: F64

    @classmethod
    def of(cls, points_m: F64, cov_m2: F64) -> "PlaceEstimate":
        """From six values xx, xy, xz, yy, yz, zz. Of an unknown height one learns nothing, however often it comes."""
        cov = full_covariance(cov_m2)
        if cov[2, 2] > UNKNOWN_HEIGHT_M2 / 2:
            cov[2], cov[:, 2] = 0.0, 0.0
            cov[2, 2] = _NOTHING_M2
        return cls(points_m, cov)

    @property
    def least_m2(self) -> float:
        """The smaller horizontal variance: how sure it claims to be."""
        xx, xy, yy = self.cov_m2[0, 0], self.cov_m2[0, 1], self.cov_m2[1, 1]
        return float(0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy))

    def six(self) -> F64:
        """(6,) the covariance as features have it."""
        six = six_of(self.cov_m2)
        six[5] = min(six[5], UNKNOWN_HEIGHT_M2)
        return six

    def scaled(self, factor: float) -> "PlaceEstimate":
        """The same with a covariance `factor` times as large."""
        return PlaceEstimate(self.points_m, self.cov_m2 * factor) if factor != 1.0 else self


def step(state: PlaceEstimate, measured: PlaceEstimate) -> PlaceEstimate:
    """The state after one more measurement. NFL, Eq. (12) with H = I, in Joseph form.

    Args:
        state: x_{k-1} and P_{k-1}.
        measured: y_k and R_k.
    """
    P, R = state.cov_m2, measured.cov_m2
    K = np.linalg.solve(P + R, P).T  # Eq. (12): P (P + R)^-1, both symmetric
    points_m = state.points_m + (onto(state.points_m, measured.points_m) - state.points_m) @ K.T  # Eq. (12)
    J = _I3 - K
    cov = J @ P @ J.T + K @ R @ K.T  # Eq. (12), Joseph form: positive whatever the rounding
    return PlaceEstimate(points_m, 0.5 * (cov + cov.T))


def estimate(measured: Sequence[PlaceEstimate], known: PlaceEstimate | None = None) -> PlaceEstimate:
    """What all measurements say together, one after the other.

    Args:
        measured: at least one unless `known` is given.
        known: what was known before; None: the first measurement is where it begins. NFL, Eq. (11).
    """
    state, rest = (measured[0], measured[1:]) if known is None else (known, measured)  # Eq. (11): x_0 = y_0, P_0 = R_0
    for one in rest:
        state = step(state, one)
    return state


def fused(together: PlaceEstimate, repeats: int, information: float) -> PlaceEstimate:
    """One vehicle's measurements of one feature as a single one.

    Its n errors have something in common. Of n equally good ones with correlation ρ each, the mean has the variance
    R (1 + (n - 1) ρ) / n, which is what this gives.

    Args:
        together: `estimate` of the n measurements.
        repeats: n >= 1.
        information: n / (1 + (n - 1) ρ), `FeatureMergeParameters.information_of`.
    """
    return together.scaled(repeats / information)


def is_even(measured_m2: Sequence[float], known_m2: float | None, most: float) -> bool:
    """Whether no measurement's variance is more than `most` times smaller than the next; the map's own may be.

    Args:
        measured_m2: smallest variances, one a vehicle.
        known_m2: that of what the map knows, which is a witness too; None: nothing.
        most: see `balanced`.
    """
    all_m2 = sorted([*measured_m2, *([] if known_m2 is None else [known_m2])])
    return len(all_m2) < 2 or all_m2[1] <= most * min(measured_m2, default=np.inf)


def balanced(measured: Sequence[PlaceEstimate], known: PlaceEstimate | None, most: float) -> list[PlaceEstimate]:
    """The measurements of vehicles, none of which claims to be much surer than all others.

    Args:
        measured: one a vehicle.
        known: what the map knows, which is a witness too.
        most: no variance is more than this times smaller than the second smallest; the covariance is scaled up to that.
    """
    least_m2, known_m2 = [one.least_m2 for one in measured], None if known is None else known.least_m2
    if is_even(least_m2, known_m2, most):
        return list(measured)
    bound_m2 = sorted([*least_m2, *([] if known_m2 is None else [known_m2])])[1] / most
    return [one.scaled(max(1.0, bound_m2 / max(one.least_m2, 1e-12))) for one in measured]
