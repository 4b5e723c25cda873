"""A finished study of new feature layers."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import F64
from studies.new_layer_study.layers import Layer, LayerTruth
from studies.new_layer_study.options import NewLayerOptions


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
class Localised:
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
    without: Localised
    with_layer: Localised


@dataclass(frozen=True, slots=True, eq=False)
class SeedOutcome:
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


@dataclass(frozen=True, slots=True, eq=False)
class StudyOutcome:
    """Everything."""

    options: NewLayerOptions
    seeds: tuple[SeedOutcome, ...]
    runtime_s: Mapping[str, float]
