"""Where objects are put: seeded places on free, even ground beside the track."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.shapes import Block, Post
from studies.real.scene import Scene

F64 = NDArray[np.float64]
Object = Block | Post

KINDS = ("box", "post", "wall", "car")
CELL_M = 0.5
NEAREST_M, FARTHEST_M = 2.5, 14.0
"""From the track to the middle of an object."""
CLEAR_M = 0.3
"""Room around an object that must be free of points."""
UNEVEN_M = 0.25
MIN_KNOWN = 0.6
"""Share of the ground under an object that must have been measured."""
MAX_POINTS_INSIDE = 3
TRIES = 3000
_NEAR_M, _CUBE_M = 25.0, 0.2


@dataclass(frozen=True, slots=True)
class Placed:
    """An object with what it stands for."""

    kind: str
    shape: Object
    radius_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Points (N, 3) near the track, one in each cube of 20 cm, and the lowest point in cells of the ground plane."""

    points_m: F64
    low_m: F64
    corner_m: F64

    @classmethod
    def of(cls, scene: Scene) -> "Surroundings":
        """From every third point of every scan."""
        parts = []
        for scan in scene.scans:
            refined = scene.refined(scan)
            range_m = np.linalg.norm(refined.points_map_m - refined.origins_map_m, axis=1)
            parts.append(_one_a_cube(refined.points_map_m[(range_m > 2.0) & (range_m < _NEAR_M)][::3]))
        points = _one_a_cube(np.concatenate(parts))
        corner = points[:, :2].min(axis=0)
        at = ((points[:, :2] - corner) / CELL_M).astype(np.int64)
        low = np.full(at.max(axis=0) + 1, np.inf)
        np.minimum.at(low, (at[:, 0], at[:, 1]), points[:, 2])
        return cls(points, low, corner)

    def lowest(self, xy_m: F64) -> F64:
        """(K,) lowest point of the cells at (K, 2), inf where nothing was measured."""
        at = np.floor((xy_m - self.corner_m) / CELL_M).astype(np.int64)
        inside = ((at >= 0) & (at < self.low_m.shape)).all(axis=1)
        found = np.full(len(at), np.inf)
        found[inside] = self.low_m[at[inside, 0], at[inside, 1]]
        return found


def _one_a_cube(points_m: F64) -> F64:
    """One point in each cube of `_CUBE_M`, the lowest."""
    if not len(points_m):
        return points_m
    low_first = points_m[np.argsort(points_m[:, 2], kind="stable")]
    at = np.floor((low_first - low_first.min(axis=0)) / _CUBE_M).astype(np.int64)
    shape = at.max(axis=0) + 1
    return low_first[np.unique(np.ravel_multi_index(tuple(at.T), tuple(shape)), return_index=True)[1]]


def choose_places(scene: Scene, around: Surroundings, n: int, rng: np.random.Generator) -> list[Placed]:
    """Up to `n` objects of all kinds, none in another's place or in the vehicle's way."""
    found: list[Placed] = []
    for tried in range(TRIES):
        if len(found) == n:
            break
        one = _candidate(scene, around, KINDS[(len(found) + tried // 200) % len(KINDS)], rng)
        if one is not None and _apart(one, found) and _off_the_track(one, scene.positions_m):
            found.append(one)
    return found


def _candidate(scene: Scene, around: Surroundings, kind: str, rng: np.random.Generator) -> Placed | None:
    T = scene.poses.T_dst_vehicle[rng.integers(len(scene.poses))]
    aside = rng.uniform(NEAREST_M, FARTHEST_M) * rng.choice([-1.0, 1.0])
    xy = (T @ np.array([rng.uniform(-6.0, 6.0), aside, 0.0, 1.0]))[:2]
    half_x, half_y, height = _size(kind, rng)
    yaw = rng.uniform(0.0, np.pi)
    ground = around.lowest(xy + _footprint(half_x + CLEAR_M, half_y + CLEAR_M, yaw))
    known = np.isfinite(ground)
    if known.mean() < MIN_KNOWN or np.ptp(ground[known]) > UNEVEN_M:
        return None
    bottom = float(np.median(ground[known]))
    if _points_inside(around.points_m, xy, half_x, half_y, yaw, bottom, height) > MAX_POINTS_INSIDE:
        return None
    x, y, low, high = float(xy[0]), float(xy[1]), bottom - 0.1, bottom + height
    shape = Post(x, y, half_x, low, high) if kind == "post" else Block(x, y, half_x, half_y, low, high, yaw)
    return Placed(kind, shape, float(np.hypot(half_x, half_y)))


def _size(kind: str, rng: np.random.Generator) -> tuple[float, float, float]:
    """Half length, half width and height over the ground."""
    low, high = {
        "box": ((0.4, 0.4, 0.8), (0.9, 0.8, 2.0)),
        "post": ((0.1, 0.1, 2.0), (0.3, 0.1, 3.5)),
        "wall": ((1.0, 0.1, 1.0), (2.5, 0.15, 2.4)),
        "car": ((1.9, 0.8, 1.4), (2.4, 0.95, 1.8)),
    }[kind]
    half_x, half_y, height = rng.uniform(low, high)
    return float(half_x), float(half_x if kind == "post" else half_y), float(height)


def _footprint(half_x: float, half_y: float, yaw: float) -> F64:
    """(K, 2) points spread over a rectangle about the origin."""
    u, v = (np.linspace(-half, half, max(2, int(2 * half / CELL_M) + 1)) for half in (half_x, half_y))
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(grid @ np.array([[c, s], [-s, c]]))


def _points_inside(
    points: F64, xy: NDArray[np.floating], half_x: float, half_y: float, yaw: float, bottom: float, height: float
) -> int:
    """Points in the room that an object takes, with some room around it, the ground left out."""
    near = points[np.abs(points[:, :2] - xy).max(axis=1) < half_x + half_y + 1.0]
    c, s = np.cos(yaw), np.sin(yaw)
    along = (near[:, :2] - xy) @ np.array([[c, -s], [s, c]])
    z = near[:, 2] - bottom
    inside = (np.abs(along[:, 0]) < half_x + CLEAR_M) & (np.abs(along[:, 1]) < half_y + CLEAR_M)
    return int((inside & (z > 0.3) & (z < height + CLEAR_M)).sum())


def _apart(one: Placed, others: Sequence[Placed]) -> bool:
    gaps = [
        np.hypot(one.shape.x_m - o.shape.x_m, one.shape.y_m - o.shape.y_m) - one.radius_m - o.radius_m for o in others
    ]
    return min(gaps, default=np.inf) > 1.5


def _off_the_track(one: Placed, positions_m: F64) -> bool:
    distance = np.linalg.norm(positions_m[:, :2] - [one.shape.x_m, one.shape.y_m], axis=1)
    return bool(distance.min() > one.radius_m + 1.3)
