"""What a feature layer is: one declaration, which vehicles, shards and the tile server read alike.

A user declares a layer in a settings file, and every program takes the same table:

    [[feature_layer]]
    name = "hydrants"
    kinds = ["hydrant"]
    sensor = "camera"
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

from gnd.gnd_map.config import from_mapping
from gnd.gnd_map.errors import ConfigError
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.features.feature import KIND_PATTERN
from gnd.gnd_map.settings import check_settings, setting
from gnd.schemas.errors import LayerError
from gnd.schemas.wire import LAYER_PATTERN


@dataclass(frozen=True, slots=True)
class LayerParameters:
    """One feature layer."""

    name: str = setting(..., 'Of the layer, such as "signs".')
    sensor: Literal["camera", "lidar"] = setting(
        ...,
        '"camera": looks that the recording brings; "lidar": the pole detector on the vehicle\'s own scans.',
    )
    kinds: tuple[str, ...] = setting(
        ...,
        "Of features that belong to the layer. Only equal kinds are ever taken for each other; a detection of another"
        " kind is left out by the vehicle and refused by the cloud.",
    )
    geometry: Literal["point", "line"] = setting(
        "point", "Of the features; vehicles find points. Lines, such as lanes, come from imported maps."
    )
    field_deg: float = setting(360.0, "Field of view, ahead; 360 all around.", unit="deg", above=0, most=360)
    range_m: float = setting(25.0, "The farthest range of the sensor.", unit="m", above=0, most=1000)
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
    reach_m: float | None = setting(
        None,
        "In the cloud, a measurement farther than this from a feature is never of it; less than half the distance of"
        " two features. By default `features.reach_m` of the shard.",
        unit="m",
        above=0,
        most=100,
    )

    def __post_init__(self) -> None:
        if not LAYER_PATTERN.fullmatch(self.name) or not is_feature_layer(self.name):
            raise LayerError(f"layer {self.name[:80]!r} is no feature layer: {LAYER_PATTERN.pattern}, not ndt…")
        if not self.kinds:
            raise LayerError(f"layer {self.name} needs at least one kind of features")
        unfit = [kind for kind in self.kinds if not KIND_PATTERN.fullmatch(kind)]
        if unfit:
            raise LayerError(f"layer {self.name}: kind {unfit[0][:80]!r} does not match {KIND_PATTERN.pattern}")
        check_settings(self, LayerError)


SIGNS: Final = ("traffic_sign", "speed_limit", "no_overtaking", "warning", "direction", "exit", "information")
"""A sign, and what a detector may know of its type; types are never taken for each other."""
LAYERS: Final = {
    layer.name: layer
    for layer in (
        LayerParameters("signs", "camera", SIGNS, field_deg=40.0, range_m=80.0),
        LayerParameters("streetlights", "lidar", ("streetlight",), height_m=4.0, detection_confidence=0.6, alone_m=3.0),
        LayerParameters("poles", "lidar", ("pole", "trunk"), detection_confidence=0.6),
    )
}
"""Those that every vehicle knows; the camera is that of SLAMCU, section 6.1."""


def declared_layers(tables: object, where: str) -> tuple[LayerParameters, ...]:
    """The layers of the tables `[[feature_layer]]` of a settings file.

    Raises:
        ConfigError: no list of tables, or a key that is none of a layer's.
        LayerError: a layer that cannot be.
    """
    if not isinstance(tables, list | tuple):
        raise ConfigError(f"{where}: write [[feature_layer]], a list of tables, not [feature_layer]")
    return tuple(
        table if isinstance(table, LayerParameters) else from_mapping(LayerParameters, table, where=f"{where}: layer")
        for table in tables
    )


def checked_layers(layers: Iterable[LayerParameters]) -> dict[str, LayerParameters]:
    """Declared layers by name.

    Raises:
        LayerError: a name comes twice.
    """
    found: dict[str, LayerParameters] = {}
    for layer in layers:
        if layer.name in found:
            raise LayerError(f"layer {layer.name} comes twice")
        found[layer.name] = layer
    return found


def named_layer(name: str, declared: Iterable[LayerParameters] = ()) -> LayerParameters:
    """The layer of a name: a declared one, else one that every vehicle knows.

    Raises:
        LayerError: nobody has declared it; says what to write.
    """
    known = LAYERS | checked_layers(declared)
    if name in known:
        return known[name]
    raise LayerError(
        f"there is no layer {name[:80]!r}; known are {', '.join(known)}. To declare it, write into the settings file: "
        f'[[feature_layer]] name = "{name[:80]}", kinds = ["..."], sensor = "camera" (each on a line of its own)'
    )
