"""Settings of the mapping of a new feature layer: frozen dataclasses with defaults that run; units are in the names."""

from dataclasses import dataclass, field
from math import log, radians, sqrt


@dataclass(frozen=True, slots=True)
class MappingMotionNoise:
    """Errors of wheel speed and yaw rate; the defaults are those of a car's series sensors.

    wheel_scale: sigma of the error of the wheel's radius, one for the whole drive, as a share.
    wheel_mps: sigma of a sample of the wheel speed, white.
    gyro_bias_radps: sigma of the constant error of the yaw rate, one for the whole drive.
    gyro_radps: sigma of a sample of the yaw rate, white.
    slip_m, slip_rad: what tyres and road add over a metre driven, growing with the root of the way.
    gap_mps2, gap_radps2: how much speed and yaw rate may change unseen between samples more than 0.1 s apart.
    """

    wheel_scale: float = 0.005
    wheel_mps: float = 0.02
    gyro_bias_radps: float = radians(0.1)
    gyro_radps: float = radians(0.1)
    slip_m: float = 0.001
    slip_rad: float = radians(0.002)
    gap_mps2: float = 2.0
    gap_radps2: float = 0.3

    def __post_init__(self) -> None:
        if min(self.wheel_scale, self.wheel_mps, self.gyro_bias_radps, self.gyro_radps, self.slip_m) <= 0:
            raise ValueError(f"wheel_scale, wheel_mps, gyro_bias_radps, gyro_radps and slip_m must be > 0, got {self}")
        if min(self.slip_rad, self.gap_mps2, self.gap_radps2) < 0:
            raise ValueError(f"slip_rad, gap_mps2 and gap_radps2 must be >= 0, got {self}")


@dataclass(frozen=True, slots=True)
class MappingGnssNoise:
    """Errors of a low-cost receiver: slow and white, the slow part first-order Gauss-Markov.

    Defaults: half of all fixes within 2.5 m, as the data sheet of the paper's receiver says, 30 % of the variance white
    and the rest with 13.4 s, as a recorded drive of such a receiver gives (`python -m studies gnss-noise` at 9b4197d).

    sigma_m: of the slow part, each axis.
    correlation_s: its time constant.
    white_m: sigma of what is new with each fix, each axis.
    every_s: a state of the slow part at least this far from the next.
    robust_k: Huber's k of a fix, in sigmas.
    """

    sigma_m: float = 2.5 * sqrt(0.7 / (2.0 * log(2.0)))
    correlation_s: float = 13.4
    white_m: float = 2.5 * sqrt(0.3 / (2.0 * log(2.0)))
    every_s: float = 1.0
    robust_k: float = 3.0

    def __post_init__(self) -> None:
        if min(self.sigma_m, self.correlation_s, self.white_m, self.every_s, self.robust_k) <= 0:
            raise ValueError(f"all values of the GNSS noise must be > 0, got {self}")


@dataclass(frozen=True, slots=True)
class LandmarkParameters:
    """How measurements become features.

    robust_k: Huber's k of a measurement, in sigmas.
    """

    robust_k: float = 3.0

    def __post_init__(self) -> None:
        if self.robust_k <= 0:
            raise ValueError(f"robust_k must be > 0, got {self}")


@dataclass(frozen=True, slots=True)
class LaneParameters:
    """How lanes are matched with the HD map (Eq. 7-9).

    map_sigma_m: of the HD map itself.
    robust_k: Huber's k of a window's match, in sigmas.
    """

    map_sigma_m: float = 0.01
    robust_k: float = 3.0

    def __post_init__(self) -> None:
        if self.map_sigma_m < 0 or self.robust_k <= 0:
            raise ValueError(f"map_sigma_m >= 0 and robust_k > 0 are required, got {self}")


@dataclass(frozen=True, slots=True)
class NewLayerParameters:
    """What the mapping of a new layer can be told.

    rounds: how often measurements are given to features anew and the graph is solved.
    """

    rounds: int = 6
    motion: MappingMotionNoise = field(default_factory=MappingMotionNoise)
    gnss: MappingGnssNoise = field(default_factory=MappingGnssNoise)
    landmarks: LandmarkParameters = field(default_factory=LandmarkParameters)
    lanes: LaneParameters = field(default_factory=LaneParameters)

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise ValueError(f"rounds must be >= 1, got {self.rounds}")
