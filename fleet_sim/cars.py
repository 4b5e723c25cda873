"""Cars parked along the kerbs of one drive: they hide the street, and are no part of its truth."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import sin, tau
from typing import Final

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.shapes import Ball, Block, Post, Shape
from gnd.fleet_sim.world import Bay, State, World

SLOT_M: Final = 6.2
LANE_M: Final = 1.05
"""Distance of a parked car's middle from the kerb."""
_CLEARANCE_M: Final = 0.3
MAX_STAY_H: Final = 1000.0
_FORGOTTEN_STAYS: Final = 20
"""Stays are followed from so many mean stays before the common time."""
_GROUND_M2: Final = 200.0
"""What is larger is ground."""


@dataclass(frozen=True, slots=True)
class Stays:
    """How long cars stay in a slot, and when it is looked at.

    Attributes:
        mean_h: mean stay, hours; 0: every drive meets other cars, whenever it is.
        at_h: time of the drive, hours after a time that is common to all drives of a world.
    """

    mean_h: float = 0.0
    at_h: float = 0.0

    def chance(self, world_seed: int, slot: int, occupancy: float) -> tuple[bool, np.random.Generator]:
        """Return whether a slot is taken, and the stream that decides what stands there and how.

        Stays and gaps follow each other, both exponential, from so long ago that the beginning is forgotten; the share
        of the time in which the slot is taken is the occupancy.
        """
        rng, number = np.random.default_rng([world_seed, 0x57A1, slot]), 0
        gap_h = self.mean_h * (1.0 - occupancy) / occupancy if occupancy > 0.0 else 0.0
        taken, until_h = bool(rng.random() < occupancy), -_FORGOTTEN_STAYS * self.mean_h
        while occupancy > 0.0:
            until_h += float(rng.exponential(self.mean_h if taken else gap_h))
            if until_h > self.at_h:
                break
            taken, number = not taken, number + 1
        return taken, np.random.default_rng([world_seed, 0x57A1, slot, number])


def parked_cars(
    world: World, state: State, occupancy: float, seed: int, stays: Stays | None = None
) -> tuple[Shape, ...]:
    """Return the primitives of the cars that stand there during one drive.

    Args:
        world: the street.
        state: what else stands there; no car parks where an object of this state does.
        occupancy: probability that a slot is taken, 0 … 1.
        seed: seed of the drive.
        stays: how long cars stay; without it, or with a mean of 0, every seed has cars of its own.

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
    for number, slot in enumerate(_slots(world)):
        lasting = stays is not None and stays.mean_h > 0.0
        here, chance = stays.chance(world.seed, number, occupancy) if stays is not None and lasting else (False, rng)
        drawn = chance.random() < occupancy
        dx, dy = float(chance.normal(0.0, slot.along_m)), float(chance.normal(0.0, 0.12))
        turned, style = float(chance.normal(0.0, 0.02)), int(chance.integers(2**31))
        x, y = slot.bay.x_m + dx, slot.bay.y_m + slot.side * dy
        if (here if lasting else drawn) and not _hits(taken, x, y, abs(sin(slot.bay.yaw_rad)) > 0.5):
            make = parts.delivery_van if slot.bay.van else parts.car
            cars += make(x, y, _ground_m(world, x, y), turned + slot.bay.yaw_rad, style)
    return tuple(cars)


@dataclass(frozen=True, slots=True)
class _Slot:
    """A place for a car, the side of the street for its offset, and how far along it cars stand off the middle [m]."""

    bay: Bay
    side: int = 1
    along_m: float = 0.15


def _slots(world: World) -> Iterator[_Slot]:
    """Slots along the kerbs, then the world's bays."""
    for side in (1, -1) if world.kerb_parking else ():
        yaw = 0.0 if side < 0 else tau / 2
        for x in np.arange(-world.half_length_m - 20.0, world.half_length_m + 20.0, SLOT_M).tolist():
            yield _Slot(Bay(x, side * (world.kerb_m - LANE_M), yaw), side, 0.25)
    yield from (_Slot(bay) for bay in world.bays)


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
