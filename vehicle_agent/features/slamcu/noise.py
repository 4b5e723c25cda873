"""Errors of the vehicle's own sensors as SLAMCU takes them: wheels, gyro and a low-cost GNSS receiver.

Noise of wheels and gyro is per square root of a second, so that it does not depend on their rate: twice the white noise
that `gnd.fleet_sim.drives.SensorErrors` gives its sensors at 50 Hz, for wheels also slip. The error of the GNSS is slow
(Gauss-Markov) and white, both together of the sigma of the fix, as `python -m studies gnss-noise` at 9b4197d finds in a
car's single-point fixes.
"""

from math import radians
from typing import Final

SPEED_M: Final = 0.006
"""Of the way driven, m/√s."""
YAW_RAD: Final = radians(0.02)
"""Of the heading, rad/√s."""
SCALE: Final = 0.005
"""Sigma of the error of the wheel's radius, as a share; constant."""
BIAS_RADPS: Final = radians(0.1)
"""Sigma of the error of the yaw rate; constant."""
SCALE_WALK: Final = 2e-5
"""The scale's change, 1/√s."""
BIAS_WALK_RADPS: Final = radians(5e-4)
"""The bias's change, rad/s/√s."""

GNSS_WHITE_SHARE: Final = 0.30
"""White noise's share of the variance of a fix."""
GNSS_CORRELATION_S: Final = 13.4
"""Time constant of the slow error."""
GNSS_INTERVAL_S: Final = 0.5
"""At most one fix in this time is used: those between have the same error."""


def gnss_variances_m2(sigma_m: float) -> tuple[float, float]:
    """White and slow part of the variance of a fix, m², of its sigma."""
    return GNSS_WHITE_SHARE * sigma_m**2, (1.0 - GNSS_WHITE_SHARE) * sigma_m**2
