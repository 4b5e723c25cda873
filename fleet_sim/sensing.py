"""What surfaces, weather and the width of a beam do to the returns of a LiDAR, beside noise and loss.

Glass lets most shots through or mirrors them. A wet road mirrors flat shots or gives nothing back. Drops take returns
away and give some of their own. A beam has a width: at an edge it meets two things, on a slanting surface the nearer
side answers first, and a retro-reflective sign answers to shots beside it.

Sizes are those that the papers on the effects report, rounded; they are no model of one sensor: Goodin et al. 2019
(rain: loss grows as exp(-2 a r)), Tuley et al. 2005 (mixed pixels), Laconte et al. 2019 (bias by incidence, up to 20 cm
beyond 80°), Zhao et al. 2020 (mirrors and glass).
"""

from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.ray_kernels import FloatArray, IntArray
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.shapes import COLUMNS
from gnd.fleet_sim.world import State, World

Weather = Literal["clear", "rain"]
WEATHERS: Final[tuple[Weather, ...]] = get_args(Weather)
Beams = Literal["ideal", "real"]
BEAMS: Final[tuple[Beams, ...]] = get_args(Beams)
BoolArray = NDArray[np.bool_]
Returns = tuple[FloatArray, IntArray, FloatArray]
"""Ranges, primitives and cosines of incidence of a sweep, (columns, beams) each."""

_GROUND: Final = ("road", "pavement")
_GLASS: Final = "glass"
_WET_COSINE: Final = 0.08
"""A wet road gives nothing back of exp(-cosine / this) of the shots: 9 % at 10 m, 45 % at 30 m from a roof."""
_WET_MIRRORED: Final = 0.4
"""Of those, so many meet what they are mirrored to."""
_RAIN_PER_M: Final = 0.004
_DROP_SHARE: Final = 0.004
_DROP_M: Final = 3.0
_GLASS_HEAD_ON: Final = 0.94
_GLASS_ANSWERS: Final = (0.12, 0.7)
"""Share of shots that glass gives back, slanting and head-on."""
_GLASS_MIRRORED: Final = 0.35
_GLASS_THROUGH: Final = 0.35
_ROOM_M: Final = 4.0
_ROOM_RANGE_M: Final = 9.0
_EDGE_M: Final = (0.25, 2.0)
_EDGE_SHARE: Final = 0.35
_DIVERGENCE_RAD: Final = 0.003
_BIAS_SHARE: Final = 0.15
_BIAS_MAX_M: Final = 0.06
_RETRO: Final = 0.85
_BLOOM: Final = ((1, 0.5), (2, 0.25))
_BLOOM_M: Final = 0.3
_SKIN_M: Final = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class SweepShots:
    """The shots of a sweep in the street frame, as `ray_kernels.cast_sweep` takes them.

    Attributes:
        poses: float64 (columns + 1, 3, 4).
        directions: float64 (columns, beams, 3).
        shares: float64 (beams,).
        range_m: reach.
    """

    poses: FloatArray
    directions: FloatArray
    shares: FloatArray
    range_m: float

    def rays(self, column: NDArray[np.int64], beam: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
        """Return origins and directions (K, 3) of single shots; the plain twin of `ray_kernels.shot`."""
        a, b, share = self.poses[column], self.poses[column + 1], self.shares[beam][:, None, None]
        pose = a + share * (b - a)
        return pose[:, :, 3], np.einsum("kij,kj->ki", pose[:, :, :3], self.directions[column, beam])


class Disturbance:
    """What disturbs the returns of one drive; its chance is of a stream of its own."""

    def __init__(self, world: World, state: State, weather: Weather, beams: Beams, seed: tuple[int, ...]) -> None:
        kinds = np.array([o.kind for o in world.in_state(state) for _ in o.shapes])
        self._glass, self._ground = kinds == _GLASS, np.isin(kinds, _GROUND)
        self._rain, self._beams, self._seed = weather == "rain", beams == "real", seed

    @property
    def acts(self) -> bool:
        """Whether anything is disturbed at all."""
        return bool(self._rain or self._beams or self._glass.any())

    def disturb(self, scene: Scene, packed: FloatArray, shots: SweepShots, t_s: float, met: Returns) -> None:
        """Change ranges, primitives and incidences of a sweep as they were met without any disturbance.

        Args:
            scene: what stands there; the world's primitives come first.
            packed: float64 (P, 13), all primitives that `met` counts.
            shots: of the sweep.
            t_s: its time, which makes its chance another than the next one's.
            met: what was met; changed.
        """
        rng = np.random.default_rng([*self._seed, 0x5EA5, round(t_s * 1e6) + 10**9])
        if self._beams:
            _retro(packed, met, rng)
            _mixed_pixels(met, rng)
            _incidence_bias(met)
        if self._glass.any():
            self._glazed(scene, shots, met, rng)
        if self._rain:
            self._wet_road(scene, shots, met, rng)
            _drops(met, rng)

    def _of(self, mask: BoolArray, primitive: IntArray) -> BoolArray:
        """Which shots met one of the world's primitives that a mask (P,) names."""
        inside = (primitive >= 0) & (primitive < len(mask))
        return inside & mask[np.where(inside, primitive, 0)]

    def _glazed(self, scene: Scene, shots: SweepShots, met: Returns, rng: np.random.Generator) -> None:
        ranges, primitive, incidence = met
        glass, draw = self._of(self._glass, primitive), rng.random((2, *ranges.shape))
        answers = np.where(incidence > _GLASS_HEAD_ON, _GLASS_ANSWERS[1], _GLASS_ANSWERS[0])
        column, beam = np.nonzero(glass & (draw[0] >= answers))
        _, direction = shots.rays(column, beam)
        kind, near = draw[1][column, beam], ranges[column, beam]
        mirrored = _mirrored(scene, shots, (column, beam), near, axis=1)
        behind = near + _ROOM_M / np.maximum(np.abs(direction[:, 1]), 1e-6)
        room = np.where(behind - near <= _ROOM_RANGE_M, behind, np.inf)
        rest = np.where(kind < _GLASS_MIRRORED + _GLASS_THROUGH, room, np.inf)
        _put(met, (column, beam), np.where(kind < _GLASS_MIRRORED, mirrored, rest), shots.range_m)

    def _wet_road(self, scene: Scene, shots: SweepShots, met: Returns, rng: np.random.Generator) -> None:
        ranges, primitive, incidence = met
        draw = rng.random((2, *ranges.shape))
        lost = self._of(self._ground, primitive) & (draw[0] < np.exp(-incidence / _WET_COSINE))
        column, beam = np.nonzero(lost)
        mirrored = _mirrored(scene, shots, (column, beam), ranges[column, beam], axis=2)
        seen = draw[1][column, beam] < _WET_MIRRORED
        _put(met, (column, beam), np.where(seen, mirrored, np.inf), shots.range_m)


Picked = tuple[NDArray[np.int64], NDArray[np.int64]]


def _mirrored(scene: Scene, shots: SweepShots, picked: Picked, near_m: FloatArray, axis: int) -> FloatArray:
    """Ranges (K,) at which shots appear that are mirrored where they met something, inf where they meet nothing more.

    The mirror is perpendicular to an axis of the street frame: 1 for fronts, 2 for the road.
    """
    origin, direction = shots.rays(*picked)
    turned = direction.copy()
    turned[:, axis] *= -1.0
    start = np.ascontiguousarray(origin + near_m[:, None] * direction + _SKIN_M * turned)
    inside = scene.holds(start)
    further = np.full(len(near_m), np.inf)
    if inside.any():
        met, _ = scene.cast_in_street(start[inside], turned[inside], shots.range_m)
        further[inside] = met
    return np.asarray(near_m + further)


def _put(met: Returns, picked: Picked, ranges_m: FloatArray, reach_m: float) -> None:
    """Give shots other ranges; one beyond the reach, or infinite, is no return."""
    ranges, primitive, _ = met
    none = ~(ranges_m <= reach_m)
    ranges[picked] = np.where(none, np.inf, ranges_m)
    primitive[picked] = np.where(none, -1, primitive[picked])


def _drops(met: Returns, rng: np.random.Generator) -> None:
    """Rain between: returns are lost with the way through it, and some drops near the sensor answer themselves."""
    ranges, primitive, incidence = met
    lost = rng.random(ranges.shape) >= np.exp(-2.0 * _RAIN_PER_M * np.where(np.isfinite(ranges), ranges, 0.0))
    ranges[lost], primitive[lost] = np.inf, -1
    drop = 1.0 + rng.exponential(_DROP_M, ranges.shape)
    answers = (rng.random(ranges.shape) < _DROP_SHARE) & (drop < ranges)
    ranges[answers], incidence[answers] = drop[answers], 1.0
    primitive[answers] = np.maximum(primitive[answers], 0)


def _mixed_pixels(met: Returns, rng: np.random.Generator) -> None:
    """At an edge between neighbouring columns, some shots that met the farther thing give a range in between."""
    ranges = met[0]
    near, far = ranges[:-1].copy(), ranges[1:].copy()
    chance, part = rng.random((2, *near.shape)), rng.uniform(0.2, 0.8, (2, *near.shape))
    for k, (first, second, shift) in enumerate(((near, far, 1), (far, near, 0))):
        with np.errstate(invalid="ignore"):
            step = second - first
        edge = np.isfinite(step) & (step > _EDGE_M[0]) & (step < _EDGE_M[1]) & (chance[k] < _EDGE_SHARE)
        target = ranges[shift : len(ranges) - 1 + shift]
        target[edge] = first[edge] + part[k][edge] * step[edge]


def _incidence_bias(met: Returns) -> None:
    """On a slanting surface the nearer side of the footprint answers first."""
    ranges, primitive, incidence = met
    cosine = np.clip(incidence, 0.05, 1.0)
    slant = np.sqrt(1.0 - cosine * cosine) / cosine
    hit = primitive >= 0
    bias = np.minimum(_BIAS_SHARE * _DIVERGENCE_RAD * np.where(hit, ranges, 0.0) * slant, _BIAS_MAX_M)
    ranges[hit] -= bias[hit]


def _retro(packed: FloatArray, met: Returns, rng: np.random.Generator) -> None:
    """A retro-reflective sign answers to some shots that pass beside it."""
    ranges, primitive, incidence = met
    bright = (primitive >= 0) & (packed[np.maximum(primitive, 0), COLUMNS - 1] >= _RETRO)
    shown, of = ranges.copy(), primitive.copy()
    for away, share in _BLOOM:
        for step in (away, -away):
            sign, mark, number = (np.roll(values, step, axis=0) for values in (shown, bright, of))
            beside = mark & ~bright & (ranges > sign + _BLOOM_M) & (rng.random(ranges.shape) < share)
            ranges[beside], primitive[beside], incidence[beside] = sign[beside], number[beside], 1.0
