"""Errors of the poses of one run over time, and what they are held against: the paper's tables, Ford, our targets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.motion import Trajectory
from gnd.vehicle_agent.localise.estimates import PoseEstimate, error_series

QUANTITIES: Final = ("longitudinal_m", "lateral_m", "heading_deg")
STATISTICS: Final = ("p95", "max")
Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ErrorLimit:
    """Largest errors that a requirement allows; what a heading may not exceed is infinite where it says nothing."""

    p95: Triple
    max: Triple

    def plain(self) -> dict[str, dict[str, float]]:
        """Return the limit by quantity and statistic; what is not limited is left out."""
        return {
            quantity: {"p95": self.p95[i], "max": self.max[i]}
            for i, quantity in enumerate(QUANTITIES)
            if self.p95[i] != _NONE
        }


_NONE: Final = float("inf")

PAPER_LIMITS: Final = ErrorLimit((0.15, 0.15, 0.17), (0.44, 0.44, 0.5))
"""Ford's requirement as the GND paper takes it (section 6.2)."""
FORD_LOCAL: Final = ErrorLimit((0.10, 0.10, _NONE), (0.29, 0.29, _NONE))
"""Ford's row of local streets (Reid et al. 2019, arXiv 1906.01061), positions only."""

PAPER: Final[Mapping[str, ErrorLimit]] = {
    "table2_without_submap": ErrorLimit((0.08412, 0.30124, 1.1388), (0.2002, 1.4518, 6.2191)),
    "table2_with_submap": ErrorLimit((0.031013, 0.012499, 0.052715), (0.054553, 0.030573, 0.094034)),
    "table4_without_submap": ErrorLimit((0.2299, 0.28506, 0.41892), (0.36875, 0.66626, 0.94196)),
    "table4_with_submap": ErrorLimit((0.1478, 0.13104, 0.14799), (0.19742, 0.20154, 0.2351)),
    "table6_before_update": ErrorLimit((0.2299, 0.28506, 0.41892), (0.36875, 0.66626, 0.94196)),
    "table6_after_update": ErrorLimit((0.11053, 0.14431, 0.13136), (0.17868, 0.20133, 0.20966)),
}
"""The paper's tables: 2 is its simulation, 4 and 6 are its real drives (its text has 0.20966 for the 0.13136)."""

PAPER_OF_ROW: Final[Mapping[str, tuple[str, ...]]] = {
    "without_submap": ("table2_without_submap", "table4_without_submap"),
    "with_submap": ("table2_with_submap", "table4_with_submap"),
    "online": ("table6_before_update",),
    "after_update": ("table6_after_update",),
}
"""Which of the paper's rows stand beside ours."""

MUST_TURNING: Final = ErrorLimit((0.031, 0.0125, 0.053), (_NONE, _NONE, _NONE))
"""With submaps, sensors that look all around: the paper's 95 % (Table 2)."""
AIM_TURNING: Final = ErrorLimit((0.015, 0.010, 0.02), (_NONE, _NONE, _NONE))
MUST_WINDOW: Final = PAPER_LIMITS
"""With submaps, a sensor with a window (Scala)."""
AIM_WINDOW: Final = ErrorLimit((0.05, 0.05, 0.10), (_NONE, _NONE, _NONE))
MUST_UPDATE_RATIO: Final = 1.1
"""After the map update the 95 % errors are at most this multiple of those on a fresh map."""
MUST_REINITIALISED: Final = 0.95
AIM_REINITIALISED: Final = 0.995
"""Share of starts that find the right pose; none may call a wrong one healthy."""


HEALTHS: Final = ("lost", "degraded", "good")


@dataclass(frozen=True, slots=True, eq=False)
class PoseSeries:
    """N poses against the truth.

    Attributes:
        t_ns: int64 (N,).
        error: float64 (N, 3), signed: along and across the true heading [m], heading [deg].
        health: uint8 (N,), the health that the vehicle gave the pose, index of `HEALTHS`.
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
