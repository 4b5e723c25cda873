"""What detectors report of what they could see: noise, misses, false alarms, and lane markings.

Noise follows Table 1 of Kim et al. 2018: range N(0, l^2) m and bearing N(0, (2.5 l)^2)° of point features, distance
and heading of polylines likewise, drawn anew each look. How the table is read for polylines: one draw of each for a
whole marking in a look; the distance moves the marking sideways, the heading turns it about the vehicle's origin, as
the first two coefficients of a lane camera's polynomial would err.
"""

from dataclasses import dataclass
from math import radians
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import RoadError
from gnd.fleet_sim.roads.curve import FloatArray
from gnd.fleet_sim.roads.route import Features, IntArray, Route
from gnd.fleet_sim.roads.sight import BoolArray, CameraView
from gnd.schemas.drive import Detections, LaneLook

BEARING_DEG: Final = 2.5
"""Bearing noise for l = 1."""
_LANE_STEP_M: Final = 1.0
_NEAREST_M: Final = 1.0


@dataclass(frozen=True, slots=True)
class DetectorNoise:
    """How a detector errs.

    Attributes:
        level: l of Table 1.
        miss_rate: share of visible features that a look misses; 0.1 goes with SLAMCU's λ = 0.9.
        false_alarms: mean number of false detections a look, anywhere in the field of view.
        misclassified: share of detections with another feature's kind.
    """

    level: float = 1.0
    miss_rate: float = 0.1
    false_alarms: float = 0.02
    misclassified: float = 0.0

    def __post_init__(self) -> None:
        shares = (self.miss_rate, self.misclassified)
        if not (self.level > 0 and self.false_alarms >= 0 and all(0.0 <= share < 1.0 for share in shares)):
            raise RoadError(f"impossible noise of a detector: {self}")

    @property
    def sigma_range_m(self) -> float:
        """Standard deviation of a range."""
        return self.level

    @property
    def sigma_bearing_rad(self) -> float:
        """Standard deviation of a bearing."""
        return radians(BEARING_DEG * self.level)


def detected(
    view: CameraView,
    noise: DetectorNoise,
    features: Features,
    layer: str,
    t_ns: IntArray,
    polar_true: tuple[FloatArray, FloatArray],
    visible: BoolArray,
    rng: np.random.Generator,
) -> tuple[tuple[Detections, ...], tuple[IntArray, ...]]:
    """Return the L looks of a detector, and for evaluation only which feature each detection is of (0: of none).

    Args:
        view: its field of view.
        noise: how it errs.
        features: N that stand there.
        layer: written into the looks.
        t_ns: int64 (L,).
        polar_true: true ranges and bearings, float64 (L, N) each.
        visible: bool (L, N), in view and not hidden.
        rng: draws everything.
    """
    range_true, bearing_true = polar_true
    shape = visible.shape
    hit = visible & (rng.random(shape) >= noise.miss_rate)
    range_m = np.abs(range_true + noise.sigma_range_m * rng.standard_normal(shape))
    bearing = bearing_true + noise.sigma_bearing_rad * rng.standard_normal(shape)
    wrong = rng.random(shape) < noise.misclassified
    words = sorted(set(features.kinds)) or ["false"]
    other = rng.integers(1, max(2, len(words)), shape)
    alarms = rng.poisson(noise.false_alarms, len(t_ns))
    index = {word: k for k, word in enumerate(words)}
    kind = np.array([index[word] for word in features.kinds], dtype=np.int64)
    kind = np.where(wrong, (kind[None, :] + other) % len(words), kind[None, :])
    looks, truth = [], []
    for row in range(len(t_ns)):
        seen = np.flatnonzero(hit[row])
        extra = _false_alarms(int(alarms[row]), view, len(words), rng)
        order = rng.permutation(len(seen) + len(extra[0]))
        mine = (range_m[row, seen], bearing[row, seen])
        columns = [np.concatenate(pair)[order] for pair in zip(mine, extra[:2], strict=True)]
        kinds = np.concatenate([kind[row, seen], extra[2]])[order].tolist()
        looks.append(look_from(int(t_ns[row]), view, layer, [words[k] for k in kinds], columns, noise))
        truth.append(np.concatenate([features.feature_id[seen], np.zeros(len(extra[0]), dtype=np.int64)])[order])
    return tuple(looks), tuple(truth)


def _false_alarms(
    count: int, view: CameraView, words: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Ranges, bearings and kinds of false detections, evenly over the area of the field of view."""
    range_m = view.range_m * np.sqrt(rng.random(count))
    return range_m, view.width_rad * (rng.random(count) - 0.5), rng.integers(0, words, count)


def look_from(
    t_ns: int, view: CameraView, layer: str, kinds: list[str], polar: list[FloatArray], noise: DetectorNoise
) -> Detections:
    """Return a look with detections of these kinds at ranges [m] and bearings [rad], with the noise's sigmas."""
    count = len(kinds)
    return Detections(
        t_ns=t_ns,
        sensor=view.sensor,
        layer=layer,
        kinds=tuple(kinds),
        range_m=polar[0].astype(np.float32),
        bearing_rad=((polar[1] + np.pi) % (2 * np.pi) - np.pi).astype(np.float32),
        height_m=np.full(count, np.nan, dtype=np.float32),
        sigma_range_m=np.full(count, noise.sigma_range_m, dtype=np.float32),
        sigma_bearing_rad=np.full(count, noise.sigma_bearing_rad, dtype=np.float32),
    )


def lane_looks(
    route: Route,
    view: CameraView,
    noise: DetectorNoise,
    t_ns: IntArray,
    poses: FloatArray,
    way_m: FloatArray,
    rng: np.random.Generator,
) -> tuple[LaneLook, ...]:
    """Return what a camera sees of the lane markings at poses (L, 3) on ways (L,), a point every metre.

    A marking may be missed, whole, like any feature; other vehicles hide none.
    """
    shape = (len(t_ns), len(route.marking_left_m))
    missed = rng.random(shape) < noise.miss_rate
    aside = noise.sigma_range_m * rng.standard_normal(shape)
    turn = noise.sigma_bearing_rad * rng.standard_normal(shape)
    ahead = np.arange(0.0, view.range_m + _LANE_STEP_M, _LANE_STEP_M)
    seen: list[list[NDArray[np.float32]]] = [[] for _ in range(len(t_ns))]
    for k, left_m in enumerate(route.marking_left_m):
        points = _in_vehicle(route, left_m, poses, way_m, ahead)
        held = _within(view, points) & ~missed[:, k, None]
        found = _moved(points, aside[:, k], turn[:, k])
        for row in np.flatnonzero(held.sum(axis=1) >= 2).tolist():
            seen[row].append(found[row, held[row]])
    sigmas = (noise.sigma_range_m, noise.sigma_bearing_rad)
    return tuple(LaneLook(t, tuple(lines), *sigmas) for t, lines in zip(t_ns.tolist(), seen, strict=True))


def _in_vehicle(route: Route, left_m: float, poses: FloatArray, way_m: FloatArray, ahead_m: FloatArray) -> FloatArray:
    """A marking ahead of each pose in the vehicle frame, float64 (L, P, 2)."""
    way = way_m[:, None] + ahead_m
    if not route.line.closed:
        way = np.clip(way, 0.0, route.length_m)
    step = route.line.offset(way, np.full(way.shape, left_m)) - poses[:, None, :2]
    c, s = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    return np.stack([c * step[..., 0] + s * step[..., 1], -s * step[..., 0] + c * step[..., 1]], axis=2)


def _within(view: CameraView, points: FloatArray) -> BoolArray:
    """Which points of markings (L, P, 2) lie in the field of view and are not the one before again, bool (L, P)."""
    distance = np.linalg.norm(points, axis=2)
    held = view.holds(distance, np.arctan2(points[..., 1], points[..., 0])) & (distance >= _NEAREST_M)
    held[:, 1:] &= np.linalg.norm(np.diff(points, axis=1), axis=2) > 1e-6
    return np.asarray(held)


def _moved(points: FloatArray, aside_m: FloatArray, turn_rad: FloatArray) -> NDArray[np.float32]:
    """Markings (L, P, 2) turned about the vehicle's origin by (L,), then moved to the left by (L,)."""
    c, s = np.cos(turn_rad)[:, None], np.sin(turn_rad)[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([c * x - s * y, s * x + c * y + aside_m[:, None]], axis=2).astype(np.float32)
