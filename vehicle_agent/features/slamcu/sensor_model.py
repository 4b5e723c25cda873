"""What a vehicle learns about its own camera while driving: how far its errors exceed what its detector states.

A detector states the sigma of each look. What it does not state is learnt within bounds, from features that the vehicle
is sure of: how large errors are that stay with a feature (no averaging removes them), how large the white ones are
beside the stated ones, how often a feature is detected by range, and how often it is taken for another kind. All of
these are hyperparameters of the filter and common to its particles; the camera's own calibration is a state of each
particle (`ParticleFilter.camera`).
"""

from collections import Counter
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from math import log, radians
from typing import Any, Final

import numpy as np
from scipy.special import betaln

from gnd.gnd_map.arrays import F64

BIN_M: Final = 10.0
"""Detections are counted by ranges of this width."""
DETECTED: Final = (0.3, 0.95)
"""Bounds of the share of looks that detect a feature."""
BEFORE: Final = 20.0
"""The share before any look counts as so many looks."""
HELD: Final = (0.008, radians(0.15))
"""Errors of range (share) and bearing [rad] that stay with a feature, before any was measured: small, or a sign that
was replaced by one beside it seems to be the same. The first signs that stand as mapped show what they are."""
HELD_SPREAD: Final = 1.3
"""Standard deviation of their natural logarithm."""
CALIBRATION: Final = np.array([0.03, radians(1.0)])
"""Sigmas of the camera's errors before anything was measured: share of the range, bearing [rad]."""
WRONG: Final = np.array([0.15, radians(3.0)])
"""A camera that is farther off than this is mounted wrongly; its looks are still used."""
ENOUGH_HITS: Final = 8
"""A feature that was measured so often says something about the errors that stay with it."""
SURE_HITS: Final = 10
"""And from then on its innovations are those of the white noise."""
MEMORY: Final = 600.0
"""White noise is judged by the last so many measurements."""
PLACES: Final = 120.0
"""And places by the last so many comparisons with the map, two a feature."""
MOST_SQUARED: Final = 20.0
"""A feature farther off than this has moved, or is another one."""
TYPICAL_M: Final = 30.0
"""A feature is judged by looks from about so far."""
CONFUSED: Final = (0.002, 0.2)
"""Bounds of the share of detections that name another kind."""
KINDS: Final = 6.0
"""Another kind is one of so many."""
MAP_SAYS: Final = 3.0
"""What the map says of a feature's kind counts as so many detections."""
OTHER_KIND: Final = 0.75
"""A feature of the map is of another kind when this share of its detections says so, and `ENOUGH_HITS` do."""


class ScaleBelief:
    """How large a standard deviation is, by a grid over its logarithm.

    Args:
        middle: the likeliest before anything was measured.
        spread: standard deviation of its natural logarithm before.
        least, most: bounds.
    """

    def __init__(self, middle: float, spread: float, least: float, most: float) -> None:
        self._ln = np.linspace(log(least), log(most), 25)
        self._before = -0.5 * np.square((self._ln - log(middle)) / spread)
        self._log = np.zeros_like(self._ln)

    def add(self, off: float, variance: float, forget: float = 0.0, factor: float = 1.0) -> None:
        """An error of this size was found, with a variance beside: off ~ N(0, factor σ² + variance)."""
        total = factor * np.exp(2.0 * self._ln) + variance
        self._log = (1.0 - forget) * self._log - 0.5 * (off * off / total + np.log(total))

    @property
    def value(self) -> float:
        """The standard deviation: the mean of its logarithm."""
        return float(np.exp(self._weights @ self._ln))

    @property
    def variance(self) -> float:
        """The variance of an error whose standard deviation is this uncertain: the mean of the square."""
        return float(self._weights @ np.exp(2.0 * self._ln))

    @property
    def _weights(self) -> F64:
        together = self._before + self._log
        weights = np.exp(together - together.max())
        return np.asarray(weights / weights.sum())


@dataclass(slots=True)
class Tally:
    """Looks at one feature that was well in view and not hidden, by range.

    Attributes:
        looks: number by `BIN_M`.
        hits: of those that measured it.
    """

    looks: Counter[int] = field(default_factory=Counter)
    hits: Counter[int] = field(default_factory=Counter)

    def count(self, range_m: float, *, hit: bool) -> None:
        """One more look."""
        self.looks[int(range_m / BIN_M)] += 1
        self.hits[int(range_m / BIN_M)] += hit

    def add(self, other: "Tally") -> None:
        """Those of another."""
        self.looks.update(other.looks)
        self.hits.update(other.hits)


class SensorModel:
    """What is known of a detector; `learns` False: its stated noise is all there is, and it always detects with λ.

    Args:
        confidence: λ of Eq. (1) and (2), the share of looks that detect a feature before anything was learnt.
        learns: from what it measures.
    """

    def __init__(self, confidence: float, *, learns: bool = True) -> None:
        self.confidence, self.learns = confidence, learns
        share, turn = HELD
        self._held = (
            ScaleBelief(share, HELD_SPREAD, 0.002, 0.15),
            ScaleBelief(turn, HELD_SPREAD, radians(0.05), radians(4.0)),
        )
        self._white = (ScaleBelief(1.0, 0.3, 0.5, 4.0), ScaleBelief(1.0, 0.3, 0.5, 4.0))
        self._places = ScaleBelief(1.0, 0.3, 1.0, 3.0)
        self._seen = Tally()
        self._named = np.array([1.0, 30.0])  # detections of another kind, and of the feature's own

    def __deepcopy__(self, memo: dict[int, Any]) -> "SensorModel":
        copied = SensorModel(self.confidence, learns=self.learns)
        memo[id(self)] = copied
        for name in ("_held", "_white", "_places", "_seen", "_named"):
            setattr(copied, name, deepcopy(getattr(self, name), memo))
        return copied

    @property
    def held(self) -> F64:
        """(2,) variances of the errors of range (share) and of bearing [rad] that stay with a feature."""
        return np.square([one.value for one in self._held]) if self.learns else np.zeros(2)

    @property
    def claimed(self) -> F64:
        """(2,) the same for what is claimed of places: as long as nobody knows how large these errors are, they may be
        large.
        """
        return np.array([one.variance for one in self._held]) if self.learns else np.zeros(2)

    @property
    def white(self) -> F64:
        """(2,) what the stated variances of range and bearing are multiplied by."""
        return np.square([one.value for one in self._white]) if self.learns else np.ones(2)

    @property
    def places(self) -> float:
        """What variances of places are multiplied by, as innovations against the map show; 1 or more."""
        return self._places.value**2 if self.learns else 1.0

    def compared(self, squared: float) -> None:
        """A feature of the map was measured so far off (squared Mahalanobis distance, 2 degrees of freedom)."""
        for _ in range(2):
            self._places.add(float(np.sqrt(0.5 * min(squared, MOST_SQUARED))), 0.0, 1.0 / PLACES)

    def detects(self, range_m: float) -> float:
        """The share of looks that detect a feature at a range, within `DETECTED`."""
        if not self.learns:
            return self.confidence
        bin_ = int(range_m / BIN_M)
        share = (self._seen.hits[bin_] + self.confidence * BEFORE) / (self._seen.looks[bin_] + BEFORE)
        return float(np.clip(share, *DETECTED))

    def lasting(self, heading_rad: float) -> F64:
        """(2, 2) covariance of what stays with a feature although its looks do not show it: half of its sigmas."""
        c, s = np.cos(heading_rad), np.sin(heading_rad)
        R = np.array([[c, -s], [s, c]])
        return np.asarray(R @ np.diag(0.25 * self.held * TYPICAL_M**2) @ R.T)

    def miss(self, range_m: float) -> float:
        """What a look without the feature at this range counts, in misses of Eq. (2). Its λ is the share of looks that
        detect it: a miss where half of the looks miss says a third as much as one where a tenth does.
        """
        if not self.learns:
            return 1.0
        return min(log(1.0 - self.detects(range_m)) / log(1.0 - self.confidence), 1.0)

    def settled(self, mean: F64, variance: F64, before: F64) -> None:
        """Errors (2,) that stay with a feature were estimated, with variances (2,) that were `before`."""
        for belief, off, after, prior in zip(self._held, mean, variance, before, strict=True):
            told = 1.0 / after - 1.0 / prior if after > 0.0 and prior > 0.0 else 0.0  # by its measurements alone
            if told > 0.1 / prior:
                belief.add(off / (after * told), 1.0 / told)

    def measured(self, innovation: F64, predicted: F64, stated: F64) -> None:
        """A feature that is well known was measured: innovation (2,), variances (2,) predicted of it without noise, and
        stated of the noise.
        """
        for belief, off, beside, noise in zip(self._white, innovation, predicted, stated, strict=True):
            belief.add(off, beside, 1.0 / MEMORY, noise)

    def passed(self, tally: Tally, named: Mapping[str, int], kind: str) -> None:
        """A feature that is there was passed: how often it was detected, and as what."""
        self._seen.add(tally)
        total = sum(named.values())
        self._named += [total - named.get(kind, 0), named.get(kind, 0)]

    @property
    def confused(self) -> float:
        """The share of detections that name another kind, within `CONFUSED`."""
        return float(np.clip(self._named[0] / self._named.sum(), *CONFUSED))

    def kind_cost(self, named: Mapping[str, float], kind: str) -> float:
        """-ln of the chance that a feature with these detections by kind is next detected as `kind`."""
        if not self.learns:
            return 0.0 if kind in named else np.inf
        other, own = log(self.confused / KINDS), log(1.0 - self.confused)
        kinds = [*named, *(() if kind in named else (kind,))]
        counts, total = np.array([named.get(one, 0.0) for one in kinds]), sum(named.values())
        belief = counts * own + (total - counts) * other
        belief -= np.logaddexp.reduce(belief)
        fits = np.array([own if one == kind else other for one in kinds])
        return -float(np.logaddexp.reduce(belief + fits))

    # Whether a new feature is a sign, or something that is sometimes taken for one

    def ln_sign(self, tally: Tally, named: Mapping[str, int]) -> float:
        """How much likelier it is that detections are those of a sign than of something that looks like one (natural
        logarithm): a sign is detected in most looks, and mostly as the same kind.
        """
        looks = float(sum(tally.looks.values()))
        hits = float(sum(tally.hits.values()))
        expected = sum(count * self.detects((bin_ + 0.5) * BIN_M) for bin_, count in tally.looks.items())
        if not self.learns:
            return 0.0
        usual = float(np.clip(expected / max(looks, 1.0), 0.05, 0.95))
        rate = _ln_rate(hits, looks, SIGN_RATE, usual) - _ln_rate(hits, looks, CLUTTER_RATE, usual)
        total, top = float(sum(named.values())), float(max(named.values(), default=0))
        usual_sign = betaln(1.0 + total - top, 15.0 + top) - betaln(1.0, 15.0)
        confused = betaln(4.0 + total - top, 6.0 + top) - betaln(4.0, 6.0)
        kinds = np.logaddexp(log(1.0 - ALWAYS_CONFUSED) + usual_sign, log(ALWAYS_CONFUSED) + confused)
        kinds -= betaln(1.5 + total - top, 2.5 + top) - betaln(1.5, 2.5)
        return float(np.clip(rate, -MOST_LN, MOST_LN) + np.clip(kinds, -MOST_LN, MOST_LN))


SIGN_RATE: Final = (0.65, 1.05)
CLUTTER_RATE: Final = (0.02, 0.75)
"""Signs and what looks like them are detected in these shares of the looks that usually detect a sign."""
ALWAYS_CONFUSED: Final = 0.07
"""Share of signs that a drive takes for another kind again and again."""
MOST_LN: Final = 6.0
"""Neither rate nor kinds alone say more than this."""
LN_SIGN: Final = 0.5
"""A new feature that is less likely a sign than this (natural logarithm) is not reported."""


def _ln_rate(hits: float, looks: float, between: tuple[float, float], usual: float) -> float:
    """Logarithm of the mean chance of so many hits over rates evenly between two shares of the usual one."""
    rates = np.clip(np.linspace(*between, 24) * usual, 1e-3, 0.995)
    ln = hits * np.log(rates) + (looks - hits) * np.log1p(-rates)
    return float(np.logaddexp.reduce(ln) - log(len(rates)))
