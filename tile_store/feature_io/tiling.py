"""Features of the Earth into tiles of layers, and whole again."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from gnd.gnd_map.errors import FeatureError, MapError
from gnd.gnd_map.features import Feature, FeatureTile, join_pieces, pieces_of
from gnd.gnd_map.features.feature import M_PER_STEP
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.feature_io.errors import BadGeometry, FeatureFileError
from gnd.tile_store.feature_io.osm_document import Progress
from gnd.tile_store.feature_io.values import MapFeature

Pieces: TypeAlias = dict[str, dict[TileId, list[Feature]]]
"""By layer and tile."""
_EVERY = 256


def cut(features: Iterable[MapFeature], total: int = 0, progress: Progress | None = None) -> Pieces:
    """The features as points and pieces of polylines in the frames of their tiles.

    Raises:
        BadGeometry: one that cannot lie in tiles: too many vertices in a tile, too far above it.
    """
    found: Pieces = defaultdict(lambda: defaultdict(list))
    for number, feature in enumerate(features):
        try:
            pieces = _pieces(feature)
        except MapError as error:
            raise BadGeometry(f"{feature.name or feature.feature_id}: {error}") from None
        for tile, piece in pieces:
            found[feature.layer][tile].append(piece)
        if progress and number % _EVERY == 0:
            progress("cutting into tiles", number, total)
    return found


def _pieces(feature: MapFeature) -> list[tuple[TileId, Feature]]:
    """The snapped pieces; a cut polyline is cut again where it lies once snapped, so that it is the same when what was
    exported is imported.
    """
    pieces = pieces_of(feature.feature(), feature.lat_rad, feature.lon_rad, feature.height_m)
    if len(pieces) > 1:
        pieces = pieces_of(feature.feature(), *join_pieces([(tile, _on_lattice(piece)) for tile, piece in pieces]))
    return pieces


def _on_lattice(piece: Feature) -> Feature:
    """The piece with vertices as `snapped` makes them; the rest does not move them."""
    return replace(piece, points_m=np.round(piece.points_m / M_PER_STEP) / round(1 / M_PER_STEP))


def whole(tiles: Mapping[str, Iterable[FeatureTile]]) -> list[MapFeature]:
    """The features of layers, their pieces joined, sorted by layer and id.

    A polyline's pieces may have been merged apart: the joined one is as uncertain as the most uncertain of them.

    Raises:
        FeatureFileError: a piece of a polyline is in none of the tiles.
    """
    return [one for layer in sorted(tiles) for one in _whole_layer(layer, tiles[layer])]


def _whole_layer(layer: str, tiles: Iterable[FeatureTile]) -> list[MapFeature]:
    pieces: dict[int, list[tuple[TileId, Feature]]] = defaultdict(list)
    for tile in tiles:
        for feature in tile.features:
            pieces[feature.feature_id].append((tile.tile_id, feature))
    return [_joined(layer, pieces[feature_id]) for feature_id in sorted(pieces)]


def _joined(layer: str, pieces: list[tuple[TileId, Feature]]) -> MapFeature:
    try:
        lat, lon, height = join_pieces(pieces)
    except FeatureError as error:
        raise FeatureFileError(f"layer {layer}, feature {pieces[0][1].feature_id}: {error}") from None
    worst = max((feature for _, feature in pieces), key=lambda feature: float(feature.cov_m2[[0, 3, 5]].sum()))
    return MapFeature(
        worst.feature_id, worst.kind, layer, lat, lon, height, worst.cov_m2, worst.existence, worst.attributes,
        f"layer {layer}, feature {worst.feature_id}", worst.hits, worst.vehicles,
    )  # fmt: skip
