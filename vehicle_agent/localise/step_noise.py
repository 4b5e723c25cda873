"""How much worse than assumed wheels and gyro are, as map and scans show it along the stretches."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.localise.stretch import SolvedStretch, StretchStep, residual

_FORGETTING: Final = 0.7
"""Weight of the residuals until the last solution."""
_WORST_VARIANCE: Final = 1e4
_LEAST_VARIANCE: Final = 0.1
WINDOW: Final = 8
"""Steps over which wheels and gyro are compared with scans: the error of the latter does not grow with the way."""


class StepNoise:
    """Variance of the steps by wheels and gyro, (6,), in units of what is assumed; at least 1.

    Where map and odometry disagree either may be worse than it claims, and the stretch that trusts one finds its fault
    with the other. Steps from scan to scan know no map: wheels and gyro are no worse than these show.
    """

    def __init__(self) -> None:
        self._variance = np.ones(6)
        self._squares, self._redundancy = np.full(6, 3.0), np.full(6, 3.0)

    def grown(self, step: StretchStep) -> StretchStep:
        """Return a step by wheels and gyro with the covariance that residuals show."""
        grown = np.sqrt(self._variance)
        return replace(step, covariance=grown[:, None] * step.covariance * grown)

    def learn(self, solved: SolvedStretch, steps: Sequence[Sequence[StretchStep]], shared_off: F64) -> None:
        """Take the residuals of a solved stretch.

        Args:
            solved: the stretch.
            steps: that it was solved with.
            shared_off: (N_SHARED,) what the shared parameters differ by from those that the steps were made with.
        """
        self._squares = _FORGETTING * self._squares + solved.step_squares * self._variance
        self._redundancy = _FORGETTING * self._redundancy + solved.step_redundancy
        worst = np.minimum(_WORST_VARIANCE, np.maximum(variance_by_scans(steps, shared_off) * self._variance, 1.0))
        self._variance = np.clip(self._squares / self._redundancy, 1.0, worst)

    def against_claimed(self) -> F64:
        """Return (6,) the variance that residuals show in units of the one that is claimed, at most 1."""
        return np.asarray(np.clip(self._squares / self._redundancy / self._variance, _LEAST_VARIANCE, 1.0))


def variance_by_scans(steps: Sequence[Sequence[StretchStep]], shared_off: F64) -> F64:
    """Return (6,) the mean square by which steps of wheels and gyro (the first measurement of each) differ from those
    of scans (the second), in units of the variance claimed; infinite where there are too few of scans.
    """
    windows, single = [], []
    for i in range(0, len(steps) - WINDOW + 1, WINDOW // 2):
        window = steps[i : i + WINDOW]
        if all(len(measured) > 1 for measured in window):
            off = np.array([residual(seen.T_before_now, driven, shared_off) for driven, seen, *_ in window])
            variance = np.array([np.diag(driven.covariance) for driven, *_ in window])
            by_scans = np.array([np.diag(seen.covariance) for _, seen, *_ in window])
            windows.append(off.sum(axis=0) ** 2 / variance.sum(axis=0))
            single.append((off**2 - by_scans).sum(axis=0) / variance.sum(axis=0))
    return np.maximum(np.mean(windows, axis=0), np.mean(single, axis=0)) if windows else np.full(6, np.inf)
