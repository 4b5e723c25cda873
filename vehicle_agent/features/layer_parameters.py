"""Which feature layers a vehicle keeps up to date, and with which of its sensors."""

from dataclasses import dataclass
from math import radians
from typing import Final, Literal

from gnd.gnd_map.settings import check_settings, setting
from gnd.schemas.wire import LAYER_PATTERN
from gnd.vehicle_agent.features.errors import FeatureLayerError
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.view import SensorView

MARGIN_M: Final = 10.0
"""A tile this much farther away than a sensor sees is left: it is decided."""


@dataclass(frozen=True, slots=True)
class LayerParameters:
    """One feature layer and what looks for its features."""

    name: str = setting(..., 'Of the layer, such as "signs".')
    sensor: Literal["camera", "lidar"] = setting(
        ...,
        '"camera": looks that the recording brings; "lidar": the pole detector on the vehicle\'s own scans.',
    )
    kinds: tuple[str, ...] = setting(..., "Of features that belong to the layer; others of the same detector do not.")
    field_deg: float = setting(360.0, "Field of view, ahead; 360 all around.", unit="deg", above=0, most=360)
    range_m: float = setting(25.0, "The farthest look.", unit="m", above=0, most=1000)
    rate_hz: float = setting(10.0, "Looks a second.", unit="Hz", above=0, most=1000)
    height_m: float = setting(
        2.5,
        "Usual height of the features above the vehicle's origin: what decides what hides them.",
        unit="m",
    )
    detection_confidence: float = setting(
        0.9, "Confidence in a detection: λ of SLAMCU, Eq. (1) and (2).", least=1e-3, most=0.999
    )
    alone_m: float = setting(
        0.0,
        "Two features of the layer never stand nearer to each other: found so, they are something else (the "
        "tall posts of a scaffold are no lamps); 0 = they may.",
        unit="m",
        least=0,
    )

    def __post_init__(self) -> None:
        if not LAYER_PATTERN.fullmatch(self.name) or self.name.startswith("ndt"):
            raise FeatureLayerError(f"layer {self.name[:80]!r} is no feature layer: {LAYER_PATTERN.pattern}, not ndt…")
        if not self.kinds:
            raise FeatureLayerError(f"layer {self.name} needs at least one kind of features")
        check_settings(self, FeatureLayerError)
        _ = self.view, self.slamcu  # they check the rest

    @property
    def view(self) -> SensorView:
        """What the sensor has in view."""
        return SensorView(radians(self.field_deg), self.range_m, self.rate_hz)

    @property
    def slamcu(self) -> SlamcuParameters:
        """SLAMCU with given poses: few particles, which carry the uncertainty of the pose into the features' places."""
        return SlamcuParameters(particles=16, detection_confidence=self.detection_confidence)


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
    """The feature layers of one agent."""

    layers: tuple[LayerParameters, ...] = setting(
        (), "Layers, each by name (signs, streetlights, poles) or as a table; none: the agent knows voxels only."
    )

    def __post_init__(self) -> None:
        names = [layer.name for layer in self.layers]
        if len(set(names)) != len(names):
            raise FeatureLayerError(f"layers {', '.join(names)}: one comes twice")
        check_settings(self, FeatureLayerError)

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
