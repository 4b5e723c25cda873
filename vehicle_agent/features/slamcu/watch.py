"""Is the vehicle where its particles have it? Asked of what they cannot talk round: the GNSS, wheels and gyro, the map.

Four tests:

- **offset**: the mean of fix minus pose, weighed by how far its neighbours have the same error (the fixes'
  slow error is a Gauss-Markov process: generalised least squares by its Kalman filter), over two windows;
- **blind**: the pose against that of wheels, gyro and GNSS alone (`blind.py`), which has the heading too;
- **map**: features of the map that have gone, while one like it stands near by, against those found in place: a
  sequential test (CUSUM) of "lost" against "here";
- **sign**: how far from its place in the map a feature was measured, in units of what pose and measurement may be off
  by: the sign that finds a lost vehicle's place again is far from where it was expected.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.slamcu import noise
from gnd.vehicle_agent.features.slamcu.blind import BlindBelief, apart
from gnd.vehicle_agent.features.slamcu.map_comparison import MapInnovation
from gnd.vehicle_agent.features.slamcu.slamcu import Passed
from gnd.vehicle_agent.features.slamcu.tracked_feature import FeatureClass

WINDOWS_S: Final = (40.0, 160.0)
"""Over these times offsets are averaged: three and twelve time constants of the slow error."""
LASTING_M: Final = 0.5
"""What a GNSS may be off by all the while (ionosphere, the antenna's place), each axis."""
GATE_OFFSET: Final = 18.4
"""χ² of 2 degrees of freedom, one in 10,000."""
GATE_BLIND: Final = 21.1
"""χ² of 3 degrees of freedom, one in 10,000."""
WORTH_ASKING: Final = 0.65
"""An alarm is raised from this share of either gate on, one in 300 to 400: asking costs time only. An account that is
beyond the gate itself will not do."""
GATE_SIGN: Final = 10.6
"""χ² of 2 degrees of freedom, one in 200."""
LEAST_LN_DENSITY: Final = -11.5
"""A feature called itself in spite of its place costs no more than this: one in 100,000 a square metre."""
MOST_COST: Final = 0.25
"""A fix speaks against a place with at most so much (natural logarithm) more than one that fits: a minute of
reflections weighs as five signs do."""

FOUND: Final = -2.2
GONE: Final = 0.4
STANDS_BESIDE: Final = 2.8
"""Log likelihood ratios of lost against here, of a feature of the map that was found in its place, that was not, and
that was not while a new one like it stands near by. Here: 0.86, 0.09 and 0.05 of them; lost: 0.1, 0.1 and 0.8."""
GATE_MAP: Final = 4.0
"""Two signs in a row that stand elsewhere."""
BESIDE_M: Final = 30.0
PASSED_AROUND_S: Final = 40.0
"""A feature that stands near by was in view at most so long before."""
DELETED_COST: Final = 3.0
NEW_COST: Final = 2.0
"""What a change costs an account of a drive (natural logarithm): few features of a map have gone, few are new."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """The place is in doubt.

    Attributes:
        test: "offset", "blind", "map" or "sign".
        value: of its statistic.
        gate: that it should stay below.
    """

    test: str
    value: float
    gate: float


class Watch:
    """The four tests along one run of a drive.

    Attributes:
        cost: of fixes and signs against this run (natural logarithm).
        run: of the map's test, >= 0.
    """

    def __init__(self) -> None:
        self._error, self._of_one, self._var = np.zeros(2), 0.0, 0.0
        self._sums = np.zeros((len(WINDOWS_S), 4))  # A (2), B, and B of the squared weights
        self._offset = self._blind = 0.0
        self.cost = 0.0
        self.run = 0.0
        self._sign = 0.0

    def fix(self, off_m: F64, sigma_m: float, dt_s: float, pose: tuple[F64, F64], blind: BlindBelief) -> None:
        """Take a fix that was used.

        Args:
            off_m: (2,) fix minus pose.
            sigma_m: of each axis.
            dt_s: since the one before.
            pose: (3,) and covariance (3, 3).
            blind: of wheels, gyro and GNSS alone.
        """
        white, slow = noise.gnss_variances_m2(sigma_m)
        fade = exp(-dt_s / noise.GNSS_CORRELATION_S) if self._var else 1.0
        var = self._var * fade**2 + (1.0 - fade**2) * slow if self._var else slow
        total, place = var + white, pose[1][:2, :2]
        nu, one = off_m - fade * self._error, 1.0 - fade * self._of_one  # the answer to an offset of one metre
        self._error, self._of_one = fade * self._error + var / total * nu, fade * self._of_one + var / total * one
        self._var = var * white / total
        for sums, window_s in zip(self._sums, WINDOWS_S, strict=True):
            forget = exp(-dt_s / window_s)
            sums[:3] *= forget
            sums[3] *= forget**2
            sums[:2] += one * nu / total
            sums[2:] += one**2 / total
        self._offset = max(_offset(sums, place) for sums in self._sums)
        self._blind = apart(*pose, blind)
        wide = total * np.eye(2) + place
        self.cost += min(0.5 * float(nu @ np.linalg.solve(wide, nu)) - 1.0, MOST_COST)

    def passed(self, seen: Sequence[Passed], beside: Sequence[Passed]) -> None:
        """Features that have just left the view, and those (new ones among them) that stand around."""
        for one in seen:
            if one.known:
                self.run = max(self.run + _evidence(one, beside), 0.0)

    def sign(self, innovation: MapInnovation) -> None:
        """A feature of the map was measured, and compared with its place."""
        self._sign = max(self._sign, innovation.squared)
        self.cost -= max(innovation.ln_density, LEAST_LN_DENSITY)

    def settled(self) -> None:
        """The doubt has been looked into, and this run is the best there is: one more such sign, and it is asked
        again.
        """
        self.run = min(self.run, 0.5 * GATE_MAP)
        self._sign = 0.0

    def alarm(self, share: float = 1.0) -> Alarm | None:
        """The test that fails most, if one does; `share` < 1 of the gates for a stricter question."""
        tests = (
            Alarm("offset", self._offset, WORTH_ASKING * GATE_OFFSET),
            Alarm("blind", self._blind, WORTH_ASKING * GATE_BLIND),
            Alarm("map", self.run, GATE_MAP),
            Alarm("sign", self._sign, GATE_SIGN),
        )
        most = max(tests, key=lambda test: test.value / test.gate)
        return most if most.value > share * most.gate else None

    @property
    def agrees(self) -> bool:
        """Whether GNSS, wheels and gyro have nothing against the place."""
        return self._offset <= GATE_OFFSET and self._blind <= GATE_BLIND


def _offset(sums: F64, place: F64) -> float:
    """Squared Mahalanobis distance from zero of a mean offset, A / B."""
    off = sums[:2] / sums[2]
    cov = (sums[3] / sums[2] ** 2 + LASTING_M**2) * np.eye(2) + place
    return float(off @ np.linalg.solve(cov, off))


def _evidence(one: Passed, around: Sequence[Passed]) -> float:
    """Log likelihood ratio of lost against here, of a feature of the map."""
    if one.feature_class == FeatureClass.NORMAL:
        return FOUND
    if one.feature_class != FeatureClass.DELETED:
        return 0.0
    twins = (other for other in around if not other.known and other.feature_class == FeatureClass.NEW)
    near = any(other.kind == one.kind and float(np.hypot(*(other.xy_m - one.xy_m))) < BESIDE_M for other in twins)
    return STANDS_BESIDE if near else GONE
