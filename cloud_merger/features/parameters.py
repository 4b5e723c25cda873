"""How reports about features become changes: the parameters of the cloud merge of feature layers."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from scipy.stats import chi2

from gnd.cloud_merger.errors import MergerError

_SHARES: Final = ("gate", "reliability", "prior", "absence", "ceiling")


@dataclass(frozen=True, slots=True)
class FeatureMergeParameters:
    """How statements about features become changes.

    Attributes:
        gate: share of the good measurements that pass the innovation gate (a quantile of χ²).
        reach_m: a measurement farther than this from a feature is never of it, whatever the covariances allow; less
            than half the distance of streetlights along a road.
        line_reach_m: the same for polylines, across the line: less than half the width of a lane.
        moved_m: a map feature that is measured outside the gate has moved only if it is farther off than this.
        min_vehicles: so many different vehicles must say the same before anything published changes.
        reliability: the evidence of one vehicle is discounted by this (Shafer): it may be wrong as a whole.
        prior: what the map itself says of its features never weighs more than this. λ_HD of SLAMCU, Eq. (3).
        absence: mass of "absent" of a vehicle that viewed a place without finding what others found there.
        view_margin_m: such a vehicle must have viewed all cells within this of the feature, or within its sigma.
        voters: of the vehicles that speak of a feature, the so many whose reports are newest vote: so a world that
            changes again is followed.
        repeat_correlation: correlation of the errors of one vehicle's measurements of one feature in several reports
            (its sensors, its calibration, the GNSS of one drive are the same): n of them weigh n / (1 + (n - 1) ρ).
        most_weight: a vehicle that claims to be surer than all others (and the map) weighs at most this times the
            second surest, until another is as sure.
        renewal_gain: a published estimate is renewed when the variance along an axis has shrunk by this factor, or when
            it has moved by more than its sigma; 1: with every vehicle.
        renewal_mass: published masses are renewed when "exist" has changed by more than this.
        max_begun: a vehicle begins at most so many candidates in a tile; what else it finds must be known already.
        ceiling: no published feature has a larger mass than this, or no evidence could change it any more.
    """

    gate: float = 0.999
    reach_m: float = 15.0
    line_reach_m: float = 1.5
    moved_m: float = 0.3
    min_vehicles: int = 2
    reliability: float = 0.9
    prior: float = 0.95
    absence: float = 0.8
    view_margin_m: float = 0.5
    voters: int = 6
    repeat_correlation: float = 0.5
    most_weight: float = 4.0
    renewal_gain: float = 1.25
    renewal_mass: float = 0.1
    max_begun: int = 128
    ceiling: float = 0.99

    def __post_init__(self) -> None:
        for name in _SHARES:
            if not 0 < getattr(self, name) < 1:
                raise MergerError(f"{name} must lie in (0, 1), got {getattr(self, name)}")
        for name in ("reach_m", "line_reach_m"):
            if not 0 < getattr(self, name) <= 100:
                raise MergerError(f"{name} must lie in (0, 100] m, got {getattr(self, name)}")
        for name in ("moved_m", "view_margin_m"):
            if not 0 <= getattr(self, name) <= 100:
                raise MergerError(f"{name} must lie in [0, 100] m, got {getattr(self, name)}")
        if self.min_vehicles < 2 or self.voters < self.min_vehicles:
            raise MergerError(
                f"min_vehicles {self.min_vehicles} must be at least 2 (one vehicle alone changes nothing), voters "
                f"{self.voters} at least as many"
            )
        if not 0 <= self.repeat_correlation <= 1 or not 0 < self.renewal_mass <= 1:
            raise MergerError(
                f"repeat_correlation {self.repeat_correlation} must lie in [0, 1], renewal_mass {self.renewal_mass} in "
                "(0, 1]"
            )
        self._check_bounds()

    def _check_bounds(self) -> None:
        if not 1 <= self.renewal_gain <= 16:
            raise MergerError(f"renewal_gain must lie in [1, 16], got {self.renewal_gain}")
        if self.most_weight < 1 or self.max_begun < 1:
            raise MergerError(
                f"most_weight {self.most_weight} and max_begun {self.max_begun} must be at least 1: a vehicle counts"
            )

    def gate_of(self, dimensions: int) -> float:
        """The largest squared Mahalanobis distance of a measurement of 1, 2 or 3 dimensions that passes."""
        return _quantile(self.gate, dimensions)

    def information_of(self, repeats: int) -> float:
        """What so many measurements by one vehicle weigh, in measurements."""
        return repeats / (1.0 + (repeats - 1) * self.repeat_correlation) if repeats else 0.0


@lru_cache(maxsize=64)
def _quantile(share: float, dimensions: int) -> float:
    return float(chi2.ppf(share, dimensions))
