"""A route: its line, its lanes, and the truth of what stands beside it."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import RoadError
from gnd.fleet_sim.roads.curve import Centreline, FloatArray
from gnd.gnd_map.geodesy import LocalFrame

IntArray = NDArray[np.int64]
FeatureState = Literal["normal", "deleted", "new"]
FEATURE_STATES: Final[tuple[FeatureState, ...]] = get_args(FeatureState)
MAP_ERROR_M: Final = 0.1
"""Error of each coordinate of a mapped feature: HERE's maps are 10 to 20 cm accurate (Jo et al., section 2.2)."""


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """What stands beside a road, and what the map says of it; N rows.

    Attributes:
        feature_id: int64 (N,), > 0, unique.
        kinds: N words, such as "speed_limit".
        xy_m: float64 (N, 2), true place in the route's frame; of a deleted one: where it stood.
        height_m: float64 (N,) above the road.
        states: of each: "normal" (stands and is mapped), "deleted" (is mapped only), "new" (stands only).
        mapped_xy_m: float64 (N, 2), where the map has it, nan for new ones.
    """

    feature_id: IntArray
    kinds: tuple[str, ...]
    xy_m: FloatArray
    height_m: FloatArray
    states: tuple[FeatureState, ...]
    mapped_xy_m: FloatArray

    def __post_init__(self) -> None:
        count = len(self.feature_id)
        shapes = (self.xy_m.shape, self.mapped_xy_m.shape, self.height_m.shape, len(self.kinds), len(self.states))
        if shapes != ((count, 2), (count, 2), (count,), count, count):
            raise RoadError(f"{count} features with columns of shapes {shapes}")
        if len(np.unique(self.feature_id)) != count or (count and self.feature_id.min() < 1):
            raise RoadError("ids of features must be positive and unique")
        if set(self.states) - set(FEATURE_STATES):
            raise RoadError(f"states must be among {FEATURE_STATES}, got {sorted(set(self.states))}")

    def __len__(self) -> int:
        return len(self.feature_id)

    def rows(self, *states: FeatureState) -> IntArray:
        """Return the rows in one of some states, int64 (K,)."""
        return np.flatnonzero(np.isin(np.array(self.states, dtype=object), states)).astype(np.int64)

    def take(self, rows: IntArray | Sequence[int]) -> "Features":
        """Return some rows."""
        index = np.asarray(rows, dtype=np.int64)
        kinds, states = (tuple(column[i] for i in index.tolist()) for column in (self.kinds, self.states))
        arrays = (a[index] for a in (self.feature_id, self.xy_m, self.height_m, self.mapped_xy_m))
        feature_id, xy, height, mapped = arrays
        return Features(feature_id, kinds, xy, height, states, mapped)  # type: ignore[arg-type]

    @property
    def standing(self) -> "Features":
        """What a sensor can see: normal and new."""
        return self.take(self.rows("normal", "new"))

    @property
    def mapped(self) -> "Features":
        """What the map holds: normal and deleted."""
        return self.take(self.rows("normal", "deleted"))


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """A road that can be driven.

    The frame is the plane of `frame`'s east and north; the true centre line of lane k lies `lane_left_m[k]` to the left
    of `line` (a negative number: to the right).

    Attributes:
        name: such as "motorway-11".
        seed: what it was drawn from.
        frame: anchor of the route's frame on earth.
        line: the line that ways are counted along.
        lane_left_m: middles of the lanes of this direction, the rightmost first.
        marking_left_m: lane markings, the rightmost first.
        features: truth and map of what stands there.
        layer: feature layer of those features.
        cruise_mps: slowest and fastest cruising speed.
    """

    name: str
    seed: int
    frame: LocalFrame
    line: Centreline
    lane_left_m: tuple[float, ...]
    marking_left_m: tuple[float, ...]
    features: Features
    layer: str
    cruise_mps: tuple[float, float]

    @property
    def length_m(self) -> float:
        """Way from one end to the other, or once around."""
        return self.line.length_m

    def lanes(self, step_m: float = 1.0) -> tuple[FloatArray, ...]:
        """Return the lane markings, each float64 (P, 2), a point every `step_m` of way; closed ones end at the start.

        These are the lane layer of the HD map, which has no error here, as in Kim et al., section 5.1.
        """
        count = max(2, round(self.length_m / step_m) + 1)
        way = np.linspace(0.0, self.length_m, count)
        return tuple(self.line.offset(way, left) for left in self.marking_left_m)


def placed(
    line: Centreline,
    stands: Sequence[tuple[float, float, str, float, FeatureState]],
    map_error: np.random.Generator,
) -> Features:
    """Return the features of stands (way [m], left of the line [m], kind, height [m], state), in the way's order."""
    ordered = sorted(stands)
    way, left, height = (np.array([s[k] for s in ordered], dtype=np.float64) for k in (0, 1, 3))
    states = tuple(s[4] for s in ordered)
    xy = line.offset(way, left)
    mapped = xy + MAP_ERROR_M * map_error.standard_normal(xy.shape)
    mapped[[state == "new" for state in states]] = nan
    ids = np.arange(1, len(ordered) + 1, dtype=np.int64)
    return Features(ids, tuple(s[2] for s in ordered), xy, height, states, mapped)
