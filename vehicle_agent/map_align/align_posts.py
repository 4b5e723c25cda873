"""Where the posts of a vector HD map stand among those of a LiDAR map, with a decision: it fits, or why it does not.

All shifts and headings of the search are tried: pairs of posts vote for the shift that brings one onto the other, the
best places are refined by mutual nearest posts. A row of lamps at equal distances, a street that is its own mirror
image and posts on one line leave more than one place, and are refused. Heights are not compared: what the height of a
post means (foot, top, plate) differs from map to map.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial import cKDTree

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse, exp_so3
from gnd.vehicle_agent.map_align.candidates import Reach

_CELL_M: Final = 0.5
_STEP_M: Final = 0.4
"""So far the outermost post may move from one heading to the next."""
_PLACES: Final = 12
_GATES_M: Final = (1.5, 1.0, 0.7, 0.5, 0.5, 0.5)
"""Within which posts are paired, round by round."""
MATCHED_M: Final = 0.5
"""HD maps are within 10 to 20 cm; two posts this near are taken as one."""
SEEN_M: Final = 2.0
"""A post of the HD map counts where the LiDAR map knows anything so near."""
_APART_M, _APART_RAD = 1.0, float(np.radians(1.0))
"""Places that differ by less are the same."""
_COMPARABLE: Final = 0.5
"""A place where fewer posts are seen than this share of those at the best place says nothing against it."""
_SIGMA_M: Final = 0.05
"""At least, of a post."""

MIN_MATCHED: Final = 8
MIN_SHARE: Final = 0.5
"""Of the HD map's posts where the LiDAR map knows anything."""
MAX_SECOND: Final = 0.7
"""The second place, or the mirror image, may match so much of what the best one does."""
MIN_WIDTH_M: Final = 2.0
"""Standard deviation of the matched posts across the line along which they stand."""
MAX_RESIDUAL_M: Final = 0.25
MAX_SCALED_M: Final = 0.15
"""By how much the outermost posts may lie off for a scale, beyond three sigmas."""


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """turn_rad, shift_m (2,): p = R (v - pivot) + pivot + shift. score, seen: see `_scored`."""

    turn_rad: float
    shift_m: F64
    score: float = 0.0
    seen: int = 0

    @property
    def share(self) -> float:
        return self.score / max(self.seen, 1)

    def moved(self, posts: F64, pivot: F64) -> F64:
        c, s = np.cos(self.turn_rad), np.sin(self.turn_rad)
        return np.asarray((posts - pivot) @ np.array([[c, s], [-s, c]]) + pivot + self.shift_m)


@dataclass(frozen=True, slots=True, eq=False)
class PostAlignment:
    """How the HD map lies on the LiDAR map, and whether to believe it.

    Attributes:
        T_lidar_vector: (4, 4) moves the HD map onto the LiDAR map: east, north and heading only.
        pivot_m: (2,) middle of the HD map's posts, at which the shift is given.
        shift_m: (2,) there.
        heading_deg: counter-clockwise.
        sigma_m, sigma_deg: of them, one each way.
        seen: posts of the HD map where the LiDAR map knows anything; matched: those with a post of the LiDAR map.
        median_m: distance between the matched.
        second: what the second place matches, as a share of the best; mirror: what the mirror image matches.
        scale: of the HD map against the LiDAR map, less 1.
        reasons: why it is refused; empty: it fits.
    """

    T_lidar_vector: F64
    pivot_m: F64
    shift_m: F64
    heading_deg: float
    sigma_m: float
    sigma_deg: float
    seen: int
    matched: int
    median_m: float
    second: float
    mirror: float
    scale: float
    reasons: tuple[str, ...]

    @property
    def fits(self) -> bool:
        """Whether it may be used."""
        return not self.reasons

    @property
    def T_vector_lidar(self) -> F64:
        """(4, 4) moves the LiDAR map onto the HD map."""
        return T_inverse(self.T_lidar_vector)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "fits": self.fits,
            "reasons": list(self.reasons),
            "hd_map_shift_m": dict(zip(("east", "north"), self.shift_m.tolist(), strict=True)),
            "heading_deg": self.heading_deg,
            "sigma_m": self.sigma_m,
            "sigma_deg": self.sigma_deg,
            "T_lidar_vector": self.T_lidar_vector.tolist(),
            "posts": {"seen": self.seen, "matched": self.matched},
            "residual_m": self.median_m,
            "second_best": self.second,
            "mirror_image": self.mirror,
            "scale_less_1": self.scale,
        }


def align_posts(lidar: F64, known: F64, vector: F64, reach: Reach) -> PostAlignment:
    """Lay the posts of an HD map onto those of a LiDAR map.

    Args:
        lidar: (L, 2) posts of the LiDAR map.
        known: (K, 2) where it knows anything.
        vector: (V, 2) posts of the HD map, in the same frame (ENU), where the map says they are.
        reach: how far from there they may stand; its height is not used.
    """
    around = cKDTree(known) if len(known) else None
    near = vector[:0] if around is None else vector[around.query(vector)[0] < reach.shift_m + SEEN_M]
    if len(near) < MIN_MATCHED or len(lidar) < MIN_MATCHED or around is None:
        return _refused_before(near, lidar)
    pivot = np.median(near, axis=0)
    places = _places(lidar, around, near, pivot, reach)
    if not places:
        return _refused_before(near, lidar)
    best = places[0]
    second = max((_worth(one, best) for one in places if not _same(one, best)), default=0.0)
    images = _places(lidar, around, _mirrored(near, pivot), pivot, reach)
    mirror = images[0].score / max(best.score, 1e-9) if images else 0.0
    return _judged(lidar, near, pivot, best, second, mirror, reach)


def _refused_before(near: F64, lidar: F64) -> PostAlignment:
    pivot, nan = np.median(near, axis=0) if len(near) else np.zeros(2), float("nan")
    reason = (
        f"too few posts: {len(near)} of the HD map where the LiDAR map may know anything, {len(lidar)} of the LiDAR"
        f" map; {MIN_MATCHED} of each are needed"
    )
    return PostAlignment(np.eye(4), pivot, np.zeros(2), 0.0, nan, nan, len(near), 0, nan, nan, nan, nan, (reason,))


def _places(lidar: F64, around: cKDTree, vector: F64, pivot: F64, reach: Reach) -> list[_Place]:
    """The best places of the search, best first, each once."""
    tree = cKDTree(lidar)
    refined = [_scored(_refined(one, lidar, tree, vector, pivot), lidar, tree, around, vector, pivot)
               for one in _voted(lidar, vector, pivot, reach)]  # fmt: skip
    kept: list[_Place] = []
    for one in sorted(refined, key=lambda place: -place.score):
        if not any(_same(one, other) for other in kept):
            kept.append(one)
    return kept


def _same(one: _Place, other: _Place) -> bool:
    near = float(np.linalg.norm(one.shift_m - other.shift_m)) < _APART_M
    return near and abs(one.turn_rad - other.turn_rad) < _APART_RAD


def _worth(one: _Place, best: _Place) -> float:
    """What a place matches as a share of the best: of the posts that are seen there, unless they are too few."""
    return one.share / max(best.share, 1e-9) if one.seen >= _COMPARABLE * best.seen else 0.0


def _mirrored(vector: F64, pivot: F64) -> F64:
    """The posts mirrored across the line along which they stand."""
    across = np.linalg.eigh(np.cov((vector - pivot).T))[1][:, 0]
    return np.asarray(vector - 2.0 * np.outer((vector - pivot) @ across, across))


def _voted(lidar: F64, vector: F64, pivot: F64, reach: Reach) -> Iterator[_Place]:
    """Places for which most pairs of posts vote, of all headings."""
    radius_m = float(np.linalg.norm(vector - pivot, axis=1).max())
    limit = np.radians(reach.heading_deg)
    steps = int(max(1, np.ceil(limit * radius_m / _STEP_M)))
    half = int(np.ceil(reach.shift_m / _CELL_M))
    found: list[tuple[float, float, F64]] = []
    for turn in np.linspace(-limit, limit, 2 * steps + 1).tolist():
        apart = (lidar[:, None] - _Place(turn, np.zeros(2)).moved(vector, pivot)[None]).reshape(-1, 2)
        cell = np.rint(apart[np.abs(apart).max(axis=1) <= reach.shift_m] / _CELL_M).astype(int) + half
        votes = np.zeros((2 * half + 1, 2 * half + 1))
        np.add.at(votes, (cell[:, 0], cell[:, 1]), 1.0)
        votes = gaussian_filter(votes, 0.7, mode="constant")
        peaks = np.argwhere((votes == maximum_filter(votes, 3)) & (votes > 0))
        found += [(float(votes[x, y]), turn, (np.array([x, y]) - half) * _CELL_M) for x, y in peaks]
    found.sort(key=lambda one: -one[0])
    kept: list[_Place] = []
    for _, turn, shift in found:
        place = _Place(turn, shift)
        if not any(_same(place, other) for other in kept):
            kept.append(place)
        if len(kept) == _PLACES:
            break
    yield from kept


def _pairs(
    moved: F64, lidar: F64, tree: cKDTree, gate_m: float
) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], np.ndarray[tuple[int], np.dtype[np.int64]]]:
    """Rows of both that are each other's nearest, within a distance."""
    distance, nearest = tree.query(moved, distance_upper_bound=gate_m)
    rows = np.flatnonzero(np.isfinite(distance))
    if not len(rows):
        return rows, rows
    back = cKDTree(moved).query(lidar[nearest[rows]])[1]
    rows = rows[back == rows]
    return rows, nearest[rows]


def _refined(place: _Place, lidar: F64, tree: cKDTree, vector: F64, pivot: F64) -> _Place:
    """Least squares over mutual nearest posts, from far to near."""
    for gate_m in _GATES_M:
        mine, theirs = _pairs(place.moved(vector, pivot), lidar, tree, gate_m)
        if len(mine) < 3:
            return place
        p, q = vector[mine] - pivot, lidar[theirs] - pivot
        a, b = p - p.mean(axis=0), q - q.mean(axis=0)
        turn = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))
        turned = _Place(turn, np.zeros(2)).moved(vector[mine], pivot) - pivot
        place = _Place(turn, q.mean(axis=0) - turned.mean(axis=0))
    return place


def _scored(place: _Place, lidar: F64, tree: cKDTree, around: cKDTree, vector: F64, pivot: F64) -> _Place:
    """With the sum of how well its posts are matched (1 at no distance, 0 at `MATCHED_M`), and how many are seen."""
    moved = place.moved(vector, pivot)
    seen = around.query(moved)[0] < SEEN_M
    mine, theirs = _pairs(moved, lidar, tree, MATCHED_M)
    apart = np.linalg.norm(moved[mine] - lidar[theirs], axis=1)
    return _Place(place.turn_rad, place.shift_m, float((1.0 - (apart / MATCHED_M) ** 2).sum()), int(seen.sum()))


def _judged(
    lidar: F64, vector: F64, pivot: F64, best: _Place, second: float, mirror: float, reach: Reach
) -> PostAlignment:
    moved = best.moved(vector, pivot)
    mine, theirs = _pairs(moved, lidar, cKDTree(lidar), MATCHED_M)
    apart = np.linalg.norm(moved[mine] - lidar[theirs], axis=1)
    median_m = float(np.median(apart)) if len(mine) else float("nan")
    n, spread = max(len(mine), 1), moved[mine] - moved[mine].mean(axis=0) if len(mine) else np.zeros((1, 2))
    sigma_post_m = max(_SIGMA_M, float(np.sqrt((apart**2).sum() / max(2 * n - 3, 1))))
    lever = float((spread**2).sum())
    scale = _scale(moved[mine], lidar[theirs])
    reasons = (
        *_match_reasons(len(mine), best.seen, median_m),
        *_place_reasons(best, second, mirror, spread, reach),
        *_scale_reasons(scale, float(np.linalg.norm(spread, axis=1).max()), sigma_post_m, lever),
    )
    T = np.eye(4)
    T[:3, :3] = exp_so3([0.0, 0.0, best.turn_rad])
    T[:2, 3] = pivot + best.shift_m - T[:2, :2] @ pivot
    return PostAlignment(
        T, pivot, best.shift_m, float(np.degrees(best.turn_rad)), sigma_post_m / np.sqrt(n),
        float(np.degrees(sigma_post_m / np.sqrt(max(lever, 1e-9)))), best.seen, len(mine), median_m, second, mirror,
        scale, reasons,
    )  # fmt: skip


def _scale(moved: F64, fixed: F64) -> float:
    """Of the first against the second, less 1, by pairs; 0 where there are too few."""
    if len(moved) < 3:
        return 0.0
    a, b = moved - moved.mean(axis=0), fixed - fixed.mean(axis=0)
    return float((a * a).sum() / max((a * b).sum(), 1e-9) - 1.0)


def _match_reasons(matched: int, seen: int, median_m: float) -> Iterator[str]:
    if matched < MIN_MATCHED:
        yield f"too few posts: {matched} of the HD map have one in the LiDAR map, {MIN_MATCHED} are needed"
    if matched < MIN_SHARE * seen:
        yield (
            f"residuals too high: {matched} of {seen} posts of the HD map that the LiDAR map should hold are there;"
            f" {100 * MIN_SHARE:.0f} % are needed: another street, other units or mirrored axes"
        )
    if matched and median_m > MAX_RESIDUAL_M:
        yield f"residuals too high: posts lie {median_m:.2f} m apart (median), {MAX_RESIDUAL_M} m are allowed"


def _place_reasons(best: _Place, second: float, mirror: float, spread: F64, reach: Reach) -> Iterator[str]:
    if second > MAX_SECOND:
        yield (
            f"ambiguous: another place matches {100 * second:.0f} % of what the best one does,"
            f" {100 * MAX_SECOND:.0f} % are allowed: posts at equal distances, or too many beside them; a crossing or"
            " a bend would decide"
        )
    if mirror > MAX_SECOND:
        yield (
            f"its mirror image matches {100 * mirror:.0f} % of it, {100 * MAX_SECOND:.0f} % are allowed: whether axes"
            " are mirrored cannot be told"
        )
    width_m = float(np.sqrt(max(np.linalg.eigvalsh(spread.T @ spread / len(spread))[0], 0.0)))
    if width_m < MIN_WIDTH_M:
        yield f"posts on one line: {width_m:.1f} m across it, {MIN_WIDTH_M:.0f} m are needed to tell sides apart"
    if np.abs(best.shift_m).max() > reach.shift_m - 0.5 or abs(np.degrees(best.turn_rad)) > reach.heading_deg - 0.1:
        yield (
            f"at the edge of the search: {best.shift_m[0]:.1f} m east, {best.shift_m[1]:.1f} m north,"
            f" {np.degrees(best.turn_rad):.1f} degrees; try a wider one"
        )


def _scale_reasons(scale: float, radius_m: float, sigma_m: float, lever_m2: float) -> Iterator[str]:
    sigma = sigma_m / np.sqrt(max(lever_m2, 1e-9))
    if abs(scale) * radius_m > MAX_SCALED_M and abs(scale) > 3.0 * sigma:
        yield (
            f"the HD map is {100 * scale:+.2f} % larger: its outermost posts lie {abs(scale) * radius_m:.2f} m off,"
            f" {MAX_SCALED_M} m are allowed"
        )
