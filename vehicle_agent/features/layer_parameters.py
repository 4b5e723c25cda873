"""Which feature layers a vehicle keeps up to date, and with which of its sensors."""

from dataclasses import dataclass, field
from math import isfinite, radians
from typing import Final, Literal

from gnd.schemas.wire import LAYER_PATTERN
from gnd.vehicle_agent.features.coverage import CoverageParameters
from gnd.vehicle_agent.features.errors import FeatureLayerError
from gnd.vehicle_agent.features.slamcu.parameters import FilterParameters, SlamcuParameters
from gnd.vehicle_agent.features.view import SensorView


@dataclass(frozen=True, slots=True)
class LayerParameters:
    """One feature layer and what looks for its features.

    Attributes:
        name: of the layer, such as "signs".
        sensor: "camera": looks that the recording brings; "lidar": the pole detector on the vehicle's own scans.
        kinds: of features that belong to the layer; others of the same detector do not.
        field_deg: field of view, ahead; 360 all around.
        range_m: the farthest look.
        rate_hz: looks a second.
        height_m: usual height of the features above the vehicle's origin: what decides what hides them.
        detection_confidence: λ of SLAMCU, Eq. (1) and (2).
        alone_m: two features of the layer never stand nearer to each other: found so, they are something else (the tall
            posts of a scaffold are no lamps); 0 = they may.
    """

    name: str
    sensor: Literal["camera", "lidar"]
    kinds: tuple[str, ...]
    field_deg: float = 360.0
    range_m: float = 25.0
    rate_hz: float = 10.0
    height_m: float = 2.5
    detection_confidence: float = 0.9
    alone_m: float = 0.0

    def __post_init__(self) -> None:
        if not LAYER_PATTERN.fullmatch(self.name) or self.name.startswith("ndt"):
            raise FeatureLayerError(f"layer {self.name[:80]!r} is no feature layer: {LAYER_PATTERN.pattern}, not ndt…")
        if not self.kinds or not isfinite(self.height_m) or not self.alone_m >= 0:
            raise FeatureLayerError(
                f"layer {self.name}: {len(self.kinds)} kinds, height {self.height_m} m, alone within {self.alone_m} m"
            )
        _ = self.view, self.slamcu  # they check the rest

    @property
    def view(self) -> SensorView:
        """What the sensor has in view."""
        return SensorView(radians(self.field_deg), self.range_m, self.rate_hz)

    @property
    def slamcu(self) -> SlamcuParameters:
        """SLAMCU with given poses: few particles, which carry the uncertainty of the pose into the features' places."""
        return SlamcuParameters(
            detection_confidence=self.detection_confidence, filter=FilterParameters(particles=16, jitter=0.0)
        )


SIGNS: Final = ("traffic_sign", "speed_limit", "no_overtaking", "warning", "direction", "exit", "information")
"""A sign, and what a detector may know of its type; types are never taken for each other."""
LAYERS: Final = {
    layer.name: layer
    for layer in (
        LayerParameters("signs", "camera", SIGNS, field_deg=40.0, range_m=80.0, rate_hz=15.0),
        LayerParameters("streetlights", "lidar", ("streetlight",), height_m=4.0, detection_confidence=0.6, alone_m=3.0),
        LayerParameters("poles", "lidar", ("pole", "trunk"), detection_confidence=0.6),
    )
}
"""Those that vehicles know by name; the camera is that of SLAMCU, section 6.1."""


@dataclass(frozen=True, slots=True)
class FeatureParameters:
    """The feature layers of one agent.

    Attributes:
        layers: none: the agent knows voxels only.
        coverage: when a place counts as looked at.
        margin_m: a tile this much farther away than a sensor sees is left: it is decided.
    """

    layers: tuple[LayerParameters, ...] = ()
    coverage: CoverageParameters = field(default_factory=CoverageParameters)
    margin_m: float = 10.0

    def __post_init__(self) -> None:
        names = [layer.name for layer in self.layers]
        if len(set(names)) != len(names):
            raise FeatureLayerError(f"layers {', '.join(names)}: one comes twice")
        if not self.margin_m > 0:
            raise FeatureLayerError(f"margin_m = {self.margin_m} must be positive")

    @classmethod
    def of(cls, *names: str) -> "FeatureParameters":
        """The layers with these names.

        Raises:
            FeatureLayerError: nobody has said what looks for one of them.
        """
        unknown = [name for name in names if name not in LAYERS]
        if unknown:
            raise FeatureLayerError(f"no detector for layer {', '.join(unknown)}; known are {', '.join(LAYERS)}")
        return cls(tuple(LAYERS[name] for name in names))
