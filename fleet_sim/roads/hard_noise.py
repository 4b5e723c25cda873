"""What a camera's detector of signs errs by on real roads: errors that stay with a sign and with a drive, misses that
depend on range, signs taken for others, objects that look like signs, and a profile of occlusion that errs as well.

The papers' noise (`looks.py`) is white and of known sigma. Averaging over the looks of one passage removes it; nothing
removes what is the same in all of them. Shapes: L looks, N features, A azimuths of an occluder profile.
"""

from dataclasses import dataclass
from math import radians
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import RoadError
from gnd.fleet_sim.roads.curve import FloatArray
from gnd.fleet_sim.roads.looks import DetectorNoise, look_from
from gnd.fleet_sim.roads.route import IntArray, Route
from gnd.fleet_sim.roads.sight import BoolArray, CameraView, PlacedBoxes, hidden, polar
from gnd.schemas.drive import Detections

_LOOKALIKE_STREAM: Final = 17
_LOOKALIKE_HEIGHT_M: Final = 2.5
_LOOKALIKE_LEFT_M: Final = (8.0, 22.0)
"""How far to either side of the line objects that look like signs stand: adverts, mile boards, parked lorries."""


@dataclass(frozen=True, slots=True)
class HardNoise:
    """Errors on top of the white ones of `DetectorNoise`; standard deviations where nothing else is said.

    Attributes:
        sign_range_share: error of range that stays with a sign during a drive, as a share of the range.
        sign_bearing_rad: the same of its bearing.
        yaw_rad: by how much the camera is mounted off, drawn for each drive.
        range_share: error of scale of all ranges of a drive.
        pitch_rad: error of the camera's pitch in a drive: ranges err by pitch times range² over the camera's height.
        white_ln_sigma: of the logarithm of true over stated white noise in a drive.
        miss_near, miss_far: share of looks that miss a visible sign right ahead, and at the end of the range; between
            them it rises with the square of the range.
        least_seen: how well a sign can be seen in a drive (backlight, dirt): its chance is multiplied by a number
            between this and 1.
        confused: share of detections with another kind.
        confused_signs, confused_often: share of signs that a drive takes for another kind again and again, and in
            which share of their detections.
        lookalikes_per_km: objects at fixed places that may be taken for signs.
        lookalike_seen: share of the drives in which one of them is.
        lookalike_rate: least and largest share of the looks in which it is then, where a sign would be detected.
        lookalike_kind: share of its detections that name its usual kind; the others any.
        profile_m, profile_rad: error of distances of the occluder profile in each look, and of its azimuths in a drive.
        profile_dropped: share of its azimuths that show nothing.
        profile_missing: share of looks whose profile shows nothing at all.
    """

    sign_range_share: float = 0.05
    sign_bearing_rad: float = radians(1.0)
    yaw_rad: float = radians(0.5)
    range_share: float = 0.02
    pitch_rad: float = radians(0.02)
    white_ln_sigma: float = 0.2
    miss_near: float = 0.05
    miss_far: float = 0.5
    least_seen: float = 0.75
    confused: float = 0.05
    confused_signs: float = 0.05
    confused_often: float = 0.4
    lookalikes_per_km: float = 0.5
    lookalike_seen: float = 0.6
    lookalike_rate: tuple[float, float] = (0.1, 0.7)
    lookalike_kind: float = 0.7
    profile_m: float = 1.0
    profile_rad: float = radians(0.5)
    profile_dropped: float = 0.1
    profile_missing: float = 0.05

    def __post_init__(self) -> None:
        sigmas = [self.sign_range_share, self.sign_bearing_rad, self.yaw_rad, self.range_share, self.pitch_rad]
        sigmas += [self.white_ln_sigma, self.lookalikes_per_km, self.profile_m, self.profile_rad]
        shares = [self.miss_near, self.miss_far, self.least_seen, self.confused, self.confused_signs]
        shares += [self.confused_often, self.lookalike_seen, *self.lookalike_rate, self.lookalike_kind]
        shares += [self.profile_dropped, self.profile_missing]
        if min(sigmas) < 0.0 or not all(0.0 <= share <= 1.0 for share in shares):
            raise RoadError(f"hard noise needs sigmas >= 0 and shares within 0 … 1, got {self}")
        if self.miss_far < self.miss_near or self.lookalike_rate[0] > self.lookalike_rate[1]:
            raise RoadError(f"misses {self.miss_near} … {self.miss_far}, rates {self.lookalike_rate}: they must rise")

    def detectable(self, range_m: FloatArray, reach_m: float) -> FloatArray:
        """Return the chance of a detection at ranges, of what is visible, by a sensor that sees so far."""
        share = np.minimum(range_m / reach_m, 1.0) ** 2
        return np.asarray(1.0 - self.miss_near - (self.miss_far - self.miss_near) * share)


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """What may be detected at L looks: N features or look-alikes.

    Attributes:
        feature_id: int64 (N,); 0 of a look-alike.
        kind: int64 (N,), index of the usual kind.
        range_m, bearing_rad: float64 (L, N), true ones.
        visible: bool (L, N), in view and not hidden.
        rate: float64 (N,), by which the chance of a detection is multiplied.
        other_kind: float64 (N,), share of the detections that name another kind.
    """

    feature_id: IntArray
    kind: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray
    visible: BoolArray
    rate: FloatArray
    other_kind: FloatArray


def lookalikes(route: Route, hard: HardNoise) -> tuple[FloatArray, IntArray]:
    """Return the places (N, 2) and usual kinds (N,) of a route's look-alikes: the same for all of its drives."""
    rng = np.random.default_rng([route.seed, _LOOKALIKE_STREAM, 9])
    count = int(rng.poisson(hard.lookalikes_per_km * route.length_m / 1000.0))
    way = np.sort(rng.uniform(0.0, route.length_m, count))
    left = rng.uniform(*_LOOKALIKE_LEFT_M, count) * rng.choice((-1.0, 1.0), count)
    words = max(len(set(route.features.kinds)), 1)
    return np.asarray(route.line.offset(way, left)).reshape(-1, 2), rng.integers(0, words, count)


def hard_looks(
    route: Route,
    view: CameraView,
    noise: DetectorNoise,
    hard: HardNoise,
    t_ns: IntArray,
    poses: FloatArray,
    placed: PlacedBoxes,
    standing: tuple[IntArray, FloatArray, FloatArray, BoolArray],
    rng: np.random.Generator,
) -> tuple[tuple[Detections, ...], tuple[IntArray, ...]]:
    """Return the L looks of a camera, and for evaluation only which feature each detection is of (0: of none).

    Args:
        route: whose features and look-alikes.
        view: field of view.
        noise: white noise as the detector states it, and false alarms anywhere.
        hard: all else.
        t_ns: int64 (L,).
        poses: float64 (L, 3), where the looks were taken.
        placed: other vehicles.
        standing: rows of the route's features that stand there, int64 (N,); their true ranges and bearings, float64
            (L, N); bool (L, N), which are in view and not hidden.
        rng: draws everything.
    """
    words = sorted(set(route.features.kinds)) or ["false"]
    there = _joined(_signs(route, hard, words, standing, rng), _lookalikes(route, view, hard, poses, placed, rng))
    range_m, bearing = _measured(view, noise, hard, there, rng)
    hit = there.visible & (rng.random(there.visible.shape) < hard.detectable(there.range_m, view.range_m) * there.rate)
    kind = _kinds(there, len(words), hit.shape, rng)
    alarms = rng.poisson(noise.false_alarms, len(t_ns))
    looks, truth = [], []
    for row in range(len(t_ns)):
        seen, extra = np.flatnonzero(hit[row]), int(alarms[row])
        ranges = np.concatenate([range_m[row, seen], view.range_m * np.sqrt(rng.random(extra))])
        bearings = np.concatenate([bearing[row, seen], view.width_rad * (rng.random(extra) - 0.5)])
        kinds = np.concatenate([kind[row, seen], rng.integers(0, len(words), extra)])
        order = rng.permutation(len(ranges))
        named = [words[k] for k in kinds[order].tolist()]
        looks.append(look_from(int(t_ns[row]), view, route.layer, named, [ranges[order], bearings[order]], noise))
        truth.append(np.concatenate([there.feature_id[seen], np.zeros(extra, np.int64)])[order])
    return tuple(looks), tuple(truth)


def _signs(
    route: Route,
    hard: HardNoise,
    words: list[str],
    standing: tuple[IntArray, FloatArray, FloatArray, BoolArray],
    rng: np.random.Generator,
) -> Standing:
    rows, range_m, bearing, visible = standing
    features = route.features.take(rows)
    kind = np.array([words.index(word) for word in features.kinds], np.int64)
    often = rng.random(len(kind)) < hard.confused_signs
    other = np.where(often, hard.confused_often, hard.confused)
    rate = rng.uniform(hard.least_seen, 1.0, len(kind))
    return Standing(features.feature_id, kind, range_m, bearing, visible, rate, other)


def _lookalikes(
    route: Route, view: CameraView, hard: HardNoise, poses: FloatArray, placed: PlacedBoxes, rng: np.random.Generator
) -> Standing:
    xy_m, kind = lookalikes(route, hard)
    seen = rng.random(len(xy_m)) < hard.lookalike_seen
    rate = np.where(seen, rng.uniform(*hard.lookalike_rate, len(xy_m)), 0.0)
    range_m, bearing = polar(poses, xy_m)
    in_view = view.holds(range_m, bearing)
    out_of_sight = hidden(poses, xy_m, np.full(len(xy_m), _LOOKALIKE_HEIGHT_M), in_view, placed, view.eye_m)
    other = np.full(len(xy_m), 1.0 - hard.lookalike_kind)
    return Standing(np.zeros(len(xy_m), np.int64), kind, range_m, bearing, in_view & ~out_of_sight, rate, other)


def _joined(one: Standing, other: Standing) -> Standing:
    pairs = [(getattr(one, name), getattr(other, name)) for name in Standing.__slots__]
    return Standing(*(np.concatenate(pair, axis=-1) for pair in pairs))


def _measured(
    view: CameraView, noise: DetectorNoise, hard: HardNoise, there: Standing, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Ranges and bearings (L, N): what stays with the drive, what stays with each sign, and what is white."""
    polar, sigmas = (there.range_m, there.bearing_rad), (noise.sigma_range_m, noise.sigma_bearing_rad)
    return erring(polar, sigmas, view.eye_m, hard, rng)


def _kinds(there: Standing, words: int, shape: tuple[int, ...], rng: np.random.Generator) -> IntArray:
    """The kind that each detection (L, N) names. A kind is confused with its neighbour in the alphabet: what looks
    alike is confused, not anything with anything.
    """
    wrong = rng.random(shape) < there.other_kind
    aside = rng.choice((-1, 1), shape)
    return np.asarray(np.where(wrong, (there.kind + aside) % words, there.kind), np.int64)


def erring(
    polar: tuple[FloatArray, FloatArray],
    sigmas: tuple[float, float],
    eye_m: float,
    hard: HardNoise,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Return ranges and bearings (L, N) as a camera at a height measures the true ones (L, N) of N objects in one
    drive; `sigmas` are those of range [m] and bearing [rad] that its detector states.
    """
    (true_m, true_rad), (sigma_m, sigma_rad) = polar, sigmas
    shape, count = true_m.shape, true_m.shape[1]
    scale, pitch = hard.range_share * rng.standard_normal(), hard.pitch_rad * rng.standard_normal()
    yaw, white = hard.yaw_rad * rng.standard_normal(), np.exp(hard.white_ln_sigma * rng.standard_normal())
    share = np.maximum(1.0 + scale + hard.sign_range_share * rng.standard_normal(count), 0.5)
    turn = yaw + hard.sign_bearing_rad * rng.standard_normal(count)
    range_m = true_m * share + pitch * true_m**2 / eye_m
    range_m = np.abs(range_m + white * sigma_m * rng.standard_normal(shape))
    return range_m, true_rad + turn + white * sigma_rad * rng.standard_normal(shape)


def erring_profile(
    free_m: NDArray[np.float32], view: CameraView, hard: HardNoise, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return an occluder profile float32 (L, A) as a sensor gives it: turned, noisy, with gaps; inf where nothing."""
    step_rad = view.width_rad / free_m.shape[1]
    steps = round(hard.profile_rad * float(rng.standard_normal()) / step_rad)
    turned = np.full_like(free_m, np.inf)
    source = np.arange(free_m.shape[1]) - steps
    inside = (source >= 0) & (source < free_m.shape[1])
    turned[:, inside] = free_m[:, source[inside]]
    noisy = np.maximum(turned + hard.profile_m * rng.standard_normal(free_m.shape), 0.5)
    gone = (rng.random(free_m.shape) < hard.profile_dropped) | (rng.random((len(free_m), 1)) < hard.profile_missing)
    return np.where(gone, np.inf, noisy).astype(np.float32)
