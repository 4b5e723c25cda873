"""Detections of poles against the truth: who was found, what was wrong, how far off, and whether its sigma says so."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.poles.detector import Pole
from studies.pole_scenes import Posts

GATE_M: Final = 0.5
"""A detection is right when the axis of a post that no nearer detection has lies within this."""
BANDS: Final = ((0, 10), (10, 20), (20, 30), (30, 40))
SINGLE: Final = ("lamp", "sign", "tree")
"""Things of the world that stand alone; a scaffold's posts do not, and bollards are too low to count."""
CHI2_2_95: Final = 5.991
"""95 % quantile of chi-square with two degrees of freedom."""

Mask = NDArray[np.bool_]


@dataclass(slots=True)
class Score:
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
