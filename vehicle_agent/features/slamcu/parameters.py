"""Parameters of SLAMCU; the defaults are the paper's where it names a value (section 6.2)."""

from dataclasses import dataclass, field
from math import isfinite, radians

from gnd.vehicle_agent.features.errors import SlamcuParameterError


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """What is wrong with wheels and gyro. Noise per square root of a second, so that it does not depend on their rate.

    Twice the white noise that `gnd.fleet_sim.drives.SensorErrors` gives its sensors at 50 Hz: wheels also slip.
    """

    speed_m: float = 0.006
    """Of the way driven, m/√s."""
    yaw_rad: float = radians(0.02)
    """Of the heading, rad/√s."""
    scale: float = 0.005
    """Error of the wheel's radius, as a share; constant."""
    bias_radps: float = radians(0.1)
    """Error of the yaw rate; constant."""
    scale_walk: float = 2e-5
    """The scale's change, 1/√s."""
    bias_walk_radps: float = radians(5e-4)
    """The bias's change, rad/s/√s."""

    def __post_init__(self) -> None:
        for name in self.__slots__:
            _check(f"motion.{name}", getattr(self, name), 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class GnssNoise:
    """Errors of a low-cost GNSS: a slow one (Gauss-Markov) and a white one, together of the sigma that the fix tells.

    As `python -m studies gnss-noise` at 9b4197d finds them in a car's single-point fixes.
    """

    white_share: float = 0.30
    """White noise's share of the variance."""
    correlation_s: float = 13.4
    """Time constant of the slow error."""
    interval_s: float = 0.5
    """At most one fix in this time is used: those between tell the same error once more."""

    def __post_init__(self) -> None:
        _check("gnss.white_share", self.white_share, 1e-3, 0.999)
        _check("gnss.correlation_s", self.correlation_s, 1e-3, 1e6)
        _check("gnss.interval_s", self.interval_s, 0.0, 1e3)


@dataclass(frozen=True, slots=True)
class FilterParameters:
    """The Rao-Blackwellised particle filter."""

    particles: int = 1000
    """M; one is enough where the poses are given and certain."""
    resample_below: float = 0.5
    """α of Eq. (20): resample when the effective number falls below this share of M."""
    jitter: float = 0.45
    """h: a resampled particle keeps √(1-h²) of its distance from the mean; h of that of another pair makes up for it.
    0 is plain resampling."""
    floor: float = 4e-4
    """Density, 1/(m·rad), of a measurement that belongs to something else although it was associated: about one false
    alarm in fifty looks over 80 m x 40°. It keeps a wrong association from deciding about the particles."""
    horizon_m: float = 2000.0
    """A new feature left behind by this way no longer learns from what comes."""

    def __post_init__(self) -> None:
        _check("filter.particles", self.particles, 1, 100_000)
        _check("filter.resample_below", self.resample_below, 0.0, 1.0)
        _check("filter.jitter", self.jitter, 0.0, 0.9)
        _check("filter.floor", self.floor, 0.0, 1.0)
        _check("filter.horizon_m", self.horizon_m, 0.0, 1e6)


@dataclass(frozen=True, slots=True)
class SlamcuParameters:
    """Existence, association and filter."""

    detection_confidence: float = 0.9
    """λ of Eq. (1) and (2)."""
    map_confidence: float = 0.95
    """λ_HD of Eq. (3)."""
    map_sigma_m: float = 0.05
    """Error of each axis of a map feature's position on top of the covariance that the map gives it."""
    motion: MotionNoise = field(default_factory=MotionNoise)
    gnss: GnssNoise = field(default_factory=GnssNoise)
    filter: FilterParameters = field(default_factory=FilterParameters)

    def __post_init__(self) -> None:
        _check("detection_confidence", self.detection_confidence, 1e-3, 0.999)
        _check("map_confidence", self.map_confidence, 0.0, 0.999)
        _check("map_sigma_m", self.map_sigma_m, 0.0, 1e3)


def _check(name: str, value: float, low: float, high: float) -> None:
    if not (isfinite(value) and low <= value <= high):
        raise SlamcuParameterError(f"{name} = {value} is not in {low:g} … {high:g}")
