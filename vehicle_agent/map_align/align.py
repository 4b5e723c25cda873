"""Where a map B lies on a map A, with a decision: it fits, or it does not and why.

The search covers every shift and heading of the reach, so that a second place that is nearly as good cannot stay
unseen: a street that repeats itself, or a tunnel that leaves the way along it open, is refused, not guessed.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.se3 import T_inverse, log_so3, transform
from gnd.vehicle_agent.map_align.candidates import Reach, candidates
from gnd.vehicle_agent.map_align.cloud import GaussianCloud
from gnd.vehicle_agent.map_align.fit import NOISE_M, Fit, FitScore, gains, lay_onto, local_motion, residuals_m, score_of

Progress = Callable[[str, int, int], None]

_CORE_M: Final = 250.0
"""The search uses what lies so near the middle of the overlap; the fit after it uses all."""
_CANDIDATES: Final = 16
_SAMPLE: Final = 6000
"""So many surfaces of B take part in the search."""
_SAMPLE_SEED: Final = 0
_APART_M: Final = 0.5
_APART_RAD: Final = float(np.radians(1.0))
"""Fits that differ by less are the same."""
_ALONG_M: Final = (-8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0)
"""Shifts along the weakest direction at which nothing may fit nearly as well."""
_DECISIVE: Final = 0.5
"""A surface says something about a direction when at least so much of its information is along it."""
_DECISIVE_WORTH: Final = 20.0
"""Fewer of them tell nothing: the direction is open."""
_SEEN_SHARE: Final = 0.3
"""Of a place where A knows fewer of them nothing can be said."""
_BLOCK_M: Final = 15.0
_BLOCK_PAIRS: Final = 50
_FIRM_SHARE: Final = 0.85
_BETTER: Final = 1.5
"""A block lies better elsewhere when the surfaces that can tell are worth so much more there: 9 cm make 1.5."""
_MOST: Final = 0.6
"""And when most of them are matched there. What was rebuilt is matched nowhere, and what stands beside it here."""

MIN_AREA_M2: Final = 600.0
MIN_UPRIGHT: Final = 150
"""Upright surfaces of B where A knows anything."""
MIN_SHARE: Final = 0.4
"""Of them have their surface in A."""
MIN_LEVEL_SHARE: Final = 0.5
MAX_SECOND: Final = 0.85
"""The second place may be worth so much of the best."""
MAX_BEND_M: Final = 0.12
"""Residual shift of blocks that at most 15 % of the surfaces may exceed: what was rebuilt a little beside its old place
looks the same."""
MAX_TILT_RAD: Final = float(np.radians(2.0))


@dataclass(frozen=True, slots=True, eq=False)
class AlignmentBlock:
    """A part of the overlap and by how much it would lie better elsewhere.

    Attributes:
        centre_m: (2,) in the common frame.
        shift_m: (3,) east, north, up; 0 along what its surfaces do not constrain.
        pairs: surfaces of it that are compared.
        median_m: median distance across its matched surfaces.
    """

    centre_m: F64
    shift_m: F64
    pairs: int
    median_m: float


@dataclass(frozen=True, slots=True, eq=False)
class MapAlignment:
    """How B lies on A, and whether to believe it.

    Attributes:
        T_a_b: (4, 4) moves B onto A in the common frame (ENU).
        pivot_m: (3,) middle of the overlap, at which the shift is given.
        covariance: (6, 6) of a small motion about the pivot, rotation [rad] about east, north and up first, then shift.
        score: of the best place.
        second: worth of the second best place as a share of the best; at `second_m` (3,) from it.
        median_m, p90_m: distance across the surfaces of the overlap that have a partner.
        blocks: the overlap by parts.
        area_m2: of the overlap, seen from above.
        bend_m: 85 % of the surfaces lie in blocks whose residual shift is at most this.
        scale: of B against A in the horizontal, less 1, by the blocks' shifts; NaN where they are too few.
        reasons: why it is refused; empty: it fits.
    """

    T_a_b: F64
    pivot_m: F64
    covariance: F64
    score: FitScore
    second: float
    second_m: F64
    median_m: float
    p90_m: float
    blocks: tuple[AlignmentBlock, ...]
    area_m2: float
    bend_m: float
    scale: float
    reasons: tuple[str, ...]

    @property
    def fits(self) -> bool:
        """Whether B may be moved by it."""
        return not self.reasons

    @property
    def shift_m(self) -> F64:
        """(3,) east, north, up at the pivot."""
        return np.asarray(transform(self.T_a_b, self.pivot_m[None])[0] - self.pivot_m)

    @property
    def rotation_deg(self) -> F64:
        """(3,) about east, north and up (the heading, counter-clockwise)."""
        return np.asarray(np.degrees(log_so3(self.T_a_b[:3, :3])))

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        sigma = np.sqrt(np.diag(self.covariance))
        return {
            "fits": self.fits,
            "reasons": list(self.reasons),
            "shift_m": dict(zip(("east", "north", "up"), self.shift_m.tolist(), strict=True)),
            "sigma_m": dict(zip(("east", "north", "up"), sigma[3:].tolist(), strict=True)),
            "heading_deg": float(self.rotation_deg[2]),
            "tilt_deg": dict(zip(("about_east", "about_north"), self.rotation_deg[:2].tolist(), strict=True)),
            "sigma_deg": np.degrees(sigma[:3]).tolist(),
            "T_a_b": self.T_a_b.tolist(),
            "covariance": self.covariance.tolist(),
            "overlap": {"area_m2": self.area_m2, "upright": self.score.upright, "level": self.score.level},
            "matched_share": {"upright": self.score.share, "level": self.score.level_share},
            "residual_m": {"p50": self.median_m, "p90": self.p90_m},
            "second_best": {"worth": self.second, "from_best_m": self.second_m.tolist()},
            "bend_m": self.bend_m,
            "scale_less_1": None if np.isnan(self.scale) else self.scale,
            "blocks": [
                {
                    "centre_m": one.centre_m.tolist(),
                    "shift_m": one.shift_m.tolist(),
                    "pairs": one.pairs,
                    "residual_p50_m": one.median_m,
                }
                for one in self.blocks
            ],
        }


def align_clouds(a: GaussianCloud, b: GaussianCloud, reach: Reach, progress: Progress | None = None) -> MapAlignment:
    """Lay B onto A.

    Args:
        a: what stays.
        b: what is moved; both in one metric frame (ENU), B where it says it is.
        reach: how far from there it may lie.
        progress: told the step, how much of it is done, and of how much.
    """
    tell = progress or (lambda _step, _done, _total: None)
    shared = b.take(_within(a, b, reach.shift_m + 2.0)) if len(a) and len(b) else b.take(np.empty(0, np.int64))
    area_m2 = _area_m2(shared.mean_m)
    if area_m2 < MIN_AREA_M2 or shared.is_upright.sum() < MIN_UPRIGHT:
        return _nowhere(_little(area_m2, int(shared.is_upright.sum())), shared)
    pivot = np.median(shared.mean_m, axis=0)
    core = _sampled(shared.take(np.linalg.norm(shared.mean_m[:, :2] - pivot[:2], axis=1) < _CORE_M))
    near_a = a.take(np.linalg.norm(a.mean_m[:, :2] - pivot[:2], axis=1) < _CORE_M + 2.0 * reach.shift_m)
    fits = list[tuple[Fit, FitScore]]()
    found = candidates(near_a, core, pivot, reach, _CANDIDATES)
    for done, one in enumerate(found):
        fit = lay_onto(near_a, core, one.T_a_b)
        if fit is not None:
            fits.append((fit, score_of(near_a, core.moved(fit.T_a_b))))
        tell("trying places", done + 1, len(found))
    if not fits:
        return _nowhere("no place in the search where any 30 surfaces meet", shared)
    fits.sort(key=lambda pair: -pair[1].mass)
    second, second_m = _second(near_a, core, pivot, fits, reach)
    fine = lay_onto(a, b, fits[0][0].T_a_b, (0.4, 0.15)) or fits[0][0]
    tell("residuals by block", 0, 1)
    result = _judged(a, b, pivot, fine, second, second_m, reach)
    tell("residuals by block", 1, 1)
    return result


def _within(a: GaussianCloud, b: GaussianCloud, distance_m: float) -> NDArray[np.bool_]:
    """(N,) which of B lie within a horizontal distance of anything of A."""
    return np.asarray(a.plan_tree.query(b.mean_m[:, :2], distance_upper_bound=distance_m)[0] < distance_m)


def _area_m2(points_m: F64) -> float:
    """Square metres that hold anything, from above."""
    return float(len(np.unique(np.floor(points_m[:, :2]).astype(np.int64), axis=0)))


def _little(area_m2: float, upright: int) -> str:
    return (
        f"too little overlap: {area_m2:.0f} m2 and {upright} upright surfaces of B where A knows anything, "
        f"{MIN_AREA_M2:.0f} m2 and {MIN_UPRIGHT} are needed"
    )


def _nowhere(reason: str, shared: GaussianCloud) -> MapAlignment:
    """A refusal before there is any place."""
    pivot = np.median(shared.mean_m, axis=0) if len(shared) else np.zeros(3)
    nothing, unknown = (
        FitScore(int(shared.is_upright.sum()), 0, 0.0, int(shared.is_ground.sum()), 0),
        np.full(3, np.nan),
    )
    nan = float("nan")
    return MapAlignment(
        np.eye(4), pivot, np.diag([1e2] * 6), nothing, nan, unknown, nan, nan, (), _area_m2(shared.mean_m), nan, nan,
        (reason,),
    )  # fmt: skip


def _sampled(cloud: GaussianCloud) -> GaussianCloud:
    """At most `_SAMPLE` of the surfaces; upright ones before level ones, which say nothing of the horizontal place."""
    rng = np.random.default_rng(_SAMPLE_SEED)
    upright, other = np.flatnonzero(cloud.is_upright), np.flatnonzero(cloud.is_surface & ~cloud.is_upright)
    rows = [rng.permutation(some)[: _SAMPLE // 2] for some in (upright, other)]
    return cloud.take(np.sort(np.concatenate(rows)))


def _second(
    a: GaussianCloud, core: GaussianCloud, pivot: F64, fits: list[tuple[Fit, FitScore]], reach: Reach
) -> tuple[float, F64]:
    """Worth of the best place that is not the best one, as a share of it, and how far it is off (3,).

    Two places are compared by the surfaces that say something about the way between them: along a street those across
    it, posts and corners, not the house fronts, which lie on themselves after every shift along them.
    """
    best = fits[0][0].T_a_b
    there = gains(a, core.moved(best))
    compared = list[tuple[float, F64]]()
    for T in _other_places(a, core, fits, reach):
        off = transform(T, pivot[None])[0] - transform(best, pivot[None])[0]
        turned = float(np.linalg.norm(log_so3(T[:3, :3] @ best[:3, :3].T)))
        if np.linalg.norm(off) <= _APART_M and turned <= _APART_RAD:
            continue
        decisive = core.is_upright
        if np.linalg.norm(off[:2]) > _APART_M:
            unit = np.append(off[:2] / np.linalg.norm(off[:2]), 0.0)
            decisive = decisive & (core.moved(best).information_along(unit, NOISE_M) > _DECISIVE)
        moved = core.moved(T)
        shared = decisive & _within(a, moved, 2.0)
        worth, all_of_it = float(there[shared].sum()), float(there[decisive].sum())
        if all_of_it < _DECISIVE_WORTH:
            compared.append((1.0, off))
        elif worth > _SEEN_SHARE * all_of_it:  # what A does not reach there does not speak against the place
            compared.append((float(gains(a, moved)[shared].sum()) / worth, off))
    return max(compared, key=lambda one: one[0], default=(0.0, np.full(3, np.nan)))


def _other_places(
    a: GaussianCloud, core: GaussianCloud, fits: list[tuple[Fit, FitScore]], reach: Reach
) -> Iterator[F64]:
    """The other fits, and places along the direction that holds least, where everything else may settle."""
    for fit, _ in fits[1:]:
        yield fit.T_a_b
    best = fits[0][0]
    weakest = _weakest(best)
    for along_m in _ALONG_M:
        if abs(along_m) <= reach.shift_m:
            T = best.T_a_b.copy()
            T[:3, 3] += along_m * weakest
            yield _beside(a, core, T, weakest)


def _weakest(fit: Fit) -> F64:
    """(3,) horizontal unit direction in which the surfaces hold the maps together least."""
    covariance = np.linalg.inv(fit.H + 1e-6 * np.eye(6))[3:5, 3:5]
    return np.append(np.linalg.eigh(covariance)[1][:, -1], 0.0)


def _beside(a: GaussianCloud, b: GaussianCloud, T: F64, along: F64) -> F64:
    """The pose near T that fits best without going back along a direction: height and what is across may settle."""
    motion = local_motion(a, b.moved(T), turns=False)
    settled = T.copy()
    if motion is not None:
        shift = motion[:3, 3]
        step = shift - along * float(along @ shift)
        settled[:3, 3] += np.clip(step, -1.0, 1.0)
    return settled


def _judged(
    a: GaussianCloud, b: GaussianCloud, pivot: F64, fit: Fit, second: float, second_m: F64, reach: Reach
) -> MapAlignment:
    moved = b.moved(fit.T_a_b)
    row, across_m, matched = residuals_m(a, moved)
    score, shared = score_of(a, moved), moved.take(_within(a, moved, 2.0))
    blocks = _blocks(a, moved, row, across_m, matched)
    bend_m = _bend_m(blocks)
    partnered = across_m[across_m < 1.0]
    median_m, p90_m = np.percentile(partnered, [50, 90]).tolist() if len(partnered) else [float("nan")] * 2
    area_m2, scale = _area_m2(shared.mean_m), _scale(blocks)
    where = transform(fit.T_a_b, pivot[None])[0] - pivot
    reasons = [
        *_overlap_reasons(area_m2, score),
        *_place_reasons(fit.T_a_b, where, reach),
        *_second_reasons(second, second_m),
        *_bend_reasons(bend_m, len(blocks), scale),
    ]
    covariance = _covariance(fit, pivot + where, blocks)
    return MapAlignment(
        fit.T_a_b, pivot, covariance, score, second, second_m, median_m, p90_m, blocks, area_m2, bend_m, scale,
        tuple(reasons),
    )  # fmt: skip


def _blocks(
    a: GaussianCloud, moved: GaussianCloud, row: I64, across_m: F64, matched: NDArray[np.bool_]
) -> tuple[AlignmentBlock, ...]:
    """The overlap in squares of 15 m, those in which enough surfaces meet."""
    cell = np.floor(moved.mean_m[row, :2] / _BLOCK_M).astype(np.int64)
    found = list[AlignmentBlock]()
    names, number = np.unique(cell, axis=0, return_inverse=True)
    for k in range(len(names)):
        mine = np.flatnonzero(number.ravel() == k)
        if len(mine) < _BLOCK_PAIRS:
            continue
        part, good = moved.take(row[mine]), mine[matched[mine]]
        median_m = float(np.median(across_m[good])) if len(good) else float("nan")
        found.append(AlignmentBlock(part.mean_m[:, :2].mean(axis=0), _residual_shift(a, part), len(mine), median_m))
    return tuple(found)


def _residual_shift(a: GaussianCloud, part: GaussianCloud) -> F64:
    """(3,) by how much a part of B lies better elsewhere; 0 unless clearly more of it is matched there.

    The part may turn as well: where B is bent, its neighbouring parts lie at angles to each other.
    """
    T = local_motion(a, part)
    if T is None:
        return np.zeros(3)
    moved = part.moved(T)
    steps = moved.mean_m - part.mean_m
    shift = np.asarray(steps.mean(axis=0))
    largest = steps[np.linalg.norm(steps, axis=1).argmax()]
    unit = largest / max(float(np.linalg.norm(largest)), 1e-9)
    decisive = part.information_along(unit, NOISE_M) > _DECISIVE
    here, there = float(gains(a, part)[decisive].sum()), float(gains(a, moved)[decisive].sum())
    is_elsewhere = there > _BETTER * here + 3.0 and there > _MOST * float(decisive.sum())
    return shift if is_elsewhere else np.zeros(3)


def _bend_m(blocks: tuple[AlignmentBlock, ...]) -> float:
    """So far off, or less, lie 85 % of the surfaces, each with its block; NaN without blocks."""
    if not blocks:
        return float("nan")
    shifts, pairs = np.array([(np.linalg.norm(one.shift_m), one.pairs) for one in blocks]).T
    order = np.argsort(shifts)
    below = np.cumsum(pairs[order]) / pairs.sum()
    return float(shifts[order][np.searchsorted(below, _FIRM_SHARE)])


def _scale(blocks: tuple[AlignmentBlock, ...]) -> float:
    """By how much B is larger than A in the horizontal, by the shifts of at least four blocks; else NaN."""
    if len(blocks) < 4:
        return float("nan")
    at = np.array([one.centre_m for one in blocks])
    at = at - at.mean(axis=0)
    return -float((at * np.array([one.shift_m[:2] for one in blocks])).sum() / (at**2).sum())


def _covariance(fit: Fit, pivot_m: F64, blocks: tuple[AlignmentBlock, ...]) -> F64:
    """(6, 6) at the pivot: of the fit, and beside it what the blocks' disagreement says."""
    x, y, z = pivot_m - fit.centre_m
    lever = np.eye(6)
    lever[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    covariance = lever @ fit.covariance @ lever.T
    if len(blocks) >= 2:
        shifts = np.array([one.shift_m for one in blocks])
        at = np.array([one.centre_m for one in blocks])
        arm2 = float(((at - at.mean(axis=0)) ** 2).sum(axis=1).mean()) + 1.0
        spread = (shifts**2).mean(axis=0) / len(blocks)
        covariance[3:, 3:] += np.diag(spread)
        covariance[2, 2] += float(spread[:2].sum()) / arm2
    return np.asarray(covariance)


def _overlap_reasons(area_m2: float, score: FitScore) -> list[str]:
    if area_m2 < MIN_AREA_M2 or score.upright < MIN_UPRIGHT:
        return [_little(area_m2, score.upright)]
    found = list[str]()
    if score.share < MIN_SHARE:
        found.append(
            f"residuals too high: {100 * score.share:.0f} % of {score.upright} upright surfaces have their like in A, "
            f"{100 * MIN_SHARE:.0f} % are needed: another place, other units, mirrored axes, or much rebuilt?"
        )
    if score.level_share < MIN_LEVEL_SHARE:
        found.append(
            f"residuals too high: {100 * score.level_share:.0f} % of {score.level} level surfaces have their like in "
            f"A, {100 * MIN_LEVEL_SHARE:.0f} % are needed"
        )
    return found


def _place_reasons(T: F64, where: F64, reach: Reach) -> list[str]:
    found, turn = list[str](), log_so3(T[:3, :3])
    tilt = float(np.hypot(turn[0], turn[1]))
    if tilt > MAX_TILT_RAD:
        found.append(f"tilted: {np.degrees(tilt):.1f} degrees; two frames that know the vertical differ by less")
    if np.abs(where[:2]).max() > reach.shift_m - 0.5 or abs(where[2]) > reach.height_m:
        found.append(f"at the edge of the search: {where[0]:.1f}, {where[1]:.1f}, {where[2]:.1f} m; try a wider one")
    if abs(np.degrees(turn[2])) > reach.heading_deg + 0.25:
        found.append(f"turned by {np.degrees(turn[2]):.1f} degrees, more than was searched")
    return found


def _second_reasons(second: float, off_m: F64) -> list[str]:
    if second <= MAX_SECOND:
        return []
    return [
        f"ambiguous: {off_m[0]:.1f} m east, {off_m[1]:.1f} m north of the best place B fits nearly as well "
        f"({100 * second:.0f} % of the best; {100 * MAX_SECOND:.0f} % are allowed): what is there repeats itself, or "
        "leaves the way along it open; a larger overlap with a crossing or a bend would decide"
    ]


def _bend_reasons(bend_m: float, blocks: int, scale: float) -> list[str]:
    if not blocks:
        return ["no part of the overlap holds enough surfaces to tell whether B is bent"]
    if bend_m <= MAX_BEND_M:
        return []
    scaled = "" if np.isnan(scale) or abs(scale) < 5e-4 else f", B is {100 * scale:+.2f} % larger"
    return [
        f"bent: some of {blocks} parts of the overlap lie {100 * bend_m:.0f} cm or more off their place, "
        f"{100 * MAX_BEND_M:.0f} cm are allowed{scaled}: no rigid motion brings B onto A; "
        "`gnd map build` with the drives of both bends their poses"
    ]


def difference(T: F64, T_true: F64, pivot_m: F64) -> tuple[float, float]:
    """Distance [m] at the pivot and angle [rad] between two placements."""
    apart = transform(T, pivot_m[None])[0] - transform(T_true, pivot_m[None])[0]
    turn = log_so3((T_inverse(T_true) @ T)[:3, :3])
    return float(np.linalg.norm(apart)), float(np.linalg.norm(turn))
