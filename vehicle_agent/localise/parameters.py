"""Settings of localisation: one frozen dataclass a step, with defaults that run; units are in the names.

What nobody turns is a constant beside its use.
"""

from dataclasses import dataclass, field
from typing import Final

from gnd.gnd_map.settings import check_settings, setting

NOISE_M: Final = 0.04
"""One sigma of range noise, distortion left in the sweep and voxel rounding together: of map matches and of steps."""


@dataclass(frozen=True, slots=True)
class SamplingParameters:
    """Which points of a scan are matched."""

    n_points: int = setting(2500, "About so many points of a scan are matched.", least=100, most=100_000)
    leaf_m: float = setting(0.3, "At most one of them lies in a cube of this side.", unit="m", above=0, most=10)
    min_range_m: float = setting(2.5, "Nearer points are the vehicle itself.", unit="m", least=0)
    max_range_m: float = setting(60.0, "Farther points are not matched; more than `min_range_m`.", unit="m", above=0)

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.min_range_m < self.max_range_m:
            raise ValueError(f"min_range_m = {self.min_range_m} must be less than max_range_m = {self.max_range_m}")


@dataclass(frozen=True, slots=True)
class RegistrationParameters:
    """Scan-to-map matching."""

    noise_m: float = setting(
        NOISE_M,
        "One sigma of range noise, distortion left in the sweep and voxel rounding together.",
        unit="m",
        above=0,
        most=1,
    )
    wheel_sigma_m: float = setting(
        0.02, "How well the wheels keep the vehicle on the road; 0: wheels are no witness.", unit="m", least=0
    )
    scales: tuple[float, ...] = (4.0, 2.0)
    """Geman-McClure scales in sigmas, one a stage, wide to narrow, when the start is known to some 10 cm: where the
    world has changed, a narrow kernel stays with what has not. This and what follows is what matches of scans with each
    other, and of codecs with the exact map, do otherwise; no setting."""
    correlation: float = 10.0
    """So many points share one error (of the map, of the mount); multiplies the covariance."""
    floor_m: float = 0.01
    floor_rad: float = 3e-4
    """The least sigma claimed along an axis, whatever the Hessian says."""
    degenerate_m: float = 0.2
    """A direction whose sigma exceeds this (turns taken at 10 m) is reported and not moved along."""
    max_iterations: int = 15
    stop_m: float = 5e-4
    stop_rad: float = 1e-4
    """A match ends with a shorter step."""

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.scales or min(*self.scales, self.max_iterations) <= 0:
            raise ValueError(f"at least one scale and one iteration are required, all positive, got {self}")


@dataclass(frozen=True, slots=True)
class InitialiseParameters:
    """How a search for poses goes about it: around a GNSS position, around a tracked pose, along a loop. No settings.

    step_m, step_deg: spacing of the coarse hypotheses; n_refined: how many of the best are refined by registration;
    n_kept: how many of these are refined to the end; same_m, same_deg: refined poses nearer than this are one.
    """

    step_m: float = 1.0
    step_deg: float = 5.0
    n_refined: int = 24
    n_kept: int = 8
    same_m: float = 0.2
    same_deg: float = 1.0

    def __post_init__(self) -> None:
        if min(self.step_m, self.step_deg, self.n_refined) <= 0:
            raise ValueError(f"steps and counts must be positive, got {self}")


@dataclass(frozen=True, slots=True)
class OdometryParameters:
    """What is known of wheels and gyro before anything is learnt, one sigma each."""

    scale_prior: float = setting(0.02, "Of the wheel scale, as a share.", above=0, most=1)
    bias_prior_radps: float = setting(0.005, "Of the gyro's bias.", unit="rad/s", above=0)
    course_prior: float = setting(
        0.02,
        "Of the motion sideways and upwards per metre forward: the LiDAR's mount is not aligned with the wheels.",
        above=0,
        most=1,
    )

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, slots=True)
class GraphParameters:
    """The fixed-lag pose graph."""

    lag_s: float = setting(3.0, "A pose is final when it is this old.", unit="s", above=0)
    gnss_inflation: float = setting(
        5.0, "GNSS errors last for tens of seconds, so a fix's sigma is taken this many times.", least=1
    )

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, slots=True)
class HealthParameters:
    """When a match is believed, and when the pose is called degraded or lost."""

    min_matching_ratio: float = setting(0.5, "Least share of the points with a Gaussian nearby.", least=0, most=1)
    degraded_after_s: float = setting(
        0.6, "Without a believed match for so long the pose is degraded.", unit="s", above=0
    )
    lost_after_s: float = setting(
        4.0, "Without one for so long it is lost; at least `degraded_after_s`.", unit="s", above=0
    )

    def __post_init__(self) -> None:
        check_settings(self)
        if self.degraded_after_s > self.lost_after_s:
            raise ValueError(
                f"degraded_after_s = {self.degraded_after_s} must not exceed lost_after_s = {self.lost_after_s}"
            )


@dataclass(frozen=True, slots=True)
class ScanOdometryParameters:
    """Scan-to-scan odometry."""

    enabled: bool = setting(True, "Without, the step between two scans is left to wheel speed and yaw rate alone.")
    min_standing_share: float = setting(
        0.25,
        "So many of a scan's points must stand above the ground. Rings on open ground keep their place relative to the"
        " vehicle: they fit best where it stood before, and it seems to be slower than it is.",
        least=0,
        below=1,
    )

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, slots=True)
class RefineParameters:
    """Hierarchical GraphSLAM (GND, 3 (ii) and 6.2): the scans of a stretch onto the map, together."""

    enabled: bool = setting(True, "Without, poses are final as they leave the graph of single scans (no submaps).")
    every_m: float = setting(4.0, "The stretch is solved after this much way ...", unit="m", above=0)
    every_s: float = setting(1.0, "... or time.", unit="s", above=0)
    length_m: float = setting(
        25.0, "Length of the stretch; what is older is remembered as a belief about its first scan.", unit="m", above=0
    )
    lag_m: float = setting(10.0, "A scan is final when one this much further on takes part ...", unit="m", least=0)
    longest_s: float = setting(4.0, "... or when it is this old.", unit="s", above=0)
    unlearnt_s: float = setting(
        8.0, "Until the gyro's bias is known scans may wait so long instead.", unit="s", above=0
    )

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, slots=True)
class UniquenessParameters:
    """Is there another place that looks the same?"""

    enabled: bool = setting(True, "Without, no pose has to be the only one.")


@dataclass(frozen=True, slots=True)
class LocaliserParameters:
    """Everything of the localiser."""

    sampling: SamplingParameters = setting(SamplingParameters, "Which points of a scan are matched.")
    registration: RegistrationParameters = setting(RegistrationParameters, "Scan-to-map matching.")
    initialise: InitialiseParameters = field(default_factory=InitialiseParameters)
    odometry: OdometryParameters = setting(OdometryParameters, "Wheels and gyro.")
    graph: GraphParameters = setting(GraphParameters, "The fixed-lag pose graph.")
    health: HealthParameters = setting(HealthParameters, "When a match is believed.")
    scan_odometry: ScanOdometryParameters = setting(ScanOdometryParameters, "Scan-to-scan odometry.")
    refine: RefineParameters = setting(RefineParameters, "Submaps.")
    uniqueness: UniquenessParameters = setting(UniquenessParameters, "Whether a pose must be the only one.")
