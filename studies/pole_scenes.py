"""Simulated scans with their poles: what each scan sees of them, and detections against this truth."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.cars import parked_cars
from gnd.fleet_sim.drives import PERFECT, DriveConfig, DriveSimulation
from gnd.fleet_sim.lidar import Lidar, column_poses
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.shapes import Post
from gnd.fleet_sim.street import street
from gnd.fleet_sim.traffic import Traffic
from gnd.fleet_sim.world import World, WorldObject
from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import transform
from gnd.vehicle_agent.features.poles.detector import Pole, Rays

KINDS: Final = {"lamp": "streetlight", "sign": "traffic_sign", "tree": "trunk"}
"""Kinds of the detector by kinds of the world; a post of anything else is a "pole"."""
THIN_M: Final = 0.25
"""A thicker post is none."""
OBSERVABLE_LENGTH_M, OBSERVABLE_RETURNS = 1.5, 6
"""A scan shows a pole when so many returns lie on its post, and reach so far upwards. Fixed before tuning."""


@dataclass(frozen=True, slots=True, eq=False)
class Posts:
    """P upright posts of a world; several cylinders about one axis are one post.

    Attributes:
        source: the kind of the world's object that each belongs to.
        kind: what a detector should call it.
        xy_m: (P, 2) map frame.
        diameter_m: (P,) of the longest of its cylinders.
        top_m: (P,) over its lower end.
        of_primitive: post of each primitive of the scene, -1 where there is none.
    """

    source: tuple[str, ...]
    kind: tuple[str, ...]
    xy_m: F64
    diameter_m: F64
    top_m: F64
    of_primitive: I64


@dataclass(frozen=True, slots=True, eq=False)
class PoleScan:
    """A scan with its truth.

    Attributes:
        t_s: time of the drive, in its middle.
        rays: in the map frame.
        T_map_vehicle: (4, 4) true pose at t_s.
        returns: (P,) on each post.
        length_m: (P,) from the lowest to the highest return on each post.
    """

    t_s: float
    rays: Rays
    T_map_vehicle: F64
    returns: I64
    length_m: F64

    @property
    def observable(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """(P,) whether the scan shows each post."""
        return np.asarray((self.returns >= OBSERVABLE_RETURNS) & (self.length_m >= OBSERVABLE_LENGTH_M))


@dataclass(frozen=True, slots=True)
class PoleScans:
    """Which scans of which drive: those that begin at the given times."""

    seed: int
    sensor: str
    times_s: tuple[float, ...]
    traffic: bool = True


def posts_of(world: World, primitives: int) -> Posts:
    """The posts of the state `after`, whose objects come first in a scene of so many primitives."""
    found: dict[tuple[float, float], list[tuple[Post, WorldObject, int]]] = {}
    index = 0
    for thing in world.in_state("after"):
        for shape in thing.shapes:
            if isinstance(shape, Post) and shape.radius_m <= THIN_M:
                found.setdefault((shape.x_m, shape.y_m), []).append((shape, thing, index))
            index += 1
    of_primitive, street_xy, diameter, top = np.full(primitives + 1, -1), [], [], []
    for number, parts in enumerate(found.values()):
        of_primitive[[i for _, _, i in parts]] = number
        longest = max((shape for shape, _, _ in parts), key=lambda shape: shape.top_m - shape.bottom_m)
        street_xy.append([longest.x_m, longest.y_m, 0.0])
        diameter.append(2 * longest.radius_m)
        top.append(longest.top_m - min(shape.bottom_m for shape, _, _ in parts))
    source = tuple(parts[0][1].kind for parts in found.values())
    return Posts(
        source, tuple(KINDS.get(name, "pole") for name in source), world.map_of_street(np.array(street_xy))[:, :2],
        np.array(diameter), np.array(top), of_primitive,
    )  # fmt: skip


class PoleDrive:
    """A simulated drive whose scans come with the posts that they see; poses are true, the sensor is as it is."""

    def __init__(self, drive: PoleScans) -> None:
        world = _world(drive.seed)
        traffic = Traffic.urban() if drive.traffic else Traffic()
        self._config = DriveConfig("car", drive.sensor, seed=drive.seed, errors=PERFECT, traffic=traffic)
        self._drive, self._simulation = drive, DriveSimulation(world, self._config)
        share = world.parking if self._config.car_share is None else self._config.car_share
        shapes = (*world.shapes("after"), *parked_cars(world, "after", share, drive.seed))
        self._scene, self._lidar = Scene.build(shapes, world.A_street_map), Lidar(self._config.model)
        self.posts = posts_of(world, len(shapes))

    def scans(self) -> Iterator[PoleScan]:
        """The scans of the drive, one by one."""
        rng = np.random.default_rng([self._drive.seed, len(self._drive.times_s)])
        for t_s in self._drive.times_s:
            yield self._scan(t_s, rng)

    def _scan(self, t_s: float, rng: np.random.Generator) -> PoleScan:
        mount, motion, model = self._config.T_vehicle_lidar, self._simulation.motion, self._config.model
        T_map_lidar = column_poses(model, t_s, lambda t: motion.T_map_vehicle(t) @ mount)
        sweep = self._lidar.sweep(self._scene, T_map_lidar, rng, self._simulation.movers, t_s)
        knots_s = t_s + np.arange(-0.1, 0.25, 0.01)
        poses = Trajectory(np.round(knots_s * 1e9).astype(np.int64) + 10**12, motion.T_map_vehicle(knots_s))
        start_ns = round(t_s * 1e9) + 10**12
        middle_ns = start_ns + model.period_ns // 2
        T = poses.at(middle_ns)
        ends, starts = (
            transform(T, deskew(p, sweep.t_offset_ns, start_ns, poses, mount, middle_ns))
            for p in (sweep.points_lidar_m, np.zeros_like(sweep.points_lidar_m))
        )
        of = self.posts.of_primitive[np.minimum(sweep.primitive, len(self.posts.of_primitive) - 1)]
        returns = np.bincount(of[of >= 0], minlength=len(self.posts.kind))
        return PoleScan(t_s + 0.5 / model.rate_hz, Rays(ends, starts), T, returns, self._lengths(ends[:, 2], of))

    def _lengths(self, z_m: F64, of: I64) -> F64:
        low, high = np.full(len(self.posts.kind), np.inf), np.full(len(self.posts.kind), -np.inf)
        np.minimum.at(low, of[of >= 0], z_m[of >= 0])
        np.maximum.at(high, of[of >= 0], z_m[of >= 0])
        return np.asarray(np.maximum(high - low, 0.0))


@lru_cache(maxsize=4)
def _world(seed: int) -> World:
    return street(seed)


GATE_M: Final = 0.5
"""A detection is right when the axis of a post that no nearer detection has lies within this."""
BANDS: Final = ((0, 10), (10, 20), (20, 30), (30, 40))
SINGLE: Final = ("lamp", "sign", "tree")
"""Things of the world that stand alone; a scaffold's posts do not, and bollards are too low to count."""
CHI2_2_95: Final = 5.991
"""95 % quantile of chi-square with two degrees of freedom."""

Mask = NDArray[np.bool_]


@dataclass(slots=True)
class PoleScore:
    """Counts over scans or windows.

    Attributes:
        seen: (band, source, found) of observable posts.
        all: (source, found) of all posts within range, visible or not.
        right: (band, whether a post stands there) of detections.
        kinds: (source, kind told) of right detections.
        errors_m, nees, diameters_m: of right detections; the last is told less true.
        spent_s: time of one core, of each call.
    """

    seen: Counter[tuple[int, str, bool]] = field(default_factory=Counter)
    all: Counter[tuple[str, bool]] = field(default_factory=Counter)
    right: Counter[tuple[int, bool]] = field(default_factory=Counter)
    kinds: Counter[tuple[str, str]] = field(default_factory=Counter)
    errors_m: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    diameters_m: list[float] = field(default_factory=list)
    spent_s: list[float] = field(default_factory=list)

    def add(self, poles: Sequence[Pole], posts: Posts, observable: Mask, place_m: F64) -> None:
        """Count one scan or window, seen from a place (2,) of the map frame."""
        match = matches(poles, posts)
        away = np.hypot(*(posts.xy_m - place_m).T)
        for post in np.flatnonzero(away < BANDS[-1][1]):
            found = bool((match == post).any())
            self.all[posts.source[post], found] += 1
            if observable[post]:
                self.seen[_band(away[post]), posts.source[post], found] += 1
        for pole, post in zip(poles, match, strict=True):
            self.right[_band(float(np.hypot(*(pole.xy_m - place_m)))), post >= 0] += 1
            if post >= 0:
                self._add_right(pole, posts, post)

    def _add_right(self, pole: Pole, posts: Posts, post: int) -> None:
        off = pole.xy_m - posts.xy_m[post]
        self.kinds[posts.source[post], pole.kind] += 1
        self.errors_m.append(float(np.hypot(*off)))
        self.nees.append(float(off @ np.linalg.solve(pole.cov_m2, off)))
        self.diameters_m.append(pole.diameter_m - float(posts.diameter_m[post]))

    def recall(self, band: int | None = None, sources: Sequence[str] = SINGLE) -> tuple[float, int]:
        """Share of the observable posts that were found, in percent, and how many there were."""
        counts = {f: sum(n for (b, s, g), n in self.seen.items() if g == f and s in sources and band in (None, b))
                  for f in (True, False)}  # fmt: skip
        return 100.0 * counts[True] / max(sum(counts.values()), 1), sum(counts.values())

    def recall_of_all(self) -> tuple[float, int]:
        """The same of all posts that stand alone within range, hidden and far ones too."""
        counts = {f: sum(n for (s, g), n in self.all.items() if g == f and s in SINGLE) for f in (True, False)}
        return 100.0 * counts[True] / max(sum(counts.values()), 1), sum(counts.values())

    def precision(self, band: int | None = None) -> tuple[float, int]:
        """Share of the detections where a post stands, in percent, and how many there were."""
        right = sum(n for (b, r), n in self.right.items() if r and band in (None, b))
        total = sum(n for (b, _), n in self.right.items() if band in (None, b))
        return 100.0 * right / max(total, 1), total


def _band(away_m: float) -> int:
    return min(int(away_m // 10), len(BANDS) - 1)


def matches(poles: Sequence[Pole], posts: Posts) -> I64:
    """Post of each pole, -1 where there is none: one to one, the nearest pairs first."""
    match = np.full(len(poles), -1)
    if not poles or not len(posts.xy_m):
        return match
    apart = np.hypot(*np.moveaxis(np.array([pole.xy_m for pole in poles])[:, None] - posts.xy_m, -1, 0))
    while apart.min() <= GATE_M:
        pole, post = np.unravel_index(apart.argmin(), apart.shape)
        match[pole] = post
        apart[pole], apart[:, post] = np.inf, np.inf
    return match
