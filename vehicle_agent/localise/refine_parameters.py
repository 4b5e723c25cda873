"""Settings of the refined poses: submaps, their matches, and the graph that ties them."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RefineParameters:
    """Hierarchical GraphSLAM (GND, 3 (ii) and 6.2): scans into submaps, submaps onto the map, a graph over all.

    enabled: without, poses are final as they leave the fixed-lag graph of single scans ("without submap").
    every_m, every_s: an anchor (a scan around which a submap is made) after this much way or time.
    half_m, half_s: a submap holds the scans this far before and after its anchor, but none further off in time.
    max_scans: of a submap, evenly thinned (a vehicle that stands makes many alike).
    n_points, leaf_m: points of a submap, at most one in a cube of `leaf_m`.
    lag_m: a scan is final when an anchor this much further on has been matched; longest_s: or when it is this old.
    window, window_s: anchors in the graph, and how old they may be; what leaves it is remembered as one prior.
    scales: Geman-McClure scales of the submap's match; first_scales: when the prediction is off by more than `near_m`.
    min_matching_ratio: least share of the submap's points with a Gaussian nearby.
    wheel_sigma_m, wheel_every_m: of the wheels on the road, which are put down once in so much way.
    yaw_deg, longitudinal_m, lateral_m: one sigma of the odometry over `every_m`, growing with the root of the way;
        roll_pitch_deg, vertical_m: of attitude and height, which come from the single scans.
    inlier_chi2: matches farther off than this (half of chi-square, 6 degrees of freedom) are left out (graduated
        non-convexity with truncated least squares; Yang et al. 2020).
    learnt_degps, unlearnt_s: sigma of the gyro's bias below which it is known; until then scans may wait so long.
    bent_degps: change of the bias from which on submaps are made again.
    firm_fit: fit of a submap that is beyond doubt; certain_m: one sigma of a pose that no rival can question.
    floor_m, floor_deg: the least sigma of a final pose: what map and mount are wrong by, no match can tell.
    correct_m, correct_deg: an online pose farther off than this from what the submaps say begins anew from there.
    """

    enabled: bool = True
    every_m: float = 5.0
    every_s: float = 2.0
    half_m: float = 10.0
    half_s: float = 3.0
    max_scans: int = 60
    n_points: int = 6000
    leaf_m: float = 0.25
    lag_m: float = 10.0
    longest_s: float = 4.0
    window: int = 24
    window_s: float = 15.0
    scales: tuple[float, ...] = (2.0, 1.0)
    first_scales: tuple[float, ...] = (4.0, 2.0, 1.0)
    near_m: float = 0.04
    min_matching_ratio: float = 0.3
    wheel_sigma_m: float = 0.01
    wheel_every_m: float = 1.0
    yaw_deg: float = 0.02
    longitudinal_m: float = 0.004
    lateral_m: float = 0.003
    roll_pitch_deg: float = 1.0
    vertical_m: float = 0.03
    inlier_chi2: float = 8.4
    learnt_degps: float = 0.03
    unlearnt_s: float = 8.0
    bent_degps: float = 0.02
    firm_fit: float = 0.35
    certain_m: float = 0.1
    floor_m: float = 0.005
    floor_deg: float = 0.01
    correct_m: float = 0.06
    correct_deg: float = 0.12

    @property
    def overlap(self) -> float:
        """In how many submaps each scan takes part: matches of neighbours are not independent."""
        return max(1.0, 2.0 * self.half_m / self.every_m)

    def __post_init__(self) -> None:
        numbers = [value for name in self.__slots__ if isinstance(value := getattr(self, name), int | float)]
        if not all(math.isfinite(value) for value in (*numbers, *self.scales, *self.first_scales)):
            raise ValueError(f"finite values are required, got {self}")
        may_be_zero = {"enabled", "lag_m", "min_matching_ratio", "wheel_sigma_m", "floor_m", "floor_deg", "firm_fit"}
        bad = [name for name in self.__slots__ if name not in may_be_zero and _least(getattr(self, name)) <= 0]
        bad += [name for name in may_be_zero if getattr(self, name) < 0]
        if bad:
            raise ValueError(f"{', '.join(sorted(bad))} must be positive, got {self}")
        if self.window < 4 or self.max_scans < 2 or self.n_points < 100:
            raise ValueError(f"window >= 4, max_scans >= 2 and n_points >= 100 are required, got {self}")


def _least(value: float | tuple[float, ...]) -> float:
    return min(value) if isinstance(value, tuple) else value
