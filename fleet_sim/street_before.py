"""What stands on the street before its changes: ground, buildings, walls, furniture, trees, drawn from named streams.

Everything reaches END_MARGIN_M beyond the stretch that is driven, so that no drive looks into the void.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.parts import Lot
from gnd.fleet_sim.shapes import Block, Shape
from gnd.fleet_sim.world import WorldObject

KERB_M: Final = 6.2
CROWN: Final = 0.02
PAVEMENT_M: Final = 0.03
STRIP_M: Final = 2.8
"""Width of the pavement's inner strip, which is laid in pieces that an edit can take away."""
STRETCH_M: Final = 200.0
"""One shelter and one row of bollards a side stand on every stretch of this length."""
END_MARGIN_M: Final = 60.0

_DEPTH_M: Final = 45.0
_PIECE_M: Final = 10.0


@dataclass(frozen=True, slots=True)
class StreetPlan:
    """What the seed has decided before anything is built.

    Attributes:
        half_length_m: the stretch that is driven reaches so far from the middle.
        lots: buildings of both sides in order along the street.
        gaps: (side, x0, x1) of the alleys between them.
        zone_side: the side of the street with the construction zone.
        zone_x_m: its middle along the street.
    """

    half_length_m: float
    lots: tuple[Lot, ...]
    gaps: tuple[tuple[int, float, float], ...]
    zone_side: int
    zone_x_m: float

    @property
    def end_m(self) -> float:
        """What is built reaches so far from the middle, along the street."""
        return self.half_length_m + END_MARGIN_M


def drawn_plan(half_length_m: float, rng: np.random.Generator, site: np.random.Generator) -> StreetPlan:
    """Draw the buildings of a street from one stream, and the place of its construction zone from another."""
    end_m = half_length_m + END_MARGIN_M
    lots: list[Lot] = []
    gaps: list[tuple[int, float, float]] = []
    for side in (1, -1):
        x = -end_m + float(rng.uniform(0.0, 6.0))
        while x < end_m - 8.0:
            end = x + float(rng.uniform(10.0, 18.0))
            front = 10.4 + float(rng.uniform(0.0, 0.7) if rng.random() < 0.6 else rng.uniform(2.4, 4.0))
            height, style = float(rng.uniform(5.5, 13.0)), int(rng.integers(2**31))
            lots.append(Lot(side, round(x, 2), round(end, 2), round(front, 2), round(height, 2), style, PAVEMENT_M))
            gap = float(rng.uniform(2.5, 5.0)) if rng.random() < 0.4 else 0.0
            if gap:
                gaps.append((side, round(end, 2), round(end + gap, 2)))
            x = end + gap
    zone_side = 1 if site.random() < 0.5 else -1
    zone_x = round(float(site.uniform(-12.0, 12.0)), 1)
    return StreetPlan(half_length_m, tuple(lots), tuple(gaps), zone_side, zone_x)


def _kept(name: str, kind: str, shapes: tuple[Shape, ...]) -> WorldObject:
    return WorldObject(name, kind, ("before", "after"), "kept", shapes)


def built(plan: StreetPlan, furniture: np.random.Generator, greenery: np.random.Generator) -> tuple[WorldObject, ...]:
    """Return everything that stands on the street before its changes, all of it kept."""
    return (*_ground(plan.end_m), *_buildings(plan), *_furniture(plan, furniture), *_greenery(plan.end_m, greenery))


def _ground(end_m: float) -> list[WorldObject]:
    found = []
    for side in (1, -1):
        half = _DEPTH_M / 2
        fall = {"rise_y": -side * CROWN, "reflectivity": parts.ASPHALT}
        road = Block(0.0, side * half, end_m, half, -3.0, round(-CROWN * half, 4), **fall)
        found.append(_kept(f"road {side:+d}", "road", (road,)))
        inner = KERB_M + STRIP_M
        yard = parts.slab(-end_m, end_m, side * inner, side * _DEPTH_M, -1.0, PAVEMENT_M)
        found.append(_kept(f"yard {side:+d}", "pavement", (yard,)))
        for x in np.arange(-end_m, end_m, _PIECE_M).tolist():
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


def _furniture(plan: StreetPlan, rng: np.random.Generator) -> list[WorldObject]:
    found, end_m = [], plan.end_m
    start = float(rng.uniform(10.0 - end_m, 30.0 - end_m))
    for side in (1, -1):
        for index, x in enumerate(np.arange(start + 14.0 * (side < 0), end_m - 10.0, 28.0).tolist()):
            found.append(_kept(f"lamp {side:+d} {index}", "lamp", parts.lamp(x, side * 6.75, PAVEMENT_M, side)))
        for index, x in enumerate(np.arange(18.0 - end_m, end_m - 18.0, 17.0).tolist()):
            where, width, yaw = x + float(rng.uniform(-5, 5)), float(rng.uniform(0.6, 1.1)), float(rng.normal(0, 0.15))
            plate = parts.sign(where, side * 6.85, PAVEMENT_M, width, float(rng.uniform(2.3, 2.8)), yaw)
            found.append(_kept(f"sign {side:+d} {index}", "sign", plate))
        for index, x in enumerate(np.arange(20.0 - end_m, end_m - 20.0, 33.0).tolist()):
            box = parts.cabinet(x + float(rng.uniform(-8, 8)), side * 9.7, PAVEMENT_M)
            found.append(_kept(f"cabinet {side:+d} {index}", "cabinet", box))
        found += _once_a_stretch(plan.half_length_m, side, rng)
    return found


def _once_a_stretch(half_length_m: float, side: int, rng: np.random.Generator) -> list[WorldObject]:
    """A row of bollards and a bus shelter on every stretch of a side."""
    found, stretches = [], max(1, round(2 * half_length_m / STRETCH_M))
    half = half_length_m / stretches
    for index in range(stretches):
        middle, name = (2 * index + 1 - stretches) * half, f"{side:+d}" + (f" {index}" if index else "")
        x, count = middle + float(rng.uniform(30.0 - half, half - 50.0)), int(rng.integers(5, 9))
        found.append(_kept(f"bollards {name}", "bollards", parts.bollards(x, count, side * 6.6, PAVEMENT_M)))
        x = middle + side * float(rng.uniform(half - 62.0, half - 38.0))
        found.append(_kept(f"shelter {name}", "shelter", parts.shelter(x, side * 7.7, PAVEMENT_M, side)))
    return found


def _greenery(end_m: float, rng: np.random.Generator) -> list[WorldObject]:
    found = []
    for side in (1, -1):
        for index, x in enumerate(np.arange(15.0 - end_m, end_m - 15.0, 24.0).tolist()):
            where = x + float(rng.uniform(-7.0, 7.0))
            shapes = parts.tree(where, side * 8.3, PAVEMENT_M, int(rng.integers(2**31)))
            found.append(_kept(f"tree {side:+d} {index}", "tree", shapes))
    return found
