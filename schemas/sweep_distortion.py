"""How far a pose may be off because the vehicle moved while the LiDAR turned and nobody knows the times of points."""

import math
from collections.abc import Callable
from typing import Final, NamedTuple

from gnd.schemas.drive import Deskew, DriveHeader

USUAL_SWEEP_S: Final = 0.1
"""Taken where a drive does not say how long its sweeps last: most LiDARs turn at 10 Hz."""
UNKNOWN_SHARE: Final[dict[Deskew, float]] = {
    "unsaid": 0.0, "measured": 0.0, "compensated": 0.0, "reconstructed": 0.02, "none": 1.0,
}  # fmt: skip
"""Share of the motion during a sweep that is still in the points. Reconstructed: the lasers of a head look up to 9°
past its azimuth, 2.5 % of a turn, to either side."""
LEVER_M: Final = 10.0
"""How far away the surfaces are that hold a heading: what shifts them against each other turns the scan."""


class DistortionSigma(NamedTuple):
    """One sigma of the pose in the vehicle's axes."""

    along_m: float
    across_m: float
    heading_rad: float


def distortion_sigma(deskew: Deskew, speed_mps: float, yaw_rate_radps: float, sweep_ns: int = 0) -> DistortionSigma:
    """One sigma of what a sweep's distortion does to the pose that matching it gives.

    A point was measured at some time of the sweep, uniform over it for want of better: a deviation of the sweep's
    length through the root of 12 about its middle. Which azimuths hold the pose is not known either, so errors of
    points do not average out. Surfaces to the left and to the right are half a sweep apart, which turns the scan.

    Args:
        deskew: what the drive's header says of the times of points.
        speed_mps: of the vehicle, either sign.
        yaw_rate_radps: either sign.
        sweep_ns: length of a sweep; 0 takes `USUAL_SWEEP_S`.
    """
    sigma_s = UNKNOWN_SHARE[deskew] * (sweep_ns * 1e-9 or USUAL_SWEEP_S) / math.sqrt(12.0)
    along_m, turned_rad = abs(speed_mps) * sigma_s, abs(yaw_rate_radps) * sigma_s
    return DistortionSigma(along_m, LEVER_M * turned_rad, math.hypot(turned_rad, along_m / (2.0 * LEVER_M)))


def distortion_of(header: DriveHeader) -> Callable[[float, float], DistortionSigma] | None:
    """`distortion_sigma` of speed and yaw rate for the sweeps of a drive; None where nothing distorts them."""
    if UNKNOWN_SHARE[header.deskew] == 0.0:
        return None
    return lambda speed_mps, yaw_rate_radps: distortion_sigma(header.deskew, speed_mps, yaw_rate_radps, header.sweep_ns)
