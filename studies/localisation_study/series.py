"""Errors of the poses of one run over time."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.motion import Trajectory
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from gnd.vehicle_agent.localise_drive.accuracy import error_series
from studies.localisation_study.reference import PAPER_LIMITS, QUANTITIES

HEALTHS: Final = ("lost", "degraded", "good")


@dataclass(frozen=True, slots=True, eq=False)
class PoseSeries:
    """N poses against the truth.

    Attributes:
        t_ns: int64 (N,).
        error: float64 (N, 3), signed: along and across the true heading [m], heading [deg].
        health: uint8 (N,), what the vehicle said of the pose, index of `HEALTHS`.
    """

    t_ns: I64
    error: F64
    health: NDArray[np.uint8]

    @classmethod
    def of(cls, estimates: Sequence[PoseEstimate], reference: Trajectory) -> "PoseSeries":
        """Return the errors of the estimates that lie within the reference's time; frames must be the same."""
        within = [e for e in estimates if reference.t_ns[0] <= e.t_ns <= reference.t_ns[-1]]
        errors = error_series(within, reference)
        health = np.array([HEALTHS.index(e.health) for e in within], np.uint8)
        return cls(errors.t_ns, np.column_stack([errors.longitudinal, errors.lateral, errors.heading]), health)

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def good(self) -> NDArray[np.bool_]:
        """(N,) which poses the vehicle called good."""
        return np.asarray(self.health == HEALTHS.index("good"))

    @property
    def wrong(self) -> NDArray[np.bool_]:
        """(N,) which poses are off by more than the paper's maxima (0.44 m along or across, 0.5 deg)."""
        return np.asarray((np.abs(self.error) > np.array(PAPER_LIMITS.max)).any(axis=1))

    def quantiles(self) -> dict[str, dict[str, float] | None]:
        """Return 95 % quantile and maximum of the absolute errors by quantity; None where there is no pose."""
        if not len(self):
            return dict.fromkeys(QUANTITIES)
        size = np.abs(self.error)
        return {
            name: {"p95": float(np.quantile(size[:, i], 0.95)), "max": float(size[:, i].max())}
            for i, name in enumerate(QUANTITIES)
        }

    def row(self, scans: int) -> dict[str, Any]:
        """Return a row of the result: errors, and how many of the drive's scans have a pose at all."""
        return {
            **self.quantiles(),
            "poses": len(self),
            "scans": scans,
            "coverage": len(self) / scans if scans else 0.0,
            "good_share": float(self.good.mean()) if len(self) else 0.0,
            "wrong_called_good": int(np.count_nonzero(self.good & self.wrong)),
        }
