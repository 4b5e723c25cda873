"""Which feature layers a vehicle keeps up to date; what a layer is: `gnd.schemas.feature_layer`."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import radians
from typing import Final

from gnd.gnd_map.settings import check_settings, setting
from gnd.schemas.feature_layer import LayerParameters, checked_layers, named_layer
from gnd.vehicle_agent.features.errors import FeatureLayerError
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.view import SensorView

LANES: Final = "lanes"
"""The layer that vehicles without LiDAR localise by."""
MARGIN_M: Final = 10.0
"""A tile this much farther away than a sensor sees is left: it is decided."""
_LIDAR_KINDS: Final = ("pole", "trunk", "traffic_sign", "streetlight")
"""What the detector in the LiDAR's scans tells apart (`poles/kinds.py`)."""
_PARTICLES: Final = 16
"""Where poses are given, few particles carry the uncertainty of the pose into the features' places."""


def view_of(layer: LayerParameters) -> SensorView:
    """What the layer's sensor has in view."""
    return SensorView(radians(layer.field_deg), layer.range_m)


def slamcu_of(layer: LayerParameters) -> SlamcuParameters:
    """SLAMCU of a layer with given poses."""
    return SlamcuParameters(particles=_PARTICLES, detection_confidence=layer.detection_confidence)


@dataclass(frozen=True, slots=True)
class FeatureParameters:
    """The feature layers of one agent."""

    layers: tuple[LayerParameters, ...] = setting(
        (),
        "Layers to keep up to date, each by name (signs, streetlights, poles, or one that `feature_layer` declares) or"
        " as a table; none: the agent knows voxels only.",
    )

    def __post_init__(self) -> None:
        check_settings(self, FeatureLayerError)
        for layer in checked_layers(self.layers).values():
            if layer.geometry != "point":
                raise FeatureLayerError(f"layer {layer.name} holds lines; a vehicle finds points, maps bring lines")
            strange = [kind for kind in layer.kinds if kind not in _LIDAR_KINDS]
            if layer.sensor == "lidar" and strange:
                raise FeatureLayerError(
                    f"layer {layer.name}: the LiDAR's detector finds {', '.join(_LIDAR_KINDS)}, no"
                    f' {", ".join(strange)}; features that the recording brings have sensor = "camera"'
                )

    @classmethod
    def of(cls, *names: str, declared: Sequence[LayerParameters] = ()) -> "FeatureParameters":
        """The layers with these names.

        Raises:
            LayerError: nobody has declared one of them; says what to write.
        """
        return cls(tuple(named_layer(name, declared) for name in names))
