"""The first pose: a search of the map around a GNSS position with unknown heading.

Coarse: every position x heading on a grid is scored by how many sampled points fall into or next to a voxel of the map
that stands above the ground. The best are refined by registration: candidates. `initialise` answers from one scan, and
says how sure it is; `Hypotheses` (hypotheses.py) follows the candidates of a place that looks alike until one has won.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I32
from gnd.gnd_map.jit import bare
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import RegistrationResult, Start, fit_of, register

HYPOTHESIS_GAIN: Final = 50.0
"""How many times likelier a pose is (as a logarithm) for a whole unit of mean fit more, one view."""
_NONE_FIT: Final = 0.35
"""Mean fit of the hypothesis that it is none of them."""
INITIALISE_RADIUS_SIGMAS: Final = 3.0
"""How far around the position, in its sigmas."""
_N_POINTS: Final = 400
"""Points that score one."""
_N_CHECKED: Final = 400
INITIALISE_N_REFINING: Final = 1000
INITIALISE_MIN_FIT: Final = 0.4
"""Least fit (0 ... 1) that counts as found."""
_AMBIGUITY: Final = 0.9
"""The runner-up may reach this share of the best fit."""
_APART_M: Final = 1.0
_APART_DEG: Final = 5.0
"""Two poses nearer than this are the same answer."""
STANDING_ABOVE_M: Final = 0.4
"""Points that stand are higher than this above the ground, which fits everywhere."""

U8 = NDArray[np.uint8]

GROUND_RADIUS_M = 12.0  # map columns around the position for height and slope of the ground
HIGHEST_GROUND_M = 0.2  # above the origin of the vehicle frame
HIT, NEXT_TO = 3, 1  # score of a point in a voxel with a Gaussian, in a neighbour of one
SUPPRESS_M, SUPPRESS_DEG = 1.5, 8.0  # coarse hypotheses nearer than this converge to the same pose
LOOKED_AT = 1500  # of the best coarse hypotheses, for distinct ones


@dataclass(frozen=True, slots=True)
class SearchGrid:
    """How a search for poses goes about it.

    Attributes:
        step_m, step_deg: spacing of the coarse hypotheses.
        n_refined: how many of the best are refined by registration.
        n_kept: how many of these are refined to the end.
        same_m, same_deg: refined poses nearer than this are one.
    """

    step_m: float
    step_deg: float
    n_refined: int
    n_kept: int
    same_m: float
    same_deg: float


AROUND_POSITION: Final = SearchGrid(step_m=1.0, step_deg=5.0, n_refined=24, n_kept=8, same_m=0.2, same_deg=1.0)
"""Around a GNSS position."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A refined pose, and the fit (0 ... 1) of the points that stand above the ground there."""

    registration: RegistrationResult
    fit: float


@dataclass(frozen=True, slots=True)
class Around:
    """Where to search: a position (3,) in the map frame, how far around it [m], and headings [rad]: all, or those
    within `turn_rad` of `heading_rad` (counter-clockwise from the map's x axis).
    """

    p_map_m: F64
    reach_m: float
    heading_rad: float = 0.0
    turn_rad: float = np.pi


@dataclass(frozen=True, slots=True, eq=False)
class InitialPose:
    """The best pose found, and how sure it is.

    fit: 0 ... 1, of the points above the ground (see `fit_of`); runner_up_fit: that of the best pose that is another
    answer (0 if there is none); hypotheses: how many were scored; found: good enough and unambiguous; probability: 0
    ... 1 of this answer among all candidates and "none of them" (Hypotheses).
    """

    registration: RegistrationResult
    fit: float
    runner_up_fit: float
    hypotheses: int
    found: bool
    probability: float = 0.0


def initialise(
    points_m: F64,
    p_gnss_m: F64,
    sigma_m: float,
    match_map: MatchMap,
    grid: SearchGrid | None = None,
    registration: RegistrationParameters | None = None,
) -> InitialPose | None:
    """Find the vehicle's pose around a GNSS position; None when the map there matches nothing.

    Args:
        points_m: (N, 3) sampled points, vehicle frame, sweep motion removed.
        p_gnss_m: (3,) position in the map frame; its height is not used.
        sigma_m: one sigma of the horizontal position.
        match_map: the map window, linearised near the position.
        grid: of the search; `AROUND_POSITION` if None.
        registration: of the refinement.
    """
    grid, registration = grid or AROUND_POSITION, registration or RegistrationParameters()
    around = Around(np.asarray(p_gnss_m, np.float64), INITIALISE_RADIUS_SIGMAS * sigma_m)
    candidates, n = search(points_m, around, match_map, grid, registration)
    answer = _answer(candidates, n)
    return _with_all_points(answer, points_m, match_map, registration)


def search(
    points_m: F64,
    around: Around,
    match_map: MatchMap,
    grid: SearchGrid,
    registration: RegistrationParameters,
    standing_m: F64 | None = None,
) -> tuple[list[Candidate], int]:
    """Refined poses around a place, no two of them the same, best fit first; and how many hypotheses were scored. None
    where the map shows no ground.

    The height of `around` is not used. Fits are of `n_refining` points; `n_checked` points decide which coarse
    hypotheses are refined to the end. `standing_m` (K, 3): the points that stand above the ground, if known already.
    """
    ground = _ground_plane(match_map, around.p_map_m)
    if ground is None or not len(points_m):
        return [], 0
    ground_below_m = ground_below(points_m)
    if standing_m is None:
        standing_m = points_m[points_m[:, 2] > ground_below_m + STANDING_ABOVE_M]  # ground fits everywhere
    standing = standing_m
    hypotheses = _hypotheses(around, ground, ground_below_m, grid)
    scores = _score(thinned(standing, _N_POINTS), hypotheses, match_map)
    poses = hypotheses[_distinct_best(hypotheses, scores, grid.n_refined)]
    checked = _refined(thinned(points_m, _N_CHECKED), standing, poses, match_map, registration, "capture")
    best = [c.registration.T_map_vehicle for c in _distinct(checked, grid)[: grid.n_kept]]
    few = thinned(points_m, INITIALISE_N_REFINING)
    return _distinct(_refined(few, standing, best, match_map, registration, "near"), grid), len(hypotheses)


def _distinct(candidates: list[Candidate], grid: SearchGrid) -> list[Candidate]:
    """Best fit first, those left out that ended in the same pose as a better one."""
    kept: list[Candidate] = []
    for one in sorted(candidates, key=lambda c: -c.fit):
        T = np.stack([k.registration.T_map_vehicle for k in kept]) if kept else np.empty((0, 4, 4))
        if not near_pose(T, one.registration.T_map_vehicle, grid.same_m, grid.same_deg).any():
            kept.append(one)
    return kept


def _ground_plane(m: MatchMap, p_map_m: F64) -> F64 | None:
    """(3,) z = c + sx dx + sy dy around `p_map_m`: least squares through the lowest Gaussians of the columns there."""
    near = np.flatnonzero(np.hypot(*(m.mean_m[:, :2] - p_map_m[:2]).T) < GROUND_RADIUS_M)
    if len(near) < 10:
        return None
    g = np.floor(m.mean_m[near] @ m.A.T + m.b).astype(np.int64)
    order = np.lexsort((m.mean_m[near, 2], g[:, 1], g[:, 0]))
    first = np.any(np.diff(g[order, :2], axis=0, prepend=-1), axis=1)
    low = m.mean_m[near[order[first]]] - [*p_map_m[:2], 0.0]
    return _robust_plane(low)


def _robust_plane(points: F64) -> F64:
    """Z = c + sx x + sy y through the lower half of `points` (N, 3), refitted twice without what stands above it."""
    keep = points[:, 2] <= np.median(points[:, 2])
    plane = np.zeros(3)
    for _ in range(3):
        columns = np.column_stack([np.ones(keep.sum()), points[keep, :2]])
        plane = np.linalg.lstsq(columns, points[keep, 2], rcond=None)[0]
        off = points[:, 2] - (plane[0] + points[:, :2] @ plane[1:])
        keep = np.abs(off) <= max(0.2, float(np.quantile(np.abs(off), 0.4)))
    return np.asarray(plane)


def ground_below(points_m: F64) -> float:
    """Height of the ground in the vehicle frame: the fullest 20 cm among the points within 15 m.

    No vehicle stands below the ground: what would lie above the frame's origin is a wall or a car, seen by a sensor
    that looks ahead only, and the origin itself is on the road.
    """
    near = np.sort(points_m[np.hypot(points_m[:, 0], points_m[:, 1]) < 15.0, 2])  # once, for all that follows
    if not len(near):
        return 0.0
    low = near[: np.searchsorted(near, quantile_of(near, 0.6), side="right")]
    edges = np.linspace(low[0], low[-1], max(1, int((low[-1] - low[0]) / 0.2)) + 1)
    begin = np.searchsorted(low, edges)
    begin[-1] = len(low)
    k = int(np.argmax(np.diff(begin)))
    fullest = low[begin[k] : np.searchsorted(low, edges[k + 1], side="right")]
    found = 0.5 * float(fullest[(len(fullest) - 1) // 2] + fullest[len(fullest) // 2])  # their median
    return found if found < HIGHEST_GROUND_M else 0.0


def quantile_of(rising: F64, share: float) -> float:
    """As `numpy.quantile` of numbers (N,) that are sorted already."""
    at = share * (len(rising) - 1)
    low, high = float(rising[int(at)]), float(rising[min(int(at) + 1, len(rising) - 1)])
    part = at - int(at)
    return low + (high - low) * part if part < 0.5 else high - (high - low) * (1.0 - part)


def _hypotheses(around: Around, ground: F64, ground_below_m: float, grid: SearchGrid) -> F64:
    """(K, 4, 4) poses on a grid of positions in the circle and headings, standing on the ground plane."""
    p, reach = around.p_map_m, around.reach_m
    steps = np.arange(-np.ceil(reach / grid.step_m), np.ceil(reach / grid.step_m) + 1) * grid.step_m
    dx, dy = (a.ravel() for a in np.meshgrid(steps, steps))
    inside = np.hypot(dx, dy) <= max(reach, grid.step_m)
    dx, dy = dx[inside], dy[inside]
    z = ground[0] + ground[1] * dx + ground[2] * dy - ground_below_m
    t = np.column_stack([p[0] + dx, p[1] + dy, z])
    yaw = _headings(around, np.radians(grid.step_deg))
    R = _tilt(ground) @ exp_so3(np.column_stack([np.zeros((len(yaw), 2)), yaw]))
    return T_from_R_t(np.tile(R, (len(t), 1, 1)), np.repeat(t, len(yaw), axis=0))


def _headings(around: Around, step_rad: float) -> F64:
    """Headings at most `step_rad` apart: of the whole circle, or within the turn of the one given."""
    if around.turn_rad >= np.pi:
        return np.arange(0.0, 2 * np.pi - 1e-9, step_rad)
    n = int(np.ceil(around.turn_rad / step_rad))
    return around.heading_rad + np.linspace(-around.turn_rad, around.turn_rad, 2 * n + 1)


def _tilt(ground: F64) -> F64:
    """(3, 3) the smallest rotation that puts the z axis on the ground's normal."""
    normal = np.array([-ground[1], -ground[2], 1.0]) / np.sqrt(1.0 + ground[1] ** 2 + ground[2] ** 2)
    return exp_so3(np.arccos(normal[2]) * np.array([-normal[1], normal[0], 0.0]) / max(np.hypot(*normal[:2]), 1e-12))


def thinned(points: F64, n: int) -> F64:
    """At most n of the points (N, 3), evenly through their order."""
    return points[np.linspace(0, len(points) - 1, min(n, len(points))).astype(np.int64)]


def _score(points_m: F64, hypotheses: F64, m: MatchMap) -> F64:
    """(K,) mean score a point of each hypothesis."""
    R = m.A @ hypotheses[:, :3, :3]
    t = hypotheses[:, :3, 3] @ m.A.T + m.b
    scores = np.zeros(len(hypotheses))
    if len(points_m):
        _score_all(np.ascontiguousarray(points_m), np.ascontiguousarray(R), t, _field(m.index), scores)
    return scores


def _field(index: I32) -> U8:
    """(nx, ny, nz) uint8: HIT in a voxel with a Gaussian, NEXT_TO in its six neighbours, else 0."""
    field = np.zeros(index.shape, np.uint8)
    _mark(index, field)
    return field


@bare
def _mark(index: I32, field: U8) -> None:
    """Fill `field`, which is 0, by `index` (nx, ny, nz): see `_field`."""
    nx, ny, nz = index.shape
    for x in range(nx):
        for y in range(ny):
            for z in range(nz):
                if index[x, y, z] < 0:
                    continue
                field[x, y, z] = HIT
                for k in range(6):
                    i = x + (1 if k == 0 else -1 if k == 1 else 0)
                    j = y + (1 if k == 2 else -1 if k == 3 else 0)
                    h = z + (1 if k == 4 else -1 if k == 5 else 0)
                    if 0 <= i < nx and 0 <= j < ny and 0 <= h < nz and index[i, j, h] < 0:
                        field[i, j, h] = NEXT_TO


@bare
def _score_all(points: F64, R: F64, t: F64, field: U8, scores: F64) -> None:
    """Mean of `field` over the points (N, 3) under each transform R (K, 3, 3), t (K, 3) into window coordinates."""
    nx, ny, nz = field.shape
    for k in range(R.shape[0]):
        total = 0
        for n in range(points.shape[0]):
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            gx = R[k, 0, 0] * x + R[k, 0, 1] * y + R[k, 0, 2] * z + t[k, 0]
            gy = R[k, 1, 0] * x + R[k, 1, 1] * y + R[k, 1, 2] * z + t[k, 1]
            gz = R[k, 2, 0] * x + R[k, 2, 1] * y + R[k, 2, 2] * z + t[k, 2]
            if 0.0 <= gx < nx and 0.0 <= gy < ny and 0.0 <= gz < nz:
                total += field[int(gx), int(gy), int(gz)]
        scores[k] = total / points.shape[0]


def _distinct_best(hypotheses: F64, scores: F64, n: int) -> NDArray[np.int64]:
    """Indices of the n best hypotheses, none near a better one."""
    left = np.argsort(-scores, kind="stable")[:LOOKED_AT]
    chosen: list[int] = []
    while len(left) and len(chosen) < n:
        chosen.append(int(left[0]))
        left = left[~near_pose(hypotheses[left], hypotheses[left[0]], SUPPRESS_M, SUPPRESS_DEG)]
    return np.array(chosen, np.int64)


def near_pose(T: F64, other: F64, apart_m: float, apart_deg: float) -> NDArray[np.bool_]:
    """(K,) which poses (K, 4, 4) lie within both limits (horizontal distance, angle) of `other` (4, 4)."""
    distance = np.hypot(T[:, 0, 3] - other[0, 3], T[:, 1, 3] - other[1, 3])
    cosine = 0.5 * (np.einsum("kij,ij->k", T[:, :3, :3], other[:3, :3]) - 1.0)  # of the angle between them
    return np.asarray((distance < apart_m) & (cosine > np.cos(np.radians(apart_deg))))


def _refined(
    points_m: F64, standing_m: F64, poses: Iterable[F64], m: MatchMap, par: RegistrationParameters, start: Start,
) -> list[Candidate]:  # fmt: skip
    """Registrations from each pose with the fit of what stands above the ground; those that match nothing left out."""
    standing_m = thinned(standing_m, INITIALISE_N_REFINING)
    candidates = []
    for T in poses:
        try:
            result = register(points_m, T, m, par, start)
        except RegistrationError:
            continue
        candidates.append(Candidate(result, fit_of(standing_m, result.T_map_vehicle, m, par)))
    return candidates


def _answer(candidates: list[Candidate], n: int) -> InitialPose | None:
    """The best candidate, compared with the best that is a different answer."""
    if not candidates:
        return None
    best = candidates[0]
    T = np.stack([c.registration.T_map_vehicle for c in candidates])
    fits = np.array([c.fit for c in candidates])
    others = fits[~near_pose(T, T[0], _APART_M, _APART_DEG)]
    runner_up = float(others.max()) if len(others) else 0.0
    found = best.fit >= INITIALISE_MIN_FIT and runner_up <= _AMBIGUITY * best.fit
    probability = float(probabilities(np.concatenate([[best.fit], others]), 1.0)[0])
    return InitialPose(best.registration, best.fit, runner_up, n, found, probability)


def probabilities(fits: F64, views: float, penalties: F64 | float = 0.0) -> F64:
    """(K,) probabilities of poses with mean fits (K,) over so many views, beside that of being none of them.

    `penalties` (K,) are logarithms taken off: from odometry and GNSS.
    """
    log = HYPOTHESIS_GAIN * views * (np.concatenate([fits, [_NONE_FIT]])) - np.append(penalties + 0.0 * fits, 0.0)
    weight = np.exp(log - log.max())
    return np.asarray(weight[:-1] / weight.sum())


def _with_all_points(
    answer: InitialPose | None, points_m: F64, m: MatchMap, par: RegistrationParameters
) -> InitialPose | None:
    """The same answer, its pose refined once more with all points."""
    if answer is None or not answer.found:
        return answer
    return replace(answer, registration=register(points_m, answer.registration.T_map_vehicle, m, par))
