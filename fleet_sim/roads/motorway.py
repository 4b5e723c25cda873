"""A motorway with traffic signs, some of which the map lacks and some of which are gone (Jo et al. 2018, section 6).

20 km, three lanes a direction. The numbers of signs are those of the paper's Table 1: 55 stand as mapped, 9 of the
map are gone, 39 stand without being mapped. They stand as along French motorways: pairs on both sides, rows on the
verge before exits, gantries over the lanes with panels a lane apart.
"""

from dataclasses import dataclass
from math import pi, radians
from typing import Final

import numpy as np

from gnd.fleet_sim.errors import RoadError
from gnd.fleet_sim.roads.alignment import Bends, drawn_bends
from gnd.fleet_sim.roads.curve import of_curvature
from gnd.fleet_sim.roads.route import FeatureState, Route, placed
from gnd.gnd_map.geodesy import LocalFrame

LENGTH_M: Final = 20_000.0
NORMAL: Final = 55
DELETED: Final = 9
NEW: Final = 39
LANE_M: Final = 3.5
LANES: Final = (-1.5 * LANE_M, -0.5 * LANE_M, 0.5 * LANE_M)
"""Ways are counted along the line between the middle and the left lane."""
MARKINGS: Final = (-2.0 * LANE_M, -LANE_M, 0.0, LANE_M)
VERGE_LEFT_M: Final = -2.0 * LANE_M - 4.0
"""Signs on the right stand behind the hard shoulder of 2.5 … 3 m."""
MEDIAN_LEFT_M: Final = LANE_M + 2.0
KINDS: Final = ("speed_limit", "no_overtaking", "warning", "information", "direction", "exit")

_ANCHOR: Final = LocalFrame(radians(49.2), radians(2.6), 90.0)
_BENDS: Final = Bends((900.0, 5000.0), (100.0, 1200.0), (300.0, 1300.0), (120.0, 250.0))
"""French motorways for 130 km/h have radii of at least 600 m, curves without superelevation of 900 m (ICTAAL 2015)."""
_MOVED: Final = 3
"""So many of the deleted signs have been moved by some metres: a new one of the same kind stands near."""
_ENDS_M: Final = 250.0


@dataclass(frozen=True, slots=True)
class _Stand:
    """A sign with its place along the way, left of the line, and over the road."""

    way_m: float
    left_m: float
    kind: str
    height_m: float


def motorway(seed: int, length_m: float = LENGTH_M) -> Route:
    """Return the motorway of a seed.

    Args:
        seed: any integer >= 0.
        length_m: at least 5 km; shorter ones than 20 km hold the same share of signs, rounded, at least one a state.

    Raises:
        RoadError: the seed is negative or the motorway too short.
    """
    if seed < 0 or length_m < 5000.0:
        raise RoadError(f"a motorway needs a seed >= 0 and at least 5000 m, got {seed} and {length_m:g} m")
    curves, signs, fate, survey = (np.random.default_rng([seed, stream, 6]) for stream in range(4))
    line = of_curvature(drawn_bends(_BENDS, length_m, curves), float(curves.uniform(-pi, pi)))
    share = length_m / LENGTH_M
    normal, deleted, new = (max(1, round(share * count)) for count in (NORMAL, DELETED, NEW))
    stands = _fated(_stands(normal + deleted + new - min(_MOVED, deleted, new), length_m, signs), deleted, new, fate)
    features = placed(line, stands, survey)
    return Route(f"motorway-{seed}", seed, _ANCHOR, line, LANES, MARKINGS, features, "signs", (25.0, 33.0))


def _stands(count: int, length_m: float, rng: np.random.Generator) -> list[_Stand]:
    """`count` signs in groups along the way, groups at least 60 m apart."""
    makers = (_single, _single, _single, _pair, _pair, _exit_row, _gantry)
    stands: list[_Stand] = []
    groups: list[list[_Stand]] = []
    while sum(map(len, groups)) < count:
        groups.append(makers[int(rng.integers(len(makers)))](rng))
    groups[-1] = groups[-1][: count - sum(map(len, groups[:-1]))]
    gaps = rng.exponential(1.0, len(groups) + 1)
    reach = [max(s.way_m for s in group) for group in groups]
    free_m = length_m - 2 * _ENDS_M - sum(reach) - 60.0 * len(groups)
    if free_m < 0:
        raise RoadError(f"{count} signs do not fit on {length_m:.0f} m: {-free_m:.0f} m too long")
    way = _ENDS_M
    for group, gap, long in zip(groups, gaps / gaps.sum() * free_m, reach, strict=False):
        way += float(gap)
        stands += [_Stand(way + s.way_m, s.left_m, s.kind, s.height_m) for s in group]
        way += long + 60.0
    return stands


def _single(rng: np.random.Generator) -> list[_Stand]:
    """A sign on a post on the verge."""
    kind = KINDS[int(rng.integers(1, 4))]
    return [_Stand(0.0, VERGE_LEFT_M - float(rng.uniform(0.0, 1.5)), kind, float(rng.uniform(2.2, 3.0)))]


def _pair(rng: np.random.Generator) -> list[_Stand]:
    """The same sign on both sides: a speed limit or a ban on overtaking."""
    kind, height = KINDS[int(rng.integers(0, 2))], float(rng.uniform(2.2, 2.8))
    right = _Stand(float(rng.uniform(0.0, 3.0)), VERGE_LEFT_M - float(rng.uniform(0.0, 1.0)), kind, height)
    return [right, _Stand(float(rng.uniform(0.0, 3.0)), MEDIAN_LEFT_M + float(rng.uniform(0.0, 0.4)), kind, height)]


def _exit_row(rng: np.random.Generator) -> list[_Stand]:
    """What announces an exit: panels and beacons on the verge, one behind the other."""
    count, way, found = int(rng.integers(3, 6)), 0.0, []
    for index in range(count):
        kind = KINDS[5] if index else KINDS[4]
        left = VERGE_LEFT_M - float(rng.uniform(0.0, 1.5))
        found.append(_Stand(way, left, kind, float(rng.uniform(2.0, 4.0))))
        way += float(rng.uniform(12.0, 60.0))
    return found


def _gantry(rng: np.random.Generator) -> list[_Stand]:
    """Panels over the lanes, a lane apart, and sometimes one more on the verge."""
    panels = LANES if rng.random() < 0.5 else LANES[:2]
    found = [_Stand(0.0, left + float(rng.uniform(-0.3, 0.3)), KINDS[4], 6.5) for left in panels]
    if rng.random() < 0.4:
        found.append(_Stand(float(rng.uniform(-4.0, 4.0)) + 4.0, VERGE_LEFT_M, KINDS[3], 2.5))
    return found


def _fated(
    stands: list[_Stand], deleted: int, new: int, rng: np.random.Generator
) -> list[tuple[float, float, str, float, FeatureState]]:
    """Decide which of the signs are gone and which the map lacks; some of the gone ones were moved by some metres."""
    order = rng.permutation(len(stands)).tolist()
    moved = min(_MOVED, deleted, new)
    state: dict[int, FeatureState] = dict.fromkeys(order[:deleted], "deleted")
    state |= dict.fromkeys(order[deleted : deleted + new - moved], "new")
    found: list[tuple[float, float, str, float, FeatureState]] = [
        (s.way_m, s.left_m, s.kind, s.height_m, state.get(i, "normal")) for i, s in enumerate(stands)
    ]
    for i in order[:moved]:
        s, step_m = stands[i], float(rng.uniform(6.0, 20.0)) * float(rng.choice((-1.0, 1.0)))
        found.append((s.way_m + step_m, s.left_m, s.kind, s.height_m, "new"))
    return found
