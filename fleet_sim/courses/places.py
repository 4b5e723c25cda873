"""The places of the hard cases, each made from a seed: a street and what becomes of it, a field, a tunnel, a ring."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import pi, radians, tau
from typing import Final

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.courses.company import keeping, van
from gnd.fleet_sim.courses.course import CoursePlace
from gnd.fleet_sim.courses.foliage import Leaves, crown, hedge
from gnd.fleet_sim.courses.path import Path, lane, smoothed
from gnd.fleet_sim.courses.terrain import LEVEL, TerrainGround, TerrainProfile, raised
from gnd.fleet_sim.parts import Lot
from gnd.fleet_sim.shapes import Block, Post, Shape
from gnd.fleet_sim.street import BORDER_LON_RAD, HEIGHT_M, LANE_OFFSET_M, LAT_RAD, StreetOptions, street
from gnd.fleet_sim.street_before import KERB_M, PAVEMENT_M
from gnd.fleet_sim.world import STATES, Edit, State, World, WorldObject
from gnd.gnd_map.arrays import F64

LENGTH_M: Final = 160.0
_FEW_EDITS: Final = 0.15
"""Share of a street's usual edits where the case is about something else."""
_ROWS_M: Final = (-23.5, -12.5, -7.5, 3.5, 8.5, 19.5)
"""Rows of a car park, with aisles of 6 m at -18, -2 and 14 m."""
_TAKEN: Final = 0.65
"""Share of its slots that are taken."""
_MARGIN_M: Final = 4.0
_MAPPED_BEHIND_M: Final = 15.5
_OTHER_STREET: Final = 500_000_000
"""The rebuilt third comes from the street of another seed."""


def place_of(name: str, seed: int, length_m: float = LENGTH_M) -> CoursePlace:
    """Make a place.

    Args:
        name: one of `PLACES`.
        seed: any integer >= 0.
        length_m: of what is driven, roughly.
    """
    return PLACES[name](seed, length_m)


def _rng(seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng([seed, 0xC0125E, stream])


def _on_street(
    name: str, world: World, profile: TerrainProfile, foliage: Mapping[State, tuple[Leaves, ...]]
) -> CoursePlace:
    """A place whose right lane is driven along the street and that was mapped in both lanes."""
    reach = world.half_length_m - _MARGIN_M
    driven = lane(-reach, reach, -LANE_OFFSET_M, _rng(world.seed, 0))
    ends = np.linspace(-reach, reach, round(2 * reach))
    surveys = tuple(Path(np.stack([ends, np.full(len(ends), y)], axis=1)) for y in (-LANE_OFFSET_M, LANE_OFFSET_M))
    return CoursePlace(name, world, TerrainGround(profile, world.crown), driven, surveys, foliage)


def _street(seed: int, length_m: float) -> CoursePlace:
    return _on_street("street", street(seed, StreetOptions(length_m, edit_share=_FEW_EDITS)), LEVEL, {})


def _followed(seed: int, length_m: float) -> CoursePlace:
    """The street, mapped by a vehicle that drove behind a van and did not take it out of its scans."""
    return replace(_street(seed, length_m), name="followed", mapped_behind=(keeping(van(), _MAPPED_BEHIND_M),))


def _rebuilt(seed: int, length_m: float) -> CoursePlace:
    """The street, a third of which has been torn down and built anew."""
    world = street(seed, StreetOptions(length_m, edit_share=_FEW_EDITS))
    other = street(seed + _OTHER_STREET, StreetOptions(length_m, edit_share=0.0))
    x0 = float(_rng(seed, 1).uniform(-0.4, 0.06)) * length_m
    return _on_street("street", grafted(world, other, x0, x0 + length_m / 3), LEVEL, {})


def grafted(world: World, other: World, x0_m: float, x1_m: float) -> World:
    """Return a world whose state after holds, between two places, what stands there in another world.

    What had been edited is left as it is, ground stays.
    """
    found = []
    for o in world.objects:
        gone = o.edit == "kept" and o.kind not in ("road", "pavement") and x0_m <= _middle_m(o) < x1_m
        found.append(replace(o, states=("before",), edit="removed") if gone else o)
    found += [
        WorldObject(f"rebuilt {o.name}", o.kind, ("after",), "added", o.shapes)
        for o in other.in_state("after")
        if o.kind not in ("road", "pavement") and x0_m <= _middle_m(o) < x1_m
    ]
    return replace(world, objects=tuple(found))


def _middle_m(o: WorldObject) -> float:
    bounds = np.array([shape.bounds() for shape in o.shapes])
    return 0.5 * float(bounds[:, 0].min() + bounds[:, 2].max())


def _hill(seed: int, length_m: float) -> CoursePlace:
    """The street over a hill: level, 8 % up, a crest, 6 % down. The street itself rises by some 2 % more."""
    world = street(seed, StreetOptions(length_m, edit_share=_FEW_EDITS))
    third = length_m / 6
    profile = TerrainProfile((-1.7 * third, 0.6 * third), (-world.slope, 0.08 - world.slope, -0.06 - world.slope))
    return _on_street("hill", raised(world, profile), profile, {})


def _avenue(seed: int, length_m: float) -> CoursePlace:
    """A street without houses near the road: crowns in rows, hedges before them, houses far behind the leaves.

    In the state after, the leaves have grown and some of the trees are gone.
    """
    world, rng = street(seed, StreetOptions(length_m, edit_share=0.0)), _rng(seed, 2)
    end = world.half_length_m + 55.0
    objects = [o for o in world.objects if o.kind in ("road", "pavement", "lamp", "sign")]
    before, after = list[Leaves](), list[Leaves]()
    for side in (1, -1):
        for index, about in enumerate(np.arange(-end, end, 8.0).tolist()):
            x, y = about + float(rng.uniform(-0.5, 0.5)), side * 8.0
            felled, leaves = rng.random() < 0.1, crown(x, y, PAVEMENT_M, rng, float(rng.uniform(0.7, 1.6)))
            trunk = (Post(x, y, float(rng.uniform(0.12, 0.2)), -0.2, 4.0, 0.25),)
            states: tuple[State, ...] = ("before",) if felled else STATES
            edit: Edit = "removed" if felled else "kept"
            objects.append(WorldObject(f"trunk {side:+d} {index}", "tree", states, edit, trunk))
            before.append(leaves)
            after += [] if felled else [_grown(leaves, 1.15)]
        for x in np.arange(-end, end, 14.0).tolist():
            row = hedge(x + 1.0, x + 13.0, side * 10.5, PAVEMENT_M, rng, float(rng.uniform(2.0, 4.0)))
            before.append(row)
            after.append(_grown(row, 1.1))
        for index, x in enumerate(np.arange(-end, end - 14.0, 38.0).tolist()):
            lot = Lot(side, x, x + 14.0, float(rng.uniform(20.0, 28.0)), 8.0, int(rng.integers(2**31)), PAVEMENT_M)
            objects.append(WorldObject(f"house {side:+d} {index}", "building", STATES, "kept", parts.building(lot)))
    leafy: dict[State, tuple[Leaves, ...]] = {"before": tuple(before), "after": tuple(after)}
    return _on_street("avenue", replace(world, objects=tuple(objects)), LEVEL, leafy)


def _grown(leaves: Leaves, factor: float) -> Leaves:
    """Return leaves that have grown; a hedge not along its row."""
    along = 1.0 if leaves.box else factor
    return replace(
        leaves,
        half_x_m=leaves.half_x_m * along,
        half_y_m=leaves.half_y_m * factor,
        half_z_m=leaves.half_z_m * factor,
    )


def _field(seed: int, length_m: float) -> CoursePlace:
    """A road through open country: ground, delineator posts, a few trees, pieces of hedge and a barn far off."""
    rng, half = _rng(seed, 3), length_m / 2
    objects = _open_ground(half + 90.0, 90.0)
    for index, x in enumerate(np.arange(-half - 40.0, half + 40.0, 50.0).tolist()):
        for side in (1, -1):
            post = (Post(x + float(rng.uniform(-1, 1)), side * 5.0, 0.06, -0.2, 1.0, 0.5),)
            objects.append(WorldObject(f"delineator {side:+d} {index}", "bollards", STATES, "kept", post))
    leaves = []
    for index in range(8):
        x, y = float(rng.uniform(-half - 40, half + 40)), float(rng.choice((-1, 1)) * rng.uniform(16.0, 60.0))
        objects.append(WorldObject(f"trunk {index}", "tree", STATES, "kept", (Post(x, y, 0.2, -0.2, 4.0, 0.25),)))
        leaves.append(crown(x, y, 0.0, rng, 1.2))
    for x in np.linspace(-half - 20.0, half, 4).tolist():
        y = float(rng.choice((-1, 1)) * rng.uniform(12.0, 26.0))
        leaves.append(hedge(x, x + float(rng.uniform(8.0, 16.0)), y, 0.0, rng, 3.0))
    side = 1 if rng.random() < 0.5 else -1
    x = float(rng.uniform(-half, half))
    lot = Lot(side, x - 11.0, x + 11.0, float(rng.uniform(35.0, 60.0)), 7.0, int(rng.integers(2**31)), 0.0)
    objects.append(WorldObject("barn", "building", STATES, "kept", parts.building(lot)))
    both: dict[State, tuple[Leaves, ...]] = {"before": tuple(leaves), "after": tuple(leaves)}
    return _on_street("field", _world(seed, half, 0.01, objects), LEVEL, both)


def _tunnel(seed: int, length_m: float) -> CoursePlace:
    """A street that runs into a smooth tunnel, two thirds of the way long, and out again."""
    world = street(seed, StreetOptions(length_m, edit_share=0.0))
    inside = length_m / 3
    objects = [o for o in world.objects if o.kind == "road" or abs(_middle_m(o)) > inside + 10.0]
    objects = [o for o in objects if not o.name.startswith("yard")]
    for side in (1, -1):
        wall = parts.slab(-inside, inside, side * (KERB_M - 0.2), side * (KERB_M + 0.8), -1.0, 5.6)
        objects.append(WorldObject(f"tunnel wall {side:+d}", "wall", STATES, "kept", (wall,)))
    roof = parts.slab(-inside, inside, -KERB_M - 0.8, KERB_M + 0.8, 5.2, 6.4)
    objects.append(WorldObject("tunnel roof", "wall", STATES, "kept", (roof,)))
    return _on_street("tunnel", replace(world, objects=tuple(objects)), LEVEL, {})


def _roundabout(seed: int, length_m: float) -> CoursePlace:
    """A ring of 13 m about an island with bushes, houses around; in from the west, three quarters round, out north."""
    rng, half = _rng(seed, 5), max(length_m / 2, 60.0)
    objects = _open_ground(half + 60.0, half + 60.0)
    island = (Post(0.0, 0.0, 8.0, -0.5, 0.15, 0.3), Post(0.0, 0.0, 0.1, 0.0, 5.0, 0.25))
    objects.append(WorldObject("island", "pavement", STATES, "kept", island))
    leaves = tuple(_bush(rng.uniform(2.0, 6.0) * _unit(angle), rng) for angle in np.arange(0.3, tau, 1.2).tolist())
    for quarter in range(4):
        objects += _corner(quarter, rng)
    both: dict[State, tuple[Leaves, ...]] = {"before": leaves, "after": leaves}
    angle = np.linspace(pi + 0.35, tau + pi / 2 - 0.35, 60)
    ring = 13.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    reach = half - 20.0
    corners = np.concatenate([[[-reach, -1.75], [-16.0, -2.5]], ring, [[1.75, 17.0], [1.75, reach]]])
    driven = smoothed(corners, 3.0)
    around = np.linspace(0.0, tau, 90, endpoint=False)
    circle = Path(13.0 * np.stack([np.cos(around), np.sin(around)], axis=1))
    world = _world(seed, half, 0.0, objects)
    return CoursePlace("roundabout", world, TerrainGround(LEVEL, 0.0), driven, (driven.shifted(0.5), circle), both)


def _bush(place_m: F64, rng: np.random.Generator) -> Leaves:
    """A bush on the island: the upper half of a crown."""
    return crown(float(place_m[0]), float(place_m[1]), -3.2, rng, 2.0)


def _corner(quarter: int, rng: np.random.Generator) -> list[WorldObject]:
    """The houses and signs between two arms of a roundabout."""
    found, c, s = [], *_unit(quarter * pi / 2).round()
    for index in range(4):
        along, across = (16.0 + 14.0 * index, 14.0) if index < 3 else (24.0, 36.0)
        x, y, high = along + rng.uniform(-1, 1), across + rng.uniform(-1, 2), float(rng.uniform(5.0, 10.0))
        half_x, half_y = rng.uniform(4.0, 6.0), rng.uniform(3.0, 5.0)
        bay = rng.uniform(0.3, 0.8)
        body = _turned(x, y + half_y, half_x, half_y, high, c, s)
        front = _turned(x + rng.uniform(-2, 2), y - bay / 2, rng.uniform(0.8, 1.6), bay / 2, high - 1.5, c, s)
        found.append(WorldObject(f"house {quarter} {index}", "building", STATES, "kept", (body, front)))
    x, y = c * 17.0 - s * 8.5, s * 17.0 + c * 8.5
    plate = parts.sign(float(x), float(y), 0.0, 0.8, 2.4, float(rng.uniform(0, pi)))
    found.append(WorldObject(f"sign {quarter}", "sign", STATES, "kept", plate))
    return found


def _turned(x: float, y: float, half_x: float, half_y: float, high: float, c: float, s: float) -> Block:
    """A house given in the frame of its corner, turned by quarters."""
    swap = abs(s) > 0.5
    size = (half_y, half_x) if swap else (half_x, half_y)
    return Block(float(c * x - s * y), float(s * x + c * y), float(size[0]), float(size[1]), -0.5, high)


def _car_park(seed: int, length_m: float) -> CoursePlace:
    """Rows of parked cars, most of them others than when the map was made; few things stay."""
    rng, half = _rng(seed, 6), max(length_m / 4, 30.0)
    objects = _open_ground(half + 60.0, 80.0)
    lot = Lot(1, -half - 10.0, half + 10.0, 32.0, 8.0, int(rng.integers(2**31)), 0.0)
    objects.append(WorldObject("market", "building", STATES, "kept", parts.building(lot)))
    fence = hedge(-half - 12.0, half + 12.0, -30.0, 0.0, rng, 3.0)
    for index, x in enumerate(np.arange(-half, half + 1.0, 20.0).tolist()):
        for row, y in enumerate((-10.0, 6.0)):
            mast = parts.lamp(x, y, 0.0, 1)
            objects.append(WorldObject(f"lamp {row} {index}", "lamp", STATES, "kept", mast))
    for row, y in enumerate(_ROWS_M):
        for index, x in enumerate(np.arange(-half, half, 2.6).tolist()):
            objects += _slot(f"car {row} {index}", x, y, rng)
    end, turn = half + 4.0, half + 8.0
    out, back = [[-end, -18.0], [end, -18.0], [turn, -10.0]], [[end, -2.0], [-end, -2.0], [-turn, 6.0]]
    driven = smoothed(np.array([*out, *back, [-end, 14.0], [end, 14.0]]), 4.0)
    both: dict[State, tuple[Leaves, ...]] = {"before": (fence,), "after": (fence,)}
    world = _world(seed, half, 0.0, objects)
    return CoursePlace("car_park", world, TerrainGround(LEVEL, 0.0), driven, (driven.shifted(0.3),), both)


def _slot(name: str, x: float, y: float, rng: np.random.Generator) -> list[WorldObject]:
    """The cars that stand in a slot of a car park before and after, each state with its own, often none."""
    found = []
    states: tuple[tuple[State, Edit], ...] = (("before", "removed"), ("after", "added"))
    for state, edit in states:
        yaw = float(rng.choice((-1.0, 1.0)) * pi / 2 + rng.normal(0.0, radians(2.0)))
        shapes = parts.car(x + rng.normal(0.0, 0.12), y + rng.normal(0.0, 0.2), 0.0, yaw, int(rng.integers(2**31)))
        if rng.random() < _TAKEN:
            found.append(WorldObject(f"{name} {state}", "car", (state,), edit, shapes))
    return found


def _open_ground(half_x_m: float, half_y_m: float) -> list[WorldObject]:
    ground: tuple[Shape, ...] = (Block(0.0, 0.0, half_x_m, half_y_m, -3.0, 0.0, reflectivity=parts.ASPHALT),)
    return [WorldObject("ground", "road", STATES, "kept", ground)]


def _world(seed: int, half_m: float, slope: float, objects: list[WorldObject]) -> World:
    """A world of its own making where the street of the simulations lies."""
    heading = float(_rng(seed, 7).uniform(0.0, tau))
    return World(
        seed=seed,
        lat_rad=LAT_RAD,
        lon_rad=BORDER_LON_RAD,
        height_m=HEIGHT_M,
        heading_rad=heading,
        slope=slope,
        crown=0.0,
        half_length_m=half_m,
        lane_offset_m=LANE_OFFSET_M,
        kerb_m=KERB_M,
        objects=tuple(objects),
    )


def _unit(angle_rad: float) -> F64:
    return np.array([np.cos(angle_rad), np.sin(angle_rad)])


PLACES: Final[Mapping[str, Callable[[int, float], CoursePlace]]] = {
    "street": _street,
    "followed": _followed,
    "rebuilt": _rebuilt,
    "hill": _hill,
    "avenue": _avenue,
    "field": _field,
    "tunnel": _tunnel,
    "roundabout": _roundabout,
    "car_park": _car_park,
}
"""Places by the names that cases use; "rebuilt" has the state before, and so the map, of "street"."""
