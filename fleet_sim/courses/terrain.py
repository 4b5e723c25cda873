"""Roads that climb and fall: a height profile along the street, and a world that is raised to stand on it."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.shapes import Ball, Block, Shape
from gnd.fleet_sim.world import World, WorldObject
from gnd.gnd_map.arrays import F64

_PIECE_M: Final = 2.0
"""The ground is laid in level-edged pieces of this length: over a crest of 300 m radius they are off by 2 mm."""
_FOOT_M: Final = 2.5
"""What stands on a slope reaches so much deeper into the ground."""
_LAID: Final = ("road", "pavement", "wall")
"""Kinds that follow the ground piece by piece; all else stands upright on the height under its middle."""


@dataclass(frozen=True)
class TerrainProfile:
    """Height of the ground over the street's reference plane, by x.

    Attributes:
        x_m: where the grade changes, rising, at least one.
        grades: rise a metre before the first of them, between them, and after the last; one more than `x_m`.
        ease_m: a change of grade is spread over so much of the way on either side.
    """

    x_m: tuple[float, ...] = (0.0,)
    grades: tuple[float, ...] = (0.0, 0.0)
    ease_m: float = 12.0

    def __post_init__(self) -> None:
        if len(self.grades) != len(self.x_m) + 1 or list(self.x_m) != sorted(set(self.x_m)) or self.ease_m <= 0.0:
            raise DriveSimError(f"{len(self.x_m)} rising places need {len(self.x_m) + 1} grades, got {self}")
        if any(b - a < 2 * self.ease_m for a, b in zip(self.x_m, self.x_m[1:], strict=False)):
            raise DriveSimError(f"changes of grade at {self.x_m} overlap: each is {2 * self.ease_m} m long")

    @cached_property
    def _knots(self) -> tuple[F64, F64]:
        """Where the grade is a straight line in between, and the grade there."""
        x = [at + side * self.ease_m for at in self.x_m for side in (-1.0, 1.0)]
        grade = [g for before, after in zip(self.grades, self.grades[1:], strict=False) for g in (before, after)]
        return np.array(x), np.array(grade)

    def grade(self, x_m: F64) -> F64:
        """Return the rise a metre at x (K,)."""
        return np.interp(x_m, *self._knots)

    @cached_property
    def _curve(self) -> CubicSpline:
        x = np.arange(-1000.0, 1000.5, 0.5)
        rise = np.concatenate([[0.0], np.cumsum(0.25 * (self.grade(x[1:]) + self.grade(x[:-1])))])
        return CubicSpline(x, rise - np.interp(0.0, x, rise))

    def height_m(self, x_m: F64) -> F64:
        """Return the height at x (K,) [m]; 0 at x = 0."""
        return np.asarray(self._curve(x_m))


LEVEL: Final = TerrainProfile()


@dataclass(frozen=True, slots=True)
class TerrainGround:
    """The surface that vehicles drive on, in the street frame.

    Attributes:
        profile: along the street.
        crown: fall from the middle of the road to its sides, metres a metre.
    """

    profile: TerrainProfile
    crown: float

    def height_m(self, place_m: F64) -> F64:
        """Return the height (K,) under places (K, 2) [m]."""
        return self.profile.height_m(place_m[:, 0]) - self.crown * np.abs(place_m[:, 1])

    def gradient(self, place_m: F64) -> F64:
        """Return the rise along x and along y (K, 2) at places (K, 2)."""
        across = -self.crown * np.sign(place_m[:, 1])
        return np.stack([self.profile.grade(place_m[:, 0]), across], axis=1)


def raised(world: World, profile: TerrainProfile) -> World:
    """Return a world whose things stand on a profile: the ground bends, walls stay upright."""
    return replace(world, objects=tuple(_raised(o, profile) for o in world.objects))


def _raised(o: WorldObject, profile: TerrainProfile) -> WorldObject:
    if o.kind in _LAID:
        return replace(o, shapes=tuple(piece for shape in o.shapes for piece in _laid(shape, profile)))
    bounds = np.array([shape.bounds() for shape in o.shapes])
    rise = float(profile.height_m(np.array([0.5 * (bounds[:, 0].min() + bounds[:, 2].max())]))[0])
    return replace(o, shapes=tuple(_lifted(shape, rise) for shape in o.shapes))


def _lifted(shape: Shape, rise_m: float) -> Shape:
    """Return a primitive raised; one that reaches the ground reaches deeper into it."""
    if isinstance(shape, Ball):
        return replace(shape, z_m=shape.z_m + rise_m)
    foot = _FOOT_M if shape.bottom_m < 0.05 else 0.0
    return replace(shape, bottom_m=shape.bottom_m + rise_m - foot, top_m=shape.top_m + rise_m)


def _laid(shape: Shape, profile: TerrainProfile) -> list[Shape]:
    """Return the pieces of a block that lies along the street, each as steep as the ground under it."""
    if not isinstance(shape, Block) or shape.yaw_rad:
        x0, _, x1, _, _ = shape.bounds()
        return [_lifted(shape, float(profile.height_m(np.array([0.5 * (x0 + x1)]))[0]))]
    count = max(1, round(2 * shape.half_x_m / _PIECE_M))
    edges = np.linspace(shape.x_m - shape.half_x_m, shape.x_m + shape.half_x_m, count + 1)
    heights, found = profile.height_m(edges), list[Shape]()
    for k in range(count):
        middle, half = 0.5 * (edges[k] + edges[k + 1]), 0.5 * (edges[k + 1] - edges[k])
        height, rise = 0.5 * (heights[k] + heights[k + 1]), (heights[k + 1] - heights[k]) / (2 * half)
        level = height + shape.rise_x * (middle - shape.x_m)
        found.append(
            replace(
                shape,
                x_m=float(middle),
                half_x_m=float(half),
                bottom_m=shape.bottom_m + float(level) - _FOOT_M,
                top_m=shape.top_m + float(level),
                rise_x=shape.rise_x + float(rise),
            )
        )
    return found
