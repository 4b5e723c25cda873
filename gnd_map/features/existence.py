"""Whether a feature exists, after Dempster and Shafer (SLAMCU, section 4.2).

The frame of discernment is {∃, ∄}; a body of evidence gives mass to ∃, to ∄ and to both together (Ω, unknown). What two
bodies give to "∃ and ∄" is conflict: Dempster's rule shares it out, and we keep account of how much it was.
"""

from dataclasses import dataclass
from math import isfinite
from typing import Final, Literal

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import FeatureError

State = Literal["exist", "absent", "unknown"]

_TOLERANCE: Final = 1e-6
MAX_CONFLICT: Final = 1.0 - 1e-9
"""Certain evidence against certain evidence cannot be combined; nearer than this it is refused."""


@dataclass(frozen=True, slots=True)
class Existence:
    """Masses of ∃, ∄ and Ω, and how much of the evidence so far contradicted itself."""

    exist: float
    """m(∃)."""
    absent: float
    """m(∄)."""
    unknown: float
    """m(Ω)."""
    conflict: float = 0.0
    """Share of all products of masses that Dempster's normalisation has thrown away so far, 1 - Π (1 - m_k(φ))."""

    def __post_init__(self) -> None:
        masses = (self.exist, self.absent, self.unknown)
        if not all(isfinite(m) and -_TOLERANCE <= m <= 1 + _TOLERANCE for m in (*masses, self.conflict)):
            raise FeatureError(f"masses {masses} with conflict {self.conflict}: each lies in 0 … 1")
        if abs(sum(masses) - 1.0) > _TOLERANCE:
            raise FeatureError(f"masses {masses} sum to {sum(masses)}, not to 1")

    @property
    def state(self) -> State:
        """What has the largest mass, unknown where two share it (the representative existence, SLAMCU, 4.3.3)."""
        if self.exist > max(self.absent, self.unknown):
            return "exist"
        return "absent" if self.absent > max(self.exist, self.unknown) else "unknown"

    def combined(self, other: "Existence") -> "Existence":
        """Dempster's rule of combination.

        Raises:
            FeatureError: the two contradict each other entirely.
        """
        return Existence(*combine(_row(self), _row(other))[0].tolist())

    def discounted(self, reliability: float) -> "Existence":
        """The same evidence from a source that is right with this probability (Shafer's discounting)."""
        if not 0.0 <= reliability <= 1.0:
            raise FeatureError(f"a reliability lies in 0 … 1, got {reliability}")
        exist, absent = self.exist * reliability, self.absent * reliability
        return Existence(exist, absent, 1.0 - exist - absent, self.conflict)


VACUOUS: Final = Existence(0.0, 0.0, 1.0)  # SLAMCU, Eq. (4)


def hit(confidence: float) -> Existence:
    """The evidence of a feature in view that was detected; `confidence` is λ. SLAMCU, Eq. (1)."""
    return Existence(confidence, 0.0, 1.0 - confidence)


def miss(confidence: float) -> Existence:
    """The evidence of a feature in view that was not detected; `confidence` is λ. SLAMCU, Eq. (2)."""
    return Existence(0.0, confidence, 1.0 - confidence)


def prior(confidence: float) -> Existence:
    """What an HD map says of a feature that it holds; `confidence` is λ_HD. SLAMCU, Eq. (3)."""
    return Existence(confidence, 0.0, 1.0 - confidence)


def combine(a: F64, b: F64) -> F64:
    """Dempster's rule for many features at once. SLAMCU, Eq. (5)-(7).

    Args:
        a: (N, 4) exist, absent, unknown, conflict so far; or (4,), (1, 4).
        b: the same, broadcast against `a`.

    Returns:
        (N, 4) the combined masses; the conflict is that of both and of this combination.

    Raises:
        FeatureError: a pair contradicts itself entirely.
    """
    a, b = np.atleast_2d(a), np.atleast_2d(b)
    exist = a[:, 0] * b[:, 0] + a[:, 0] * b[:, 2] + a[:, 2] * b[:, 0]  # Eq. (7): ∃∩∃, ∃∩Ω, Ω∩∃
    absent = a[:, 1] * b[:, 1] + a[:, 1] * b[:, 2] + a[:, 2] * b[:, 1]
    unknown = a[:, 2] * b[:, 2]
    conflict = a[:, 0] * b[:, 1] + a[:, 1] * b[:, 0]  # mass of φ
    if (conflict > MAX_CONFLICT).any():
        raise FeatureError(
            f"{int((conflict > MAX_CONFLICT).sum())} of {len(conflict)} pairs of masses contradict entirely"
        )
    left = exist + absent + unknown  # = 1 - mass of φ, without its rounding
    total = 1.0 - (1.0 - a[:, 3]) * (1.0 - b[:, 3]) * (1.0 - conflict)
    return np.column_stack([exist / left, absent / left, unknown / left, total])  # Eq. (6)


def _row(existence: Existence) -> F64:
    return np.array([[existence.exist, existence.absent, existence.unknown, existence.conflict]])
