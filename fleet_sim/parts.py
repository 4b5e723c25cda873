"""Things found on a street, each as a function from a few numbers to primitives (street frame, metres).

`side` is +1 for the left side of the street (y > 0) and -1 for the right. Fronts look at the road.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import cos, sin

import numpy as np

from gnd.fleet_sim.shapes import Ball, Block, Post, Shape

ASPHALT, CONCRETE, PLASTER, METAL, LEAF, SIGN = 0.15, 0.3, 0.4, 0.25, 0.45, 0.9
"""Diffuse reflectivities at 905 nm of the materials used here (typical values of rangefinder data sheets)."""

STOREY_M = 3.0
DEPTH_M = 10.0


@dataclass(frozen=True, slots=True)
class Lot:
    """A building's place and looks.

    Attributes:
        side: +1 left of the street, -1 right.
        x0_m, x1_m: extent along the street.
        front_m: distance of the front from the middle of the road.
        height_m: height of the eaves.
        style: seed of the relief.
        base_m: height of the ground there.
    """

    side: int
    x0_m: float
    x1_m: float
    front_m: float
    height_m: float
    style: int
    base_m: float

    @property
    def x_m(self) -> float:
        """Middle of the lot along the street."""
        return 0.5 * (self.x0_m + self.x1_m)


def rounded(value: float) -> float:
    """Return a length rounded to the millimetre, so that world files stay short."""
    return round(float(value), 3)


def slab(
    x0: float,
    x1: float,
    y0: float,
    y1: float,
    z0: float,
    z1: float,
    reflectivity: float = CONCRETE,
    rise_y: float = 0.0,
) -> Block:
    """Return an upright block from its faces; with `rise_y`, z1 is the height of its middle."""
    x, y = rounded((x0 + x1) / 2), rounded((y0 + y1) / 2)
    half_x, half_y = rounded(abs(x1 - x0) / 2), rounded(abs(y1 - y0) / 2)
    return Block(x, y, half_x, half_y, rounded(z0), rounded(z1), rise_y=rise_y, reflectivity=reflectivity)


def building(lot: Lot) -> tuple[Shape, ...]:
    """Return a building: body, pilasters, cornices, bands, balconies and a door step, drawn from its style."""
    rng = np.random.default_rng(lot.style)
    bays = max(2, round((lot.x1_m - lot.x0_m) / rng.uniform(2.4, 3.6)))
    edges = np.linspace(lot.x0_m, lot.x1_m, bays + 1)
    storeys = max(1, int((lot.height_m - 0.5) // STOREY_M))
    relief, pillar = rng.uniform(0.12, 0.35), rng.uniform(0.3, 0.7)
    body = _before_front(lot, lot.x0_m, lot.x1_m, -DEPTH_M, 0.0, -0.5, lot.height_m)
    parts: list[Shape] = [body]
    for x in edges:
        low, high = max(lot.x0_m, x - pillar / 2), min(lot.x1_m, x + pillar / 2)
        parts.append(_before_front(lot, low, high, 0.0, relief, -0.2, lot.height_m))
    for storey in range(1, storeys + 1):
        z, out = storey * STOREY_M, relief + rng.uniform(0.05, 0.25)
        parts.append(_before_front(lot, lot.x0_m, lot.x1_m, 0.0, out, z - 0.25, z + 0.1))
        for left, right in pairwise(edges):
            if storey < storeys and rng.random() < 0.25:
                parts.append(_before_front(lot, left + 0.3, right - 0.3, 0.0, 1.1, z + 0.1, z + 1.1))
    door = int(rng.integers(bays))
    parts.append(_before_front(lot, edges[door] + 0.4, edges[door + 1] - 0.4, 0.0, relief + 0.5, -0.1, 0.3))
    return tuple(parts)


def _before_front(lot: Lot, x0: float, x1: float, out0: float, out1: float, z0: float, z1: float) -> Block:
    """Return a block that stands out of a lot's front by out0 … out1, at heights above its ground."""
    y0, y1 = lot.side * (lot.front_m - out0), lot.side * (lot.front_m - out1)
    return slab(x0, x1, y0, y1, lot.base_m + z0, lot.base_m + z1, PLASTER)


def wall(x0: float, x1: float, y: float, height: float, base: float, thickness: float = 0.3) -> tuple[Shape, ...]:
    """Return a wall along the street with a pillar every 3 m."""
    panel = slab(x0, x1, y - thickness / 2, y + thickness / 2, base - 0.2, base + height)
    count = max(1, round((x1 - x0) / 3))
    pillars = [
        slab(x - 0.2, x + 0.2, y - thickness / 2 - 0.1, y + thickness / 2 + 0.1, base - 0.2, base + height + 0.15)
        for x in np.linspace(x0 + 0.2, x1 - 0.2, count + 1)
    ]
    return (panel, *pillars)


def tree(x: float, y: float, base: float, style: int) -> tuple[Shape, ...]:
    """Return a trunk with a crown of leaf tufts."""
    rng = np.random.default_rng(style)
    radius, height = rng.uniform(1.2, 1.7), rng.uniform(4.0, 4.8)
    direction = rng.normal(size=(45, 3))
    direction *= (radius * rng.uniform(0.35, 1.0, (45, 1))) / np.linalg.norm(direction, axis=1, keepdims=True)
    tufts = [
        Ball(rounded(x + d[0]), rounded(y + d[1]), rounded(base + height + d[2]), rounded(r), LEAF)
        for d, r in zip(direction, rng.uniform(0.16, 0.34, 45), strict=True)
    ]
    return (Post(rounded(x), rounded(y), 0.14, rounded(base - 0.2), rounded(base + height), METAL), *tufts)


def lamp(x: float, y: float, base: float, side: int) -> tuple[Shape, ...]:
    """Return a street lamp: foot, mast, and an arm over the road."""
    foot = Post(rounded(x), rounded(y), 0.2, rounded(base - 0.2), rounded(base + 0.6), METAL)
    mast = Post(rounded(x), rounded(y), 0.09, rounded(base), rounded(base + 7.5), METAL)
    arm = slab(x - 0.06, x + 0.06, y, y - side * 2.0, base + 7.35, base + 7.5, METAL)
    return foot, mast, arm


def sign(x: float, y: float, base: float, width: float, height: float, yaw: float) -> tuple[Shape, ...]:
    """Return a traffic sign: thin post and a plate turned by `yaw` against the street's crossing direction."""
    post = Post(rounded(x), rounded(y), 0.04, rounded(base - 0.2), rounded(base + height + 0.4), METAL)
    plate_x, plate_y = rounded(x - 0.06 * cos(yaw)), rounded(y - 0.06 * sin(yaw))
    bottom, top = rounded(base + height - 0.4), rounded(base + height + 0.4)
    return post, Block(plate_x, plate_y, 0.02, rounded(width / 2), bottom, top, round(yaw, 4), reflectivity=SIGN)


def shelter(x: float, y: float, base: float, side: int) -> tuple[Shape, ...]:
    """Return a bus shelter: roof, back and side panels, bench."""
    back = y + side * 0.7
    return (
        slab(x - 2, x + 2, y - 0.8, y + 0.8, base + 2.3, base + 2.45, METAL),
        slab(x - 2, x + 2, back - 0.04, back + 0.04, base, base + 2.3, METAL),
        slab(x - 2.0, x - 1.92, y - 0.6, y + 0.6, base, base + 2.3, METAL),
        slab(x - 1.5, x + 1.5, back - side * 0.5, back - side * 0.1, base + 0.35, base + 0.45, METAL),
    )


def cabinet(x: float, y: float, base: float) -> tuple[Shape, ...]:
    """Return a switch cabinet."""
    return (slab(x - 0.6, x + 0.6, y - 0.22, y + 0.22, base - 0.1, base + 1.3, METAL),)


def bollards(x0: float, count: int, y: float, base: float) -> tuple[Shape, ...]:
    """Return a row of bollards, 1.5 m apart."""
    return tuple(
        Post(rounded(x0 + 1.5 * i), rounded(y), 0.1, rounded(base - 0.1), rounded(base + 0.9), CONCRETE)
        for i in range(count)
    )


def barrier(x: float, y: float, base: float, yaw: float) -> tuple[Shape, ...]:
    """Return a 2 m concrete barrier: wide foot, narrow head."""
    turn = round(yaw, 4)
    foot = Block(rounded(x), rounded(y), 1.0, 0.3, rounded(base - 0.1), rounded(base + 0.3), turn)
    return foot, Block(rounded(x), rounded(y), 1.0, 0.12, rounded(base + 0.3), rounded(base + 0.9), turn)


def container(x: float, y: float, base: float, yaw: float, length: float = 6.06) -> tuple[Shape, ...]:
    """Return a site container with a door frame that stands out."""
    turn = round(yaw, 4)
    body = Block(rounded(x), rounded(y), rounded(length / 2), 1.22, rounded(base), rounded(base + 2.59), turn)
    return body, Block(rounded(x), rounded(y), 0.5, 1.3, rounded(base), rounded(base + 2.1), turn)


def scaffold(x0: float, x1: float, y: float, base: float, side: int, levels: int) -> tuple[Shape, ...]:
    """Return a scaffold: posts in two rows, decks, and toe boards."""
    posts = [
        Post(rounded(x), rounded(y + dy), 0.05, rounded(base), rounded(base + 2.1 * levels + 1.0), METAL)
        for x in np.linspace(x0, x1, max(2, round((x1 - x0) / 2.5) + 1))
        for dy in (0.0, side * 0.9)
    ]
    low, high = min(y, y + side * 0.9), max(y, y + side * 0.9)
    decks = [slab(x0, x1, low, high, base + 2.1 * k - 0.06, base + 2.1 * k, METAL) for k in range(1, levels + 1)]
    boards = [
        slab(x0, x1, y - 0.02, y + 0.02, base + 2.1 * k, base + 2.1 * k + 0.5, METAL) for k in range(1, levels + 1)
    ]
    return (*posts, *decks, *boards)


def heap(x: float, y: float, base: float, size: float) -> tuple[Shape, ...]:
    """Return a heap of earth: two ramps, back to back."""
    height, half = 0.5 * size, size / 2
    low, top = rounded(base - 0.1), rounded(base + height / 2)
    ramps = [(x - half / 2, 1.0), (x + half / 2, -1.0)]
    return tuple(
        Block(rounded(rx), rounded(y), rounded(half / 2), rounded(half), low, top, rise_x=sign_ * height / half)
        for rx, sign_ in ramps
    )


def car(x: float, y: float, base: float, yaw: float, style: int) -> tuple[Shape, ...]:
    """Return a parked car or van: body, cabin, four wheels."""
    rng = np.random.default_rng(style)
    van = rng.random() < 0.2
    half, wide = (2.5, 0.98) if van else (rng.uniform(2.0, 2.4), rng.uniform(0.86, 0.94))
    belt, roof = (1.1, 2.1) if van else (rng.uniform(0.75, 0.9), rng.uniform(1.42, 1.65))
    shift, cabin = (-0.3, 2.1) if van else (-0.25, rng.uniform(1.1, 1.4))
    c, s = cos(yaw), sin(yaw)
    body = Block(x, y, half, wide, base + 0.22, base + belt, yaw, reflectivity=METAL)
    top = Block(x + shift * c, y + shift * s, cabin, wide - 0.12, base + belt, base + roof, yaw, reflectivity=METAL)
    wheels = [
        Block(x + dx * c - dy * s, y + dx * s + dy * c, 0.3, 0.1, base, base + 0.62, yaw, reflectivity=0.1)
        for dx in (-0.6 * half, 0.6 * half)
        for dy in (-wide + 0.1, wide - 0.1)
    ]
    return (body, top, *wheels)


def delivery_van(x: float, y: float, base: float, yaw: float, style: int) -> tuple[Shape, ...]:
    """Return a van with a high box, as it stands at a delivery zone: box, cab, four wheels."""
    rng = np.random.default_rng(style)
    half, wide, roof = rng.uniform(2.6, 3.2), rng.uniform(0.98, 1.08), rng.uniform(2.4, 3.0)
    c, s = cos(yaw), sin(yaw)
    box = Block(x - 0.5 * c, y - 0.5 * s, half - 0.6, wide, base + 0.55, base + roof, yaw, reflectivity=PLASTER)
    front = half - 0.55
    cab = Block(x + front * c, y + front * s, 0.55, wide - 0.05, base + 0.3, base + 1.95, yaw, reflectivity=METAL)
    wheels = [
        Block(x + dx * c - dy * s, y + dx * s + dy * c, 0.35, 0.12, base, base + 0.7, yaw, reflectivity=0.1)
        for dx in (-0.6 * half, 0.65 * half)
        for dy in (-wide + 0.12, wide - 0.12)
    ]
    return (box, cab, *wheels)
