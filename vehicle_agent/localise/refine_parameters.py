"""Settings of the refined poses: submaps, their matches, and the graph that ties them."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RefineParameters:
    """Hierarchical GraphSLAM (GND, 3 (ii) and 6.2): the scans of a stretch onto the map, together.

    enabled: without, poses are final as they leave the fixed-lag graph of single scans ("without submap").
    every_m, every_s: the stretch is solved after this much way or time.
    knot_m, knot_s: a scan takes part when the vehicle has moved so far, or so much time has passed, since the last.
    n_points: of a scan.
    correlated_m: scans nearer to each other see the same surfaces of the map, wrong by the same: they share one say.
    length_m, length_s: of the stretch; what is older is remembered as a belief about its first scan.
    lag_m: a scan is final when one this much further on takes part; longest_s: or when it is this old.
    yaw_deg, longitudinal_m, lateral_m: one sigma of the odometry over 5 m beside what all steps share, growing with the
        root of the way; roll_pitch_deg, vertical_m: of attitude and height from scan to scan, which no wheel tells.
    scales: Geman-McClure scales of the match; first_scales: when the prediction is off by more than `near_m`.
    learnt_degps, unlearnt_s: sigma of the gyro's bias below which it is known; until then scans may wait so long.
    fit_m: the newest part of the stretch that says how well all fits. firm_fit: fit of a stretch that is beyond doubt;
        least_fit: below, it tells nothing; most_misfit: of a firm one; certain_m: one sigma of a pose that no rival can
        question.
    floor_m, floor_deg: the least sigma of a final pose: what map and mount are wrong by, no match can tell.
    correct_m, correct_deg: an online pose farther off than this from what the stretch says begins anew from there.
    """

    enabled: bool = True
    every_m: float = 4.0
    every_s: float = 1.0
    knot_m: float = 0.7
    knot_s: float = 0.5
    n_points: int = 2500
    correlated_m: float = 2.0
    length_m: float = 25.0
    length_s: float = 15.0
    lag_m: float = 10.0
    longest_s: float = 4.0
    yaw_deg: float = 0.02
    longitudinal_m: float = 0.01
    lateral_m: float = 0.003
    roll_pitch_deg: float = 0.2
    vertical_m: float = 0.01
    scales: tuple[float, ...] = (2.0, 1.5)
    first_scales: tuple[float, ...] = (4.0, 2.0, 1.5)
    near_m: float = 0.04
    learnt_degps: float = 0.06
    unlearnt_s: float = 8.0
    fit_m: float = 20.0
    firm_fit: float = 0.35
    least_fit: float = 0.15
    most_misfit: float = 4.0
    certain_m: float = 0.1
    floor_m: float = 0.002
    floor_deg: float = 0.004
    correct_m: float = 0.06
    correct_deg: float = 0.12

    def __post_init__(self) -> None:
        numbers = [value for name in self.__slots__ if isinstance(value := getattr(self, name), int | float)]
        if not all(math.isfinite(value) for value in (*numbers, *self.scales, *self.first_scales)):
            raise ValueError(f"finite values are required, got {self}")
        may_be_zero = {"enabled", "lag_m", "floor_m", "floor_deg", "firm_fit", "least_fit"}
        bad = [name for name in self.__slots__ if name not in may_be_zero and _least(getattr(self, name)) <= 0]
        bad += [name for name in may_be_zero if getattr(self, name) < 0]
        if bad:
            raise ValueError(f"{', '.join(sorted(bad))} must be positive, got {self}")
        if self.n_points < 100:
            raise ValueError(f"n_points >= 100 is required, got {self}")


def _least(value: float | tuple[float, ...]) -> float:
    return min(value) if isinstance(value, tuple) else value
