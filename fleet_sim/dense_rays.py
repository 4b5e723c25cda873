"""The rays of the dense scan: where they start, where they go, and where they end in both states of a world.

What stands in both states is met once; what went or came has scenes of its own, and the nearer end counts. So the two
states cost little more than one, and a ray that meets a kept thing in both ends in both at the same point to the bit.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import radians, tau
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.shapes import Shape
from gnd.fleet_sim.world import STATES, State, World
from gnd.gnd_map.jit import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]

BEFORE_KEPT: Final = 1
"""Sub-cell hit before, on something that still stands after."""
BEFORE_GONE: Final = 2
"""Sub-cell hit before, on something that does not stand after."""
AFTER_KEPT: Final = 4
"""Sub-cell hit after, on something that stood before."""
AFTER_COME: Final = 8
"""Sub-cell hit after, on something that did not stand before."""
LEAF_BEFORE: Final = 16
"""Sub-cell hit before, on leaves or snow that are gone after; they count as standing: seasons change no map."""
LEAF_AFTER: Final = 32
"""Sub-cell hit after, on leaves or snow that were not there before; there is nothing, for a map."""

_KEPT: Final[dict[State, int]] = {"before": BEFORE_KEPT, "after": AFTER_KEPT}
_CHANGED: Final[dict[State, int]] = {"before": BEFORE_GONE, "after": AFTER_COME}
_SEASONAL: Final[dict[State, int]] = {"before": BEFORE_KEPT | LEAF_BEFORE, "after": LEAF_AFTER}
_GOLDEN: Final = 0.6180339887498949
_TIE_M: Final = 1e-9
"""Changed things are looked for so far behind a kept one: of two surfaces in one place, the first listed counts."""
_SPARSE_CELL_M: Final = 6.0
"""Cells of the scenes of changed things, of which there are few."""


@dataclass(frozen=True, slots=True)
class ScanPlan:
    """Where the dense scan looks from, and how finely.

    Attributes:
        spacing_m: distance of the scanner's places along each lane.
        end_margin_m: the first and last place are so far from the street's ends.
        sensor_m: height over the road.
        step_rad: angle between rays, both ways.
        low_rad, high_rad: field of view: HDL-32E's lowest to VLP-16's highest beam.
        range_m: reach of the rays.
        pass_stride: every n-th ray is followed through the voxels that it passes.
    """

    spacing_m: float = 1.0
    end_margin_m: float = 2.0
    sensor_m: float = 1.9
    step_rad: float = radians(0.5)
    low_rad: float = radians(-31.0)
    high_rad: float = radians(15.0)
    range_m: float = 50.0
    pass_stride: int = 7

    def origins_street(self, world: World) -> FloatArray:
        """Return the scanner's places, float64 (K, 3), street frame."""
        reach = world.half_length_m - self.end_margin_m
        x = np.arange(-reach, reach + 1e-9, self.spacing_m)
        lanes = [np.stack([x, side * world.lane_m(x)[0]], axis=1) for side in (-1, 1)]
        xy = np.concatenate(lanes)
        return np.column_stack([xy, world.road_height_m(xy[:, 1], xy[:, 0]) + self.sensor_m])

    def directions_street(self, index: int) -> FloatArray:
        """Return unit ray directions, float64 (N, 3), of place `index`; its raster is shifted so as to fill gaps."""
        shift = (index * _GOLDEN) % 1.0, (index * _GOLDEN**2) % 1.0
        elevation = np.arange(self.low_rad, self.high_rad - self.step_rad, self.step_rad) + shift[0] * self.step_rad
        azimuth = np.arange(0.0, tau, self.step_rad) + shift[1] * self.step_rad
        flat, up = np.cos(elevation)[:, None], np.sin(elevation)[:, None]
        parts = np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), up)
        return np.stack(parts, axis=-1).reshape(-1, 3)


class Shots(NamedTuple):
    """Rays of one place in one state.

    Index of the state, origin (3,) and ends (N, 3) in metres in the map frame, flags uint8 (N,), and bool (N,): false
    for a ray before that ends at the same point after, and would be counted twice there.
    """

    state: int
    origin: FloatArray
    ends: FloatArray
    flags: NDArray[np.uint8]
    fresh: NDArray[np.bool_]


class _Part(NamedTuple):
    """Things that are met together: a scene, none without things, and each primitive's rank in the lists of states.

    `flags` uint8: what a hit on each primitive says, of things that stand in one state only.
    """

    scene: Scene | None
    ranks: dict[State, IntArray]
    flags: NDArray[np.uint8]


def shots(world: World, plan: ScanPlan) -> Iterator[Shots]:
    """Yield the rays of every place, in the state before and then in the state after."""
    kept = _part(world, STATES)
    changed: dict[State, _Part] = {state: _part(world, (state,)) for state in STATES}
    A_map_street = np.ascontiguousarray(np.linalg.inv(world.A_street_map))
    origins = plan.origins_street(world)
    for place, (origin, start) in enumerate(zip(world.map_of_street(origins), origins, strict=True)):
        directions, directions_map = _aim(plan.directions_street(place), A_map_street)
        common = _cast(kept, start, directions, np.full(len(directions), plan.range_m))
        reach_m = np.minimum(common[0] + _TIE_M, plan.range_m)
        casts = [
            _nearer(
                *common,
                kept.ranks[state],
                *_cast(part, start, directions, reach_m),
                part.ranks[state],
                _KEPT[state],
                part.flags,
            )
            for state, part in changed.items()
        ]
        for state, (ranges, flags) in enumerate(casts):
            fresh = np.ones(len(ranges), dtype=np.bool_) if state else casts[0][0] != casts[1][0]
            yield Shots(state, origin, _ends(origin, directions_map, ranges, plan.range_m), flags, fresh)


def _part(world: World, states: tuple[State, ...]) -> _Part:
    """Everything that stands in exactly these states."""
    mine = [o for o in world.objects if set(o.states) == set(states)]
    shapes: list[Shape] = [shape for o in mine for shape in o.shapes]
    says = [(_SEASONAL if o.edit == "seasonal" else _CHANGED)[states[0]] for o in mine for _ in o.shapes]
    sparse = len(states) < len(STATES)
    room = {"cell_m": _SPARSE_CELL_M, "margin_m": 2 * world.half_length_m + world.kerb_m} if sparse else {}
    ranks = {state: _ranks(world, state, states) for state in states}
    return _Part(Scene.build(shapes, world.A_street_map, **room) if shapes else None, ranks, np.array(says, np.uint8))


def _ranks(world: World, state: State, states: tuple[State, ...]) -> IntArray:
    """Rank of each primitive of the things of exactly `states` among all primitives of `state`."""
    mine = [set(o.states) == set(states) for o in world.in_state(state) for _ in o.shapes]
    return np.flatnonzero(mine).astype(np.int32)


def _cast(part: _Part, origin: FloatArray, directions: FloatArray, reach_m: FloatArray) -> tuple[FloatArray, IntArray]:
    if part.scene is None:
        return np.full(len(directions), np.inf), np.full(len(directions), -1, dtype=np.int32)
    return part.scene.cast_fan(origin, directions, reach_m)


@kernel
def _aim(directions: FloatArray, A_map_street: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Street-frame directions (N, 3) scaled so that their images in the map frame are unit vectors, and these."""
    scaled, images = np.empty_like(directions), np.empty_like(directions)
    for n in range(len(directions)):
        d = directions[n]
        x = A_map_street[0, 0] * d[0] + A_map_street[0, 1] * d[1] + A_map_street[0, 2] * d[2]
        y = A_map_street[1, 0] * d[0] + A_map_street[1, 1] * d[1] + A_map_street[1, 2] * d[2]
        z = A_map_street[2, 0] * d[0] + A_map_street[2, 1] * d[1] + A_map_street[2, 2] * d[2]
        length = np.sqrt(x * x + y * y + z * z)
        images[n, 0], images[n, 1], images[n, 2] = x / length, y / length, z / length
        scaled[n, 0], scaled[n, 1], scaled[n, 2] = d[0] / length, d[1] / length, d[2] / length
    return scaled, images


@kernel
def _nearer(
    kept_m: FloatArray,
    kept_index: IntArray,
    kept_ranks: IntArray,
    part_m: FloatArray,
    part_index: IntArray,
    part_ranks: IntArray,
    kept_flag: int,
    part_flags: NDArray[np.uint8],
) -> tuple[FloatArray, NDArray[np.uint8]]:
    """The nearer of two ends of each of N rays, and the flag of what is met there (0: nothing).

    Of two surfaces in the same place the one that comes first in the world's list counts, as in one scene of all.
    """
    ranges, flags = np.empty(len(kept_m)), np.zeros(len(kept_m), np.uint8)
    for n in range(len(kept_m)):
        i, j = kept_index[n], part_index[n]
        if j < 0 or kept_m[n] < part_m[n] or (kept_m[n] == part_m[n] and kept_ranks[i] < part_ranks[j]):
            ranges[n], flags[n] = kept_m[n], (kept_flag if i >= 0 else 0)
        else:
            ranges[n], flags[n] = part_m[n], part_flags[j]
    return ranges, flags


@kernel
def _ends(origin: FloatArray, directions: FloatArray, ranges: FloatArray, range_m: float) -> FloatArray:
    """Points (N, 3) where rays end, at most `range_m` away."""
    ends = np.empty_like(directions)
    for n in range(len(ends)):
        t = min(ranges[n], range_m)
        for a in range(3):
            ends[n, a] = origin[a] + t * directions[n, a]
    return ends
