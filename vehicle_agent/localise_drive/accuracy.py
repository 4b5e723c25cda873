"""Errors of poses against a reference, scan by scan, beside the limits that the GND paper asks for."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from gnd.vehicle_agent.localise.estimates import ErrorSeries, PoseEstimate


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
