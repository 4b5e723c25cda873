"""Other vehicles on a course: those that keep pace with the one that measures, and those that come towards it.

What keeps its place beside a vehicle looks like something that stands, to whoever measures only relative to himself.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import tau
from typing import Final

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.courses.motion import CourseMotion
from gnd.fleet_sim.movers import Mover, Movers
from gnd.fleet_sim.shapes import Block, Shape
from gnd.gnd_map.arrays import F64

STEP_S: Final = 0.02
_LEAD_S: Final = 0.5
_EVERYWHERE_M: Final = 1e4
_EASE_M: Final = 2.0


@dataclass(frozen=True, eq=False)
class Companion:
    """A vehicle on the road.

    Attributes:
        shapes: in its own frame, x ahead, middle over the origin.
        way_m: from times (S,) [s] and the ways (S,) of the one that measures to its own ways (S,) along the path [m].
        left_m: its lane, so far to the left of the path.
        towards: it drives against the path.
    """

    shapes: tuple[Shape, ...]
    way_m: Callable[[F64, F64], F64]
    left_m: float = 0.0
    towards: bool = False


def van() -> tuple[Shape, ...]:
    """Return a delivery van, 5.6 m long and 2.5 m high."""
    return (
        Block(0.0, 0.0, 2.8, 1.0, 0.3, 2.5, reflectivity=0.5),
        *_wheels(1.8, 0.9),
    )


def lorry() -> tuple[Shape, ...]:
    """Return a lorry, 10 m long and 3.8 m high: box and cab with a gap between."""
    return (
        Block(-1.2, 0.0, 3.8, 1.25, 1.0, 3.8, reflectivity=0.5),
        Block(3.9, 0.0, 1.0, 1.2, 0.5, 2.9, reflectivity=0.35),
        *_wheels(3.4, 1.1),
    )


def car(style: int) -> tuple[Shape, ...]:
    """Return a car or a small van."""
    return parts.car(0.0, 0.0, 0.0, 0.0, style)


def _wheels(x_m: float, y_m: float) -> tuple[Shape, ...]:
    return tuple(Block(x, y, 0.45, 0.12, 0.0, 0.9, reflectivity=0.1) for x in (-x_m, x_m) for y in (-y_m, y_m))


def keeping(
    shapes: tuple[Shape, ...], ahead_m: float, left_m: float = 0.0, swing_m: float = 0.0, phase_rad: float = 0.0
) -> Companion:
    """Return a vehicle whose middle keeps `ahead_m` before the rear axle of the one that measures (behind: negative).

    With `swing_m` the distance swings by so much, once in 9 s.
    """

    def way_m(t_s: F64, ego_m: F64) -> F64:
        return ego_m + ahead_m + swing_m * np.sin(tau * t_s / 9.0 + phase_rad)

    return Companion(shapes, way_m, left_m)


def lagging(shapes: tuple[Shape, ...], ahead_m: float, lag_s: float, left_m: float = 0.0) -> Companion:
    """Return a vehicle that does what the one that measures does, `lag_s` later (sooner: negative), `ahead_m` before.

    So a queue moves off: one after the other.
    """

    def way_m(t_s: F64, ego_m: F64) -> F64:
        return np.interp(t_s - lag_s, t_s, ego_m) + ahead_m

    return Companion(shapes, way_m, left_m)


def passing(shapes: tuple[Shape, ...], start_m: float, speed_mps: float, left_m: float) -> Companion:
    """Return a vehicle of a constant speed along the path, towards the one that measures where it is negative."""

    def way_m(t_s: F64, ego_m: F64) -> F64:
        return start_m + speed_mps * t_s + 0.0 * ego_m

    return Companion(shapes, way_m, left_m, towards=speed_mps < 0.0)


def movers_of(companions: tuple[Companion, ...], motion: CourseMotion) -> Movers | None:
    """Return the vehicles around a ride, None if there are none."""
    if not companions:
        return None
    t_s = np.arange(-_LEAD_S, motion.ride.duration_s + _LEAD_S + STEP_S, STEP_S)
    ego_m = motion.ride.way_m(t_s)
    return Movers([_mover(one, motion, t_s, ego_m) for one in companions], float(t_s[0]), STEP_S, _EVERYWHERE_M)


def _mover(one: Companion, motion: CourseMotion, t_s: F64, ego_m: F64) -> Mover:
    way_m = one.way_m(t_s, ego_m)
    place = motion.path.beside(way_m, one.left_m)
    chord = motion.path.beside(way_m + _EASE_M, one.left_m) - motion.path.beside(way_m - _EASE_M, one.left_m)
    if one.towards:
        chord = -chord
    yaw = np.unwrap(np.arctan2(chord[:, 1], chord[:, 0]))
    track = np.column_stack([place, motion.ground.height_m(place), yaw, np.zeros(len(t_s))])
    return Mover(one.shapes, (0.0,) * len(one.shapes), track)
