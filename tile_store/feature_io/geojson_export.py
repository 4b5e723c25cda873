"""Features as GeoJSON (RFC 7946): WGS-84, longitude before latitude in degrees, ellipsoidal height in metres.

Points are Points, polylines are LineStrings. Coordinates have eleven digits behind the point, a micrometre. What a
feature is and how sure we are of it are properties; `geojson_import` reads them back.
"""

import json
from collections.abc import Iterable
from typing import Any, Final

import numpy as np

from gnd.tile_store.feature_io.values import MapFeature

FORMAT_VERSION: Final = 1
MEMBER: Final = "gnd"
"""The foreign member (RFC 7946, section 6.1) that marks a file of ours."""
_DEGREES: Final = 11
_METRES: Final = 4


def write_geojson(features: Iterable[MapFeature]) -> bytes:
    """A FeatureCollection, one feature a line."""
    head = {"type": "FeatureCollection", MEMBER: {"format": FORMAT_VERSION}}
    lines = ",\n".join(json.dumps(as_geojson(feature), ensure_ascii=False, allow_nan=False) for feature in features)
    return f'{json.dumps(head)[:-1]}, "features": [\n{lines}\n]}}\n'.encode()


def as_geojson(feature: MapFeature) -> dict[str, Any]:
    """One feature; its id is text, because many readers round numbers beyond 2^53."""
    columns = np.degrees(feature.lon_rad), np.degrees(feature.lat_rad)
    line = [
        [round(lon, _DEGREES), round(lat, _DEGREES), round(height, _METRES)]
        for lon, lat, height in zip(*(c.tolist() for c in columns), feature.height_m.tolist(), strict=True)
    ]
    geometry = (
        {"type": "Point", "coordinates": line[0]} if len(line) == 1 else {"type": "LineString", "coordinates": line}
    )
    return {
        "type": "Feature",
        "id": str(feature.feature_id),
        "geometry": geometry,
        "properties": properties_of(feature),
    }


def properties_of(feature: MapFeature) -> dict[str, Any]:
    """What a feature is, without its place."""
    existence = feature.existence
    return {
        "feature_id": str(feature.feature_id),
        "layer": feature.layer,
        "kind": feature.kind,
        "state": existence.state,
        "exist": existence.exist,
        "absent": existence.absent,
        "unknown": existence.unknown,
        "conflict": existence.conflict,
        "sigma_m": round(float(np.sqrt(feature.cov_m2[[0, 3]].max())), _METRES),
        "cov_m2": feature.cov_m2.tolist(),
        "hits": feature.hits,
        "vehicles": feature.vehicles,
        "attributes": dict(feature.attributes),
    }
