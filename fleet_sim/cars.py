"""Cars parked along the kerbs: they hide the street, and are no part of its truth."""

from collections.abc import Iterable
from math import tau
from typing import Final, Literal

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.shapes import Block, Post, Shape
from gnd.fleet_sim.world import State, World

SLOT_M: Final = 6.2
LANE_M: Final = 1.05
"""Distance of a parked car's middle from the kerb."""
_CLEARANCE_M: Final = 0.3
STAY_H: Final = 4.0
"""Mean time for which a car stays: between errands and residents."""
Side = Literal[1, -1]
SIDES: Final[tuple[Side, Side]] = (1, -1)


def parked_cars(world: World, state: State, occupancy: float, seed: int) -> tuple[Shape, ...]:
    """Return the primitives of the cars that stand there during one drive, which no other drive meets.

    Args:
        world: the street.
        state: what else stands there; no car parks where an object of this state does.
        occupancy: probability that a slot is taken, 0 … 1.
        seed: seed of the drive.

    Raises:
        DriveSimError: the occupancy is no probability.
    """
    _check(occupancy)
    rng = np.random.default_rng([seed, 0xCA12])
    return _standing(world, state, ((x, side, rng.random() < occupancy, rng) for side, x in _slots(world)))


def cars_of_hour(world: World, state: State, occupancy: float, hours: float) -> tuple[Shape, ...]:
    """Return the primitives of the cars that stand there at a time: drives of one hour meet mostly the same.

    A slot is taken and free in turn, for times that are exponentially distributed: a car stays `STAY_H` on the average.

    Args:
        world: the street; its seed decides who parks where and when.
        state: what else stands there.
        occupancy: share of the time that a slot is taken, 0 … 1.
        hours: since the first drive of all, ≥ 0.

    Raises:
        DriveSimError: the occupancy is no probability, or the time is negative.
    """
    _check(occupancy)
    if hours < 0.0:
        raise DriveSimError(f"nobody knows who parked {-hours:g} h before the first drive")
    slots = []
    for number, (side, x) in enumerate(_slots(world)):
        rng = np.random.default_rng([world.seed, number, 0xCA13])
        taken, turn = _turn_at(rng, occupancy, hours)
        slots.append((x, side, taken, np.random.default_rng([world.seed, number, turn, 0xCA14])))
    return _standing(world, state, slots)


def _turn_at(rng: np.random.Generator, occupancy: float, hours: float) -> tuple[bool, int]:
    """Whether a slot is taken at a time, and the number of its turn there."""
    taken, turn = rng.random() < occupancy, 0
    if occupancy in (0.0, 1.0):
        return taken, turn
    mean_h = {True: STAY_H, False: STAY_H * (1.0 - occupancy) / occupancy}
    left_h = hours - rng.exponential(mean_h[taken])
    while left_h > 0.0:
        taken, turn = not taken, turn + 1
        left_h -= rng.exponential(mean_h[taken])
    return taken, turn


def _check(occupancy: float) -> None:
    if not 0.0 <= occupancy <= 1.0:
        raise DriveSimError(f"the occupancy of parking slots must be in 0 … 1, got {occupancy}")


def _slots(world: World) -> list[tuple[Side, float]]:
    along = np.arange(-world.half_length_m - 20.0, world.half_length_m + 20.0, SLOT_M).tolist()
    return [(side, x) for side in SIDES for x in along]


def _standing(
    world: World, state: State, slots: Iterable[tuple[float, Side, bool, np.random.Generator]]
) -> tuple[Shape, ...]:
    """The cars of slots: where, on which side, whether it is taken, and what draws the car."""
    taken = [shape.bounds() for shape in world.shapes(state) if _is_obstacle(shape, world)]
    cars: list[Shape] = []
    for x, side, occupied, rng in slots:
        dx, dy = float(rng.normal(0.0, 0.25)), float(rng.normal(0.0, 0.12))
        turned, style = float(rng.normal(0.0, 0.02)), int(rng.integers(2**31))
        y = side * (world.kerb_m - LANE_M + dy)
        if occupied and not _hits(taken, x + dx, y):
            yaw = turned + (0.0 if side < 0 else tau / 2)
            cars += parts.car(x + dx, y, float(world.road_height_m(np.array([y]))[0]), yaw, style)
    return tuple(cars)


def _is_obstacle(shape: Shape, world: World) -> bool:
    """Whether a primitive stands in a parking lane (the road itself does not)."""
    _, y0, _, y1, top = shape.bounds()
    near = min(abs(y0), abs(y1)) < world.kerb_m - _CLEARANCE_M / 2 and y0 * y1 > 0
    return near and top > 0.0 and (not isinstance(shape, Post) or shape.bottom_m < 2.0) and not _is_arm(shape)


def _is_arm(shape: Shape) -> bool:
    return isinstance(shape, Block) and shape.bottom_m > 2.0


def _hits(taken: list[tuple[float, float, float, float, float]], x: float, y: float) -> bool:
    half_x, half_y = 2.5 + _CLEARANCE_M, 1.0 + _CLEARANCE_M / 2
    return any(
        x0 < x + half_x and x1 > x - half_x and y0 < y + half_y and y1 > y - half_y for x0, y0, x1, y1, _ in taken
    )
