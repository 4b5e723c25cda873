"""What localisation gives: pose estimates, scans with final poses, and their errors against a reference."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.localise.packed_scan import SweptRays
from gnd.vehicle_agent.packed_rays import PackedRays, PlacedRays

WaitingRays = PackedRays | SweptRays
"""Rays in a form that takes little memory; both forms answer to the same names."""

Health = Literal["good", "degraded", "lost"]
Cause = Literal[
    "none", "wrong_pose", "stale_map", "poor_place", "no_map", "no_match", "no_position", "no_motion", "bad_scan",
    "bad_time", "gap", "ambiguous", "searching", "unconfirmed",
    "clock", "mount", "disputed", "hindsight",
]  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """The vehicle's pose at `t_ns` in the map frame.

    Attributes:
        sigma_m: larger one of the two horizontal one-sigma axes.
        sigma_rad: one sigma of the heading.
        matching_ratio: share of the scan's points that met a Gaussian of the map (0 when the scan was not matched).
        cause: why the health is what it is; "stale_map" also goes with good health, all else with degraded or lost.
        degenerate: directions that neither the scan nor the map constrains and the pose is dead reckoned along, of
            "longitudinal", "lateral", "vertical", "roll", "pitch", "heading".
        covariance: (6, 6) of the pose in the vehicle frame, rotation (rad) before position (m); None where only the
            sigmas are known.
        disagrees: the refined pose lay farther from the online one than both are uncertain.
    """

    t_ns: int
    T_map_vehicle: F64
    sigma_m: float
    sigma_rad: float
    matching_ratio: float
    health: Health
    cause: Cause = "none"
    degenerate: tuple[str, ...] = ()
    covariance: F64 | None = None
    disagrees: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class RefinedScan:
    """A scan whose pose is final: its rays in the map frame, in firing order, sweep motion removed.

    They stay packed until what they met is counted: arrays of a whole scan that come and go between those that wait
    leave gaps in the heap.
    """

    t_ns: int
    rays: PlacedRays | WaitingRays
    estimate: PoseEstimate

    def __len__(self) -> int:
        """How many rays."""
        return len(self.rays.ends_m if isinstance(self.rays, PlacedRays) else self.rays)

    @property
    def points_map_m(self) -> F64:
        """(N, 3) float64 the ends of the rays; unpacked at each call."""
        return self.rays.restore()[0]

    @property
    def origins_map_m(self) -> F64:
        """(N, 3) float64 their starts; unpacked at each call."""
        return self.rays.restore()[1]


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


@dataclass(frozen=True, slots=True)
class LocalisationError:
    """95 % quantile and largest absolute error along, across and about the reference's heading, over `n` poses."""

    n: int
    longitudinal_p95_m: float
    longitudinal_max_m: float
    lateral_p95_m: float
    lateral_max_m: float
    heading_p95_deg: float
    heading_max_deg: float


def localisation_error(estimates: Sequence[PoseEstimate], reference: Trajectory) -> LocalisationError:
    """Errors of `estimates` against the reference poses T_map_vehicle, interpolated at the estimates' times.

    Raises:
        LocaliseError: no estimate lies within the reference's time.
    """
    series = error_series(estimates, reference)
    if not len(series):
        first, last = int(reference.t_ns[0]), int(reference.t_ns[-1])
        raise LocaliseError(f"no pose estimate lies between {first} and {last} ns, where the reference is known")
    off = np.abs([series.longitudinal, series.lateral, series.heading])
    columns = np.column_stack([np.quantile(off, 0.95, axis=1), off.max(axis=1)])
    return LocalisationError(len(series), *columns.ravel().tolist())
