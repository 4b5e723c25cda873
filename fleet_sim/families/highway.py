"""Families without houses: the motorway between noise barriers, and the mouth of a tunnel."""

from dataclasses import replace
from typing import Final

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.families.site import (
    FamilyPlace,
    FamilySite,
    Renewal,
    added,
    crown_shapes,
    kept,
    renewed,
    reshaped,
)
from gnd.fleet_sim.shapes import Block, Post, Shape
from gnd.fleet_sim.world import WorldObject

_SIDE_M: Final = 13.5
"""Noise barriers stand so far from the middle of the motorway."""
_PANEL_M: Final = 4.0
_TUBE_M: Final = 5.4
_ROOF_M: Final = 5.6


def motorway(site: FamilySite) -> FamilyPlace:
    """Four lanes between noise barriers on low banks, with rails, a median barrier, gantries and call boxes.

    Edits: panels of the noise barriers are taken out, set back or raised, rails become concrete walls, gantries, signs
    and cameras come and go.
    """
    rng, end = site.rng, site.end_m
    objects = [kept("ground", "road", Block(0.0, 0.0, end, 45.0, -3.0, 0.0, reflectivity=parts.ASPHALT))]
    for side in (1, -1):
        objects += _noise_barrier(side, end, rng)
        rail = [_rail(x, x + 8.0, side * 11.6) for x in np.arange(-end, end, 8.0).tolist()]
        objects += [kept(f"rail {side:+d} {index}", "rail", *shapes) for index, shapes in enumerate(rail)]
        posts = np.arange(-end + 10.0, end, 25.0).tolist()
        objects += [
            kept(f"delineator {side:+d} {index}", "delineator", Post(round(x, 2), side * 12.2, 0.06, -0.2, 1.0, 0.6))
            for index, x in enumerate(posts)
        ]
        for index, x in enumerate(np.arange(-end + 18.0, end, 55.0).tolist()):
            plate = parts.sign(x + float(rng.uniform(-8, 8)), side * 12.6, 0.0, 1.4, 2.6, 0.0)
            objects.append(kept(f"sign {side:+d} {index}", "sign", *plate))
    median = [(x, x + 6.0) for x in np.arange(-end, end, 6.0).tolist()]
    objects += [kept(f"median {k}", "median", *_median(x0, x1)) for k, (x0, x1) in enumerate(median)]
    gantries = np.arange(-end + 25.0, end, 80.0).tolist()
    objects += [kept(f"gantry {k}", "gantry", *_gantry(x, 12.8)) for k, x in enumerate(gantries)]
    rules = {
        "noise barrier": Renewal(0.10, 0.12, 0.0, 0.6),
        "rail": Renewal(0.15, 0.0),
        "delineator": Renewal(0.25, 0.2, 2.0, 0.3),
        "sign": Renewal(0.25, 0.35, 3.0, 0.3),
        "gantry": Renewal(0.2, 0.0),
    }
    changed = [*renewed(objects, rules, rng), *_new_on_the_motorway(site.plan.half_length_m, rng)]
    changed = [new for o in changed for new in _raised_panel(o, rng)]
    return FamilyPlace(
        tuple(changed), crown=0.0, lane_offset_m=5.2, kerb_m=11.0, kerb_parking=False, parking=0.0, cruise_mps=22.0
    )


def _noise_barrier(side: int, end: float, rng: np.random.Generator) -> list[WorldObject]:
    """Panels between posts, on a bank; some stretches are higher."""
    high = 3.0 + 0.5 * np.round(rng.uniform(0.0, 3.0, 40))
    found = []
    for index, x in enumerate(np.arange(-end, end, _PANEL_M).tolist()):
        top, y = float(high[index // 6 % 40]), side * _SIDE_M
        panel = parts.slab(x + 0.1, x + _PANEL_M - 0.1, y - 0.08, y + 0.08, -0.2, top)
        post = parts.slab(x - 0.1, x + 0.1, y - 0.15, y + 0.15, -0.2, top + 0.1, parts.METAL)
        found.append(kept(f"noise barrier {side:+d} {index}", "noise barrier", panel, post))
    bank = parts.slab(-end, end, side * (_SIDE_M + 0.5), side * 40.0, -1.0, 0.6)
    return [*found, kept(f"bank {side:+d}", "ground", bank)]


def _raised_panel(o: WorldObject, rng: np.random.Generator) -> tuple[WorldObject, ...]:
    """Some panels that stay get a metre more; some pieces of the median become a high wall."""
    if o.edit != "kept" or o.kind not in ("noise barrier", "median") or rng.random() > 0.1:
        return (o,)
    higher = 1.0 if o.kind == "noise barrier" else 0.5
    shapes = [replace(s, top_m=parts.rounded(s.top_m + higher)) for s in o.shapes if isinstance(s, Block)]
    return reshaped(o, *shapes)


def _rail(x0: float, x1: float, y: float) -> tuple[Shape, ...]:
    beam = parts.slab(x0, x1, y - 0.04, y + 0.04, 0.42, 0.76, parts.METAL)
    posts = [Post(round(x, 2), y, 0.05, -0.2, 0.74, parts.METAL) for x in np.arange(x0 + 1.0, x1, 2.0).tolist()]
    return (beam, *posts)


def _median(x0: float, x1: float) -> tuple[Shape, ...]:
    return parts.slab(x0, x1, -0.3, 0.3, -0.2, 0.3), parts.slab(x0, x1, -0.12, 0.12, 0.3, 0.9)


def _gantry(x: float, half: float) -> tuple[Shape, ...]:
    legs = [Post(round(x, 2), side * half, 0.2, -0.2, 6.8, parts.METAL) for side in (1, -1)]
    beam = parts.slab(x - 0.2, x + 0.2, -half, half, 6.4, 6.8, parts.METAL)
    boards = [parts.slab(x - 0.3, x - 0.25, y - 1.6, y + 1.6, 5.2, 6.6, parts.SIGN) for y in (-6.0, 6.0)]
    return (*legs, beam, *boards)


def _new_on_the_motorway(half: float, rng: np.random.Generator) -> list[WorldObject]:
    found = [added("new gantry", "gantry", *_gantry(float(rng.uniform(-0.6, 0.6)) * half, 12.9))]
    for index in range(3):
        side, x = (1 if rng.random() < 0.5 else -1), float(rng.uniform(15.0 - half, half - 15.0))
        box = parts.cabinet(x, side * 12.5, 0.0)
        found.append(added(f"call box {index}", "cabinet", *box))
        mast = Post(round(x + 9.0, 2), side * 12.4, 0.1, -0.2, 6.0, parts.METAL)
        found.append(added(f"camera mast {index}", "mast", mast))
    side, x0 = (1 if rng.random() < 0.5 else -1), float(rng.uniform(-0.8, 0.2)) * half
    walls = [parts.barrier(x, side * 10.6, 0.0, 0.0) for x in np.arange(x0, x0 + 30.0, 2.1).tolist()]
    return [*found, *(added(f"works wall {k}", "barrier", *shapes) for k, shapes in enumerate(walls))]


def tunnel(site: FamilySite) -> FamilyPlace:
    """A cutting between retaining walls that leads into a smooth tube with lamps, fans, niches, signs and pipes.

    Edits: fans and signs come and go, cabinets in niches change, lining panels are set before the wall, bushes of the
    cutting are cleared, a barrier and a height gauge are put up before the mouth.
    """
    rng, end = site.rng, site.end_m
    mouth = float(rng.uniform(-0.25, 0.15)) * site.plan.half_length_m
    objects = [kept("ground", "road", Block(0.0, 0.0, end, 45.0, -3.0, 0.0, reflectivity=parts.ASPHALT))]
    for side in (1, -1):
        y0, y1 = side * _TUBE_M, side * (_TUBE_M + 1.0)
        objects.append(kept(f"tube {side:+d}", "wall", parts.slab(mouth, end, y0, y1, -1.0, _ROOF_M + 0.6)))
        objects += _cutting(side, mouth, end, rng)
        objects += _tube_furniture(side, mouth, end, rng)
    roof = parts.slab(mouth, end, -_TUBE_M - 1.0, _TUBE_M + 1.0, _ROOF_M, _ROOF_M + 1.2)
    portal = parts.slab(mouth - 0.6, mouth, -_TUBE_M - 3.0, _TUBE_M + 3.0, _ROOF_M, _ROOF_M + 2.0)
    objects += [kept("roof", "wall", roof), kept("portal", "wall", portal)]
    rules = {
        "fan": Renewal(0.3, 0.3, 4.0, 0.0),
        "sign": Renewal(0.3, 0.3, 3.0, 0.0),
        "cabinet": Renewal(0.3, 0.3, 1.5, 0.0),
        "tube light": Renewal(0.1, 0.1, 1.0, 0.0),
        "bush": Renewal(0.3, 0.0),
        "rib": Renewal(0.1, 0.15, 0.6, 0.0),
    }
    changed = [*renewed(objects, rules, rng), *_new_at_the_tunnel(mouth, site.plan.half_length_m, rng)]
    return FamilyPlace(tuple(changed), crown=0.0, kerb_m=5.2, kerb_parking=False, parking=0.0, cruise_mps=14.0)


def _cutting(side: int, mouth: float, end: float, rng: np.random.Generator) -> list[WorldObject]:
    """A retaining wall that rises towards the mouth in steps, with ribs, and bushes on its top."""
    found = []
    for index, x in enumerate(np.arange(-end, mouth, 6.0).tolist()):
        share = (x + end) / (mouth + end)
        high, y = 1.0 + 5.0 * share, _TUBE_M + 2.6
        stretch = parts.slab(x, min(x + 6.0, mouth), side * y, side * 40.0, -1.0, parts.rounded(high))
        found.append(kept(f"retaining wall {side:+d} {index}", "wall", stretch))
        rib = parts.slab(x + 2.6, x + 3.2, side * (y - 0.25), side * y, -0.2, high - 0.2)
        found.append(kept(f"rib {side:+d} {index}", "rib", rib))
        half = float(rng.uniform(0.5, 0.9))
        leaves = crown_shapes(x + 3.0, side * (y + 1.2), high + half, (half, half), 40, rng)
        found.append(kept(f"bush {side:+d} {index}", "bush", *leaves))
    return found


def _tube_furniture(side: int, mouth: float, end: float, rng: np.random.Generator) -> list[WorldObject]:
    found = []
    inside = np.arange(mouth + 4.0, end - 4.0, 7.0).tolist()
    for index, x in enumerate(inside):
        lamp = parts.slab(x - 0.6, x + 0.6, side * 2.8, side * 3.1, _ROOF_M - 0.25, _ROOF_M - 0.05, parts.METAL)
        found.append(kept(f"tube light {side:+d} {index}", "tube light", lamp))
        rib = parts.slab(x + 3.0, x + 3.4, side * (_TUBE_M - 0.2), side * _TUBE_M, -0.2, _ROOF_M)
        found.append(kept(f"tube rib {side:+d} {index}", "rib", rib))
    for index, x in enumerate(inside[1::3]):
        where = x + float(rng.uniform(-1, 1))
        fan = parts.slab(where - 1.6, where + 1.6, side * 1.4, side * 2.4, _ROOF_M - 1.0, _ROOF_M - 0.1, parts.METAL)
        found.append(kept(f"fan {side:+d} {index}", "fan", fan))
        y = side * (_TUBE_M - 0.25)
        box = parts.slab(where + 2.0, where + 3.0, y - 0.22, y + 0.22, -0.1, 1.8, parts.METAL)
        found.append(kept(f"cabinet {side:+d} {index}", "cabinet", box))
        plate = parts.slab(where - 2.5, where - 1.7, side * (_TUBE_M - 0.12), side * _TUBE_M, 1.9, 2.7, parts.SIGN)
        found.append(kept(f"sign {side:+d} {index}", "sign", plate))
    return found


def _new_at_the_tunnel(mouth: float, half: float, rng: np.random.Generator) -> list[WorldObject]:
    found: list[WorldObject] = []
    for index in range(8):
        side, x = (1 if rng.random() < 0.5 else -1), float(rng.uniform(mouth + 6.0, half - 8.0))
        panels = [
            parts.slab(x + 2.0 * k, x + 2.0 * k + 1.9, side * (_TUBE_M - 0.35), side * (_TUBE_M - 0.28), 0.2, 3.0)
            for k in range(4)
        ]
        found.append(added(f"lining {index}", "lining", *panels))
    for index, x in enumerate(np.arange(mouth - 28.0, mouth - 6.0, 2.2).tolist()):
        found.append(added(f"barrier {index}", "barrier", *parts.barrier(x, 4.6, 0.0, float(rng.normal(0, 0.03)))))
    gauge = [Post(round(mouth - 14.0, 2), side * 6.4, 0.12, -0.2, 5.0, parts.METAL) for side in (1, -1)]
    beam = parts.slab(mouth - 14.1, mouth - 13.9, -6.4, 6.4, 4.7, 5.0, parts.METAL)
    return [*found, added("height gauge", "gantry", *gauge, beam)]
