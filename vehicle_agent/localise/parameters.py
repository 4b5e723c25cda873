"""Settings of localisation: one frozen dataclass a step, with defaults that run; units are in the names.

What nobody turns is a constant beside its use.
"""

from dataclasses import dataclass, replace
from typing import Final

from gnd.gnd_map.settings import check_settings, setting

NOISE_M: Final = 0.04
"""One sigma of range noise, distortion left in the sweep and voxel rounding together: of map matches and of steps."""
MIN_RANGE_M: Final = 2.5
"""Nearer points are the vehicle itself."""


@dataclass(frozen=True, slots=True)
class SamplingParameters:
    """Which points of a scan are matched."""

    n_points: int = setting(2500, "About so many points of a scan are matched.", least=100, most=100_000)
    max_range_m: float = setting(60.0, "Farther points are not matched.", unit="m", above=MIN_RANGE_M)

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, slots=True)
class MatchRules:
    """How points are matched with Gaussians: one set for scans on the map, another for scans with each other.

    Attributes:
        wheel_sigma_m: how well the wheels keep the vehicle on the road; 0: wheels are no witness.
        scales: Geman-McClure scales in sigmas, one a stage, wide to narrow, for a start that is known to some 10 cm:
            where the world has changed, a narrow kernel stays with what has not.
        correlation: so many points share one error (of the map, of the mount); multiplies the covariance.
        floor_m, floor_rad: the least sigma claimed along an axis, whatever the Hessian gives.
        degenerate_m: a direction whose sigma exceeds this (turns taken at 10 m) is reported and not moved along.
        max_iterations: of a stage.
        stop_m, stop_rad: a stage ends with a shorter step.
    """

    wheel_sigma_m: float
    scales: tuple[float, ...]
    correlation: float
    floor_m: float
    floor_rad: float
    degenerate_m: float
    max_iterations: int
    stop_m: float
    stop_rad: float

    def __post_init__(self) -> None:
        if not self.scales or min(*self.scales, self.max_iterations) <= 0:
            raise ValueError(f"at least one scale and one iteration are required, all positive, got {self}")


ON_MAP: Final = MatchRules(
    wheel_sigma_m=0.02, scales=(4.0, 2.0), correlation=10.0, floor_m=0.01, floor_rad=3e-4, degenerate_m=0.2,
    max_iterations=15, stop_m=5e-4, stop_rad=1e-4,
)  # fmt: skip
WITHOUT_WHEELS: Final = replace(ON_MAP, wheel_sigma_m=0.0)
"""On the map where the mount's height may be wrong."""


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
    rules: MatchRules = ON_MAP

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, slots=True)
class GraphParameters:
    """The fixed-lag pose graph."""

    lag_s: float = setting(3.0, "A pose is final when it is this old.", unit="s", above=0)

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, slots=True)
class HealthParameters:
    """When a match is believed, and when the pose is called degraded or lost."""

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


@dataclass(frozen=True, slots=True)
class RefineParameters:
    """Hierarchical GraphSLAM (GND, 3 (ii) and 6.2): the scans of a stretch onto the map, together."""

    enabled: bool = setting(True, "Without, poses are final as they leave the graph of single scans (no submaps).")
    every_m: float = setting(4.0, "The stretch is solved after this much way, or after a second.", unit="m", above=0)
    length_m: float = setting(
        25.0, "Length of the stretch; what is older is remembered as a belief about its first scan.", unit="m", above=0
    )
    lag_m: float = setting(10.0, "A scan is final when one this much further on takes part ...", unit="m", least=0)
    longest_s: float = setting(
        4.0, "... or when it is this old (8 s until the gyro's bias is known).", unit="s", above=0
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
    graph: GraphParameters = setting(GraphParameters, "The fixed-lag pose graph.")
    health: HealthParameters = setting(HealthParameters, "When a match is believed.")
    scan_odometry: ScanOdometryParameters = setting(ScanOdometryParameters, "Scan-to-scan odometry.")
    refine: RefineParameters = setting(RefineParameters, "Submaps.")
    uniqueness: UniquenessParameters = setting(UniquenessParameters, "Whether a pose must be the only one.")
