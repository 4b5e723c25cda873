"""What is reported of a mapped stretch, tile by tile: features found, map features judged, cells looked at."""

from collections import defaultdict
from math import nan

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.feature_layer import LayerParameters
from gnd.schemas.features import FeatureChange, Found, Seen
from gnd.vehicle_agent.features.coverage import Coverage
from gnd.vehicle_agent.features.feature_map import features_in_map, place_in_tile, with_height
from gnd.vehicle_agent.features.layer import of_counts
from gnd.vehicle_agent.features.layer_parameters import view_of
from gnd.vehicle_agent.features.mapping.feature_drive import FeatureDrive
from gnd.vehicle_agent.features.mapping.held_map import HeldMap
from gnd.vehicle_agent.features.mapping.new_layer import NewLayer
from gnd.vehicle_agent.features.view import wrapped


def changes_of(
    found: NewLayer,
    drive: FeatureDrive,
    held: HeldMap,
    layer: LayerParameters,
    height_m: float,
) -> list[FeatureChange]:
    """What is reported of a stretch, tile by tile.

    Args:
        found: the graph's result.
        drive: the stretch.
        held: the map's tiles.
        layer: whose features they are.
        height_m: stands in for heights, which a plane does not have; map frame.
    """
    times = np.array([look.t_ns for look in drive.looks], np.int64)
    poses = found.path.at(times[(times >= found.path.t_ns[0]) & (times <= found.path.t_ns[-1])])
    looked = Coverage(held.frame, view_of(layer), layer.height_m)
    for x_m, y_m, heading_rad in poses.tolist():
        looked.look(x_m, y_m, heading_rad, None)
    seen, new = _seen(found, held, layer, poses, height_m), _found(found, held, layer, height_m)
    tiles = held.tiles(layer.name)
    return [
        FeatureChange(
            tile=tile_id,
            base_version=tiles[tile_id].version if tile_id in tiles else 0,
            base_sha=tiles[tile_id].sha if tile_id in tiles else b"",
            viewed=looked.viewed(tile_id),
            seen=tuple(sorted(seen[tile_id], key=lambda one: one.feature_id)),
            found=tuple(new[tile_id]),
        )
        for tile_id in sorted({*looked.tiles, *seen, *new})
    ]


def _found(found: NewLayer, held: HeldMap, layer: LayerParameters, height_m: float) -> dict[TileId, list[Found]]:
    """The features that the map has not."""
    features, new = found.features, defaultdict[TileId, list[Found]](list)
    for n in np.flatnonzero(features.known_id == 0).tolist():
        hits = int(features.hits[n])
        point, cov = with_height(features.xy_m[n], features.cov_m2[n], nan, 1.0, height_m)
        tile_id, points, six = place_in_tile(held.frame, point, cov)
        existence = of_counts(hits, 0, layer.detection_confidence)
        new[tile_id].append(Found(features.kinds[n], points, six, existence, hits))
    return new


def _seen(
    found: NewLayer, held: HeldMap, layer: LayerParameters, poses: F64, height_m: float
) -> dict[TileId, list[Seen]]:
    """Verdicts on map features that were in view: measured independently of the map, or missed."""
    seen: dict[TileId, list[Seen]] = defaultdict(list)
    rows = {int(one): n for n, one in enumerate(found.features.known_id) if one}
    for tile_id, tile in held.tiles(layer.name).items():
        known = features_in_map(held.frame, tile, layer.kinds)
        looks = looks_at(known.xy_m, poses, layer)
        for feature_id, n_looks in zip(known.feature_id.tolist(), looks.tolist(), strict=True):
            row = rows.get(feature_id)
            hits = 0 if row is None else int(found.features.hits[row])
            if hits + n_looks == 0:
                continue
            existence = of_counts(hits, max(n_looks - hits, 0), layer.detection_confidence)
            if row is None:
                seen[tile_id].append(Seen(feature_id, existence))
                continue
            xy_m, cov_m2 = found.features.xy_m[row], found.features.cov_m2[row]
            point, cov = with_height(xy_m, cov_m2, nan, 1.0, height_m)
            _, points, six = place_in_tile(held.frame, point, cov, tile_id)
            seen[tile_id].append(Seen(feature_id, existence, hits, points[0], six))
    return seen


def looks_at(xy_m: F64, poses: F64, layer: LayerParameters) -> I64:
    """In how many looks from `poses` (L, 3) each of the places (N, 2) was well inside the field of view, (N,)."""
    if not len(xy_m) or not len(poses):
        return np.zeros(len(xy_m), np.int64)
    away = xy_m[:, None] - poses[None, :, :2]
    range_m = np.hypot(away[..., 0], away[..., 1])
    bearing = wrapped(np.arctan2(away[..., 1], away[..., 0]) - poses[None, :, 2])
    view = view_of(layer)
    inside = view.inside(range_m, bearing, 0.1 * view.range_m, 0.1 * view.field_rad)
    return np.asarray(inside.sum(axis=1), np.int64)
