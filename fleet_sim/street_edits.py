"""What changes on the street between `before` and `after`: a construction zone, and the rest of a year in a city.

The edits follow the GND paper's simulations (section 6.1: objects added, removed, transformed), sized so that
modified, new and deleted voxels each have a few hundred examples.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import pi
from typing import Final

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.parts import Lot
from gnd.fleet_sim.street_before import StreetPlan
from gnd.fleet_sim.street_site import Site, x_of, y_of
from gnd.fleet_sim.street_works import add_works
from gnd.fleet_sim.world import STATES, Edit, WorldObject

_END_M: Final = 15.0
"""Nothing is edited so near to the end of the street."""


def rebuild(
    objects: Sequence[WorldObject],
    plan: StreetPlan,
    base_m: float,
    rng: np.random.Generator,
    more: np.random.Generator,
) -> tuple[WorldObject, ...]:
    """Edit the street `before` into the street of both states.

    Args:
        objects: everything on the street before, all of it in both states.
        plan: buildings in the order of their names, alleys, and the place of the construction zone.
        base_m: height of the pavement.
        rng: decides the sizes.
        more: the same for what happens on a longer street only.
    """
    site, lots, zone_x_m = Site(objects, base_m), plan.lots, plan.zone_x_m
    near = sorted(range(len(lots)), key=lambda i: abs(lots[i].x_m - zone_x_m))
    here = [i for i in near if lots[i].side == plan.zone_side]
    there = [i for i in near if lots[i].side != plan.zone_side]
    reach_m = plan.half_length_m - _END_M
    _demolish(site, lots[here[0]], here[0], rng)
    _rebuild_fronts(site, lots, here, there, rng)
    _construction_zone(site, plan.zone_side, zone_x_m, rng)
    _pavements(site, plan.zone_side, zone_x_m)
    _walls(site, reach_m, rng)
    _infill(site, plan.gaps, zone_x_m)
    _furniture(site, reach_m, rng)
    add_works(site, lots, reach_m, more)
    return site.objects


def partly_edited(objects: Sequence[WorldObject], share: float, rng: np.random.Generator) -> tuple[WorldObject, ...]:
    """Take back all edits but a drawn share of them: what was added is not there, all else stays as it was before.

    Args:
        objects: of both states, as `rebuild` returns them.
        share: of the things that were edited, 0 … 1; with 1 nothing is taken back and nothing drawn.
        rng: decides which.
    """
    if share >= 1.0:
        return tuple(objects)
    lasting = ("kept", "seasonal")
    names = sorted({o.name for o in objects if o.edit not in lasting})
    made = {names[k] for k in rng.permutation(len(names))[: round(share * len(names))].tolist()}
    there = (o for o in objects if o.edit in lasting or o.name in made or "before" in o.states)
    return tuple(o if o.edit in lasting or o.name in made else replace(o, states=STATES, edit="kept") for o in there)


def _demolish(site: Site, lot: Lot, index: int, rng: np.random.Generator) -> None:
    """A building goes; rubble, a container and hoarding take its place."""
    site.remove(site.named(f"building {index}"))
    y = lot.side * (lot.front_m + 0.2)
    hoarding = parts.slab(lot.x0_m - 0.5, lot.x1_m + 0.5, y - 0.05, y + 0.05, site.base_m, site.base_m + 2.2)
    site.add("hoarding", "hoarding", (hoarding,))
    size = float(rng.uniform(3.5, 4.5))
    site.add("rubble", "heap", parts.heap(lot.x_m, lot.side * (lot.front_m + 5.0), site.base_m, size))


def _rebuild_fronts(
    site: Site, lots: Sequence[Lot], here: list[int], there: list[int], rng: np.random.Generator
) -> None:
    """Fronts rebuilt with other relief, moved forwards or backwards, and a building grown by a storey."""
    style = int(rng.integers(2**31))
    changes: list[tuple[int, float, float, int]] = [
        (here[1], -0.35, 0.0, style),
        (here[2], 0.45, 0.0, 0),
        (here[4], 0.0, 3.0, style + 1),
        (there[0], 0.6, 0.0, 0),
        (there[1], 0.0, 0.0, style + 2),
        (there[2], -0.4, 0.0, 0),
        (there[4], -0.3, 1.5, style + 3),
    ]
    for index, forward, taller, new_style in changes:
        old = lots[index]
        style = new_style or old.style
        lot = replace(old, front_m=old.front_m - forward, height_m=old.height_m + taller, style=style)
        edit: Edit = "reshaped" if new_style else "moved"
        site.change(site.named(f"building {index}"), parts.building(lot), edit)


def _construction_zone(site: Site, side: int, x: float, rng: np.random.Generator) -> None:
    """Barriers, containers, scaffold, site signs and spoil on the pavement and the parking lane."""
    base = site.base_m
    for index in range(11):
        where = x - 12.0 + 2.3 * index
        turned = parts.barrier(where, side * 4.75, -0.1, float(rng.normal(0.0, 0.04)))
        site.add(f"barrier {index}", "barrier", turned)
    for index, dx in enumerate((-6.0, 1.5)):
        turned = parts.container(x + dx, side * 7.7, base, float(rng.normal(0.0, 0.05)))
        site.add(f"container {index}", "container", turned)
    site.add("scaffold", "scaffold", parts.scaffold(x + 7.0, x + 17.0, side * 9.2, base, side, 3))
    site.add("spoil", "heap", parts.heap(x - 13.5, side * 7.9, base, 2.6))
    for index, dx in enumerate((-15.5, 15.5)):
        site.add(f"site sign {index}", "sign", parts.sign(x + dx, side * 5.6, -0.1, 1.2, 1.4, 0.0))


def _pavements(site: Site, side: int, x: float) -> None:
    """The kerb moves: pavement widened on one stretch, a lay-by cut into it on another, a terrace raised on a third."""
    base = site.base_m
    wide = parts.slab(x + 18.0, x + 42.0, side * 5.0, side * 6.2, -1.0, base)
    site.add("kerb extension", "pavement", (wide,))
    pieces = sorted((o for o in site.kept("pavement") if o.name.startswith(f"pavement {-side:+d} ")), key=x_of)
    for piece in [p for p in pieces if x - 45.0 < x_of(p) < x - 18.0]:
        site.remove(piece)
    site.add("terrace", "pavement", (parts.slab(x + 2.0, x + 24.0, -side * 7.2, -side * 10.3, -0.5, base + 0.35),))


def _walls(site: Site, reach_m: float, rng: np.random.Generator) -> None:
    """Walls moved by 0.3 to 2 m, one taken away, one raised."""
    walls = [o for o in site.kept("wall") if abs(x_of(o)) < reach_m]
    for old, dy in zip(walls[0:4], (0.3, 0.6, 1.2, 2.0), strict=False):
        site.shift(old, 0.0, float(np.sign(y_of(old))) * dy)
    for old in walls[4:6]:
        site.remove(old)
    for index in range(2):
        side, x = (1, -1)[index], float(rng.uniform(20.0, 60.0)) * (-1, 1)[index]
        shapes = parts.wall(x - 5.0, x + 5.0, side * 9.5, 1.3, site.base_m)
        site.add(f"new wall {index}", "wall", shapes)


def _infill(site: Site, gaps: Sequence[tuple[int, float, float]], x: float) -> None:
    """New shops in the alleys nearest to the zone, a kiosk on either pavement."""
    for index, (side, x0, x1) in enumerate(sorted(gaps, key=lambda gap: abs(gap[1] - x))[0:3]):
        lot = Lot(side, x0, x1, 10.4, 4.2 + index, 77 + index, site.base_m)
        site.add(f"shop {index}", "building", parts.building(lot))
    for index, (side, dx) in enumerate(((1, -52.0), (-1, 58.0))):
        kiosk = parts.slab(dx - 2.2, dx + 2.2, side * 7.4, side * 9.6, site.base_m - 0.1, site.base_m + 2.6)
        site.add(f"kiosk {index}", "kiosk", (kiosk,))


def _furniture(site: Site, reach_m: float, rng: np.random.Generator) -> None:
    """Signs, lamps, trees, cabinets and shelters: some moved, some gone, some new."""
    for kind, moved, removed in (("sign", 3, 3), ("lamp", 2, 1), ("cabinet", 2, 2), ("tree", 0, 4), ("shelter", 1, 0)):
        found = [o for o in site.kept(kind) if abs(x_of(o)) < reach_m]
        order = rng.permutation(len(found)).tolist()
        for rank in order[0:moved]:
            site.shift(found[rank], float(rng.uniform(0.5, 3.0)) * float(rng.choice((-1.0, 1.0))), 0.0)
        for rank in order[moved : moved + removed]:
            site.remove(found[rank])
    for index in range(4):
        side, x = (1, -1)[index % 2], float(rng.uniform(10.0 - reach_m, reach_m - 10.0))
        site.add(f"new sign {index}", "sign", parts.sign(x, side * 7.1, site.base_m, 0.9, 2.5, pi * (side < 0)))
    for index in range(3):
        side, x = (1, -1)[index % 2], float(rng.uniform(15.0 - reach_m, reach_m - 15.0))
        site.add(f"new tree {index}", "tree", parts.tree(x, side * 8.1, site.base_m, int(rng.integers(2**31))))
