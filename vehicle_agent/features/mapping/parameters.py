"""Settings of the mapping of a new feature layer: frozen dataclasses with defaults that run; units are in the names."""

from dataclasses import dataclass, field
from math import log, radians, sqrt


@dataclass(frozen=True, slots=True)
class MotionNoise:
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
class GnssNoise:
    """Errors of a low-cost receiver: slow and white, the slow part first-order Gauss-Markov.

    Defaults: half of all fixes within 2.5 m, as the data sheet of the paper's receiver says, 30 % of the variance white
    and the rest with 13.4 s, as a recorded drive of such a receiver gives (`python -m studies gnss-noise`).

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

    gate_chi2: a measurement farther than this from a feature (two degrees of freedom) is none of it; 0.1 % of the
        right ones are.
    min_hits: a feature with fewer measurements is a ghost and not told.
    revisit_m: sigma of what the first poses are off by against those of a passage `revisit_way_m` before.
    drift_m: sigma of what the first poses are off by within a passage.
    merge_chi2: two of one kind that are nearer than this, and not seen side by side, are one.
    apart_share: they count as seen side by side in more than this share of the looks of the rarer.
    robust_k: Huber's k of a measurement, in sigmas.
    """

    gate_chi2: float = 13.8
    min_hits: int = 5
    revisit_m: float = 1.5
    revisit_way_m: float = 150.0
    drift_m: float = 0.1
    merge_chi2: float = 9.2
    apart_share: float = 0.3
    robust_k: float = 3.0

    def __post_init__(self) -> None:
        if self.min_hits < 1:
            raise ValueError(f"min_hits must be >= 1, got {self.min_hits}")
        if min(self.gate_chi2, self.revisit_m, self.revisit_way_m, self.drift_m, self.merge_chi2, self.robust_k) <= 0:
            raise ValueError(f"all values of the landmarks' parameters but apart_share must be > 0, got {self}")


@dataclass(frozen=True, slots=True)
class LaneParameters:
    """How lanes are matched with the HD map (Eq. 7-9).

    sigma_m, sigma_rad: of a polyline of one look: how far off it lies beside the vehicle, and how far it is turned
        (Table 1 of the paper with l = 1); used where the look does not say.
    beside_m: lanes this far beside the vehicle are looked at.
    window_m: looks of so long a way are put together.
    search_m: the first match tries so far to either side.
    gate: a polyline farther than this many sigmas from a line is none of it.
    max_correspondence_m: of GICP.
    min_polylines: a window of fewer polylines is not matched.
    map_sigma_m: of the HD map itself.
    information: the share of what polylines would say if it were certain which lane each is. With the paper's noise
        some are taken for their neighbour; with 0.75 the squared errors of features are as large as they should be.
    robust_k: Huber's k of a window's match, in sigmas.
    """

    sigma_m: float = 1.0
    sigma_rad: float = radians(2.5)
    beside_m: float = 15.0
    window_m: float = 20.0
    search_m: float = 4.0
    gate: float = 3.5
    max_correspondence_m: float = 1.5
    min_polylines: int = 3
    map_sigma_m: float = 0.01
    information: float = 0.75
    robust_k: float = 3.0

    def __post_init__(self) -> None:
        if min(self.sigma_m, self.sigma_rad, self.window_m, self.beside_m, self.gate, self.max_correspondence_m) <= 0:
            raise ValueError(f"sigmas, window_m, beside_m, gate and max_correspondence_m must be > 0, got {self}")
        if not 0.0 < self.information <= 1.0:
            raise ValueError(f"information must be in (0, 1], got {self.information}")
        if self.search_m < 0 or self.min_polylines < 1 or self.map_sigma_m < 0 or self.robust_k <= 0:
            raise ValueError(f"search_m, map_sigma_m >= 0, min_polylines >= 1 and robust_k > 0 required, got {self}")


@dataclass(frozen=True, slots=True)
class NewLayerParameters:
    """Everything that the mapping of a new layer can be told.

    keyframe_m, keyframe_s: a pose of the graph every so many metres, and every so many seconds.
    rounds: how often measurements are given to features anew and the graph is solved.
    settled_m: rounds end when no feature moves by more.
    """

    keyframe_m: float = 5.0
    keyframe_s: float = 1.0
    rounds: int = 6
    settled_m: float = 0.01
    motion: MotionNoise = field(default_factory=MotionNoise)
    gnss: GnssNoise = field(default_factory=GnssNoise)
    landmarks: LandmarkParameters = field(default_factory=LandmarkParameters)
    lanes: LaneParameters = field(default_factory=LaneParameters)

    def __post_init__(self) -> None:
        if min(self.keyframe_m, self.keyframe_s, self.settled_m) <= 0 or self.rounds < 1:
            raise ValueError(f"all values must be > 0 and rounds >= 1, got {self}")
