"""GeoJSON (RFC 7946) as features: files that `geojson_export` wrote come back whole, those of others as they can.

Of others' files the kind is the property "kind" or "type", the layer the property "layer" or that of the kind, and the
remaining properties become attributes. A Polygon becomes the closed line of its outer border.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.features import Existence, feature_id_of, is_feature_layer
from gnd.gnd_map.features.feature import KIND_PATTERN
from gnd.schemas.wire import LAYER_PATTERN
from gnd.tile_store.feature_io.errors import BadElement, BadGeometry, FeatureFileError, FileTooLarge, UnknownFormat
from gnd.tile_store.feature_io.geojson_export import FORMAT_VERSION, MEMBER
from gnd.tile_store.feature_io.json_file import as_text, member, read_json, real_number
from gnd.tile_store.feature_io.osm_document import Progress
from gnd.tile_store.feature_io.values import (
    LEFT_OUT,
    FeatureFile,
    ImportOptions,
    MapFeature,
    MapFindings,
    attributes_of,
)

FORMAT: Final = "geojson"
MAX_FEATURES: Final = 1_000_000
_EVERY: Final = 4096
_WGS84: Final = ("urn:ogc:def:crs:OGC:1.3:CRS84", "urn:ogc:def:crs:OGC::CRS84", "EPSG:4326")
_OURS: Final = frozenset(
    {"feature_id", "layer", "kind", "exist", "absent", "unknown", "conflict", "cov_m2", "hits", "vehicles"}
)


@dataclass(frozen=True, slots=True)
class _GeojsonReading:
    where: str
    source: str
    options: ImportOptions
    ours: bool


def read_geojson(
    data: bytes, where: str, source: str, options: ImportOptions, progress: Progress | None = None
) -> FeatureFile:
    """The features of a GeoJSON file.

    Args:
        data: its bytes.
        where: what to call it in messages.
        source: what features without an id of ours are known by.
        options: layers, sigmas and existence of what the file does not state.
        progress: called now and then.

    Raises:
        FeatureFileError: one of its family says what is wrong and in which feature.
    """
    told = read_json(data, where)
    items, ours = _items(told, where)
    reading = _GeojsonReading(where, source, options, ours)
    left_out: Counter[str] = Counter()
    features: list[MapFeature] = []
    findings = MapFindings(options.strict)
    for number, item in enumerate(items):
        for feature in _features(reading, item, number):
            if feature.layer == LEFT_OUT:
                left_out[feature.kind] += 1
            else:
                findings.check_simple(feature)
                features.append(feature)
        if progress and number % _EVERY == 0:
            progress("reading", number, len(items))
    return FeatureFile(FORMAT, tuple(features), dict(sorted(left_out.items())), notes=findings.told())


def _items(told: Any, where: str) -> tuple[list[Any], bool]:
    kind = member(where, told, "type", str)
    _check_crs(told, where)
    if kind == "Feature":
        return [told], False
    if kind != "FeatureCollection":
        raise UnknownFormat(f"{where}: type {kind!r:.40}; a file of features is a FeatureCollection")
    items: list[Any] = member(where, told, "features", list)
    if len(items) > MAX_FEATURES:
        raise FileTooLarge(f"{where}: {len(items)} features, the limit is {MAX_FEATURES}")
    ours = told.get(MEMBER)
    if ours is not None and (not isinstance(ours, dict) or ours.get("format") != FORMAT_VERSION):
        raise UnknownFormat(f"{where}: format {ours!r:.60} of gnd; known is {FORMAT_VERSION}")
    return items, ours is not None


def _check_crs(told: dict[str, Any], where: str) -> None:
    """RFC 7946 knows WGS-84 only; older files may name another reference system."""
    crs = told.get("crs")
    if crs is None:
        return
    name = crs.get("properties", {}).get("name") if isinstance(crs, dict) else None
    if name not in _WGS84:
        raise UnknownFormat(f"{where}: reference system {name!r:.80}; GeoJSON is WGS-84 (RFC 7946), transform it")


def _features(reading: _GeojsonReading, item: Any, number: int) -> Iterator[MapFeature]:
    where = f"{reading.where}, feature {number}"
    if member(where, item, "type", str) != "Feature":
        raise BadElement(f"{where}: type {item['type']!r:.40}, expected Feature")
    properties = item.get("properties") or {}
    if not isinstance(properties, dict):
        raise BadElement(f"{where}: properties are {type(properties).__name__}")
    geometry = item.get("geometry")
    if geometry is None:
        raise BadGeometry(f"{where}: has no position (its geometry is null)")
    for part, line in enumerate(_lines(where, geometry)):
        yield _feature(reading, where, item, properties, line, (number, part))


def _lines(where: str, geometry: Any) -> Iterator[F64]:
    """(N, 3) degrees and metres of each line or point of a geometry."""
    kind = member(where, geometry, "type", str)
    coordinates = member(where, geometry, "coordinates", list) if kind in _LINES_OF else None
    if coordinates is None:
        raise BadGeometry(f"{where}: geometry {kind!r:.40}; known are {', '.join(_LINES_OF)}")
    for line in _LINES_OF[kind](coordinates):
        if not isinstance(line, list):
            raise BadGeometry(f"{where}: coordinates of a {kind} do not nest as RFC 7946 says")
        yield _line(where, line, 1 if kind in ("Point", "MultiPoint") else 2)


_LINES_OF: Final[Mapping[str, Callable[[list[Any]], list[Any]]]] = {
    "Point": lambda c: [[c]],
    "MultiPoint": lambda c: [[one] for one in c],
    "LineString": lambda c: [c],
    "MultiLineString": lambda c: c,
    "Polygon": lambda c: c[:1],
    "MultiPolygon": lambda c: [one[0] if isinstance(one, list) and one else one for one in c],
}
"""The lines in a geometry's coordinates."""


def _line(where: str, line: list[Any], least: int) -> F64:
    if len(line) < least:
        raise BadGeometry(f"{where}: {len(line)} positions, a line needs {least}")
    for position in line:
        if not isinstance(position, list) or not 2 <= len(position) <= 3:
            raise BadGeometry(f"{where}: position {position!r:.60} is not [longitude, latitude] or with a height")
    return np.array([[real_number(where, v) for v in (*p, 0.0)[:3]] for p in line], np.float64)


def _feature(
    reading: _GeojsonReading,
    where: str,
    item: dict[str, Any],
    properties: dict[str, Any],
    line: F64,
    at: tuple[int, int],
) -> MapFeature:
    options = reading.options
    kind = _kind(properties)
    has_height = len(_first_position(item)) == 3
    line_m = line[:, 2] + options.height_offset_m
    place = (np.radians(line[:, 1]), np.radians(line[:, 0]), line_m)
    if reading.ours or properties.keys() >= _OURS:  # editors lose the mark of the whole, not the properties
        return _of_ours(where, properties, kind, place, options)
    rest = {str(k): as_text(v) for k, v in properties.items() if k not in ("kind", "layer") and v is not None}
    name = (item["id"],) if isinstance(item.get("id"), (str, int)) else ("at", at[0])
    return MapFeature(
        feature_id_of(FORMAT, reading.source, *name, at[1]), kind, _layer(properties, kind, options), *place,
        cov_m2=options.cov_m2(height_known=has_height), existence=options.existence(), attributes=attributes_of(rest),
        name=where,
    )  # fmt: skip


def _first_position(item: dict[str, Any]) -> list[Any]:
    first: Any = item["geometry"]["coordinates"]
    while isinstance(first[0], list):
        first = first[0]
    return list(first)


def _kind(properties: dict[str, Any]) -> str:
    said = [properties.get(key) for key in ("kind", "type")]
    return next((kind for kind in said if isinstance(kind, str) and KIND_PATTERN.fullmatch(kind)), "unknown")


def _layer(properties: dict[str, Any], kind: str, options: ImportOptions) -> str:
    said = properties.get("layer")
    if kind in options.layers or not isinstance(said, str) or not LAYER_PATTERN.fullmatch(said):
        return options.layer_of(kind)
    return said if is_feature_layer(said) else options.layer_of(kind)


def _of_ours(
    where: str,
    properties: dict[str, Any],
    kind: str,
    place: tuple[F64, F64, F64],
    options: ImportOptions,
) -> MapFeature:
    """A feature as we wrote it."""
    absent = sorted(_OURS - properties.keys())
    if absent:
        raise BadElement(f"{where}: lacks the properties {', '.join(absent)}")
    try:
        masses = (real_number(where, properties[key]) for key in ("exist", "absent", "unknown", "conflict"))
        attributes = attributes_of({str(k): as_text(v) for k, v in _attributes(where, properties).items()})
        cov_m2 = np.array([real_number(where, v) for v in properties["cov_m2"]], np.float64)
        return MapFeature(
            int(properties["feature_id"]), kind, _layer(properties, kind, options), *place, cov_m2=cov_m2,
            existence=Existence(*masses), attributes=attributes, name=where,
            hits=int(properties["hits"]), vehicles=int(properties["vehicles"]),
        )  # fmt: skip
    except FeatureFileError:
        raise
    except (GndError, KeyError, TypeError, ValueError) as error:
        raise BadElement(f"{where}: {error}") from None


def _attributes(where: str, properties: dict[str, Any]) -> dict[str, Any]:
    """An object; some editors write it as text."""
    told = properties.get("attributes") or {}
    value = read_json(told.encode(), where) if isinstance(told, str) else told
    found: dict[str, Any] = member(where, {"attributes": value}, "attributes", dict)
    return found
