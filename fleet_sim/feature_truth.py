"""Map features of a simulated street: what stands before and after, and the feature layers of the map before.

Signs, streetlights and trunks are solids of the world that LiDAR and camera see. A thing that was moved is a deleted
feature and a new one (Jo et al. 2018, section 2.3).
"""

from dataclasses import dataclass
from math import cos, sin
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import WorldError
from gnd.fleet_sim.shapes import Ball, Block, Post, Shape
from gnd.fleet_sim.world import World, WorldObject
from gnd.gnd_map.features import UNKNOWN_HEIGHT_M2, Feature, FeatureTile, feature_id_of, points_in_tile, prior
from gnd.gnd_map.tile_id import TileId

FloatArray = NDArray[np.float64]
FeatureClass = Literal["normal", "deleted", "new"]

LAYER_OF: Final = {"sign": "signs", "lamp": "streetlights", "tree": "poles"}
KIND_OF: Final = {"sign": "traffic_sign", "lamp": "streetlight", "tree": "trunk"}
"""Layer and kind of a feature by the kind of the world's object."""
MAP_ERROR_M: Final = 0.1
"""Error of each coordinate of a mapped feature: HD maps are 10 to 20 cm accurate (Jo et al., section 2.2)."""
MAP_CONFIDENCE: Final = 0.95
"""λ_HD of Jo et al., section 6.2."""
SAME_PLACE_M: Final = 0.05
"""A thing that was changed but moved less is the same feature."""
PLATE_M: Final = 1.0
"""Plates are 0.6 to 1.2 m wide: nearer to each other they overlap."""
_EYE_M: Final = 1.5
_SURVEY: Final = 61
_MAPPED: Final = 63


@dataclass(frozen=True, slots=True)
class TrueFeature:
    """One feature of the truth.

    Attributes:
        feature_id: > 0, that of the base map where it holds the feature.
        name: of the world's object.
        layer, kind: such as "signs", "traffic_sign".
        state: "normal" (the map before has it, and it stands), "deleted" (the map has it, and it is gone), "new".
        position_map_m: map frame: the middle of a sign's plate, else the foot of the post.
        moved: a deleted one stands elsewhere now, or a new one stood elsewhere.
        buried: it stands, but inside something that was put there: a container, a shop. Nobody can see it.
        doubled: it is new, and its plate overlaps that of a sign that stood there already. Nobody can tell them apart.
    """

    feature_id: int
    name: str
    layer: str
    kind: str
    state: FeatureClass
    position_map_m: tuple[float, float, float]
    moved: bool = False
    buried: bool = False
    doubled: bool = False


@dataclass(frozen=True, slots=True)
class FeatureTruth:
    """All features of a world, in both states, against the map before.

    Attributes:
        world: the world.
        features: sorted by layer and id.
    """

    world: World
    features: tuple[TrueFeature, ...]

    def of(self, layer: str, *states: FeatureClass) -> tuple[TrueFeature, ...]:
        """Return the features of a layer, in some states or in all."""
        return tuple(f for f in self.features if f.layer == layer and (not states or f.state in states))

    def positions_m(self, layer: str, *states: FeatureClass) -> FloatArray:
        """Return their places, float64 (N, 3), map frame."""
        return np.array([f.position_map_m for f in self.of(layer, *states)], dtype=np.float64).reshape(-1, 3)

    def geodetic(self, layer: str, *states: FeatureClass) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return their latitudes and longitudes [rad] and ellipsoidal heights [m], WGS-84, float64 (N,) each."""
        return self.world.frame.geodetic_from_enu(self.positions_m(layer, *states))

    def counts(self) -> dict[str, dict[str, int]]:
        """Return how many features of each layer are in each state."""
        layers = sorted({f.layer for f in self.features})
        return {layer: {s: len(self.of(layer, s)) for s in ("normal", "deleted", "new")} for layer in layers}


def feature_truth(world: World, mapped_streetlights: float = 0.0) -> FeatureTruth:
    """Return the features of a world.

    Args:
        world: the street, with both states.
        mapped_streetlights: so many of the lamps before does the map hold, drawn from the seed; the layer is to be
            made by the fleet. Signs are mapped all, trunks none.

    Raises:
        WorldError: the share is not in 0 … 1.
    """
    if not 0.0 <= mapped_streetlights <= 1.0:
        raise WorldError(f"mapped_streetlights must be in 0 … 1, got {mapped_streetlights}")
    before, after = ({o.name: o for o in world.in_state(s) if o.kind in LAYER_OF} for s in ("before", "after"))
    mapped = _mapped(world, before, mapped_streetlights)
    found: list[TrueFeature] = []
    for name in sorted(before | after):
        found += _features_of(world, name, before.get(name), after.get(name), known=name in mapped)
    return FeatureTruth(world, tuple(sorted(found, key=lambda f: (f.layer, f.feature_id))))


def _mapped(world: World, before: dict[str, WorldObject], share: float) -> set[str]:
    """Names of the things that the map before holds."""
    lamps = sorted(name for name, o in before.items() if o.kind == "lamp")
    order = np.random.default_rng([world.seed, _MAPPED]).permutation(len(lamps))
    chosen = {lamps[k] for k in order[: round(share * len(lamps))].tolist()}
    return chosen | {name for name, o in before.items() if o.kind == "sign"}


def _features_of(
    world: World, name: str, old: WorldObject | None, new: WorldObject | None, *, known: bool
) -> list[TrueFeature]:
    """The features that one thing of the world is: one, or two if it was moved."""
    if old is None or not known:
        return [] if new is None else [_feature(world, name, new, "new")]
    if new is None:
        return [_feature(world, name, old, "deleted")]
    way_m = float(np.linalg.norm(position_street_m(new) - position_street_m(old)))
    if way_m < SAME_PLACE_M:
        return [_feature(world, name, old, "normal")]
    return [_feature(world, name, old, "deleted", moved=True), _feature(world, name, new, "new", moved=True)]


def _feature(world: World, name: str, o: WorldObject, state: FeatureClass, *, moved: bool = False) -> TrueFeature:
    x, y, z = world.map_of_street(position_street_m(o)).tolist()
    layer = LAYER_OF[o.kind]
    number = feature_id_of("world", world.seed, layer, name, "after" if state == "new" else "before")
    buried = state != "deleted" and is_buried(world, o)
    doubled = state == "new" and o.kind == "sign" and is_doubled(world, o)
    return TrueFeature(number, name, layer, KIND_OF[o.kind], state, (x, y, z), moved, buried, doubled)


def is_doubled(world: World, sign: WorldObject) -> bool:
    """Return whether another sign, one that was there before, stands within a plate's width of a sign."""
    others = (o for o in world.in_state("after") if o.kind == "sign" and "before" in o.states and o.name != sign.name)
    here = position_street_m(sign)
    return any(float(np.linalg.norm(position_street_m(o) - here)) < PLATE_M for o in others)


def is_buried(world: World, o: WorldObject) -> bool:
    """Return whether the middle of a sign's plate, or of a mast's lower 3 m, lies inside another solid afterwards."""
    point = position_street_m(o) + (0.0 if o.kind == "sign" else np.array([0.0, 0.0, _EYE_M]))
    others = (shape for other in world.in_state("after") if other.name != o.name for shape in other.shapes)
    return any(holds(shape, point) for shape in others)


def holds(shape: Shape, point: FloatArray) -> bool:
    """Return whether a point (3,) of the street frame lies inside a primitive."""
    dx, dy, z = point[0] - shape.x_m, point[1] - shape.y_m, point[2]
    if isinstance(shape, Ball):
        return bool(dx**2 + dy**2 + (z - shape.z_m) ** 2 <= shape.radius_m**2)
    if isinstance(shape, Post):
        return bool(dx**2 + dy**2 <= shape.radius_m**2 and shape.bottom_m <= z <= shape.top_m)
    c, s = cos(shape.yaw_rad), sin(shape.yaw_rad)
    along, across = c * dx + s * dy, c * dy - s * dx
    top = shape.top_m + shape.rise_x * along + shape.rise_y * across
    inside = abs(along) <= shape.half_x_m and abs(across) <= shape.half_y_m
    return bool(inside and shape.bottom_m <= z <= top)


def plate_of(sign: WorldObject) -> Block:
    """Return a sign's plate."""
    return next(shape for shape in sign.shapes if isinstance(shape, Block))


def position_street_m(o: WorldObject) -> FloatArray:
    """Return the place of a feature, float64 (3,), street frame: the middle of a plate, else the foot of the post."""
    first = o.shapes[0]
    if o.kind == "sign":
        plate = plate_of(o)
        return np.array([plate.x_m, plate.y_m, 0.5 * (plate.bottom_m + plate.top_m)])
    # Posts reach 0.2 m into the ground.
    return np.array([first.x_m, first.y_m, first.bottom_m + 0.2])  # type: ignore[union-attr]


def base_features(truth: FeatureTruth) -> dict[str, tuple[FeatureTile, ...]]:
    """Return the feature layers of the map before, by layer, tiles sorted: what the fleet starts with.

    Places err by MAP_ERROR_M along each axis; of posts no height is told. A layer without features has no tiles.
    """
    rng = np.random.default_rng([truth.world.seed, _SURVEY])
    layers: dict[str, dict[TileId, list[Feature]]] = {}
    for feature in sorted(truth.features, key=lambda f: f.name):
        error = MAP_ERROR_M * rng.standard_normal(3)
        if feature.state == "new":
            continue
        tile, mapped = _mapped_feature(truth.world, feature, error)
        layers.setdefault(feature.layer, {}).setdefault(tile, []).append(mapped)
    return {
        layer: tuple(FeatureTile.of(tile, 1, tiles[tile]) for tile in sorted(tiles))
        for layer, tiles in sorted(layers.items())
    }


def _mapped_feature(world: World, feature: TrueFeature, error_m: FloatArray) -> tuple[TileId, Feature]:
    lat, lon, height = world.frame.geodetic_from_enu((np.array(feature.position_map_m) + error_m)[None])
    tile = TileId.from_geodetic(float(lat[0]), float(lon[0]))
    variance = MAP_ERROR_M**2
    upright = variance if feature.layer == "signs" else UNKNOWN_HEIGHT_M2
    cov = np.array([variance, 0.0, 0.0, variance, 0.0, upright])
    points = points_in_tile(tile, lat, lon, height)
    return tile, Feature(feature.feature_id, feature.kind, points, cov, prior(MAP_CONFIDENCE))


def facing_street(plate: Block) -> FloatArray:
    """Return the direction along a plate's width, float64 (3,), street frame."""
    return np.array([-sin(plate.yaw_rad), cos(plate.yaw_rad), 0.0])
