"""A production camera that detects traffic signs on a simulated street: what it reports in each look.

What hides a sign is found by casting rays at its plate through everything that stands and moves there. White noise is
that of Kim et al. 2018, Table 1, at a level that fits cameras of series cars, and on top comes what averaging over the
looks of a passage does not remove (`roads/hard_noise.py`); field of view and rate are those of Jo et al. 2018, section
6.1. A plate is found from either side.
"""

from dataclasses import dataclass, field
from math import pi, radians
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.feature_truth import KIND_OF, LAYER_OF, facing_street, plate_of, position_street_m
from gnd.fleet_sim.movers import Movers
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.roads.hard_noise import HardNoise, erring
from gnd.fleet_sim.shapes import Block
from gnd.fleet_sim.trajectory import Motion
from gnd.fleet_sim.world import State, World
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import Detections

FloatArray = NDArray[np.float64]

_NS_PER_S: Final = 1_000_000_000
_STREAM: Final = 62
_HARD_STREAM: Final = 63
_LOOKALIKE_STREAM: Final = 64
_LOOKALIKE: Final = "looks like a sign"
_LOOKALIKE_PLATE: Final = (0.3, 0.3, 2.5)
"""Half width, half height and height of the middle of what looks like a sign [m]: an advert, a house number."""
_LOOKALIKE_LEFT_M: Final = (6.0, 8.5)
"""How far to either side of the middle of the road such things hang."""
BEARING_DEG: Final = 2.5
HEIGHT_SHARE: Final = 0.5
"""Height noise for level 1 [m]."""
_AIMS: Final = np.array([[0.0, 0.0], [-0.6, -0.6], [-0.6, 0.6], [0.6, -0.6], [0.6, 0.6]])
"""Where rays are aimed on a plate, as shares of its half width and half height."""
_FREE: Final = 3
"""A sign is seen when so many of its rays arrive."""
_TOUCH_M: Final = 0.05


@dataclass(frozen=True, slots=True)
class SignCamera:
    """A camera and its detector of signs.

    Attributes:
        level: l of the noise: l m in range, 2.5 l degrees in bearing, half l m in height. 0.7 is between the 0.5 and
            1 of Kim et al., Figure 8, where a series camera is to be expected.
        miss_rate: share of visible signs that a look misses.
        false_alarms: mean number of false detections a look.
        width_deg, range_m: field of view about the vehicle's origin, as its detections are given.
        rate_hz: looks a second.
        mount_m: where it sits: x ahead of the vehicle's origin, y left, z up.
        hard: what it errs by besides, of which no detection says anything; None: white noise is all, and any visible
            sign is missed in `miss_rate` of the looks.
    """

    level: float = 0.7
    miss_rate: float = 0.1
    false_alarms: float = 0.02
    width_deg: float = 40.0
    range_m: float = 80.0
    rate_hz: int = 15
    mount_m: tuple[float, float, float] = (1.8, 0.0, 1.3)
    hard: HardNoise | None = field(default_factory=HardNoise)

    def __post_init__(self) -> None:
        if not (self.level > 0 and 0 <= self.miss_rate < 1 and self.false_alarms >= 0 and self.rate_hz >= 1):
            raise DriveSimError(f"impossible camera: {self}")
        if not (0 < self.width_deg <= 180 and 0 < self.range_m <= 200):
            raise DriveSimError(f"a camera sees up to 180° and 200 m, got {self.width_deg}° and {self.range_m} m")

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of range [m], bearing [rad] and height [m], float64 (3,)."""
        return self.level * np.array([1.0, radians(BEARING_DEG), HEIGHT_SHARE])


@dataclass(frozen=True, slots=True, eq=False)
class _Signs:
    """S signs of a state, and what looks like one: name, aims float64 (S, A, 3) in the map frame, first and last
    primitive of each (both -1 of a look-alike, which is no object of the world).
    """

    names: tuple[str, ...]
    aims_map_m: FloatArray
    first: NDArray[np.int64]
    end: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """What the camera could see: L looks, S signs.

    Attributes:
        names: of the signs, and of what looks like one.
        polar: float64 (L, S, 3), true range [m], bearing [rad] and height [m] about the vehicle's origin.
        in_view: bool (L, S).
        visible: bool (L, S), in view and not hidden.
    """

    names: tuple[str, ...]
    polar: FloatArray
    in_view: NDArray[np.bool_]
    visible: NDArray[np.bool_]

    @property
    def is_sign(self) -> NDArray[np.bool_]:
        """Which are signs, bool (S,); the others only look like one."""
        return np.array([name != _LOOKALIKE for name in self.names], np.bool_)


def sightings(
    camera: SignCamera, world: World, state: State, scene: Scene, movers: Movers | None, motion: Motion, t_s: FloatArray
) -> Sightings:
    """Find out which signs the camera can see.

    Args:
        camera: field of view and mount.
        world: whose signs.
        state: the state that it is in.
        scene: all that stands there; the primitives of the world's objects come first, in their order.
        movers: what moves there.
        motion: of the vehicle.
        t_s: times of the looks in the motion's time, float64 (L,).
    """
    signs = _signs(world, state, camera.hard)
    T_map_vehicle = motion.T_map_vehicle(t_s)
    middle = signs.aims_map_m[:, 0]
    T = T_inverse(T_map_vehicle)
    place = np.einsum("lij,sj->lsi", T[:, :3, :3], middle) + T[:, None, :3, 3]
    range_m, bearing = np.linalg.norm(place[..., :2], axis=2), np.arctan2(place[..., 1], place[..., 0])
    in_view = (range_m <= camera.range_m) & (np.abs(bearing) <= radians(camera.width_deg) / 2)
    visible = np.zeros_like(in_view)
    look, sign = np.nonzero(in_view)
    if look.size:
        eyes = T_map_vehicle[look, :3, :3] @ np.array(camera.mount_m) + T_map_vehicle[look, :3, 3]
        visible[look, sign] = _free(signs, sign, eyes, scene, movers, t_s[look]) >= _FREE
    return Sightings(signs.names, np.stack([range_m, bearing, place[..., 2]], axis=2), in_view, visible)


def _signs(world: World, state: State, hard: HardNoise | None) -> _Signs:
    names, aims, first, end, position = [], [], [], [], 0
    for o in world.in_state(state):
        if LAYER_OF.get(o.kind) == "signs":
            names.append(o.name)
            aims.append(world.map_of_street(_aims(plate_of(o), position_street_m(o))))
            first.append(position)
            end.append(position + len(o.shapes))
        position += len(o.shapes)
    for points_street in () if hard is None else _lookalikes(world, hard):
        names.append(_LOOKALIKE)
        aims.append(world.map_of_street(points_street))
        first.append(-1)
        end.append(-1)
    points = np.array(aims).reshape(-1, len(_AIMS), 3)
    return _Signs(tuple(names), points, np.array(first, dtype=np.int64), np.array(end, dtype=np.int64))


def _lookalikes(world: World, hard: HardNoise) -> FloatArray:
    """Points on what looks like a sign, float64 (N, A, 3), street frame: the same for all drives along the street."""
    rng = np.random.default_rng([world.seed, _LOOKALIKE_STREAM])
    half_m = world.half_length_m
    count = int(rng.poisson(hard.lookalikes_per_km * 2.0 * half_m / 1000.0))
    half_wide, half_high, height_m = _LOOKALIKE_PLATE
    middle = np.full((count, 3), height_m)
    middle[:, 0] = rng.uniform(-half_m, half_m, count)
    middle[:, 1] = rng.uniform(*_LOOKALIKE_LEFT_M, count) * rng.choice((-1.0, 1.0), count)
    aims = _AIMS[:, :1] * [0.0, half_wide, 0.0] + _AIMS[:, 1:] * [0.0, 0.0, half_high]
    return np.asarray(middle[:, None] + aims)


def _aims(plate: Block, middle: FloatArray) -> FloatArray:
    """Points on a plate, float64 (A, 3), street frame."""
    wide = plate.half_y_m * facing_street(plate)
    high = np.array([0.0, 0.0, 0.5 * (plate.top_m - plate.bottom_m)])
    return np.asarray(middle + _AIMS[:, :1] * wide + _AIMS[:, 1:] * high)


def _free(
    signs: _Signs, sign: NDArray[np.int64], eyes: FloatArray, scene: Scene, movers: Movers | None, t_s: FloatArray
) -> NDArray[np.int64]:
    """How many rays from eyes (P, 3) to the signs (P,) of pairs arrive, int64 (P,)."""
    way = signs.aims_map_m[sign] - eyes[:, None]
    distance = np.linalg.norm(way, axis=2)
    directions = (way / distance[..., None]).reshape(-1, 3)
    starts = np.repeat(eyes, len(_AIMS), axis=0)
    met_m, primitive = scene.cast(starts, directions, float(distance.max()) + 1.0)
    met_m, primitive = met_m.reshape(distance.shape), primitive.reshape(distance.shape)
    own = (primitive >= signs.first[sign][:, None]) & (primitive < signs.end[sign][:, None])
    reached = np.where(own, np.inf, met_m)
    if movers is not None:
        reached = np.minimum(reached, _movers_m(scene, movers, starts, directions, t_s, distance))
    return np.asarray((reached >= distance - _TOUCH_M).sum(axis=1), dtype=np.int64)


def _movers_m(
    scene: Scene, movers: Movers, starts: FloatArray, directions: FloatArray, t_s: FloatArray, distance: FloatArray
) -> FloatArray:
    """Where the rays of each pair meet something that moves, float64 (P, A), inf where they do not."""
    found = np.full(distance.shape, np.inf)
    aims = distance.shape[1]
    T = np.tile(np.eye(4)[:3], (aims + 1, 1, 1))
    for pair in range(len(t_s)):
        T[:, :, 3] = starts[pair * aims]
        rays = np.ascontiguousarray(directions[pair * aims : (pair + 1) * aims, None, :])
        poses = np.ascontiguousarray(scene.A_street_map @ T)
        met = (np.full((aims, 1), np.inf), np.full((aims, 1), -1, dtype=np.int32), np.zeros((aims, 1)))
        # All rays leave at one instant; a turn this wide leaves no mover out.
        movers.meet((poses, rays, np.zeros(1)), float(distance[pair].max()), (float(t_s[pair]), 0.0, pi), 0, met)
        found[pair] = met[0][:, 0]
    return found


def looks_of(camera: SignCamera, seen: Sightings, t_ns: NDArray[np.int64], seed: tuple[int, int]) -> list[Detections]:
    """Return what the camera reports at times int64 (L,), one item a look, those without a sign too."""
    rng = np.random.default_rng([*seed, _STREAM])
    hit, noisy = _kindly(camera, seen, rng)
    if camera.hard is not None:
        hit, noisy[..., :2] = _hardly(camera, camera.hard, seen, np.random.default_rng([*seed, _HARD_STREAM]))
    alarms = rng.poisson(camera.false_alarms, len(t_ns))
    looks = []
    for row in range(len(t_ns)):
        false = _false_alarms(camera, int(alarms[row]), rng)
        rows = np.concatenate([noisy[row, hit[row]], false])
        looks.append(_look(camera, int(t_ns[row]), rows[rng.permutation(len(rows))]))
    return looks


def _kindly(camera: SignCamera, seen: Sightings, rng: np.random.Generator) -> tuple[NDArray[np.bool_], FloatArray]:
    """Which signs each look detects, bool (L, S), and where, float64 (L, S, 3): white noise is all."""
    shape = seen.visible.shape
    hit = seen.visible & seen.is_sign & (rng.random(shape) >= camera.miss_rate)
    return hit, seen.polar + camera.sigmas * rng.standard_normal((*shape, 3))


def _hardly(
    camera: SignCamera, hard: HardNoise, seen: Sightings, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], FloatArray]:
    """Which signs and look-alikes each look of a drive detects, bool (L, S), and where, float64 (L, S, 2). The layer
    of a street has one kind: none is confused.
    """
    range_m, bearing = seen.polar[..., 0], seen.polar[..., 1]
    count = len(seen.names)
    rate = rng.uniform(hard.least_seen, 1.0, count)
    is_taken = rng.random(count) < hard.lookalike_seen
    rate = np.where(seen.is_sign, rate, is_taken * rng.uniform(*hard.lookalike_rate, count))
    hit = seen.visible & (rng.random(seen.visible.shape) < hard.detectable(range_m, camera.range_m) * rate)
    stated = (float(camera.sigmas[0]), float(camera.sigmas[1]))
    return hit, np.stack(erring((range_m, bearing), stated, camera.mount_m[2], hard, rng), axis=2)


def _false_alarms(camera: SignCamera, count: int, rng: np.random.Generator) -> FloatArray:
    """Range, bearing, height of false detections, float64 (count, 3), evenly over the field of view."""
    range_m = camera.range_m * np.sqrt(rng.random(count))
    bearing = radians(camera.width_deg) * (rng.random(count) - 0.5)
    return np.column_stack([range_m, bearing, rng.uniform(1.0, 3.5, count)])


def _look(camera: SignCamera, t_ns: int, rows: FloatArray) -> Detections:
    range_sigma, bearing_sigma, _ = camera.sigmas
    columns = np.abs(rows[:, 0]), (rows[:, 1] + pi) % (2 * pi) - pi, rows[:, 2]
    sigmas = (np.full(len(rows), sigma) for sigma in (range_sigma, bearing_sigma))
    range_m, bearing, height, sigma_range, sigma_bearing = (a.astype(np.float32) for a in (*columns, *sigmas))
    kinds = (KIND_OF["sign"],) * len(rows)
    return Detections(t_ns, "camera", LAYER_OF["sign"], kinds, range_m, bearing, height, sigma_range, sigma_bearing)


def look_times_ns(camera: SignCamera, seconds: float) -> NDArray[np.int64]:
    """Return when the camera looks, int64 (L,) [ns] after the first scan."""
    return (np.arange(int(seconds * camera.rate_hz) + 1, dtype=np.int64) * _NS_PER_S) // camera.rate_hz
