"""A layer as a drive or the cloud tells it, the truth, and how far they are apart."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from studies.feature_study.averages import distances_plain
from studies.feature_study.honesty import Honesty
from studies.feature_study.matching import RADIUS_M, match_one_to_one
from studies.new_layer_study.reference import DIRECTIONS

WIDE_RADIUS_M: Final = 15.0
"""On the motorway lights stand 35 to 50 m apart and poses may be off by several metres along it: what is farther off
than this is missed, what is nearer counts with all its error."""


@dataclass(frozen=True, slots=True, eq=False)
class LayerTruth:
    """N true features.

    Attributes:
        xy_m: float64 (N, 2), map frame.
        along: float64 (N, 2), unit vectors of the route's direction beside each.
    """

    xy_m: F64
    along: F64


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """J features that are said to exist.

    Attributes:
        xy_m: float64 (J, 2), map frame.
        cov_m2: float64 (J, 2, 2).
    """

    xy_m: F64
    cov_m2: F64


@dataclass(frozen=True, slots=True, eq=False)
class LayerScore:
    """P features found.

    Attributes:
        feature: int64 (P,), indices of the true features.
        error_m: float64 (P, 2), estimated minus true, along the route and to its left.
        honesty: of their covariances.
        missed: true features without an estimate.
        false: estimates without a true feature.
    """

    feature: I64
    error_m: F64
    honesty: Honesty | None
    missed: int
    false: int

    def of(self, direction: str) -> F64:
        """Return the absolute errors (P,) in one of `DIRECTIONS`."""
        if direction == "euclidean":
            return np.asarray(np.linalg.norm(self.error_m, axis=1))
        return np.abs(self.error_m[:, 0 if direction == "longitudinal" else 1])

    def plain(self) -> dict[str, Any]:
        """Return errors by direction, what was missed or false, and NEES."""
        found: dict[str, Any] = {name: distances_plain(self.of(name)) for name in DIRECTIONS}
        nees = None if self.honesty is None else self.honesty.plain()
        return found | {"missed": self.missed, "false": self.false, "nees": nees}


def score(layer: Layer, truth: LayerTruth, radius_m: float = RADIUS_M) -> LayerScore:
    """Return how far a layer is from the truth; pairs are one to one and within the radius [m]."""
    matching = match_one_to_one(layer.xy_m, truth.xy_m, radius_m)
    error_m = layer.xy_m[matching.estimate] - truth.xy_m[matching.true]
    along = truth.along[matching.true]
    across = np.column_stack([-along[:, 1], along[:, 0]])
    turned = np.column_stack([np.sum(error_m * along, axis=1), np.sum(error_m * across, axis=1)])
    honesty = Honesty.of(error_m, layer.cov_m2[matching.estimate])
    return LayerScore(matching.true, turned, honesty, len(matching.missed), len(matching.false))


def pooled(scores: list[LayerScore]) -> dict[str, Any]:
    """Return the numbers of several drives' features together; missed and false are means a drive."""
    found: dict[str, Any] = {
        name: distances_plain(np.concatenate([one.of(name) for one in scores])) for name in DIRECTIONS
    }
    told = [one.honesty for one in scores if one.honesty is not None]
    nees = {"mean": float(np.mean([h.mean for h in told])), "within_95": float(np.mean([h.within for h in told]))}
    missed, false = (float(np.mean([getattr(one, name) for one in scores])) for name in ("missed", "false"))
    return found | {"missed": missed, "false": false, "nees": nees if told else None}
