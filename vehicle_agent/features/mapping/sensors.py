"""How exact the sensors of a vehicle are that maps feature layers."""

from dataclasses import dataclass
from math import log, radians, sqrt
from typing import Final


@dataclass(frozen=True, slots=True)
class WheelsAndGyro:
    """Errors of wheel speed and yaw rate.

    Attributes:
        wheel_scale: sigma of the error of the wheel's radius, one for the whole drive, as a share.
        wheel_mps: sigma of a sample of the wheel speed, white.
        gyro_bias_radps: sigma of the constant error of the yaw rate, one for the whole drive.
        gyro_radps: sigma of a sample of the yaw rate, white.
        slip_m: what tyres and road add to the way over a metre driven, growing with the root of the way.
        slip_rad: the same to the yaw.
    """

    wheel_scale: float
    wheel_mps: float
    gyro_bias_radps: float
    gyro_radps: float
    slip_m: float
    slip_rad: float

    def __post_init__(self) -> None:
        if min(self.wheel_scale, self.wheel_mps, self.gyro_bias_radps, self.gyro_radps, self.slip_m) <= 0:
            raise ValueError(f"wheel_scale, wheel_mps, gyro_bias_radps, gyro_radps and slip_m must be > 0, got {self}")
        if self.slip_rad < 0:
            raise ValueError(f"slip_rad must be >= 0, got {self}")


@dataclass(frozen=True, slots=True)
class GnssReceiver:
    """Errors of a low-cost receiver: slow (first-order Gauss-Markov) and white.

    Attributes:
        sigma_m: of the slow part, each axis.
        correlation_s: its time constant.
        white_m: sigma of what is new with each fix, each axis.
    """

    sigma_m: float
    correlation_s: float
    white_m: float

    def __post_init__(self) -> None:
        if min(self.sigma_m, self.correlation_s, self.white_m) <= 0:
            raise ValueError(f"sigma_m, correlation_s and white_m must be > 0, got {self}")


@dataclass(frozen=True, slots=True)
class DriveSensors:
    """The sensors of a vehicle but for its detector, whose looks bring their sigmas."""

    motion: WheelsAndGyro
    gnss: GnssReceiver


_CEP_M: Final = 2.5
"""Half of all fixes lie within this, as the data sheet of the paper's receiver says."""
_WHITE_SHARE: Final = 0.3
"""Of the variance of a fix, as recorded with such a receiver (`python -m studies gnss-noise` at 9b4197d)."""
SERIES_CAR: Final = DriveSensors(
    WheelsAndGyro(0.005, 0.02, radians(0.1), radians(0.1), 0.001, radians(0.002)),
    GnssReceiver(
        _CEP_M * sqrt((1.0 - _WHITE_SHARE) / (2.0 * log(2.0))), 13.4, _CEP_M * sqrt(_WHITE_SHARE / (2.0 * log(2.0)))
    ),
)
"""A car's series sensors and a low-cost receiver."""
