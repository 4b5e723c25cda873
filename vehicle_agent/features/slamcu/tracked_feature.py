"""One feature along a drive: what is known of it, and the evidence of whether it exists (SLAMCU, section 4)."""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from math import nan
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import VACUOUS, Existence, combine, hit, miss, prior
from gnd.vehicle_agent.features.slamcu.sensor_model import MAP_SAYS, Tally

MAP_CONFIDENCE: Final = 0.95
"""λ_HD of Eq. (3)."""
_MIN_HITS: Final = 3
"""A new feature exists for others once it was measured so often: two false alarms at one place happen."""

HISTORY: Final = 1024
"""So many steps of a feature's masses are kept."""
LEAST_MASS: Final = 1e-15
"""No mass falls below this: looks from one place are not independent, and changes must be able to show."""


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


def row(existence: Existence) -> F64:
    """(4,) exist, absent, unknown, conflict."""
    return np.array([existence.exist, existence.absent, existence.unknown, existence.conflict])


KNOWN_MASSES: Final = row(prior(MAP_CONFIDENCE))
"""Of a feature of the map before any evidence; Eq. (3)."""
NEW_MASSES: Final = row(VACUOUS)
"""Of one that was found here; Eq. (4)."""


@dataclass(slots=True, eq=False)
class TrackedFeature:
    """A feature of the map, or one that was found on this drive.

    Attributes:
        number: feature id of the map's, 1, 2, 3 … of those found here.
        known: whether the map holds it.
        kind: only equal kinds are associated.
        xy_m: (2,) where the map has it, or where it was last estimated.
        cov: (3,) xx, xy, yy, of `xy_m` where that is settled; None while it is estimated.
        z_m: height in the map, nan = unknown.
        masses: (4,) exist, absent, unknown, conflict.
        hits: measurements of it.
        misses: looks in which it was in view and was not measured, each as `SensorModel.miss` counts it.
        slot: its place in the particles; None: it is not estimated there.
        pass_hits: hits since it is estimated there.
        pass_misses: misses since.
        in_view_s: when it was last in view or measured.
        odometer_m: way driven when it was last measured.
        heights: in the map frame, as measured.
        measured: (2,) and (2, 2), where this drive measured a feature of the map, independently of the map.
        together: how often it and another (by key) were measured in one look: those are two features.
        history: times and masses of the last evidence.
        named: how often it was measured as which kind.
        tally: looks at it that were well in view, by range.
        held: (2,) variances of the errors that stay with it, before it was estimated.
        is_passed: whether it has been out of view since it was last measured.
        is_clutter: its detections are those of something that is taken for a sign now and then.
    """

    number: int
    known: bool
    kind: str
    xy_m: F64
    cov: F64 | None
    z_m: float
    masses: F64
    hits: int = 0
    misses: float = 0.0
    slot: int | None = None
    pass_hits: int = 0
    pass_misses: float = 0.0
    in_view_s: float = 0.0
    odometer_m: float = 0.0
    heights: deque[float] = field(default_factory=lambda: deque(maxlen=HISTORY))
    measured: tuple[F64, F64] | None = None
    together: Counter[int] = field(default_factory=Counter)
    history: deque[tuple[int, F64]] = field(default_factory=lambda: deque(maxlen=HISTORY))
    named: Counter[str] = field(default_factory=Counter)
    tally: Tally = field(default_factory=Tally)
    held: F64 = field(default_factory=lambda: np.zeros(2))
    is_passed: bool = False
    is_clutter: bool = False

    def __deepcopy__(self, memo: dict[int, Any]) -> "TrackedFeature":
        """A copy that goes its own way: arrays are only ever replaced, never written into, and may be shared."""
        copied = replace(self, heights=self.heights.copy(), history=self.history.copy(), together=self.together.copy())
        copied.named, copied.tally = self.named.copy(), Tally(self.tally.looks.copy(), self.tally.hits.copy())
        memo[id(self)] = copied
        return copied

    @property
    def key(self) -> int:
        """Unique among features of the map and new ones."""
        return self.number if self.known else -self.number

    @property
    def estimated_in(self) -> int:
        """Its slot, of a feature that is estimated."""
        assert self.slot is not None
        return self.slot

    @property
    def prior(self) -> tuple[F64, F64] | None:
        """Its position (2,) and covariance (3,) known otherwise, if there is one."""
        return None if self.cov is None else (self.xy_m, self.cov)

    @property
    def height_m(self) -> float:
        """Height in the map frame as measured, nan = never."""
        return float(np.median(self.heights)) if self.heights else nan

    @property
    def feature_class(self) -> FeatureClass:
        """The class by the largest mass (section 4.3.3); a new one must have been measured three times."""
        state = existence_of(self.masses).state
        if self.known:
            return {"exist": FeatureClass.NORMAL, "absent": FeatureClass.DELETED}.get(state, FeatureClass.UNCLASSIFIED)
        is_new = state == "exist" and self.hits >= _MIN_HITS and not self.is_clutter
        return FeatureClass.NEW if is_new else FeatureClass.UNCLASSIFIED

    @property
    def kinds(self) -> dict[str, float]:
        """Detections by kind, with what the map says of it counted as `MAP_SAYS` of them."""
        found: dict[str, float] = dict(self.named)
        if self.known or not found:
            found[self.kind] = found.get(self.kind, 0.0) + MAP_SAYS
        return found

    @property
    def exists(self) -> bool:
        """Whether it may weigh the particles: only what exists, by its masses (section 4.3.4)."""
        return bool(self.masses[0] > max(self.masses[1], self.masses[2]))

    def masses_over_time(self) -> tuple[MassesAt, ...]:
        """The last `HISTORY` steps of its masses."""
        return tuple(MassesAt(t_ns, existence_of(masses)) for t_ns, masses in self.history)


def add_evidence(
    detected: Sequence[TrackedFeature],
    missed: Sequence[TrackedFeature],
    confidence: float,
    t_ns: int,
    counts: Sequence[float] | None = None,
) -> None:
    """Detected features get Eq. (1), those in view that were not detected Eq. (2), with λ, all by Eq. (5).

    Args:
        detected: features that were measured.
        missed: those that were not.
        confidence: λ.
        t_ns: when.
        counts: what the miss of each missed one counts; None: 1.
    """
    touched, counts = [*detected, *missed], [1.0] * len(missed) if counts is None else counts
    if not touched:
        return
    unseen = [row(miss(1.0 - (1.0 - confidence) ** count)) for count in counts]
    new = np.array([row(hit(confidence))] * len(detected) + unseen)
    masses = bounded_below(combine(np.array([feature.masses for feature in touched]), new))
    for feature, after in zip(touched, masses, strict=True):
        feature.masses = after
        feature.history.append((t_ns, after))
    for feature in detected:
        feature.hits += 1
    for feature, count in zip(missed, counts, strict=True):
        feature.misses += count
        feature.pass_misses += count


def recount(feature: TrackedFeature, hits: int, misses: float, confidence: float, t_ns: int) -> None:
    """Masses from counts, whose order does not matter: hits turned out to be misses, or another feature's."""
    feature.hits, feature.misses = max(hits, 0), max(misses, 0.0)
    masses = KNOWN_MASSES if feature.known else NEW_MASSES
    feature.masses = bounded_below(counted(masses, feature.hits, feature.misses, confidence)[None])[0]
    feature.history.append((t_ns, feature.masses))


def existence_of(masses: F64) -> Existence:
    """Masses (4,) as a value."""
    return Existence(*(float(mass) for mass in masses))


def counted(masses: F64, hits: int, misses: float, confidence: float) -> F64:
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


def bounded_below(masses: F64) -> F64:
    """Masses (N, 4), none of the three below `LEAST_MASS`."""
    out = np.array(masses)
    out[:, :3] = np.maximum(out[:, :3], LEAST_MASS)
    out[:, :3] /= out[:, :3].sum(axis=1, keepdims=True)
    out[:, 3] = np.minimum(out[:, 3], 1.0 - LEAST_MASS)
    return out
