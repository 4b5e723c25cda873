"""The seeded street of the simulations: Wangsimni-ro, Seoul, where the GND paper drove (section 7.1), about 200 m of
it.

The anchor lies on a district border (longitude index 894304 = 27947 x 32), so that the street's tiles belong to two
districts. Everything is drawn from the seed by named random streams: the same seed gives the same world to the bit,
and a change to the furniture leaves the buildings where they are.
"""

from dataclasses import dataclass
from math import radians
from typing import Final

import numpy as np

from fleet_sim import parts
from fleet_sim.errors import WorldError
from fleet_sim.parts import Lot
from fleet_sim.shapes import Block, Shape
from fleet_sim.street_edits import rebuild
from fleet_sim.world import World, WorldObject

BORDER_LON_RAD: Final = radians(894304 * 360.0 / 2**20 - 180.0)
LAT_RAD: Final = radians(37.5597)
HEIGHT_M: Final = 30.0
HALF_LENGTH_M: Final = 100.0
KERB_M: Final = 6.2
LANE_OFFSET_M: Final = 1.75
CROWN: Final = 0.02
PAVEMENT_M: Final = 0.03
STRIP_M: Final = 2.8
"""Width of the pavement's inner strip, which is laid in pieces that an edit can take away."""

_END_M: Final = 160.0
_DEPTH_M: Final = 45.0
_PIECE_M: Final = 10.0
_STREAMS: Final = ("site", "lots", "furniture", "greenery", "edits")


@dataclass(frozen=True, slots=True)
class StreetPlan:
    """What the seed has decided before anything is built.

    Attributes:
        lots: buildings of both sides in order along the street.
        gaps: (side, x0, x1) of the alleys between them.
        zone_side: the side of the street with the construction zone.
        zone_x_m: its middle along the street.
    """

    lots: tuple[Lot, ...]
    gaps: tuple[tuple[int, float, float], ...]
    zone_side: int
    zone_x_m: float


def street(seed: int) -> World:
    """Make the world of a seed.

    Args:
        seed: any integer >= 0.

    Raises:
        WorldError: the seed is negative.
    """
    if seed < 0:
        raise WorldError(f"the world seed must be >= 0, got {seed}")
    streams = {name: np.random.default_rng([seed, index]) for index, name in enumerate(_STREAMS)}
    site = streams["site"]
    heading_deg, slope = float(site.uniform(22.0, 38.0)), float(site.uniform(0.012, 0.022))
    plan = _plan(streams["lots"], site)
    base = (*_ground(), *_buildings(plan), *_furniture(streams["furniture"]), *_greenery(streams["greenery"]))
    objects = rebuild(base, plan.lots, plan.gaps, plan.zone_side, plan.zone_x_m, PAVEMENT_M, streams["edits"])
    return World(
        seed=seed,
        lat_rad=LAT_RAD,
        lon_rad=BORDER_LON_RAD + float(site.uniform(-2e-6, 2e-6)),
        height_m=HEIGHT_M,
        heading_rad=radians(heading_deg),
        slope=slope,
        crown=CROWN,
        half_length_m=HALF_LENGTH_M,
        lane_offset_m=LANE_OFFSET_M,
        kerb_m=KERB_M,
        objects=tuple(objects),
    )


def _plan(rng: np.random.Generator, site: np.random.Generator) -> StreetPlan:
    lots: list[Lot] = []
    gaps: list[tuple[int, float, float]] = []
    for side in (1, -1):
        x = -_END_M + float(rng.uniform(0.0, 6.0))
        while x < _END_M - 8.0:
            end = x + float(rng.uniform(10.0, 18.0))
            front = 10.4 + float(rng.uniform(0.0, 0.7) if rng.random() < 0.6 else rng.uniform(2.4, 4.0))
            height, style = float(rng.uniform(5.5, 13.0)), int(rng.integers(2**31))
            lots.append(Lot(side, round(x, 2), round(end, 2), round(front, 2), round(height, 2), style, PAVEMENT_M))
            gap = float(rng.uniform(2.5, 5.0)) if rng.random() < 0.4 else 0.0
            if gap:
                gaps.append((side, round(end, 2), round(end + gap, 2)))
            x = end + gap
    zone_side = 1 if site.random() < 0.5 else -1
    return StreetPlan(tuple(lots), tuple(gaps), zone_side, round(float(site.uniform(-12.0, 12.0)), 1))


def _kept(name: str, kind: str, shapes: tuple[Shape, ...]) -> WorldObject:
    return WorldObject(name, kind, ("before", "after"), "kept", shapes)


def _ground() -> list[WorldObject]:
    found = []
    for side in (1, -1):
        half = _DEPTH_M / 2
        fall = {"rise_y": -side * CROWN, "reflectivity": parts.ASPHALT}
        road = Block(0.0, side * half, _END_M, half, -3.0, round(-CROWN * half, 4), **fall)
        found.append(_kept(f"road {side:+d}", "road", (road,)))
        inner = KERB_M + STRIP_M
        yard = parts.slab(-_END_M, _END_M, side * inner, side * _DEPTH_M, -1.0, PAVEMENT_M)
        found.append(_kept(f"yard {side:+d}", "pavement", (yard,)))
        for x in np.arange(-_END_M, _END_M, _PIECE_M).tolist():
            piece = parts.slab(x, x + _PIECE_M, side * KERB_M, side * inner, -1.0, PAVEMENT_M)
            found.append(_kept(f"pavement {side:+d} {x:+.0f}", "pavement", (piece,)))
    return found


def _buildings(plan: StreetPlan) -> list[WorldObject]:
    found = []
    for index, lot in enumerate(plan.lots):
        found.append(_kept(f"building {index}", "building", parts.building(lot)))
        if lot.front_m > 12.0:
            height = 0.9 + 0.9 * (lot.style % 1000) / 1000
            y = lot.side * 10.35
            found.append(
                _kept(f"wall {index}", "wall", parts.wall(lot.x0_m + 0.3, lot.x1_m - 2.5, y, height, PAVEMENT_M))
            )
    for index, (side, x0, x1) in enumerate(plan.gaps):
        depth = 11.5 + 1.7 * (index % 5)
        back = parts.wall(x0 - 0.2, x1 + 0.2, side * depth, 2.2, PAVEMENT_M)
        found.append(_kept(f"alley {index}", "wall", back))
    return found


def _furniture(rng: np.random.Generator) -> list[WorldObject]:
    found, start = [], float(rng.uniform(-150.0, -130.0))
    for side in (1, -1):
        for index, x in enumerate(np.arange(start + 14.0 * (side < 0), 150.0, 28.0).tolist()):
            found.append(_kept(f"lamp {side:+d} {index}", "lamp", parts.lamp(x, side * 6.75, PAVEMENT_M, side)))
        for index, x in enumerate(np.arange(-142.0, 142.0, 17.0).tolist()):
            where, width, yaw = x + float(rng.uniform(-5, 5)), float(rng.uniform(0.6, 1.1)), float(rng.normal(0, 0.15))
            plate = parts.sign(where, side * 6.85, PAVEMENT_M, width, float(rng.uniform(2.3, 2.8)), yaw)
            found.append(_kept(f"sign {side:+d} {index}", "sign", plate))
        for index, x in enumerate(np.arange(-140.0, 140.0, 33.0).tolist()):
            box = parts.cabinet(x + float(rng.uniform(-8, 8)), side * 9.7, PAVEMENT_M)
            found.append(_kept(f"cabinet {side:+d} {index}", "cabinet", box))
        row = parts.bollards(float(rng.uniform(-70, 50)), int(rng.integers(5, 9)), side * 6.6, PAVEMENT_M)
        found.append(_kept(f"bollards {side:+d}", "bollards", row))
        stop = parts.shelter(side * float(rng.uniform(38, 62)), side * 7.7, PAVEMENT_M, side)
        found.append(_kept(f"shelter {side:+d}", "shelter", stop))
    return found


def _greenery(rng: np.random.Generator) -> list[WorldObject]:
    found = []
    for side in (1, -1):
        for index, x in enumerate(np.arange(-145.0, 145.0, 24.0).tolist()):
            where = x + float(rng.uniform(-7.0, 7.0))
            shapes = parts.tree(where, side * 8.3, PAVEMENT_M, int(rng.integers(2**31)))
            found.append(_kept(f"tree {side:+d} {index}", "tree", shapes))
    return found
