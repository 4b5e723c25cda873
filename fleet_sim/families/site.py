"""What a family of places is made from, what it gives back, and the tools that several of them use."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import pi
from typing import Final

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.courses.terrain import TerrainProfile
from gnd.fleet_sim.parts import Lot
from gnd.fleet_sim.shapes import Ball, Block, Post, Shape
from gnd.fleet_sim.street_before import CROWN, KERB_M, PAVEMENT_M, StreetPlan, built
from gnd.fleet_sim.street_edits import rebuild
from gnd.fleet_sim.street_site import x_of, y_of
from gnd.fleet_sim.world import STATES, Bay, State, WorldObject

LANE_OFFSET_M: Final = 1.75
_CAR_HALF_M: Final = 1.4
"""Half of the corridor in which a vehicle drives."""
_CAR_HIGH_M: Final = (0.2, 4.0)
"""What is lower is driven over, what hangs higher is passed under."""


@dataclass(frozen=True, slots=True)
class FamilySite:
    """What the seed has decided before a family builds on it.

    Attributes:
        plan: buildings, alleys and construction zone of the usual street.
        streams: the usual street's named streams of chance.
        rng: of what the family adds.
    """

    plan: StreetPlan
    streams: Mapping[str, np.random.Generator]
    rng: np.random.Generator

    @property
    def end_m(self) -> float:
        """What is built reaches so far from the middle, along the street."""
        return self.plan.end_m

    def street(
        self, plan: StreetPlan | None = None, prepare: "Callable[[WorldObject], WorldObject | None] | None" = None
    ) -> tuple[WorldObject, ...]:
        """Return the things of the usual street in both states.

        Args:
            plan: another plan than the usual one.
            prepare: changes a thing of the state before, or leaves it out (None), before the edits are made.
        """
        plan = plan or self.plan
        base = built(plan, self.streams["furniture"], self.streams["greenery"])
        if prepare is not None:
            base = tuple(thing for o in base if (thing := prepare(o)) is not None)
        return rebuild(base, plan, PAVEMENT_M, self.streams["edits"], self.streams["more"])


@dataclass(frozen=True, slots=True)
class FamilyPlace:
    """A place of a family; attributes beside these: see `World`.

    Attributes:
        profile: of the ground along the street; None: level.
    """

    objects: tuple[WorldObject, ...]
    profile: TerrainProfile | None = None
    crown: float = CROWN
    lane_offset_m: float = LANE_OFFSET_M
    kerb_m: float = KERB_M
    bulge_m: float = 0.0
    bulge_half_m: float = 25.0
    kerb_parking: bool = True
    bays: tuple[Bay, ...] = ()
    parking: float = 0.2
    cruise_mps: float = 9.0


def kept(name: str, kind: str, *shapes: Shape) -> WorldObject:
    """Return a thing that stays."""
    return WorldObject(name, kind, STATES, "kept", shapes)


def added(name: str, kind: str, *shapes: Shape) -> WorldObject:
    """Return a thing that was not there before."""
    return WorldObject(name, kind, ("after",), "added", shapes)


def seasonal(name: str, kind: str, state: State, *shapes: Shape) -> WorldObject:
    """Return leaves or snow of one state, which change no map."""
    return WorldObject(name, kind, (state,), "seasonal", shapes)


def removed(o: WorldObject) -> WorldObject:
    """Return a thing that is taken away."""
    return replace(o, states=("before",), edit="removed")


def moved(o: WorldObject, dx_m: float, dy_m: float) -> tuple[WorldObject, WorldObject]:
    """Return a thing before and after it is moved."""
    shapes = tuple(replace(s, x_m=parts.rounded(s.x_m + dx_m), y_m=parts.rounded(s.y_m + dy_m)) for s in o.shapes)
    return replace(o, states=("before",), edit="moved"), replace(o, states=("after",), edit="moved", shapes=shapes)


def reshaped(o: WorldObject, *shapes: Shape) -> tuple[WorldObject, WorldObject]:
    """Return a thing before and after it gets other shapes."""
    return (
        replace(o, states=("before",), edit="reshaped"),
        replace(o, states=("after",), edit="reshaped", shapes=shapes),
    )


@dataclass(frozen=True, slots=True)
class Renewal:
    """What becomes of the things of a kind: shares that are removed and moved, and how far at most [m]."""

    removed: float = 0.0
    moved: float = 0.0
    along_m: float = 0.0
    across_m: float = 0.0


def renewed(
    objects: Iterable[WorldObject], renewals: Mapping[str, Renewal], rng: np.random.Generator
) -> tuple[WorldObject, ...]:
    """Return kept things in both states, some of them removed or moved by the rule of their kind."""
    found: list[WorldObject] = []
    for o in objects:
        rule, draw = renewals.get(o.kind, Renewal()), float(rng.random())
        if draw < rule.removed:
            found.append(removed(o))
        elif draw < rule.removed + rule.moved:
            dx, dy = float(rng.uniform(-rule.along_m, rule.along_m)), float(rng.uniform(0.3, 1.0)) * rule.across_m
            found += moved(o, dx, dy if rng.random() < 0.5 else -dy)
        else:
            found.append(o)
    return tuple(found)


def out_of_the_lanes(objects: Sequence[WorldObject], place: FamilyPlace) -> tuple[WorldObject, ...]:
    """Return the things without those that stand in a vehicle's way; one that was moved there stays where it was."""
    bad = {(o.name, o.edit) for o in objects if any(_in_the_way(shape, place) for shape in o.shapes)}
    found: list[WorldObject] = []
    for o in objects:
        if (o.name, o.edit) not in bad:
            found.append(o)
        elif o.edit in ("moved", "reshaped") and "before" in o.states:
            stays = replace(o, states=STATES, edit="kept")
            found += [] if any(_in_the_way(shape, place) for shape in o.shapes) else [stays]
    return tuple(found)


def _in_the_way(shape: Shape, place: FamilyPlace) -> bool:
    x0, y0, x1, y1, top = shape.bounds()
    low = shape.z_m - shape.radius_m if isinstance(shape, Ball) else shape.bottom_m
    if top <= _CAR_HIGH_M[0] or low >= _CAR_HIGH_M[1]:
        return False
    x = np.linspace(x0, x1, max(2, int(x1 - x0) + 1))
    turn = np.clip(pi * x / place.bulge_half_m, -pi, pi)
    lane = place.lane_offset_m + 0.5 * place.bulge_m * (1.0 + np.cos(turn))
    return any(bool(((y0 < side * lane + _CAR_HALF_M) & (y1 > side * lane - _CAR_HALF_M)).any()) for side in (1, -1))


def moved_fronts(plan: StreetPlan, front_of: Callable[[Lot], float]) -> StreetPlan:
    """Return a plan whose buildings stand at other distances from the road."""
    return replace(plan, lots=tuple(replace(lot, front_m=parts.rounded(front_of(lot))) for lot in plan.lots))


def hedge_shapes(x0: float, x1: float, y: float, height: float, rng: np.random.Generator) -> tuple[Shape, ...]:
    """Return a hedge along the street: a row of tufts with air between them, denser below."""
    count = max(8, round((x1 - x0) * 14))
    x, z = rng.uniform(x0, x1, count), PAVEMENT_M + height * rng.uniform(0.05, 0.95, count)
    out, radius = rng.normal(0.0, 0.16, count), rng.uniform(0.12, 0.22, count)
    return tuple(
        Ball(parts.rounded(a), parts.rounded(y + b), parts.rounded(c), parts.rounded(r), parts.LEAF)
        for a, b, c, r in zip(x, out, z, radius, strict=True)
    )


def crown_shapes(
    x: float, y: float, middle_m: float, half_m: tuple[float, float], count: int, rng: np.random.Generator
) -> tuple[Shape, ...]:
    """Return leaves of a crown: tufts in an ellipsoid of half width and half height `half_m`, with air between them."""
    direction = rng.normal(size=(count, 3))
    direction *= rng.uniform(0.25, 1.0, (count, 1)) / np.linalg.norm(direction, axis=1, keepdims=True)
    at = np.array([x, y, middle_m]) + direction * np.array([half_m[0], half_m[0], half_m[1]])
    return tuple(
        Ball(parts.rounded(a), parts.rounded(b), parts.rounded(c), parts.rounded(r), parts.LEAF)
        for (a, b, c), r in zip(at.tolist(), rng.uniform(0.09, 0.2, count).tolist(), strict=True)
    )


def fence_shapes(x0: float, x1: float, y: float, height: float, rails: int) -> tuple[Shape, ...]:
    """Return a fence of thin posts and rails, through which most rays pass."""
    count = max(2, round((x1 - x0) / 2.4) + 1)
    posts = [
        Post(parts.rounded(x), parts.rounded(y), 0.03, PAVEMENT_M - 0.2, parts.rounded(height), parts.METAL)
        for x in np.linspace(x0, x1, count).tolist()
    ]
    heights = np.linspace(0.25, 1.0, rails) * (height - 0.03)
    bars = [parts.slab(x0, x1, y - 0.012, y + 0.012, z - 0.015, z + 0.015, parts.METAL) for z in heights.tolist()]
    return (*posts, *bars)


def glass_fronts(
    objects: Sequence[WorldObject], plan: StreetPlan, share: float, rng: np.random.Generator
) -> tuple[WorldObject, ...]:
    """Return shop windows before a share of the fronts that stay as they are."""
    stays = {o.name for o in objects if o.edit == "kept" and o.kind == "building"}
    found = []
    for index, lot in enumerate(plan.lots):
        if rng.random() < share and f"building {index}" in stays:
            out = sorted((lot.side * (lot.front_m - 0.38), lot.side * (lot.front_m - 0.44)))
            base = lot.base_m
            pane = parts.slab(lot.x0_m + 0.4, lot.x1_m - 0.4, out[0], out[1], base + 0.35, base + 2.8, 0.3)
            found.append(kept(f"shop window {index}", "glass", pane))
    return tuple(found)


def turned_block(
    x: float, y: float, size_m: tuple[float, float], heights_m: tuple[float, float], yaw_rad: float
) -> Block:
    """Return a block of metal by its middle, its length and width, its heights and its turn."""
    bottom, top = heights_m
    half = size_m[0] / 2, size_m[1] / 2
    return Block(
        parts.rounded(x), parts.rounded(y), parts.rounded(half[0]), parts.rounded(half[1]), parts.rounded(bottom),
        parts.rounded(top), round(yaw_rad, 4), reflectivity=parts.METAL,
    )  # fmt: skip


def middle_of(o: WorldObject) -> tuple[float, float]:
    """Return where a thing is, street frame [m]."""
    return x_of(o), y_of(o)
