"""Layers as drives report or the cloud publishes them, the truth, errors, and the paper's results."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from studies.feature_study.truth import RADIUS_M, Honesty, match_one_to_one
from studies.frame.averages import distances_plain
from studies.frame.targets import Target

DIRECTIONS: Final = ("euclidean", "lateral", "longitudinal")

PAPER_SINGLE_M: Final = {"without_map": (1.372, 0.810), "with_map": (0.647, 0.357)}
"""Section 5.2, Figure 6: mean and standard deviation over the beacons."""
PAPER_INTEGRATED_M: Final = {1: 0.56, 6: 0.14}
"""Section 5.2, Figure 7: mean error by number of drives, as far as the text gives it."""
PAPER_TABLE2: Final[Mapping[str, Mapping[str, tuple[float, float]]]] = {
    "without_map": {"euclidean": (5.2718, 0.6877), "lateral": (0.4651, 0.2506), "longitudinal": (5.2445, 0.6944)},
    "with_map": {"euclidean": (4.5284, 0.6418), "lateral": (0.1825, 0.1564), "longitudinal": (4.5220, 0.6418)},
    "integration": {"euclidean": (0.5458, 0.3543), "lateral": (0.1184, 0.0939), "longitudinal": (0.5181, 0.3638)},
}
"""Table 2, 11 drives on a motorway: mean and standard deviation, m."""
PAPER_TABLE3: Final = {
    "without": {"lateral": 0.2214, "longitudinal": 5.4138},
    "with": {"lateral": 0.2077, "longitudinal": 0.6261},
}
"""Table 3: root mean square errors of localisation, m."""

TARGETS: Final = (
    Target("beacons, one drive without map", "single_without_map", "m", "1.372", 1.372, 1.372),
    Target("beacons, one drive with map", "single_with_map", "m", "0.647", 0.647, 0.4),
    Target("beacons, 6 drives", "integrated.6", "m", "0.14", 0.14, 0.10),
    Target("lights, integrated, Euclidean", "motorway.euclidean", "m", "0.546", 0.5458, 0.3),
    Target("lights, integrated, lateral", "motorway.lateral", "m", "0.118", 0.1184, 0.1184),
    Target("lights, integrated, longitudinal", "motorway.longitudinal", "m", "0.518", 0.5181, 0.3),
    Target("localisation with layer, longitudinal", "localisation.with", "m", "0.63", 0.63, 0.4),
)


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
    """J features that a drive reports or the cloud publishes.

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
    honest = [one.honesty for one in scores if one.honesty is not None]
    nees = {"mean": float(np.mean([h.mean for h in honest])), "within_95": float(np.mean([h.within for h in honest]))}
    missed, false = (float(np.mean([getattr(one, name) for one in scores])) for name in ("missed", "false"))
    return found | {"missed": missed, "false": false, "nees": nees if honest else None}


@dataclass(frozen=True, slots=True, eq=False)
class DriveLayers:
    """What one drive makes without and with the lanes of the HD map, each over all its true features."""

    without_map: Layer | None
    with_map: Layer


@dataclass(frozen=True, slots=True, eq=False)
class RouteOutcome:
    """What came of one route.

    Attributes:
        truth: its features.
        drives: layers of each drive.
        integrated: the cloud's layer by number of drives, 1 … all.
    """

    truth: LayerTruth
    drives: tuple[DriveLayers, ...]
    integrated: Mapping[int, Layer]


@dataclass(frozen=True, slots=True, eq=False)
class LayerLocalised:
    """Errors of the poses of one drive: float64 (S, 2), along and across the true heading [m], and seconds (S,)."""

    t_s: F64
    error_m: F64

    def rmse(self) -> tuple[float, float]:
        """Return the root mean square errors along and across."""
        along, across = np.sqrt(np.mean(self.error_m**2, axis=0))
        return float(along), float(across)


@dataclass(frozen=True, slots=True, eq=False)
class MotorwayOutcome:
    """One motorway: its layers, and a fresh drive localised without and with the layer of all drives before."""

    route: RouteOutcome
    without: LayerLocalised
    with_layer: LayerLocalised


@dataclass(frozen=True, slots=True, eq=False)
class NewLayerSeed:
    """What came of one seed.

    Attributes:
        seed: of the routes.
        track: the test track.
        noisy: by sensor ("beacon", "lane") and noise level.
        motorway: with gentle curves.
        straight: the straight one, where it ran.
    """

    seed: int
    track: RouteOutcome
    noisy: Mapping[str, Mapping[float, RouteOutcome]]
    motorway: MotorwayOutcome
    straight: MotorwayOutcome | None
