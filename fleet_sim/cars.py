"""Cars parked along the kerbs of one drive: they hide the street, and are no part of its truth."""

from math import sin, tau
from typing import Final

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.shapes import Ball, Block, Post, Shape
from gnd.fleet_sim.world import State, World

SLOT_M: Final = 6.2
LANE_M: Final = 1.05
"""Distance of a parked car's middle from the kerb."""
_CLEARANCE_M: Final = 0.3
_GROUND_M2: Final = 200.0
"""What is larger is ground."""


def parked_cars(world: World, state: State, occupancy: float, seed: int) -> tuple[Shape, ...]:
    """Return the primitives of the cars that stand there during one drive.

    Args:
        world: the street.
        state: what else stands there; no car parks where an object of this state does.
        occupancy: probability that a slot is taken, 0 … 1.
        seed: seed of the drive.

    Raises:
        DriveSimError: the occupancy is no probability.
    """
    if not 0.0 <= occupancy <= 1.0:
        raise DriveSimError(f"the occupancy of parking slots must be in 0 … 1, got {occupancy}")
    rng = np.random.default_rng([seed, 0xCA12])
    taken = [shape.bounds() for shape in world.shapes(state) if _is_obstacle(shape, world)]
    if world.bays:
        taken += [shape.bounds() for shape in world.shapes(state) if _stands_up(shape)]
    cars: list[Shape] = []
    for side in (1, -1) if world.kerb_parking else ():
        for x in np.arange(-world.half_length_m - 20.0, world.half_length_m + 20.0, SLOT_M).tolist():
            occupied, dx, dy = rng.random() < occupancy, float(rng.normal(0.0, 0.25)), float(rng.normal(0.0, 0.12))
            turned, style = float(rng.normal(0.0, 0.02)), int(rng.integers(2**31))
            y = side * (world.kerb_m - LANE_M + dy)
            if occupied and not _hits(taken, x + dx, y):
                yaw = turned + (0.0 if side < 0 else tau / 2)
                cars += parts.car(x + dx, y, _ground_m(world, x + dx, y), yaw, style)
    for bay in world.bays:
        occupied, dx, dy = rng.random() < occupancy, float(rng.normal(0.0, 0.15)), float(rng.normal(0.0, 0.12))
        turned, style = float(rng.normal(0.0, 0.02)), int(rng.integers(2**31))
        if occupied and not _hits(taken, bay.x_m + dx, bay.y_m + dy, abs(sin(bay.yaw_rad)) > 0.5):
            make = parts.delivery_van if bay.van else parts.car
            x, y = bay.x_m + dx, bay.y_m + dy
            cars += make(x, y, _ground_m(world, x, y), bay.yaw_rad + turned, style)
    return tuple(cars)


def _ground_m(world: World, x_m: float, y_m: float) -> float:
    """Height of the road, or of what lies level beside it, at a place."""
    across = np.array([y_m if abs(y_m) <= world.kerb_m else 0.0])
    return float(world.road_height_m(across, np.array([x_m]))[0])


def _is_obstacle(shape: Shape, world: World) -> bool:
    """Whether a primitive stands in a parking lane (the road itself does not)."""
    _, y0, _, y1, top = shape.bounds()
    near = min(abs(y0), abs(y1)) < world.kerb_m - _CLEARANCE_M / 2 and y0 * y1 > 0
    return near and top > 0.0 and (not isinstance(shape, Post) or shape.bottom_m < 2.0) and not _is_arm(shape)


def _stands_up(shape: Shape) -> bool:
    """Whether a primitive stands in a bay: no ground, nothing overhead."""
    x0, y0, x1, y1, top = shape.bounds()
    low = shape.z_m - shape.radius_m if isinstance(shape, Ball) else shape.bottom_m
    return top > 0.1 and low < 1.5 and (x1 - x0) * (y1 - y0) < _GROUND_M2


def _is_arm(shape: Shape) -> bool:
    return isinstance(shape, Block) and shape.bottom_m > 2.0


def _hits(taken: list[tuple[float, float, float, float, float]], x: float, y: float, across: bool = False) -> bool:
    half_x, half_y = 2.5 + _CLEARANCE_M, 1.0 + _CLEARANCE_M / 2
    if across:
        half_x, half_y = half_y, half_x
    return any(
        x0 < x + half_x and x1 > x - half_x and y0 < y + half_y and y1 > y - half_y for x0, y0, x1, y1, _ in taken
    )
