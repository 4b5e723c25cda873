"""The book of features: what is known of each, and whether it exists (SLAMCU, section 4)."""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from math import nan
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import VACUOUS, Existence, combine, hit, miss, prior
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters

_MIN_HITS: Final = 3
"""A new feature exists for others once it was measured so often: two false alarms at one place happen."""

HISTORY: Final = 1024
"""So many steps of a feature's masses are kept."""
DOUBT: Final = 1e-15
"""No mass falls below this: looks from one place are no independent witnesses, and changes must be able to show."""


class FeatureClass(IntEnum):
    """Classes of SLAMCU, section 4.3.3."""

    NORMAL = 0
    DELETED = 1
    NEW = 2
    UNCLASSIFIED = 3


@dataclass(frozen=True, slots=True)
class MassesAt:
    """One step of Figure 8."""

    t_ns: int
    existence: Existence


@dataclass(slots=True, eq=False)
class BookEntry:
    """One feature: the map's, or found here.

    Attributes:
        number: feature id of the map's, 1, 2, 3 … of those found here.
        known: whether the map holds it.
        kind: only equal kinds are associated.
        xy_m: (2,) where the map has it, or where it was last thought to be.
        cov: (3,) xx, xy, yy, of `xy_m` where that is settled; None while it is estimated.
        z_m: height in the map, nan = unknown.
        masses: (4,) exist, absent, unknown, conflict.
        slot: its place in the particles, None = not there.
        pass_hits: hits since it is there.
        pass_misses: misses since.
        in_view_s: when it was last in view or measured.
        odometer_m: way driven when it was last measured.
        seen: what this drive measured of a feature of the map, independently of the map's position of it.
        together: how often it and another (by key) were measured in one look: those are two features.
    """

    number: int
    known: bool
    kind: str
    xy_m: F64
    cov: F64 | None
    z_m: float
    masses: F64
    hits: int = 0
    misses: int = 0
    slot: int | None = None
    pass_hits: int = 0
    pass_misses: int = 0
    in_view_s: float = 0.0
    odometer_m: float = 0.0
    heights: deque[float] = field(default_factory=lambda: deque(maxlen=HISTORY))
    seen: tuple[F64, F64] | None = None
    together: Counter[int] = field(default_factory=Counter)
    history: deque[tuple[int, F64]] = field(default_factory=lambda: deque(maxlen=HISTORY))

    def __deepcopy__(self, memo: dict[int, Any]) -> "BookEntry":
        """A copy that goes its own way: arrays are only ever replaced, never written into, and may be shared."""
        copied = replace(self, heights=self.heights.copy(), history=self.history.copy(), together=self.together.copy())
        memo[id(self)] = copied
        return copied

    @property
    def key(self) -> int:
        """Unique among features of the map and new ones."""
        return self.number if self.known else -self.number

    @property
    def height_m(self) -> float:
        """Height in the map frame as measured, nan = never."""
        return float(np.median(self.heights)) if self.heights else nan

    def masses_over_time(self) -> tuple[MassesAt, ...]:
        """The last `HISTORY` steps of its masses."""
        return tuple(MassesAt(t_ns, existence_of(masses)) for t_ns, masses in self.history)


class ExistenceBook:
    """Masses of features, step by step."""

    def __init__(self, parameters: SlamcuParameters) -> None:
        self._p = parameters
        confidence = parameters.detection_confidence
        self._hit, self._miss = row(hit(confidence)), row(miss(confidence))
        self.known_masses = row(prior(parameters.map_confidence))  # Eq. (3)
        self.new_masses = row(VACUOUS)  # Eq. (4)

    def evidence(self, detected: Sequence[BookEntry], missed: Sequence[BookEntry], t_ns: int) -> None:
        """Detected features get Eq. (1), those in view that were not detected Eq. (2), all by Eq. (5)."""
        touched = [*detected, *missed]
        if not touched:
            return
        new = np.array([self._hit] * len(detected) + [self._miss] * len(missed))
        masses = doubted(combine(np.array([entry.masses for entry in touched]), new))
        for entry, after in zip(touched, masses, strict=True):
            entry.masses = after
            entry.history.append((t_ns, after))
        for entry in detected:
            entry.hits += 1
        for entry in missed:
            entry.misses += 1
            entry.pass_misses += 1

    def recount(self, entry: BookEntry, hits: int, misses: int, t_ns: int) -> None:
        """Masses from counts, whose order does not matter: hits turned out to be misses, or another feature's."""
        entry.hits, entry.misses = max(hits, 0), max(misses, 0)
        masses = self.known_masses if entry.known else self.new_masses
        entry.masses = doubted(counted(masses, entry.hits, entry.misses, self._p.detection_confidence)[None])[0]
        entry.history.append((t_ns, entry.masses))

    def classify(self, entry: BookEntry) -> FeatureClass:
        """The class by the largest mass (section 4.3.3); a new one must have been measured `min_hits` times."""
        state = existence_of(entry.masses).state
        if entry.known:
            known = {"exist": FeatureClass.NORMAL, "absent": FeatureClass.DELETED}
            return known.get(state, FeatureClass.UNCLASSIFIED)
        enough = entry.hits >= _MIN_HITS
        return FeatureClass.NEW if state == "exist" and enough else FeatureClass.UNCLASSIFIED

    def usable(self, entry: BookEntry) -> bool:
        """Whether it may tell where the vehicle is: only what exists, by its masses (section 4.3.4)."""
        return bool(entry.masses[0] > max(entry.masses[1], entry.masses[2]))


def row(existence: Existence) -> F64:
    """(4,) exist, absent, unknown, conflict."""
    return np.array([existence.exist, existence.absent, existence.unknown, existence.conflict])


def existence_of(masses: F64) -> Existence:
    """Masses (4,) as a value."""
    return Existence(*(float(mass) for mass in masses))


def repeated(evidence: F64, count: int) -> F64:
    """The same one-sided evidence `count` times: its unknown mass to that power, as Dempster's rule has it."""
    unknown = evidence[2] ** count
    side = (1.0 - unknown) * (evidence[:2] > 0.0)
    return np.array([side[0], side[1], unknown, 0.0])


def counted(masses: F64, hits: int, misses: int, confidence: float) -> F64:
    """Masses (4,) after so many times Eq. (1) and Eq. (2), in any order.

    Dempster's rule multiplies commonalities q(A) = Σ_{B ⊇ A} m(B); here in logarithms, as thousands of looks underflow.
    """
    ln_unknown = np.log1p(-confidence)
    with np.errstate(divide="ignore"):
        ln = np.log([masses[0], masses[1], masses[2]]) + ln_unknown * np.array([misses, hits, hits + misses])
        ln_shared = np.log(masses[2]) + ln_unknown * np.array([misses, hits])
    # m(∃) = q(∃) - q(Ω): what the prior gives to ∃, and what it leaves open and the hits decide
    top = max(ln.max(), ln_shared.max())
    decided = -np.expm1(ln_unknown * np.array([hits, misses]))
    out = np.exp(ln - top)
    out[:2] += np.exp(ln_shared - top) * decided
    total = float(out.sum())
    conflict = 1.0 - (1.0 - masses[3]) * min(total * float(np.exp(top)), 1.0)
    return np.array([*(out / total), conflict])


def doubted(masses: F64) -> F64:
    """Masses (N, 4), none of the three below `DOUBT`."""
    out = np.array(masses)
    out[:, :3] = np.maximum(out[:, :3], DOUBT)
    out[:, :3] /= out[:, :3].sum(axis=1, keepdims=True)
    out[:, 3] = np.minimum(out[:, 3], 1.0 - DOUBT)
    return out
