"""When two features of the map in a row are not where they should be, it is the vehicle that is not where it thinks.

A vehicle that starts with a GNSS fix may take a new sign for the map's next to it, and is then sure of a wrong place.
Each further sign would seem to have moved, by the same step. So a sign that moved is remembered until another one is
found in its place; when a second one moved alike, neither has: both get their evidence back, and the place is looked
for anew.
"""

from dataclasses import dataclass
from math import radians
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.slamcu.existence_book import BookEntry, ExistenceBook
from gnd.vehicle_agent.features.slamcu.rbpf import Rbpf
from gnd.vehicle_agent.features.slamcu.tracked import Tracked

ALIKE: Final = 0.5
"""Cosine of the angle between two steps that may be one, and the least ratio of their lengths."""
RECENT_M: Final = 1500.0
"""A sign that moved longer ago says nothing about the place now."""
LOOSE_M: Final = 4.0
LOOSE_RAD: Final = radians(1.0)
"""Sigmas of the place that is looked for anew: a lane, and what two signs a lane off turn the vehicle by."""


@dataclass(frozen=True, slots=True, eq=False)
class DoubtStep:
    """A feature of the map that was called moved.

    Attributes:
        known: the map's.
        found: what was registered instead.
        hits: measurements that went over to it.
        off_m: (2,) measured minus mapped position.
        odometer_m: when.
    """

    known: BookEntry
    found: BookEntry
    hits: int
    off_m: F64
    odometer_m: float


class PlaceDoubt:
    """Remembers the last feature that moved.

    Args:
        tracked: the features.
        rbpf: the particles.
        book: their masses.
    """

    def __init__(self, tracked: Tracked, rbpf: Rbpf, book: ExistenceBook) -> None:
        self._tracked, self._rbpf, self._book = tracked, rbpf, book
        self._last: DoubtStep | None = None
        self._sure_m = 0.0

    def found_in_place(self, odometer_m: float) -> None:
        """A feature of the map was measured where it should be."""
        self._last, self._sure_m = None, odometer_m

    def moved(self, step: DoubtStep) -> None:
        """A feature of the map was called moved."""
        self._last = step

    def forget(self) -> None:
        """The place is looked for anew: steps from before say nothing."""
        self._last = None

    def is_it_me(self, off_m: F64, others_m: list[F64], odometer_m: float) -> bool:
        """Whether another feature is off by the same step as one that is off by (2,)."""
        before = self._last
        if before is not None and odometer_m - before.odometer_m < RECENT_M:
            others_m = [*others_m, before.off_m]
        return self._rbpf.weighing and any(alike(off_m, other) for other in others_m)

    def look_anew(self, t_ns: int) -> None:
        """Take the last move back, and loosen the place."""
        last, self._last = self._last, None
        if last is not None and last.found in self._tracked.new and last.known in self._tracked.known:
            known, hits = last.known, last.hits
            self._tracked.hand_back(last.found, known)
            self._book.recount(known, known.hits + hits, known.misses - hits, t_ns)
        since = [e.slot for e in self._tracked.live if e.slot is not None and e.odometer_m >= self._sure_m]
        self._rbpf.loosen(since, LOOSE_M, LOOSE_RAD)


def alike(one_m: F64, other_m: F64) -> bool:
    """Whether two steps (2,) may be one."""
    lengths = float(np.hypot(*one_m)), float(np.hypot(*other_m))
    return min(lengths) > ALIKE * max(lengths) and float(one_m @ other_m) > ALIKE * lengths[0] * lengths[1]
