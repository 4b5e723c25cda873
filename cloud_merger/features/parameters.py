"""How reports about features become changes: the parameters of the cloud merge of feature layers."""

from dataclasses import dataclass
from functools import lru_cache

from scipy.stats import chi2

from gnd.cloud_merger.errors import MergerError
from gnd.gnd_map.settings import check_settings, setting


@dataclass(frozen=True, slots=True)
class FeatureMergeParameters:
    """How statements about features become changes."""

    gate: float = setting(
        0.999,
        "Share of the good measurements that pass the innovation gate (a quantile of χ²).",
        above=0,
        below=1,
    )
    reach_m: float = setting(
        15.0,
        "A measurement farther than this from a feature is never of it, whatever the covariances allow; less "
        "than half the distance of streetlights along a road.",
        unit="m",
        above=0,
        most=100,
    )
    line_reach_m: float = setting(
        1.5,
        "The same for polylines, across the line: less than half the width of a lane.",
        unit="m",
        above=0,
        most=100,
    )
    moved_m: float = setting(
        0.3,
        "A map feature that is measured outside the gate has moved only if it is farther off than this.",
        unit="m",
        least=0,
        most=100,
    )
    min_vehicles: int = setting(
        2,
        "So many different vehicles must say the same before anything published changes.",
        least=2,
    )
    reliability: float = setting(
        0.9,
        "The evidence of one vehicle is discounted by this (Shafer): it may be wrong as a whole.",
        above=0,
        below=1,
    )
    prior: float = setting(
        0.95,
        "What the map itself says of its features never weighs more than this. λ_HD of SLAMCU, Eq. (3).",
        above=0,
        below=1,
    )
    absence: float = setting(
        0.8,
        'Mass of "absent" of a vehicle that viewed a place without finding what others found there.',
        above=0,
        below=1,
    )
    view_margin_m: float = setting(
        0.5,
        "Such a vehicle must have viewed all cells within this of the feature, or within its sigma.",
        unit="m",
        least=0,
        most=100,
    )
    voters: int = setting(
        6,
        "Of the vehicles that speak of a feature, the so many whose reports are newest vote: so a world that "
        "changes again is followed.",
        least=2,
    )
    repeat_correlation: float = setting(
        0.5,
        "Correlation of the errors of one vehicle's measurements of one feature in several reports (its "
        "sensors, its calibration, the GNSS of one drive are the same): n of them weigh n / (1 + (n - 1) ρ).",
        least=0,
        most=1,
    )
    most_weight: float = setting(
        4.0,
        "A vehicle that claims to be surer than all others (and the map) weighs at most this times the second "
        "surest, until another is as sure.",
        least=1,
    )
    renewal_gain: float = setting(
        1.25,
        "A published estimate is renewed when the variance along an axis has shrunk by this factor, or when "
        "it has moved by more than its sigma; 1: with every vehicle.",
        least=1,
        most=16,
    )
    renewal_mass: float = setting(
        0.1,
        'Published masses are renewed when "exist" has changed by more than this.',
        above=0,
        most=1,
    )
    max_begun: int = setting(
        128,
        "A vehicle begins at most so many candidates in a tile; what else it finds must be known already.",
        least=1,
    )
    ceiling: float = setting(
        0.99,
        "No published feature has a larger mass than this, or no evidence could change it any more.",
        above=0,
        below=1,
    )

    def __post_init__(self) -> None:
        check_settings(self, MergerError)
        if self.voters < self.min_vehicles:
            raise MergerError(f"voters {self.voters} must be at least min_vehicles {self.min_vehicles}")

    def gate_of(self, dimensions: int) -> float:
        """The largest squared Mahalanobis distance of a measurement of 1, 2 or 3 dimensions that passes."""
        return _quantile(self.gate, dimensions)

    def information_of(self, repeats: int) -> float:
        """What so many measurements by one vehicle weigh, in measurements."""
        return repeats / (1.0 + (repeats - 1) * self.repeat_correlation) if repeats else 0.0


@lru_cache(maxsize=64)
def _quantile(share: float, dimensions: int) -> float:
    return float(chi2.ppf(share, dimensions))
