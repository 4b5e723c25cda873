"""Moving cars and people of one drive: they cross the view, hide the street, and are no part of its truth.

Cars keep to the right in both lanes, at speeds of their own, at a distance from each other and from the vehicle that
measures, which takes no notice of anybody: cars before it make way by going on. Some stop for a while and go on. People
walk up and down free stretches of the pavements, stand now and then, and some cross the road when there is room.
"""

from dataclasses import dataclass
from math import isfinite, pi, tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim import parts
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.movers import Mover, Movers
from gnd.fleet_sim.people import pedestrians
from gnd.fleet_sim.stage import STEP_S, Stage
from gnd.fleet_sim.trajectory import Direction
from gnd.fleet_sim.world import World

FloatArray = NDArray[np.float64]

MAX_PER_100_M: Final = 10.0
_NO_WALKING_MPS: Final = 13.0
"""Nobody walks along a road on which vehicles are as fast as this."""
_BEYOND_M: Final = 55.0
"""Cars come and go so far beyond the ends of the stretch that is driven; the ground reaches 5 m farther."""
_BEHIND_M: Final = 150.0
_CAR_M: Final = 5.0
_HEADWAY_S: Final = 1.6
"""Time in which a car closes the difference between its distance and the one that it wants."""
_FREE_M: Final = 5.0
_YIELD_M: Final = 12.0
_BRAKE_MPS2: Final = 6.0
_SPEED_UP_MPS2: Final = 3.0
_REACTION_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class Traffic:
    """How much moves on the street of a drive, on the average at any time.

    Attributes:
        cars_per_100m: moving cars on 100 m of street, both lanes together.
        pedestrians_per_100m: people on 100 m of street, both pavements together.
        stopping_share: share of the cars that stop once for some seconds.
        crossing_share: share of the people that cross the road.
    """

    cars_per_100m: float = 0.0
    pedestrians_per_100m: float = 0.0
    stopping_share: float = 0.35
    crossing_share: float = 0.35

    def __post_init__(self) -> None:
        for name in ("cars_per_100m", "pedestrians_per_100m"):
            value = getattr(self, name)
            if not isfinite(value) or not 0.0 <= value <= MAX_PER_100_M:
                raise DriveSimError(f"{name} must be in 0 … {MAX_PER_100_M:.0f}, got {value}")
        for name in ("stopping_share", "crossing_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise DriveSimError(f"{name} must be in 0 … 1, got {getattr(self, name)}")

    @staticmethod
    def urban() -> "Traffic":
        """Return the traffic of a lively city street: about 10 cars and 10 people on 400 m."""
        return Traffic(3.0, 2.5)


def movers_of(traffic: Traffic, stage: Stage) -> Movers | None:
    """Return everything that moves on a drive, None if nothing does; the same drive gives the same to the bit."""
    rng = np.random.default_rng([stage.seed, stage.world.seed, 0x7A41C])
    cars: list[Mover] = []
    if traffic.cars_per_100m > 0.0:
        for direction in (stage.motion.direction, -stage.motion.direction):
            cars += _lane(traffic, stage, 1 if direction > 0 else -1, rng)
    busy = [*((car.track[:, 0], car.track[:, 1]) for car in cars), stage.ego_m()]
    walking = _count(traffic.pedestrians_per_100m, stage) if stage.world.cruise_mps < _NO_WALKING_MPS else 0
    people = pedestrians(walking, traffic.crossing_share, stage, busy, rng)
    if not cars and not people:
        return None
    reach_m = stage.world.half_length_m + _BEYOND_M
    return Movers([*cars, *people], float(stage.times_s()[0]), STEP_S, reach_m)


def _count(per_100_m: float, stage: Stage) -> int:
    return round(per_100_m * 2 * stage.world.half_length_m / 100.0)


def _lane(traffic: Traffic, stage: Stage, direction: Direction, rng: np.random.Generator) -> list[Mover]:
    """Return the cars of one lane, from the foremost back."""
    times = stage.times_s()
    ego = stage.ego_m()[0] * direction if direction == stage.motion.direction else None
    cruise = stage.motion.style.cruise_mps
    start, index = _line_up(200.0 / traffic.cars_per_100m, stage, cruise, ego, rng)
    wanted = _wanted_mps(len(start), traffic.stopping_share, cruise, times, rng)
    way = drive_lane(start, wanted, None if ego is None else (index, ego))
    styles, phases = rng.integers(2**31, size=len(start)), rng.uniform(0.0, tau, len(start))
    return [
        _car(stage.world, direction, way[:, k], int(styles[k]), float(phases[k]))
        for k in range(len(start))
        if ego is None or k != index
    ]


def _line_up(
    spacing_m: float, stage: Stage, cruise_mps: float, ego: FloatArray | None, rng: np.random.Generator
) -> tuple[FloatArray, int]:
    """Return where the cars of a lane start, falling, and the index of the vehicle that measures among them (or 0)."""
    half = stage.world.half_length_m + _BEYOND_M

    def gaps(length_m: float) -> FloatArray:
        steps = spacing_m * rng.uniform(0.5, 1.5, 2 + int(2 * length_m / spacing_m))
        way = np.cumsum(np.maximum(steps, _CAR_M + _FREE_M + cruise_mps))
        return np.asarray(way[way < length_m])

    if ego is None:
        return half - gaps(2 * half + 1.2 * cruise_mps * stage.duration_s), 0
    ahead, behind = ego[0] + gaps(half - ego[0]), ego[0] - gaps(_BEHIND_M)
    return np.concatenate([ahead[::-1], ego[:1], behind]), len(ahead)


def _wanted_mps(
    count: int, stopping_share: float, cruise_mps: float, times: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return the speed that each car would like, float64 (S, count)."""
    speed = cruise_mps * rng.uniform(0.7, 1.15, count)
    stops = rng.random(count) < stopping_share
    begin = rng.uniform(times[0], times[-1], count)
    end = begin + rng.uniform(3.0, 8.0, count)
    standing = stops & (times[:, None] >= begin) & (times[:, None] < end)
    return np.where(standing, 0.0, speed)


def drive_lane(start: FloatArray, wanted: FloatArray, ego: tuple[int, FloatArray] | None) -> FloatArray:
    """Let the cars of a lane drive, each minding its neighbour: cars behind follow, cars before the ego vehicle yield.

    Args:
        start: float64 (N,), where they start along the lane, falling [m].
        wanted: float64 (S, N), the speeds they would like, every STEP_S [m/s].
        ego: index of the vehicle that minds nobody and its way, float64 (S,); None when all are free.

    Returns:
        Where they are along the lane, float64 (S, N) [m].
    """
    index, path = (-1, np.zeros(len(wanted))) if ego is None else ego
    before = np.arange(len(start)) < index
    way, speed = start.copy(), wanted[0].copy()
    found = np.empty_like(wanted)
    for k in range(len(wanted)):
        if index >= 0:
            way[index], speed[index] = path[k], (path[min(k + 1, len(path) - 1)] - path[max(k - 1, 0)]) / (2 * STEP_S)
        found[k] = way
        gap = way[:-1] - way[1:] - _CAR_M
        follow = np.append(np.inf, speed[:-1] + (gap - _FREE_M - 0.4 * speed[1:]) / _HEADWAY_S)
        make_way = np.append(speed[1:] + (_YIELD_M - gap) / _HEADWAY_S, -np.inf)
        target = np.where(before, np.maximum(wanted[k], make_way), np.minimum(wanted[k], follow))
        change = np.clip((target - speed) / _REACTION_S, -_BRAKE_MPS2, _SPEED_UP_MPS2)
        speed = np.maximum(speed + change * STEP_S, 0.0)
        way = way + speed * STEP_S
    return found


def _car(world: World, direction: Direction, way_m: FloatArray, style: int, phase_rad: float) -> Mover:
    """Return a car that has gone `way_m` (S,) along its lane, swaying a little in it."""
    wave, length_m = 0.12, 60.0
    x = direction * way_m
    turn = tau * x / length_m + phase_rad
    offset, widening = world.lane_m(x)
    y = -direction * offset + wave * np.sin(turn)
    yaw = (0.0 if direction > 0 else pi) + np.arctan(wave * tau / length_m * np.cos(turn) - direction * widening)
    track = np.stack([x, y, world.road_height_m(y, x), yaw, np.zeros_like(x)], axis=1)
    shapes = parts.car(0.0, 0.0, 0.0, 0.0, style)
    return Mover(shapes, (0.0,) * len(shapes), track)
