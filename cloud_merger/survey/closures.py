"""Where drives meet, and where they lie on the published map: matches that pass the gates of fit, overlap, innovation.

A place that looks like another fits well there. What tells them apart is what is known before: a match must lie within
what the graph leaves open, and where that is more than `LOOSE_M`, no other place in reach may fit nearly as well.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.cloud_merger.survey.graph import INLIER_CHI2, PlacedSubmaps, RelativeCovariances, SurveyTie, innovation
from gnd.cloud_merger.survey.matching import Surface, SurfaceMatch, match_surfaces
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse

NEAR_M: Final = 14.0
"""Submaps whose origins are thought to lie so near are matched."""
REVISIT_M: Final = 60.0
"""Way between two submaps of one drive from which on they are two passes."""
PARTNERS: Final = 2
"""Submaps of each other drive with which one is matched, the nearest ones."""
MIN_FIT, MIN_OVERLAP = 0.45, 0.35
MIN_MAP_OVERLAP: Final = 0.25
"""At the edge of the map only part of a submap lies on it."""
TIGHT_M: Final = 0.12
"""One sigma of a prior up to which a match begins near it."""
LOOSE_M: Final = 0.5
"""One sigma of a prior from which on other places are looked at."""
MOST_SIGMA_M: Final = 1.5
"""A prior worse than this closes nothing: what fits there may be anywhere. So it is for a drive that the map has never
held, and at the far end of a kilometre."""
RIVAL: Final = 0.93
"""Share of the best fit times overlap that another place may reach."""
_RIVAL_APART_M: Final = 1.5
_RIVAL_STEP_M: Final = 2.5

Fate = Counter[str]


@dataclass(frozen=True, slots=True, eq=False)
class SurveyPrior:
    """What is known before a match: T_target_source (4, 4) and its covariance (6, 6)."""

    T: F64
    covariance: F64

    @property
    def sigma_m(self) -> float:
        """Largest horizontal sigma."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:5, 3:5])[-1]))


def closures(
    solved: PlacedSubmaps, drive_of: np.ndarray, known: RelativeCovariances, surfaces: Sequence[Surface], fate: Fate
) -> list[SurveyTie]:
    """Closures between submaps of different drives, and of one drive that comes back; `fate` counts all."""
    found = []
    for early, late in _pairs(solved.T, drive_of):
        prior = SurveyPrior(T_inverse(solved.T[early]) @ solved.T[late], known.of(early, late))
        match = believable(surfaces[late], surfaces[early], prior, MIN_OVERLAP, fate)
        if match is not None:
            found.append(SurveyTie("closure", early, late, match.T_target_source, match.covariance))
    return found


def map_ties(solved: PlacedSubmaps, surfaces: Sequence[Surface], published: Surface, fate: Fate) -> list[SurveyTie]:
    """Matches of submaps with the published map, which is in the working frame."""
    found = []
    for n, surface in enumerate(surfaces):
        prior = SurveyPrior(solved.T[n], solved.covariance[n])
        if not len(published) or published.tree.query(solved.T[n, :3, 3])[0] > 40.0:
            continue
        match = believable(surface, published, prior, MIN_MAP_OVERLAP, fate, what="map")
        if match is not None:
            found.append(SurveyTie("map", -1, n, match.T_target_source, match.covariance))
    return found


def believable(
    source: Surface, target: Surface, prior: SurveyPrior, min_overlap: float, fate: Fate, what: str = "closure"
) -> SurfaceMatch | None:
    """The match that passes all gates, or None; why goes into `fate`."""
    if prior.sigma_m > MOST_SIGMA_M:
        fate[f"{what}_unknown_place"] += 1
        return None
    loose = prior.sigma_m > LOOSE_M
    tries = list(_starts(prior)) if loose else [prior.T]
    wide = prior.sigma_m > TIGHT_M
    matches = [m for T in tries if (m := match_surfaces(source, target, T, wide=wide)) is not None]
    matches = [m for m in matches if _chi2(m, prior) <= INLIER_CHI2]
    if not matches:
        fate[f"{what}_beyond_prior"] += 1
        return None
    best = max(matches, key=_merit)
    if best.fit < MIN_FIT or best.overlap < min_overlap:
        fate[f"{what}_poor"] += 1
        return None
    rivals = [m for m in matches if np.linalg.norm(innovation(best.T_target_source, m.T_target_source)[3:5])
              > _RIVAL_APART_M]  # fmt: skip
    if any(_merit(m) > RIVAL * _merit(best) for m in rivals):
        fate[f"{what}_ambiguous"] += 1
        return None
    fate[f"{what}_found"] += 1
    return best


def _merit(match: SurfaceMatch) -> float:
    return match.fit * match.overlap


def _chi2(match: SurfaceMatch, prior: SurveyPrior) -> float:
    e = innovation(prior.T, match.T_target_source)
    return float(e @ np.linalg.solve(prior.covariance + match.covariance, e))


def _starts(prior: SurveyPrior) -> Iterator[F64]:
    """Poses around the expected one, every `_RIVAL_STEP_M` in the plane within two sigmas."""
    reach = min(2.0 * prior.sigma_m, 2.0 * MOST_SIGMA_M)
    n = int(np.ceil(reach / _RIVAL_STEP_M))
    values, axes = np.linalg.eigh(prior.covariance[3:5, 3:5])
    wide = np.sqrt(values) * 2.0
    for i in range(-n, n + 1):
        for j in range(-n, n + 1):
            step = np.array([i, j]) * _RIVAL_STEP_M
            along = axes.T @ step
            if (np.abs(along) <= np.maximum(wide, _RIVAL_STEP_M / 2)).all():
                T = prior.T.copy()
                T[:3, 3] += prior.T[:3, :3] @ np.array([*step, 0.0])
                yield T


def _pairs(T: F64, drive_of: np.ndarray) -> list[tuple[int, int]]:
    """(early, late) nodes that lie near each other, of two drives or of two passes of one."""
    found = set[tuple[int, int]]()
    p = T[:, :3, 3]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    for late in range(len(T)):
        distance = np.linalg.norm(p[:, :2] - p[late, :2], axis=1)
        other = (drive_of != drive_of[late]) | (np.abs(way - way[late]) > REVISIT_M)
        near = np.flatnonzero(other & (distance < NEAR_M) & (np.abs(p[:, 2] - p[late, 2]) < 6.0))
        taken = Counter[int]()
        for k in near[np.argsort(distance[near], kind="stable")]:
            if taken[int(drive_of[k])] < PARTNERS:
                taken[int(drive_of[k])] += 1
                found.add((min(int(k), late), max(int(k), late)))
    return sorted(found)
