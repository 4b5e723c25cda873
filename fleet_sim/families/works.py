"""Families of busy places: the car park with its delivery zone, a street full of works, the roundabout."""

from collections.abc import Iterator
from dataclasses import replace
from math import cos, pi, sin, tau
from typing import Final

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.families.site import (
    FamilyPlace,
    FamilySite,
    added,
    crown_shapes,
    fence_shapes,
    glass_fronts,
    kept,
    middle_of,
    moved,
    moved_fronts,
    out_of_the_lanes,
    removed,
    reshaped,
    turned_block,
)
from gnd.fleet_sim.shapes import Block, Post, Shape
from gnd.fleet_sim.street_before import KERB_M, PAVEMENT_M
from gnd.fleet_sim.world import Bay, WorldObject

_BAY_M: Final = 2.6
_ROWS_M: Final = (11.2, 18.5, 24.0)
_MARKET_M: Final = 33.0
_KERB_BAY_M: Final = 6.2
_RING_M: Final = 9.0
"""Lanes swing out by so much around the island."""
_ISLAND_M: Final = 7.0


def car_park(site: FamilySite) -> FamilyPlace:
    """A market's car park on the left, a street with a delivery zone on the right.

    Cars and vans stand in bays, drawn anew for every drive: they change between drives, not between the states of the
    map. What truly changes on the left: shelters of trolleys, charging posts, lamps, islands, recycling containers in
    bays.
    """
    rng = site.rng
    plan = replace(moved_fronts(site.plan, lambda lot: _MARKET_M if lot.side > 0 else lot.front_m), zone_side=-1)
    plan = replace(plan, gaps=tuple(gap for gap in plan.gaps if gap[0] < 0))

    def right_only(o: WorldObject) -> WorldObject | None:
        left = middle_of(o)[1] > 0 and o.kind in ("wall", "tree", "cabinet", "shelter", "bollards")
        return None if left else o

    objects = [o for o in site.street(plan, right_only) if not (o.edit == "added" and 0 < middle_of(o)[1] < 30.0)]
    objects += _lot_furniture(plan.half_length_m, rng)
    objects += glass_fronts(objects, plan, 0.5, rng)
    place = FamilyPlace(tuple(objects), kerb_parking=False, bays=tuple(_bays(plan.half_length_m, rng)), parking=0.6)
    return replace(place, objects=out_of_the_lanes(place.objects, place))


def _bays(half_m: float, rng: np.random.Generator) -> Iterator[Bay]:
    for y in _ROWS_M:
        for index, x in enumerate(np.arange(-half_m, half_m, _BAY_M).tolist()):
            if index % 9 != 8:
                yield Bay(round(x, 2), y, round(pi / 2 * (1 if rng.random() < 0.5 else -1), 4))
    zone = float(rng.uniform(-0.5, 0.3)) * half_m
    for x in np.arange(-half_m, half_m, _KERB_BAY_M).tolist():
        yield Bay(round(x, 2), -(KERB_M - 1.05), 0.0, van=zone <= x <= zone + 30.0)


def _lot_furniture(half_m: float, rng: np.random.Generator) -> list[WorldObject]:
    found: list[WorldObject] = []
    for index, x in enumerate(np.arange(8 * _BAY_M - half_m, half_m, 9 * _BAY_M).tolist()):
        middle = x + _BAY_M / 2 - 1.3
        for row, y in enumerate(_ROWS_M):
            name = f"{index} {row}"
            island = kept(
                f"island {name}", "island", parts.slab(middle - 0.9, middle + 0.9, y - 2.3, y + 2.3, -0.3, 0.18)
            )
            mast = kept(f"mast {name}", "lamp", *parts.lamp(middle, y, 0.0, -1))
            trolleys = _trolleys(middle, y + 0.6)
            draw = rng.random()
            found += [*moved(mast, 0.0, 1.2)] if draw < 0.2 else ([removed(mast)] if draw < 0.3 else [mast])
            found.append(added(island.name, "island", *island.shapes) if rng.random() < 0.15 else island)
            if rng.random() < 0.4:
                shelter = kept(f"trolleys {name}", "shelter", *trolleys)
                found.append(added(shelter.name, "shelter", *trolleys) if rng.random() < 0.5 else removed(shelter))
    for index in range(4):
        x = round(float(rng.uniform(15.0 - half_m, half_m - 15.0)), 2)
        posts = [Post(round(x + _BAY_M * k, 2), 8.3, 0.15, -0.2, 1.5, parts.METAL) for k in range(4)]
        found.append(added(f"charging {index}", "charging", *posts))
    for index in range(2):
        box = parts.container(float(rng.uniform(20.0 - half_m, half_m - 20.0)), _ROWS_M[0], 0.0, pi / 2, 4.0)
        found.append(added(f"recycling {index}", "container", *box))
    return found


def _trolleys(x: float, y: float) -> tuple[Shape, ...]:
    """A shelter for trolleys: roof on four posts, rails at the sides."""
    posts = [Post(parts.rounded(x + dx), parts.rounded(y + dy), 0.04, 0.0, 2.2, parts.METAL)
             for dx in (-0.8, 0.8) for dy in (-1.5, 1.5)]  # fmt: skip
    rails = [parts.slab(x + dx - 0.02, x + dx + 0.02, y - 1.5, y + 1.5, 0.4, 0.8, parts.METAL) for dx in (-0.8, 0.8)]
    return (*posts, *rails, parts.slab(x - 0.9, x + 0.9, y - 1.6, y + 1.6, 2.2, 2.3, parts.METAL))


def construction(site: FamilySite) -> FamilyPlace:
    """The usual street with works all along: fences that rays pass, containers, excavators, spoil, pipes, barriers."""
    rng, plan = site.rng, site.plan
    objects = list(site.street())
    x, number = 12.0 - plan.half_length_m, 0
    while x < plan.half_length_m - 12.0:
        side, length = (1 if rng.random() < 0.5 else -1), float(rng.uniform(14.0, 24.0))
        if abs(x + length / 2 - plan.zone_x_m) > 28.0 or side != plan.zone_side:
            objects += _works(number, x, x + length, side, rng)
        x, number = x + length + float(rng.uniform(3.0, 9.0)), number + 1
    objects += glass_fronts(objects, plan, 0.2, rng)
    place = FamilyPlace(tuple(objects))
    return replace(place, objects=out_of_the_lanes(place.objects, place))


def _works(number: int, x0: float, x1: float, side: int, rng: np.random.Generator) -> list[WorldObject]:
    """One site: a fence towards the road, and machines and material behind it."""
    near, name = side * 4.6, f"site {number}"
    found = [added(f"{name} fence", "fence", *fence_shapes(x0, x1, near, 2.0, 9))]
    middle = float(rng.uniform(x0 + 4.0, x1 - 4.0))
    found.append(
        added(f"{name} excavator", "excavator", *_excavator(middle, side * 7.6, float(rng.uniform(0, tau)), rng))
    )
    kind = int(rng.integers(4))
    if kind == 0:
        box = parts.container(x0 + 3.2, side * 8.0, PAVEMENT_M, float(rng.normal(0.0, 0.06)))
        found.append(added(f"{name} container", "container", *box))
    elif kind == 1:
        found.append(
            added(f"{name} spoil", "heap", *parts.heap(x1 - 2.5, side * 7.8, PAVEMENT_M, float(rng.uniform(2, 3.4))))
        )
    elif kind == 2:
        pipes = [
            parts.slab(x0 + 1.0, x0 + 7.0, side * (7.0 + 0.55 * k), side * (7.5 + 0.55 * k), 0.0, 0.5) for k in range(3)
        ]
        found.append(added(f"{name} pipes", "pipes", *pipes))
    else:
        for k, at in enumerate(np.arange(x0, x1, 2.3).tolist()):
            found.append(
                added(
                    f"{name} barrier {k}", "barrier", *parts.barrier(at, side * 5.0, -0.1, float(rng.normal(0, 0.04)))
                )
            )
    return found


def _excavator(x: float, y: float, yaw: float, rng: np.random.Generator) -> tuple[Shape, ...]:
    """Tracks, a turned body with a cab, and a bent boom of three pieces down to its bucket."""
    c, s = cos(yaw), sin(yaw)
    found: list[Shape] = [turned_block(x, y + dy, (2.6, 0.45), (0.0, 0.7), 0.0) for dy in (-0.75, 0.75)]
    found.append(turned_block(x, y, (2.3, 1.7), (0.75, 1.7), yaw))
    found.append(turned_block(x + 0.4 * c - 0.45 * s, y + 0.4 * s + 0.45 * c, (1.0, 0.8), (1.7, 2.6), yaw))
    reach, top = float(rng.uniform(0.9, 1.2)), float(rng.uniform(2.6, 3.4))
    for k, (out, low, high) in enumerate(((1.4, 1.4, 2.2), (2.2, 2.0, top), (3.0, 0.3, top - 0.4))):
        along = out * reach
        found.append(turned_block(x + along * c, y + along * s, (0.9 if k < 2 else 0.5, 0.3), (low, high), yaw))
    return tuple(found)


def roundabout(site: FamilySite) -> FamilyPlace:
    """A road that swings around an island with bushes and a mast, houses and shop windows around it, four corners.

    Edits beside those of the street: the island is planted anew and gets a sculpture, islands between the lanes come,
    signs of the ring move.
    """
    rng = site.rng
    side = 1 if rng.random() < 0.5 else -1
    zone_x = side * max(52.0, 0.6 * site.plan.half_length_m)
    plan = moved_fronts(site.plan, lambda lot: max(lot.front_m, 19.0) if abs(lot.x_m) < 34.0 else lot.front_m)
    plan = replace(plan, zone_x_m=zone_x, gaps=tuple(gap for gap in plan.gaps if abs(gap[1]) > 40.0))

    def off_the_ring(o: WorldObject) -> WorldObject | None:
        if o.kind in ("road", "pavement"):
            return None
        low = min(shape.bounds()[0] for shape in o.shapes)
        high = max(shape.bounds()[2] for shape in o.shapes)
        return None if o.kind != "building" and low < 27.0 and high > -27.0 else o

    objects = [o for o in site.street(plan, off_the_ring) if o.kind != "pavement"]
    flat = Block(0.0, 0.0, site.end_m, 45.0, -3.0, 0.0, reflectivity=parts.ASPHALT)
    objects += [kept("ground", "road", flat), *_ring(rng), *glass_fronts(objects, plan, 0.3, rng)]
    place = FamilyPlace(
        tuple(objects), crown=0.0, bulge_m=_RING_M, bulge_half_m=26.0, kerb_parking=False, cruise_mps=6.5
    )
    return replace(place, objects=out_of_the_lanes(place.objects, place))


def _ring(rng: np.random.Generator) -> list[WorldObject]:
    found = [
        kept("island", "island", Post(0.0, 0.0, _ISLAND_M, -0.5, 0.15, parts.CONCRETE)),
        added(
            "sculpture", "sculpture", turned_block(1.5, 0.5, (1.6, 1.2), (0.0, 2.6), 0.5), Post(1.5, 0.5, 0.3, 2.6, 4.2)
        ),
    ]
    for index, angle in enumerate(np.arange(0.4, tau, tau / 8).tolist()):
        away, half = float(rng.uniform(3.2, 5.6)), float(rng.uniform(0.45, 0.8))
        x, y = away * cos(angle), away * sin(angle)
        bush = kept(f"ring bush {index}", "bush", *crown_shapes(x, y, half, (half, half), 40, rng))
        turn = index % 4
        found += [removed(bush)] if turn == 0 else (list(moved(bush, 0.5, 0.4)) if turn == 1 else [bush])
    for index, angle in enumerate(np.arange(pi / 4, tau, pi / 2).tolist()):
        x, y = 17.5 * cos(angle), 17.5 * sin(angle)
        plate = kept(f"ring sign {index}", "sign", *parts.sign(x, y, 0.0, 0.9, 2.3, angle))
        found += list(moved(plate, 0.8, -0.6)) if index % 2 else [plate]
        lamp = kept(f"ring lamp {index}", "lamp", *parts.lamp(x + 1.5, y, 0.0, 1 if y > 0 else -1))
        found.append(lamp)
        found.append(kept(f"corner wall {index}", "wall", *parts.wall(x - 3.0, x + 3.0, y * 1.22, 1.1, 0.0)))
    found += [
        *reshaped(*_kerb_stones(-21.0)),
        added("divider", "island", parts.slab(22.0, 30.0, -0.3, 0.3, -0.2, 0.35)),
    ]
    return found


def _kerb_stones(x: float) -> tuple[WorldObject, Shape]:
    """The divider before the ring, low before and higher after."""
    low = kept("kerb stones", "island", parts.slab(x - 7.0, x, -0.3, 0.3, -0.2, 0.22))
    return low, parts.slab(x - 7.0, x, -0.3, 0.3, -0.2, 0.7)
