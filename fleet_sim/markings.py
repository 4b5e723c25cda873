"""Paint on a simulated street: borders of lanes before and after works, and how bright a LiDAR sees the road.

The paint is drawn by a stream of random numbers of its own and touches nothing else of a world: recordings are what
they were. How bright a return is, is asked for separately (`road_intensity`).

Figures: markings 0.12 m wide, dashes 3 m with gaps of 6 m (RMS-1, Germany, in towns). The echo falls with incidence
and range (Lambert); retro-reflective beads turn most of it back, so paint falls more slowly with incidence. Paint of
0.4 to 0.6 on asphalt of 0.1 to 0.14; worn patches of some metres lose up to nine tenths.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import WorldError
from gnd.fleet_sim.world import State, World

FloatArray = NDArray[np.float64]

PaintEdit = Literal["kept", "shifted", "removed", "retyped", "added"]
_STREAM: Final = 1608
WAY_M: Final = 40.0
"""Borders are painted, and changed, in stretches of this length."""
WIDTH_M: Final = 0.12
_DASH_M: Final = 3.0
_GAP_M: Final = 6.0
_SHIFT_M: Final = (0.3, 1.0)
_SITE_M: Final = 60.0
_BESIDE_M: Final = (0.5, 0.9)
_FOOTPRINT_RAD: Final = 3e-3
_WEAR_M: Final = 2.5


@dataclass(frozen=True, slots=True)
class PaintedBorder:
    """A stretch of a border, straight in the street's frame.

    Attributes:
        name: unique in its state; a stretch that was changed keeps its name.
        line: which border of the street it belongs to, from right to left.
        start_m, end_m: along the street's x.
        y_m: across.
        marking: solid or dashed.
        colour: white, or yellow beside works.
        edit: what happened to it between the states.
    """

    name: str
    line: int
    start_m: float
    end_m: float
    y_m: float
    marking: Literal["solid", "dashed"]
    colour: Literal["white", "yellow"] = "white"
    edit: PaintEdit = "kept"

    def __post_init__(self) -> None:
        if not self.start_m < self.end_m:
            raise WorldError(f"border {self.name!r} runs from {self.start_m} to {self.end_m} m")


@dataclass(frozen=True, slots=True, eq=False)
class Paint:
    """All paint of a street in both states.

    Attributes:
        world: the street.
        before, after: the borders.
        wear: (K,) how much of the paint is left, by a running number that a place hashes to.
    """

    world: World
    before: tuple[PaintedBorder, ...]
    after: tuple[PaintedBorder, ...]
    wear: FloatArray

    def borders(self, state: State) -> tuple[PaintedBorder, ...]:
        """The borders of a state."""
        return self.before if state == "before" else self.after

    def line_map_m(self, border: PaintedBorder, step_m: float = 2.0) -> FloatArray:
        """(N, 3) the middle of a border in the map frame, dashes and gaps."""
        n = max(2, round((border.end_m - border.start_m) / step_m) + 1)
        x, y = np.linspace(border.start_m, border.end_m, n), np.full(n, border.y_m)
        return self.world.map_of_street(np.column_stack([x, y, self.world.road_height_m(y, x)]))


def paint_of(world: World, change_share: float = 0.3) -> Paint:
    """The paint of a street, drawn from its seed.

    Args:
        world: the street; its borders lie two lane widths apart about the middle.
        change_share: so much of the stretches is shifted, removed or painted as another type.
    """
    if not 0.0 <= change_share <= 1.0:
        raise WorldError(f"the share of changed borders must be in 0 … 1, got {change_share}")
    rng = np.random.default_rng([world.seed, _STREAM])
    reach = world.half_length_m + 20.0
    edges = np.append(np.arange(-reach, reach - WAY_M / 2, WAY_M), reach)
    across = (-2.0 * world.lane_offset_m, 0.0, 2.0 * world.lane_offset_m)
    before = tuple(
        PaintedBorder(f"border-{line}-{k}", line, float(a), float(b), y, "dashed" if y == 0.0 else "solid")
        for line, y in enumerate(across)
        for k, (a, b) in enumerate(pairwise(edges))
    )
    before, after = _changed(before, change_share, rng, world)
    return Paint(world, before, after, np.clip(rng.beta(3.0, 0.8, 4096), 0.1, 1.0))


def _changed(
    before: tuple[PaintedBorder, ...], share: float, rng: np.random.Generator, world: World
) -> tuple[tuple[PaintedBorder, ...], tuple[PaintedBorder, ...]]:
    """Both states; no two borders side by side are changed, and each kind of change comes once before any twice."""
    inner = [
        k for k, one in enumerate(before) if abs(0.5 * (one.start_m + one.end_m)) < world.half_length_m - WAY_M / 2
    ]
    edits: list[PaintEdit] = ["shifted", "removed", "retyped"]
    chosen: dict[int, PaintEdit] = {}
    for k in rng.permutation(inner).tolist():
        free = all(before[j].start_m != before[k].start_m for j in chosen)
        if free and len(chosen) < round(share * len(inner)):
            chosen[k] = edits[len(chosen) % len(edits)]
    after = [_after(one, chosen.get(k, "kept"), rng) for k, one in enumerate(before)]
    marked = tuple(replace(one, edit=chosen.get(k, "kept")) for k, one in enumerate(before))
    site = _site(rng, world) if share > 0.0 else ()
    return marked, (*(one for one in after if one is not None), *site)


def _after(one: PaintedBorder, edit: PaintEdit, rng: np.random.Generator) -> PaintedBorder | None:
    if edit == "removed":
        return None
    if edit == "retyped":
        return replace(one, marking="solid" if one.marking == "dashed" else "dashed", edit=edit)
    if edit == "shifted":
        step = float(rng.uniform(*_SHIFT_M))
        away = -np.sign(one.y_m) if one.y_m else rng.choice([-1.0, 1.0])
        return replace(one, y_m=one.y_m + float(away) * step, edit=edit)
    return one


def _site(rng: np.random.Generator, world: World) -> tuple[PaintedBorder, ...]:
    """Yellow paint beside the white border of one side, where works lead the lane past them."""
    start = float(rng.uniform(-world.half_length_m + 15.0, world.half_length_m - 15.0 - _SITE_M))
    side, beside = float(rng.choice([-1.0, 1.0])), float(rng.uniform(*_BESIDE_M))
    y = side * (2.0 * world.lane_offset_m - 1.0 - beside)
    return (PaintedBorder("site-0", 3, start, start + _SITE_M, y, "solid", "yellow", "added"),)


def road_intensity(
    paint: Paint,
    state: State,
    points_map_m: FloatArray,
    eyes_map_m: FloatArray,
    rng: np.random.Generator,
    wet: bool = False,
    seam_y_m: float | None = None,
) -> FloatArray:
    """How bright a LiDAR sees points, float64 (N,), in units of its own.

    Args:
        paint: of the street.
        state: which of its states.
        points_map_m: (N, 3).
        eyes_map_m: (N, 3) where the shots came from.
        rng: noise of the returns, of no other stream.
        wet: a film of water turns the light away: the contrast is gone.
        seam_y_m: a bright seam of two centimetres runs along the street there.
    """
    street = paint.world.street_of_map(points_map_m)
    x, y = street[:, 0], street[:, 1]
    on_road = (np.abs(street[:, 2] - paint.world.road_height_m(y, x)) < 0.08) & (np.abs(y) < paint.world.kerb_m)
    way = points_map_m - eyes_map_m
    range_m = np.maximum(np.linalg.norm(way, axis=1), 0.1)
    incidence = np.clip(-way[:, 2] / range_m, 0.02, 1.0)
    spot_m = _FOOTPRINT_RAD * range_m
    white = _coverage(paint, state, x, y, spot_m)
    if seam_y_m is not None:
        white = np.maximum(
            white, 0.8 * np.clip((0.01 + spot_m / 2 - np.abs(y - seam_y_m)) / spot_m, 0.0, 0.02 / spot_m)
        )
    asphalt = (0.12 + 0.02 * np.sin(0.7 * x) * np.sin(1.3 * y)) * incidence
    shining = 0.5 * incidence**0.5
    if wet:
        asphalt, shining = 0.3 * asphalt, 0.33 * asphalt
    road = asphalt + white * (shining - asphalt)
    other = 0.12 + 0.18 * _hash(np.floor(points_map_m * 2.0) @ np.array([1.0, 57.0, 113.0]))
    flat = np.abs(street[:, 2] - paint.world.road_height_m(y, x)) < 0.4
    other = np.where(flat, other * incidence, other)
    power = np.where(on_road, road, other) / (1.0 + (range_m / 25.0) ** 2)
    noisy = power * (1.0 + 0.12 * rng.standard_normal(len(power))) + 0.001 * rng.standard_normal(len(power))
    return np.asarray(np.round(255.0 * np.clip(2.0 * noisy, 0.0, 1.0)))


def _coverage(paint: Paint, state: State, x: FloatArray, y: FloatArray, spot_m: FloatArray) -> FloatArray:
    """Share of each spot that is paint, worn as it is there."""
    share = np.zeros(len(x))
    for one in paint.borders(state):
        near = np.flatnonzero((x >= one.start_m) & (x < one.end_m) & (np.abs(y - one.y_m) < 0.5))
        if not len(near):
            continue
        inside = np.clip((0.5 * (WIDTH_M + spot_m[near]) - np.abs(y[near] - one.y_m)) / spot_m[near], 0.0, 1.0)
        inside = np.minimum(inside, WIDTH_M / spot_m[near])
        if one.marking == "dashed":
            inside = inside * ((x[near] % (_DASH_M + _GAP_M)) < _DASH_M)
        worn = paint.wear[(np.floor(x[near] / _WEAR_M).astype(np.int64) * 3 + one.line * 977) % len(paint.wear)]
        share[near] = np.maximum(share[near], inside * worn)
    return share


def _hash(values: FloatArray) -> FloatArray:
    """(N,) 0 … 1, the same for the same values."""
    return np.asarray(np.abs(np.sin(values * 12.9898) * 43758.5453) % 1.0)
