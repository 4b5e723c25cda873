"""What localisation gives: pose estimates, scans with final poses, and their errors against a reference."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.vehicle_agent.errors import LocaliseError

F64 = NDArray[np.float64]
Health = Literal["good", "degraded", "lost"]
Cause = Literal[
    "none", "wrong_pose", "stale_map", "poor_place", "no_map", "no_match", "no_position", "no_motion", "bad_scan",
    "bad_time", "gap", "ambiguous", "searching", "unconfirmed",
    "clock", "mount", "disputed", "hindsight",
]  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """The vehicle's pose at `t_ns` in the map frame.

    sigma_m: larger one of the two horizontal one-sigma axes; sigma_rad: one sigma of the heading; matching_ratio: share
    of the scan's points that met a Gaussian of the map (0 when the scan was not matched).
    cause: why the health is what it is; "stale_map" also goes with good health, all else with degraded or lost.
    degenerate: directions that neither the scan nor the map constrains and the pose is dead reckoned along, of
    "longitudinal", "lateral", "vertical", "roll", "pitch", "heading".
    covariance: (6, 6) of the pose in the vehicle frame, rotation (rad) before position (m); None where only the sigmas
    are known.
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
    """A scan whose pose is final: `points_map_m` and `origins_map_m` (N, 3) float64, end and start of each ray, in
    firing order, sweep motion removed.
    """

    t_ns: int
    points_map_m: F64
    origins_map_m: F64
    estimate: PoseEstimate


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


def localisation_error(estimates: Iterable[PoseEstimate], reference: Trajectory) -> LocalisationError:
    """Errors of `estimates` against the reference poses T_map_vehicle, interpolated at the estimates' times.

    Raises:
        LocaliseError: no estimate lies within the reference's time.
    """
    first, last = int(reference.t_ns[0]), int(reference.t_ns[-1])
    within = [e for e in estimates if first <= e.t_ns <= last]
    if not within:
        raise LocaliseError(f"no pose estimate lies between {first} and {last} ns, where the reference is known")
    T_map_reference = reference.at(np.array([e.t_ns for e in within], np.int64))
    error = T_inverse(T_map_reference) @ np.stack([e.T_map_vehicle for e in within])
    along, across = np.abs(error[:, 0, 3]), np.abs(error[:, 1, 3])
    heading = np.degrees(np.abs(np.arctan2(error[:, 1, 0], error[:, 0, 0])))
    columns = [f(e) for e in (along, across, heading) for f in (_p95, np.max)]
    return LocalisationError(len(within), *map(float, columns))


def _p95(values: F64) -> float:
    return float(np.quantile(values, 0.95))
