"""Verdicts of a drive with SLAMCU on features."""

from dataclasses import dataclass, field

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import Existence
from gnd.vehicle_agent.features.slamcu.tracked_feature import FeatureClass, MassesAt


@dataclass(frozen=True, slots=True, eq=False)
class KnownState:
    """Verdict on a feature of the map.

    Attributes:
        feature_id: the map's.
        feature_class: normal, deleted or unclassified.
        existence: masses, begun with λ_HD (Eq. 3).
        hits: looks that measured it.
        misses: looks in which it was in view and was not measured, less where the sensor often misses.
        position_m: (2,) where this drive measured it, independently of where the map has it; None = not measured.
        cov_m2: (2, 2) of that position.
        height_m: in the map frame, as far as the vehicle knows its own height there; nan = not measured.
        history: masses over time, Figure 8.
    """

    feature_id: int
    feature_class: FeatureClass
    existence: Existence
    hits: int
    misses: float
    position_m: F64 | None
    cov_m2: F64 | None
    height_m: float
    history: tuple[MassesAt, ...] = field(default=(), repr=False)


@dataclass(frozen=True, slots=True, eq=False)
class NewFeature:
    """A feature that the map has not.

    Attributes:
        number: 1, 2, 3 … in the order of registration.
        kind: as measured.
        position_m: (2,) map frame.
        cov_m2: (2, 2) over all particles.
        height_m: in the map frame, as far as the vehicle knows its own height there; nan = not measured.
        feature_class: new, or unclassified while there is too little evidence.
        existence: masses, begun vacuous (Eq. 4).
        hits: looks that measured it.
        misses: looks in which it was in view and was not measured, less where the sensor often misses.
        history: masses over time, Figure 8.
    """

    number: int
    kind: str
    position_m: F64
    cov_m2: F64
    height_m: float
    feature_class: FeatureClass
    existence: Existence
    hits: int
    misses: float
    history: tuple[MassesAt, ...] = field(default=(), repr=False)
