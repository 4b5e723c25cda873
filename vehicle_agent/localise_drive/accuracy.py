"""Errors of poses against a reference, scan by scan, beside the limits that the GND paper asks for."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.vehicle_agent.localise.estimates import PoseEstimate


@dataclass(frozen=True, slots=True)
class AccuracyLimit:
    """What 95 % of the errors, and every one, must stay below."""

    unit: str
    p95: float
    largest: float


LIMITS: Final = {
    "longitudinal": AccuracyLimit("m", 0.15, 0.44),
    "lateral": AccuracyLimit("m", 0.15, 0.44),
    "heading": AccuracyLimit("deg", 0.17, 0.5),
}
"""Requirement of localisation (GND, Tables 4 and 6)."""


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSeries:
    """Signed errors along, across and about the reference's heading, left and counter-clockwise positive; (N,) each."""

    t_ns: I64
    longitudinal: F64
    """[m]"""
    lateral: F64
    """[m]"""
    heading: F64
    """[deg]"""

    def __len__(self) -> int:
        return len(self.t_ns)

    def of(self, name: str) -> F64:
        """The errors of that name of `LIMITS`."""
        errors: F64 = getattr(self, name)
        return errors


def error_series(estimates: Sequence[PoseEstimate], reference: Trajectory | None) -> ErrorSeries:
    """Errors of the estimates (T_map_vehicle) that lie within the reference's time, interpolated; none without one."""
    known = () if reference is None else (int(reference.t_ns[0]), int(reference.t_ns[-1]))
    within = [e for e in estimates if known and known[0] <= e.t_ns <= known[1]]
    t_ns = np.array([e.t_ns for e in within], np.int64)
    if reference is None or not within:
        return ErrorSeries(t_ns, *np.empty((3, 0)))
    error = T_inverse(reference.at(t_ns)) @ np.stack([e.T_map_vehicle for e in within])
    heading_deg = np.degrees(np.arctan2(error[:, 1, 0], error[:, 0, 0]))
    return ErrorSeries(t_ns, error[:, 0, 3], error[:, 1, 3], heading_deg)


def healthy(estimates: Sequence[PoseEstimate]) -> list[PoseEstimate]:
    """Those whose health is good: of these, none may be wrong."""
    return [estimate for estimate in estimates if estimate.health == "good"]


def error_summary(series: ErrorSeries) -> dict[str, Any] | None:
    """95 % quantile and largest of the absolute errors, and whether both keep the limits; None without errors."""
    if not len(series):
        return None
    found: dict[str, Any] = {"n": len(series)}
    for name, limit in LIMITS.items():
        off = np.abs(series.of(name))
        p95, largest = float(np.quantile(off, 0.95)), float(off.max())
        within = p95 <= limit.p95 and largest <= limit.largest
        found[f"{name}_{limit.unit}"] = {"p95": round(p95, 5), "max": round(largest, 5), "within_limits": within}
    return found


def limits_json() -> dict[str, dict[str, float]]:
    """The limits as plain values."""
    return {f"{name}_{limit.unit}": {"p95": limit.p95, "max": limit.largest} for name, limit in LIMITS.items()}
