"""How reports about features become changes: the parameters of the cloud merge of feature layers."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

from gnd.cloud_merger.errors import MergerError
from gnd.gnd_map.settings import check_settings, setting
from gnd.schemas.feature_layer import LayerParameters

FEATURE_GATE: Final = 0.999
"""Share of the good measurements that pass the innovation gate (a quantile of χ²)."""


@dataclass(frozen=True, slots=True)
class FeatureMergeParameters:
    """How statements about features become changes."""

    reach_m: float = setting(
        15.0,
        "A measurement farther than this from a feature is never of it, whatever the covariances allow; less "
        "than half the distance of streetlights along a road.",
        unit="m",
        above=0,
        most=100,
    )
    min_vehicles: int = setting(
        2,
        "So many different vehicles must say the same before anything published changes.",
        least=2,
        most=6,
    )
    reliability: float = setting(
        0.9,
        "The evidence of one vehicle is discounted by this (Shafer): it may be wrong as a whole.",
        above=0,
        below=1,
    )
    repeat_correlation: float = setting(
        0.5,
        "Correlation of the errors of one vehicle's measurements of one feature in several reports (its "
        "sensors, its calibration, the GNSS of one drive are the same): n of them weigh n / (1 + (n - 1) ρ).",
        least=0,
        most=1,
    )
    renewal_gain: float = setting(
        1.25,
        "A published estimate is renewed when the variance along an axis has shrunk by this factor, or when "
        "it has moved by more than its sigma; 1: with every vehicle.",
        least=1,
        most=16,
    )

    def __post_init__(self) -> None:
        check_settings(self, MergerError)

    def of_layer(self, layer: LayerParameters | None) -> "FeatureMergeParameters":
        """The same for a declared layer, which may have its own reach; None: it is not declared."""
        return self if layer is None or layer.reach_m is None else replace(self, reach_m=layer.reach_m)

    def information_of(self, repeats: int) -> float:
        """What so many measurements by one vehicle weigh, in measurements."""
        return repeats / (1.0 + (repeats - 1) * self.repeat_correlation) if repeats else 0.0


@lru_cache
def gate_of(dimensions: int) -> float:
    """The largest squared Mahalanobis distance of a measurement of 1, 2 or 3 dimensions that passes."""
    from scipy.special import gammaincinv  # here because the import is dear, and few shards merge features

    return float(2.0 * gammaincinv(dimensions / 2.0, FEATURE_GATE))  # as scipy.stats.chi2, which loads slowly
