"""Families with much that grows: the suburb with its gardens on a slope, the avenue, and the street under snow."""

from dataclasses import replace
from typing import Final

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.courses.terrain import TerrainProfile
from gnd.fleet_sim.families.site import (
    FamilyPlace,
    FamilySite,
    crown_shapes,
    fence_shapes,
    glass_fronts,
    hedge_shapes,
    moved_fronts,
    seasonal,
)
from gnd.fleet_sim.parts import Lot
from gnd.fleet_sim.shapes import Ball, Block, Post, Shape
from gnd.fleet_sim.street_before import KERB_M, PAVEMENT_M, StreetPlan
from gnd.fleet_sim.street_site import x_of
from gnd.fleet_sim.world import STATES, WorldObject

_TREE_M: Final = 9.0
"""Trees of an avenue stand so far apart on either side."""
_TUFTS: Final = 130
_TWIGS: Final = 22
_BACK_M: Final = 5.0
_GRADE: Final = (0.03, 0.08)
"""Steepest grades of a suburb's hills."""


def suburb(site: FamilySite) -> FamilyPlace:
    """Detached houses behind gardens with hedges, fences and low walls, on a road over a hill.

    Edits are those of every street: houses rebuilt and moved, garden walls and hedges moved and taken away, and so on.
    """
    rng = site.rng
    plan = _detached(site.plan, rng)

    def garden(o: WorldObject) -> WorldObject | None:
        if o.kind == "bollards" or (o.kind == "shelter" and rng.random() < 0.5):
            return None
        if o.kind != "wall" or not o.name.startswith("wall"):
            return o
        x0, x1, y = _extent(o)
        draw = rng.random()
        if draw < 0.5:
            return replace(o, shapes=hedge_shapes(x0, x1, y, float(rng.uniform(0.9, 1.9)), rng))
        if draw < 0.8:
            return replace(o, shapes=fence_shapes(x0, x1, y, float(rng.uniform(0.8, 1.3)), 4))
        return o

    objects = site.street(plan, garden)
    bushes = [_bush(f"bush {index}", lot, rng) for index, lot in enumerate(plan.lots)]
    turn = float(rng.uniform(-0.3, 0.3)) * plan.half_length_m
    steep = rng.uniform(*_GRADE, 2) * (1.0 if rng.random() < 0.5 else -1.0)
    profile = TerrainProfile((turn,), (float(steep[0]), -float(steep[1])))
    return FamilyPlace((*objects, *bushes), profile=profile)


def _detached(plan: StreetPlan, rng: np.random.Generator) -> StreetPlan:
    lots: list[Lot] = []
    for side in (1, -1):
        x = -plan.end_m + float(rng.uniform(0.0, 5.0))
        while x < plan.end_m - 14.0:
            end = x + float(rng.uniform(8.5, 13.0))
            front, high = float(rng.uniform(13.0, 18.0)), float(rng.uniform(3.6, 6.5))
            style = int(rng.integers(2**31))
            size = (parts.rounded(x), parts.rounded(end), parts.rounded(front), parts.rounded(high))
            lots.append(Lot(side, *size, style, PAVEMENT_M))
            x = end + float(rng.uniform(3.5, 8.0))
    return replace(plan, lots=tuple(lots), gaps=())


def _extent(o: WorldObject) -> tuple[float, float, float]:
    bounds = np.array([shape.bounds() for shape in o.shapes])
    return float(bounds[:, 0].min()), float(bounds[:, 2].max()), float(0.5 * (bounds[:, 1].min() + bounds[:, 3].max()))


def _bush(name: str, lot: Lot, rng: np.random.Generator) -> WorldObject:
    x, y = float(rng.uniform(lot.x0_m, lot.x1_m)), lot.side * float(rng.uniform(11.3, 12.3))
    half = float(rng.uniform(0.5, 0.8))
    return WorldObject(name, "bush", STATES, "kept", crown_shapes(x, y, half, (half, half), 45, rng))


def avenue(site: FamilySite) -> FamilyPlace:
    """Two rows of porous trees before set-back houses with shop windows; their leaves come or go between the states.

    The season is drawn: leaves have fallen (half of the seeds), have come (a quarter), or have grown anew elsewhere in
    the crowns. Of a tree that is felled, the leaves are removed with it.
    """
    rng = site.rng
    plan = moved_fronts(site.plan, lambda lot: lot.front_m + _BACK_M)
    objects = list(site.street(plan, lambda o: None if o.kind in ("tree", "bollards") else o))
    season = str(rng.choice(["fallen", "fallen", "come", "grown"]))
    for side in (1, -1):
        for index, x in enumerate(np.arange(8.0 - site.end_m, site.end_m - 8.0, _TREE_M).tolist()):
            where = x + float(rng.uniform(-0.8, 0.8))
            objects += _avenue_tree(f"{side:+d} {index}", where, side * 8.4, season, rng)
    return FamilyPlace((*objects, *glass_fronts(objects, plan, 0.4, rng)))


def _avenue_tree(name: str, x: float, y: float, season: str, rng: np.random.Generator) -> list[WorldObject]:
    """A trunk with bare twigs, and its leaves of either state; one in twelve is felled."""
    half, middle = (float(rng.uniform(1.7, 2.4)), float(rng.uniform(1.4, 1.9))), float(rng.uniform(4.2, 4.9))
    trunk = Post(parts.rounded(x), parts.rounded(y), parts.rounded(rng.uniform(0.12, 0.2)), -0.2, middle, parts.METAL)
    bare: tuple[Shape, ...] = (trunk, *crown_shapes(x, y, middle, (0.8 * half[0], 0.8 * half[1]), _TWIGS, rng))
    leaves = [crown_shapes(x, y, middle, half, _TUFTS, rng) for _ in STATES]
    if rng.random() < 1 / 12:
        shapes = bare if season == "come" else (*bare, *leaves[0])
        return [WorldObject(f"tree {name}", "tree", ("before",), "removed", shapes)]
    found = [WorldObject(f"tree {name}", "tree", STATES, "kept", bare)]
    if season != "come":
        found.append(seasonal(f"leaves {name}", "leaves", "before", *leaves[0]))
    if season != "fallen":
        found.append(seasonal(f"leaves {name}", "leaves", "after", *leaves[1]))
    return found


def snow(site: FamilySite) -> FamilyPlace:
    """The usual street with banks of snow along both kerbs and heaps at the house fronts, in the state after only."""
    rng, objects = site.rng, list(site.street())
    for side in (1, -1):
        x, index = -site.end_m, 0
        while x < site.end_m - 4.0:
            length, high = float(rng.uniform(4.0, 14.0)), float(rng.uniform(0.35, 1.1))
            if rng.random() < 0.75:
                objects.append(_bank(f"snow bank {side:+d} {index}", x, x + length, side, high))
            x, index = x + length + float(rng.uniform(0.5, 4.0)), index + 1
    for index, old in enumerate([o for o in objects if o.kind == "building" and "after" in o.states][::3]):
        lump = Ball(parts.rounded(x_of(old)), parts.rounded(float(np.sign(old.shapes[0].y_m)) * 9.9), 0.0, 0.6, 0.8)
        objects.append(seasonal(f"snow heap {index}", "snow", "after", lump))
    return FamilyPlace(tuple(objects))


def _bank(name: str, x0: float, x1: float, side: int, high: float) -> WorldObject:
    """A bank of snow on the kerb: two slopes, back to back."""
    half, middle = parts.rounded((x1 - x0) / 2), parts.rounded((x0 + x1) / 2)
    wide, level = 0.35, parts.rounded(-0.12 + 0.5 * high)
    shapes = [
        Block(middle, parts.rounded(side * KERB_M + out * wide), half, wide, -0.3, level,
              rise_y=-out * high / (2 * wide), reflectivity=0.8)
        for out in (1.0, -1.0)
    ]  # fmt: skip
    return seasonal(name, "snow", "after", *shapes)
