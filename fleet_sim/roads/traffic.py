"""Other vehicles on the road as boxes: trucks on the right lane, which the drive overtakes, and cars on the left.

They matter for what they hide. Trucks keep a constant speed; the measuring vehicle drives on the right lane and on the
next one while it passes; faster cars and coaches pass it on the leftmost lane.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.fleet_sim.errors import RoadError
from gnd.fleet_sim.roads.curve import FloatArray
from gnd.fleet_sim.roads.motion import RoadMotion
from gnd.fleet_sim.roads.route import IntArray, Route

NEAR_M: Final = 110.0
"""Nothing farther away hides anything within 80 m, whatever its length."""
_OUT_M: Final = 55.0
_BACK_M: Final = 25.0
_MARGIN_S: Final = 2.5


@dataclass(frozen=True, slots=True)
class RoadTraffic:
    """How much traffic there is.

    Attributes:
        truck_spacing_m: mean distance of trucks on the right lane; inf for none. By default so that about one sign of
            a hundred is hidden all the time, as one of 103 was in Jo et al. 2018, section 6.3.
        car_spacing_m: mean distance of cars on the left lane; inf for none.
        coach_share: so many of the "cars" of the left lane are coaches or vans that are as high as trucks.
        truck_speed: slowest and fastest truck, as shares of the route's slowest cruising speed.
        car_speed: slowest and fastest car of the left lane, as shares of the route's fastest cruising speed.
    """

    truck_spacing_m: float = 1500.0
    car_spacing_m: float = 250.0
    coach_share: float = 0.05
    truck_speed: tuple[float, float] = (0.88, 0.98)
    car_speed: tuple[float, float] = (1.02, 1.12)

    def __post_init__(self) -> None:
        if not min(self.truck_spacing_m, self.car_spacing_m) >= 50.0 or not 0.0 <= self.coach_share <= 1.0:
            raise RoadError(
                f"vehicles need 50 m of lane each and a share in 0 … 1, got {self.truck_spacing_m} m,"
                f" {self.car_spacing_m} m, {self.coach_share}"
            )


EMPTY: Final = RoadTraffic(np.inf, np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """B vehicles as upright boxes that keep their speed along a lane.

    Attributes:
        way_m: float64 (B,), way of the middle at time 0.
        speed_mps: float64 (B,).
        lane: int64 (B,), lane of the route.
        size_m: float64 (B, 3), length, width, height.
    """

    way_m: FloatArray
    speed_mps: FloatArray
    lane: IntArray
    size_m: FloatArray

    def __len__(self) -> int:
        return len(self.way_m)


def drawn_boxes(route: Route, traffic: RoadTraffic, motion: RoadMotion, rng: np.random.Generator) -> Boxes:
    """Draw the vehicles that the drive meets: trucks that it catches up with, cars that catch up with it."""
    ego = motion.way_m(np.array([0.0, motion.duration_s]))
    (slow, fast), last = route.cruise_mps, len(route.lane_left_m) - 1
    trucks_mps, cars_mps = slow * np.array(traffic.truck_speed), fast * np.array(traffic.car_speed)
    parts = [
        _lane(rng, traffic.truck_spacing_m, trucks_mps, 0, ego, motion.duration_s, tall=True),
        _lane(rng, traffic.car_spacing_m, cars_mps, last, ego, motion.duration_s),
    ]
    coach = rng.random(len(parts[1])) < traffic.coach_share
    parts[1].size_m[coach] = (12.0, 2.5, 3.4)
    way, speed, lane, size = (np.concatenate([getattr(p, name) for p in parts]) for name in Boxes.__slots__)
    return Boxes(way, speed, lane, size)


def _lane(
    rng: np.random.Generator,
    spacing_m: float,
    speeds_mps: FloatArray,
    lane: int,
    ego_m: FloatArray,
    duration_s: float,
    *,
    tall: bool = False,
) -> Boxes:
    """Vehicles of a lane whose places at half the time are spread over all that the drive can meet."""
    # All keep one speed of the lane, so that none runs into another.
    speed = float(rng.uniform(*speeds_mps))
    low = ego_m[0] - max(0.0, speed * duration_s - (ego_m[1] - ego_m[0])) - NEAR_M
    high = ego_m[0] + max(0.0, ego_m[1] - ego_m[0] - speed * duration_s) + NEAR_M
    count = 0 if np.isinf(spacing_m) else 2 + int(2 * (high - low) / spacing_m)
    gaps = np.maximum(rng.exponential(1.0, count) * (0.0 if np.isinf(spacing_m) else spacing_m), 50.0)
    way = low + np.cumsum(gaps)
    way = way[way < high]
    size = (16.5, 2.55, 4.0) if tall else (4.5, 1.8, 1.5)
    n = len(way)
    return Boxes(way, np.full(n, speed), np.full(n, lane, dtype=np.int64), np.tile(np.array(size), (n, 1)))


def lanes_taken(motion: RoadMotion, boxes: Boxes) -> IntArray:
    """Return the lane that the measuring vehicle wants at `motion.lane_times_s`: 1 while it passes a truck, else 0."""
    t_s = motion.lane_times_s
    ego = motion.way_m(t_s)
    passing = np.zeros(len(t_s), dtype=np.bool_)
    for index in np.flatnonzero(boxes.lane == 0):
        ahead = boxes.way_m[index] + boxes.speed_mps[index] * t_s - ego
        near = np.flatnonzero((ahead < _OUT_M) & (ahead > -_BACK_M))
        if near.size:
            passing |= (t_s > t_s[near[0]] - _MARGIN_S) & (t_s < t_s[near[-1]] + _MARGIN_S)
    return passing.astype(np.int64)
