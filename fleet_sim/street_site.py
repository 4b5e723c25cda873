"""The objects of a street while they are being edited: what is added, removed, moved and reshaped."""

from collections.abc import Sequence
from dataclasses import replace

from gnd.fleet_sim.shapes import Ball, Block, Post, Shape
from gnd.fleet_sim.world import Edit, WorldObject


class Site:
    """The objects of a street while they are being edited."""

    def __init__(self, objects: Sequence[WorldObject], base_m: float) -> None:
        self._objects = list(objects)
        self.base_m = base_m

    @property
    def objects(self) -> tuple[WorldObject, ...]:
        """Everything, untouched things first in their old order, then what the edits made."""
        return tuple(self._objects)

    def kept(self, kind: str) -> list[WorldObject]:
        """Return the things of a kind that no edit has touched yet, nearest to the middle of the street first."""
        return sorted((o for o in self._objects if o.kind == kind and o.edit == "kept"), key=lambda o: abs(x_of(o)))

    def add(self, name: str, kind: str, shapes: tuple[Shape, ...]) -> None:
        """Put a thing that was not there before."""
        self._objects.append(WorldObject(name, kind, ("after",), "added", shapes))

    def remove(self, old: WorldObject) -> None:
        """Take a thing away."""
        self._swap(old, replace(old, states=("before",), edit="removed"))

    def change(self, old: WorldObject, shapes: tuple[Shape, ...], edit: Edit) -> None:
        """Give a thing other shapes."""
        self._swap(old, replace(old, states=("before",), edit=edit))
        self._objects.append(WorldObject(old.name, old.kind, ("after",), edit, shapes))

    def shift(self, old: WorldObject, dx_m: float, dy_m: float) -> None:
        """Move a thing."""
        self.change(old, tuple(_shifted(shape, dx_m, dy_m) for shape in old.shapes), "moved")

    def named(self, name: str) -> WorldObject:
        """Return an untouched thing by its name."""
        return next(o for o in self._objects if o.name == name and o.edit == "kept")

    def _swap(self, old: WorldObject, new: WorldObject) -> None:
        self._objects[self._objects.index(old)] = new


def _shifted(shape: Shape, dx_m: float, dy_m: float) -> Block | Post | Ball:
    return replace(shape, x_m=round(shape.x_m + dx_m, 3), y_m=round(shape.y_m + dy_m, 3))


def x_of(o: WorldObject) -> float:
    """Return where an object is along the street [m]: its first primitive's centre."""
    return o.shapes[0].x_m


def y_of(o: WorldObject) -> float:
    """Return where an object is across the street [m]: its first primitive's centre."""
    return o.shapes[0].y_m
