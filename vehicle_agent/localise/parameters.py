"""Settings of localisation: one frozen dataclass a step, with defaults that run; units are in the names."""

from dataclasses import dataclass, field

from gnd.vehicle_agent.localise.doubt_parameters import (
    CauseParameters,
    ChallengeParameters,
    HypothesisParameters,
    PoolParameters,
    WitnessParameters,
)
from gnd.vehicle_agent.localise.refine_parameters import RefineParameters
from gnd.vehicle_agent.localise.scan_odometry_parameters import ScanOdometryParameters
from gnd.vehicle_agent.localise.uniqueness_parameters import UniquenessParameters


@dataclass(frozen=True, slots=True)
class SamplingParameters:
    """Which points of a scan are matched: about `n_points`, at most one in a cube of `leaf_m`."""

    n_points: int = 2500
    leaf_m: float = 0.3
    min_range_m: float = 2.5
    max_range_m: float = 60.0

    def __post_init__(self) -> None:
        if self.n_points < 100 or self.leaf_m <= 0 or not 0 <= self.min_range_m < self.max_range_m:
            raise ValueError(f"n_points >= 100, leaf_m > 0 and 0 <= min_range_m < max_range_m are required, got {self}")


@dataclass(frozen=True, slots=True)
class RegistrationParameters:
    """Scan-to-map matching.

    noise_m: one sigma of range noise, distortion left in the sweep and voxel rounding together.
    scales: Geman-McClure scales in sigmas, one a stage, wide to narrow, when the start is known to some 10 cm: where
        the world has changed, a narrow kernel stays with what has not.
    wide_scales: the stages when the start is known to 1 m and 3 degrees; capture_scales: to 2 m and 5 degrees.
    gate_per_scale: a point farther than this many scales from every Gaussian is no match.
    correlation: how many points share one error (of the map, of the mount); multiplies the covariance.
    floor_m, floor_rad: the least sigma claimed along an axis, whatever the Hessian says.
    degenerate_m: a direction whose sigma exceeds this (turns taken at 10 m) is reported and not moved along;
        degenerate_share: so is a horizontal one with less than this share of the strongest direction's information.
    """

    noise_m: float = 0.04
    scales: tuple[float, ...] = (4.0, 2.0)
    wide_scales: tuple[float, ...] = (8.0, 4.0, 2.0)
    capture_scales: tuple[float, ...] = (30.0, 10.0, 4.0, 2.0)
    gate_per_scale: float = 2.5
    max_iterations: int = 15
    stop_m: float = 5e-4
    stop_rad: float = 1e-4
    min_matched: int = 60
    correlation: float = 10.0
    floor_m: float = 0.01
    floor_rad: float = 3e-4
    degenerate_m: float = 0.2
    degenerate_share: float = 0.01
    wheel_sigma_m: float = 0.02

    def __post_init__(self) -> None:
        stages = (*self.scales, *self.wide_scales, *self.capture_scales)
        if not (self.scales and self.wide_scales and self.capture_scales) or min(*stages, self.noise_m) <= 0:
            raise ValueError(f"noise_m and at least one scale, all positive, are required, got {self}")
        if self.min_matched < 6 or self.max_iterations < 1:
            raise ValueError(f"min_matched >= 6 and max_iterations >= 1 are required, got {self}")


@dataclass(frozen=True, slots=True)
class InitialiseParameters:
    """Search for the first pose around a GNSS position.

    radius_sigmas: how far around the position, in its sigmas; step_m, step_deg: spacing of the coarse hypotheses;
    n_points: points that score one; n_refined: how many of the best are refined by registration, with `n_checked`
        points; n_kept: how many of these are refined to the end, with `n_refining` points; same_m, same_deg: refined
        poses nearer than this are one;
    min_fit: least fit (0 ... 1) that counts as found; ambiguity: the runner-up may reach this share of the best fit;
    good_fit, fair_fit: a fit of `good_fit` is taken at once; one of `fair_fit` when it stays the best for some way:
        where much has changed, a pose decimetres off can fit best, and a vehicle that moves soon sees something else;
    apart_m, apart_deg: two poses nearer than this are the same answer.
    """

    radius_sigmas: float = 3.0
    step_m: float = 1.0
    step_deg: float = 5.0
    n_points: int = 400
    n_refined: int = 24
    n_checked: int = 400
    n_kept: int = 8
    n_refining: int = 1000
    same_m: float = 0.2
    same_deg: float = 1.0
    min_fit: float = 0.4
    good_fit: float = 0.65
    fair_fit: float = 0.48
    ambiguity: float = 0.9
    apart_m: float = 1.0
    apart_deg: float = 5.0
    above_ground_m: float = 0.4

    def __post_init__(self) -> None:
        if min(self.step_m, self.step_deg, self.radius_sigmas) <= 0 or min(self.n_points, self.n_refined) < 1:
            raise ValueError(f"steps, radius and counts must be positive, got {self}")
        if not (0 < self.min_fit < 1 and 0 < self.ambiguity <= 1):
            raise ValueError(f"0 < min_fit < 1 and 0 < ambiguity <= 1 are required, got {self}")


@dataclass(frozen=True, slots=True)
class OdometryParameters:
    """How far to trust wheel speed and yaw rate, one sigma each.

    longitudinal_m, lateral_m, vertical_m, distance_share, roll_pitch_rad, yaw_rad: of a step between two scans, the
        share being of its length, once scale, bias and course are learnt.
    scale_prior, bias_prior_radps, course_prior: of the wheel scale, of the gyro's bias, and of the motion sideways and
        upwards per metre forward (the LiDAR's mount is not aligned with the wheels) before anything is learnt.
    scale_drift, bias_drift_radps: their change in a root second.
    stretch_m, stretch_rad: of the motion over a second that two map matches tell.
    least_scale, least_bias_radps: the least sigma of what a stretch of submaps tells about scale and bias.
    teaching_fit: least fit of a match that teaches: where much has changed, matches are off together.
    excess_gain: weight of the newest step in the running judgement of how much worse than all this the odometry is.
    """

    longitudinal_m: float = 0.003
    lateral_m: float = 0.003
    vertical_m: float = 0.01
    distance_share: float = 0.007
    roll_pitch_rad: float = 3e-3
    yaw_rad: float = 6e-4
    scale_prior: float = 0.02
    bias_prior_radps: float = 0.005
    course_prior: float = 0.02
    scale_drift: float = 1e-4
    bias_drift_radps: float = 1e-5
    stretch_m: float = 0.03
    stretch_rad: float = 2e-3
    least_scale: float = 5e-4
    least_bias_radps: float = 7e-5
    teaching_fit: float = 0.75
    excess_gain: float = 0.2

    def __post_init__(self) -> None:
        steps = (self.longitudinal_m, self.lateral_m, self.vertical_m, self.roll_pitch_rad, self.yaw_rad)
        if min(*steps, self.stretch_m, self.stretch_rad) <= 0 or self.distance_share < 0:
            raise ValueError(f"sigmas must be positive and distance_share not negative, got {self}")


@dataclass(frozen=True, slots=True)
class GraphParameters:
    """The fixed-lag pose graph.

    lag_s: a pose is final when it is this old.
    gnss_inflation: GNSS errors last for tens of seconds, so a fix counts for less than its sigma says; gnss_vertical:
        its vertical sigma in horizontal ones.
    robust_k: Cauchy scale of map matches and GNSS, in sigmas.
    """

    lag_s: float = 3.0
    gnss_inflation: float = 5.0
    gnss_vertical: float = 2.0
    robust_k: float = 2.0

    def __post_init__(self) -> None:
        if self.lag_s <= 0 or self.gnss_inflation < 1 or min(self.gnss_vertical, self.robust_k) <= 0:
            raise ValueError(f"positive values and gnss_inflation >= 1 are required, got {self}")


@dataclass(frozen=True, slots=True)
class HealthParameters:
    """When a match is believed, and when the pose is called degraded or lost.

    min_matching_ratio: least share of the points with a Gaussian nearby.
    trusted_fit: a pose is degraded until one match has had this fit: where much has changed, a wrong pose can fit best.
    better_fit, better_count: this many scans in a row that fit better by so much at a pose farther off make the pose
        suspicious.
    gate_m, gate_m_per_s, gate_deg, gate_deg_per_s: how far a match may lie from the prediction, at once and for every
        second without a believed match; three sigmas of the odometry come on top.
    degraded_after_s, lost_after_s: time without a believed match.
    gnss_sigmas, gnss_count: this many fixes in a row farther than this from the pose mean that the pose is wrong,
        however well the scan seems to fit.
    retry_s: pause between two searches for the first pose.
    """

    min_matching_ratio: float = 0.5
    trusted_fit: float = 0.65
    better_fit: float = 0.1
    better_count: int = 5
    gate_m: float = 0.15
    gate_m_per_s: float = 0.15
    gate_deg: float = 0.4
    gate_deg_per_s: float = 0.25
    degraded_after_s: float = 0.6
    lost_after_s: float = 4.0
    gnss_sigmas: float = 5.0
    gnss_count: int = 5
    retry_s: float = 0.8

    def __post_init__(self) -> None:
        if not 0 < self.degraded_after_s <= self.lost_after_s or self.gnss_count < 1:
            raise ValueError(f"0 < degraded_after_s <= lost_after_s and gnss_count >= 1 are required, got {self}")
        if min(self.gate_m, self.gate_deg, self.gnss_sigmas) <= 0 or not 0 <= self.min_matching_ratio <= 1:
            raise ValueError(f"gates must be positive and min_matching_ratio within 0 ... 1, got {self}")


@dataclass(frozen=True, slots=True)
class LocaliserParameters:
    """Everything of the localiser."""

    sampling: SamplingParameters = field(default_factory=SamplingParameters)
    registration: RegistrationParameters = field(default_factory=RegistrationParameters)
    initialise: InitialiseParameters = field(default_factory=InitialiseParameters)
    odometry: OdometryParameters = field(default_factory=OdometryParameters)
    graph: GraphParameters = field(default_factory=GraphParameters)
    health: HealthParameters = field(default_factory=HealthParameters)
    witness: WitnessParameters = field(default_factory=WitnessParameters)
    pool: PoolParameters = field(default_factory=PoolParameters)
    hypotheses: HypothesisParameters = field(default_factory=HypothesisParameters)
    challenge: ChallengeParameters = field(default_factory=ChallengeParameters)
    causes: CauseParameters = field(default_factory=CauseParameters)
    scan_odometry: ScanOdometryParameters = field(default_factory=ScanOdometryParameters)
    refine: RefineParameters = field(default_factory=RefineParameters)
    uniqueness: UniquenessParameters = field(default_factory=UniquenessParameters)
