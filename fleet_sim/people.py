"""People on the pavements of one drive: bodies of posts and balls with legs and arms that swing as they walk."""

from dataclasses import dataclass
from math import tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.movers import Mover
from gnd.fleet_sim.shapes import Ball, Post, Shape
from gnd.fleet_sim.stage import Stage

FloatArray = NDArray[np.float64]

_LINES_M: Final = (1.3, 2.9)
"""People walk at these distances from the kerb."""
_HALF_WIDTH_M: Final = 0.4
_HIGH_M: Final = 2.0
_LOW_M: Final = 0.25
"""What lies lower is stepped over, what hangs higher is passed under."""
_MIN_STRETCH_M: Final = 8.0
_BEYOND_M: Final = 40.0
_STRIDE_M: Final = 1.4
_SWING_M: Final = 0.28
_CAR_BOX_M: Final = (4.5, 2.2)
"""Nobody crosses where the middle of a car is within this, along and across the street."""
_BEFORE_S: Final = (-14.0, 4.0)
"""People set out to cross so long before or after the vehicle that measures passes: it sees most of them."""
_TRIES: Final = 60


@dataclass(frozen=True, slots=True)
class PathStretch:
    """A free stretch of pavement, straight along the street.

    Attributes:
        y_m: where it runs.
        x0_m, x1_m: its ends.
    """

    y_m: float
    x0_m: float
    x1_m: float


@dataclass(frozen=True, slots=True)
class Leg:
    """A part of somebody's way.

    Attributes:
        duration_s: how long it takes.
        x_m, y_m: where it ends.
    """

    duration_s: float
    x_m: float
    y_m: float


def person(style: int) -> tuple[tuple[Shape, ...], tuple[float, ...]]:
    """Return the primitives of somebody, and how much of the stride each swings."""
    rng = np.random.default_rng(style)
    k, coat, legs = rng.uniform(0.88, 1.1), rng.uniform(0.1, 0.6), rng.uniform(0.08, 0.4)
    found: list[tuple[Shape, float]] = [
        (Post(0.0, 0.0, 0.19 * k, 0.8 * k, 1.45 * k, coat), 0.0),
        (Ball(0.0, 0.0, 1.6 * k, 0.12 * k, 0.4), 0.0),
    ]
    for side in (1, -1):
        found += [
            (Post(0.0, side * 0.1 * k, 0.08 * k, 0.4 * k, 0.8 * k, legs), 0.5 * side),
            (Post(0.0, side * 0.1 * k, 0.06 * k, 0.0, 0.4 * k, legs), 1.0 * side),
            (Post(0.0, side * 0.25 * k, 0.05 * k, 0.85 * k, 1.4 * k, coat), -0.5 * side),
        ]
    return tuple(shape for shape, _ in found), tuple(swing for _, swing in found)


def pedestrians(
    count: int,
    crossing_share: float,
    stage: Stage,
    busy: list[tuple[FloatArray, FloatArray]],
    rng: np.random.Generator,
) -> list[Mover]:
    """Return people, fewer than `count` where the pavements have no room for so many.

    Args:
        count: how many.
        crossing_share: share that crosses the road once.
        stage: the drive.
        busy: street x and y (S,) of every vehicle at `stage.times_s()`.
        rng: all that is random.
    """
    stretches = free_stretches(stage)
    order = rng.permutation(len(stretches)).tolist()
    free, found = [stretches[k] for k in order[count:]], list[Mover]()
    for index in order[:count]:
        style, crosses = int(rng.integers(2**31)), rng.random() < crossing_share
        here = stretches[index]
        way = _crossing(here, free, stage, busy, rng) if crosses else None
        if way is None:
            way = _strolling(here, float(rng.uniform(here.x0_m, here.x1_m)), stage.duration_s, rng)
        found.append(_walker(stage, way, style))
    return found


def free_stretches(stage: Stage) -> list[PathStretch]:
    """Return the stretches of pavement where somebody can walk without meeting anything that stands there."""
    boxes, world = _standing(stage.shapes), stage.world
    end, found = world.half_length_m + _BEYOND_M, []
    for y in [side * (world.kerb_m + line) for side in (1, -1) for line in _LINES_M]:
        near = boxes[(boxes[:, 1] < y + _HALF_WIDTH_M) & (boxes[:, 3] > y - _HALF_WIDTH_M)]
        x = -end
        for x0, x1 in [*sorted(near[:, [0, 2]].tolist()), (end, end)]:
            if x0 - x > _MIN_STRETCH_M + 2 * _HALF_WIDTH_M:
                found.append(PathStretch(y, x + _HALF_WIDTH_M, x0 - _HALF_WIDTH_M))
            x = max(x, x1)
    return found


def _standing(shapes: tuple[Shape, ...]) -> FloatArray:
    """Return x0, y0, x1, y1 of everything that stands in a walker's way, float64 (N, 4)."""
    rows = []
    for shape in shapes:
        x0, y0, x1, y1, top = shape.bounds()
        bottom = shape.z_m - shape.radius_m if isinstance(shape, Ball) else shape.bottom_m
        if bottom < _HIGH_M and top > _LOW_M:
            rows.append((x0, y0, x1, y1))
    return np.array(rows).reshape(len(rows), 4)


def _strolling(stretch: PathStretch, x: float, duration_s: float, rng: np.random.Generator) -> list[Leg]:
    """Walk up and down a stretch from x on, standing for a while at its ends, and now and then in between."""
    speed = rng.uniform(0.9, 1.7)
    legs, spent = [Leg(0.0, x, stretch.y_m)], 0.0
    ahead = rng.random() < 0.5
    while spent < duration_s + 2.0:
        goal = stretch.x1_m if ahead else stretch.x0_m
        if rng.random() < 0.3:
            goal = x + rng.uniform(0.3, 0.8) * (goal - x)
        legs.append(Leg(float(abs(goal - x) / speed), float(goal), stretch.y_m))
        legs.append(Leg(float(rng.uniform(1.0, 4.0)), float(goal), stretch.y_m))
        x, ahead = float(goal), not ahead
        spent += legs[-1].duration_s + legs[-2].duration_s
    return legs


def _crossing(
    here: PathStretch,
    free: list[PathStretch],
    stage: Stage,
    busy: list[tuple[FloatArray, FloatArray]],
    rng: np.random.Generator,
) -> list[Leg] | None:
    """Stand at the kerb, cross when there is room, walk on over there; None if there is never room."""
    times, boxes = stage.times_s(), _standing(stage.shapes)
    others = [s for s in free if s.y_m * here.y_m < 0 and min(s.x1_m, here.x1_m) - max(s.x0_m, here.x0_m) > 2.0]
    for _ in range(_TRIES if others else 0):
        there = others[int(rng.integers(len(others)))]
        x = float(rng.uniform(max(here.x0_m, there.x0_m), min(here.x1_m, there.x1_m)))
        takes = float(abs(there.y_m - here.y_m) / rng.uniform(1.2, 2.0))
        passes = float(times[np.argmin(np.abs(stage.ego_m()[0] - x))])
        begin = max(passes + float(rng.uniform(*_BEFORE_S)), 0.0)
        y = np.interp(times, [begin, begin + takes], [here.y_m, there.y_m])
        during = (times > begin - 0.5) & (times < begin + takes + 0.5)
        if not _barred(boxes, x, here.y_m, there.y_m) and not _met(busy, x, y, during):
            free.remove(there)
            wait, over = Leg(begin - float(times[0]), x, here.y_m), Leg(takes, x, there.y_m)
            return [Leg(0.0, x, here.y_m), wait, over, *_strolling(there, x, stage.duration_s, rng)[1:]]
    return None


def _barred(boxes: FloatArray, x: float, y0: float, y1: float) -> bool:
    """Whether anything stands on the way across the road."""
    along = (boxes[:, 0] < x + _HALF_WIDTH_M) & (boxes[:, 2] > x - _HALF_WIDTH_M)
    return bool((along & (boxes[:, 1] < max(y0, y1)) & (boxes[:, 3] > min(y0, y1))).any())


def _met(busy: list[tuple[FloatArray, FloatArray]], x: float, y: FloatArray, during: NDArray[np.bool_]) -> bool:
    """Whether a vehicle comes too near to somebody who crosses at x, at y (S,) over time."""
    along, across = _CAR_BOX_M
    return any(
        bool((during & (np.abs(there_x - x) < along) & (np.abs(there_y - y) < across)).any())
        for there_x, there_y in busy
    )


def _walker(stage: Stage, legs: list[Leg], style: int) -> Mover:
    """Return somebody who goes a way; the ground underfoot is found in the scene, the stride from the way gone."""
    times = stage.times_s()
    knots = times[0] + np.cumsum([leg.duration_s for leg in legs])
    corners = np.array([(leg.x_m, leg.y_m) for leg in legs])
    x, y = (np.interp(times, knots, corners[:, k]) for k in range(2))
    gone = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    stride = _SWING_M * np.sin(tau * gone / _STRIDE_M)
    track = np.stack([x, y, stage.ground_m(x, y), _headings(times, knots, corners), stride], axis=1)
    return Mover(*person(style), track)


def _headings(times: FloatArray, knots: FloatArray, corners: FloatArray) -> FloatArray:
    """Return where somebody looks, float64 (S,) [rad]: along each leg, turned within half a second while standing."""
    step = np.diff(corners, axis=0)
    moves = np.flatnonzero(np.hypot(step[:, 0], step[:, 1]) > 0.0)
    if not moves.size:
        return np.zeros_like(times)
    yaw = np.unwrap(np.arctan2(step[moves, 1], step[moves, 0]))
    begins, ends = knots[moves], knots[moves + 1]
    at = np.stack([begins, ends], axis=1).ravel()
    return np.asarray(np.interp(times, np.maximum.accumulate(at), np.repeat(yaw, 2)))
