"""Lanelet2 maps in OSM XML, and plain OSM files, as features.

Borders of lanelets become polylines of kind "lane_boundary" with the tags of their ways; signs, lights, poles and lamps
become points, whether they are drawn as nodes or as linestrings (then in the middle of these). Lanelets, regulatory
elements and all else that is no feature stay in the document, which is kept beside the features and exported again.

Format: github.com/fzi-forschungszentrum-informatik/Lanelet2, lanelet2_core/doc/*.md.
"""

from collections import Counter
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import feature_id_of
from gnd.tile_store.feature_io.errors import BadGeometry, NeedsGeoreference
from gnd.tile_store.feature_io.lane_crossing import crossing_of
from gnd.tile_store.feature_io.osm_document import OsmDocument, OsmNode, OsmWay, Progress, read_osm, real
from gnd.tile_store.feature_io.osm_kinds import POINT_KINDS, kind_of, told_of
from gnd.tile_store.feature_io.values import (
    LEFT_OUT,
    FeatureFile,
    ImportOptions,
    MapFeature,
    attributes_of,
    check_positions,
    check_simple,
    check_vertices,
)

FORMAT: Final = "lanelet2"


@dataclass(frozen=True, slots=True, eq=False)
class NodePlaces:
    """Where the nodes of a document are.

    index: by node id the row. lat_rad, lon_rad, height_m: (N,). has_height: (N,). local_m: (N, 3) when the document's
    local coordinates were used, else None.
    """

    index: dict[int, int]
    lat_rad: F64
    lon_rad: F64
    height_m: F64
    has_height: "np.ndarray[tuple[int], np.dtype[np.bool_]]"
    local_m: F64 | None

    def rows(self, nodes: list[OsmNode]) -> list[int]:
        """Rows of nodes."""
        return [self.index[node.id] for node in nodes]


@dataclass(frozen=True, slots=True, eq=False)
class DrawnLane:
    """A feature and the element that draws it: a node, or a way with its nodes."""

    feature: MapFeature
    element: OsmNode | OsmWay
    nodes: tuple[OsmNode, ...]


def read_lanelet2(
    data: bytes, where: str, source: str, options: ImportOptions, progress: Progress | None = None
) -> FeatureFile:
    """The features of an OSM file.

    Args:
        data: its bytes.
        where: what to call it in messages.
        source: what its features are known by: ids are made from it and the elements' own.
        options: see there; without `placement` and `trust_latlon`, files with local coordinates are refused.
        progress: called now and then.

    Raises:
        FeatureFileError: one of its family says what is wrong and where.
    """
    document = read_osm(data, where, progress=progress)
    drawn, left_out = drawn_features(document, source, options)
    for one in drawn:
        check_simple(one.feature)
    check_lanelets(document, places_of(document, options))
    return FeatureFile(FORMAT, tuple(one.feature for one in drawn), left_out, data)


def drawn_features(
    document: OsmDocument, source: str, options: ImportOptions
) -> tuple[list[DrawnLane], dict[str, int]]:
    """The features that elements of a document draw, and how many of which kinds have no layer."""
    places, borders = places_of(document, options), _borders(document)
    left_out: Counter[str] = Counter()
    found: list[tuple[str, OsmNode | OsmWay, list[OsmNode]]] = []
    for way in document.ways.values():
        kind = kind_of(way.tags, border=way.id in borders)
        if kind is not None:
            found.append((kind, way, document.nodes_of(way)))
    for node in document.nodes.values():
        kind = kind_of(node.tags)
        if kind is not None:
            found.append((kind, node, [node]))
    drawn = []
    for kind, element, nodes in found:
        layer = options.layer_of(kind)
        if layer == LEFT_OUT:
            left_out[kind] += 1
        else:
            drawn.append(_drawn(document, source, options, places, kind, layer, element, nodes))
    return drawn, dict(sorted(left_out.items()))


def _drawn(
    document: OsmDocument,
    source: str,
    options: ImportOptions,
    places: NodePlaces,
    kind: str,
    layer: str,
    element: OsmNode | OsmWay,
    nodes: list[OsmNode],
) -> DrawnLane:
    what = "way" if isinstance(element, OsmWay) else "node"
    name = f"{document.where}, line {element.line}: {what} {element.id}"
    if not nodes:
        raise BadGeometry(f"{name} ({kind}) has no nodes, so no position")
    rows = places.rows(nodes)
    line = np.column_stack([places.lat_rad[rows], places.lon_rad[rows], places.height_m[rows]])
    if kind in POINT_KINDS:
        line = middle_of(line)[None]
    elif len(line) < 2:
        raise BadGeometry(f"{name} ({kind}) has {len(line)} node; a line needs 2")
    feature = MapFeature(
        feature_id_of(FORMAT, source, what, element.id), kind, layer,
        line[:, 0].copy(), line[:, 1].copy(), line[:, 2].copy(),
        options.cov_m2(height_known=bool(places.has_height[rows].all())), options.existence(),
        attributes_of(told_of(element.tags)), name,
    )  # fmt: skip
    return DrawnLane(feature, element, tuple(nodes))


def middle_of(line: F64) -> F64:
    """(3,) the middle of what the vertices (N, 3) span: a plate drawn by its edges hangs there."""
    return np.asarray((line.min(axis=0) + line.max(axis=0)) / 2.0)


def _borders(document: OsmDocument) -> set[int]:
    """Ids of the ways that are borders of lanelets."""
    lanelets = (one for one in document.relations.values() if one.tags.get("type") == "lanelet")
    return {ref for lanelet in lanelets for role in ("left", "right") for ref in lanelet.member("way", role)}


def places_of(document: OsmDocument, options: ImportOptions) -> NodePlaces:
    """Where the nodes are: by their local coordinates when a placement is given, by latitude and longitude otherwise.

    Raises:
        NeedsGeoreference: there are local coordinates and nothing says whether latitudes and longitudes hold; or a
            placement is given and a node has no local coordinates.
        BadGeometry: a position beyond the Earth.
    """
    nodes = list(document.nodes.values())
    index = {node.id: row for row, node in enumerate(nodes)}
    has_local = np.array(["local_x" in node.tags and "local_y" in node.tags for node in nodes], np.bool_)
    has_height = np.array(["ele" in node.tags for node in nodes], np.bool_)
    height_m = np.array([_value(document, node, "ele") for node in nodes], np.float64)
    if options.placement is not None:
        local_m = _local(document, nodes, has_local, height_m)
        lat, lon, height_m = options.placement.geodetic(local_m) if nodes else (np.zeros(0),) * 3
        has_height &= options.placement.height_known or options.height_offset_m != 0.0
    else:
        _refuse_placeholders(document, has_local, options)
        local_m = None
        lat, lon = np.radians(np.array([(n.lat_deg, n.lon_deg) for n in nodes], np.float64).reshape(-1, 2)).T
    height_m = height_m + options.height_offset_m
    _check_places(document, nodes, lat, lon, height_m)
    return NodePlaces(index, lat, lon, height_m, has_height, local_m)


def _check_places(document: OsmDocument, nodes: list[OsmNode], lat: F64, lon: F64, height_m: F64) -> None:
    try:
        if nodes:
            check_positions(document.where, lat, lon, height_m)
    except BadGeometry:
        for row, node in enumerate(nodes):
            told = f"{document.where}, line {node.line}: node {node.id}"
            check_positions(told, *(column[row : row + 1] for column in (lat, lon, height_m)))
        raise


def _refuse_placeholders(
    document: OsmDocument, has_local: "np.ndarray[tuple[int], np.dtype[np.bool_]]", options: ImportOptions
) -> None:
    if has_local.any() and not options.trust_latlon:
        raise NeedsGeoreference(
            f"{document.where}: {has_local.sum()} of {len(has_local)} nodes have local_x and local_y, so that their "
            "lat and lon may be placeholders; say --georeference latlon if they hold, an anchor "
            "(LAT,LON[,HEIGHT[,BEARING]]) or track if they do not"
        )


def _local(
    document: OsmDocument,
    nodes: list[OsmNode],
    has_local: "np.ndarray[tuple[int], np.dtype[np.bool_]]",
    height_m: F64,
) -> F64:
    if not has_local.all():
        first = nodes[int(np.argmin(has_local))]
        raise NeedsGeoreference(
            f"{document.where}, line {first.line}: {(~has_local).sum()} of {len(nodes)} nodes have no local_x and "
            f"local_y, first node {first.id}; a georeference places local coordinates only"
        )
    x, y = (np.array([_value(document, node, key) for node in nodes], np.float64) for key in ("local_x", "local_y"))
    return np.column_stack([x, y, height_m])


def _value(document: OsmDocument, node: OsmNode, key: str) -> float:
    text = node.tags.get(key)
    return 0.0 if text is None else real(f"{document.where}, line {node.line}", f"{key} of node {node.id}", text)


def check_lanelets(document: OsmDocument, places: NodePlaces) -> None:
    """BadGeometry when the borders of a lanelet cross each other."""
    for relation in document.relations.values():
        if relation.tags.get("type") != "lanelet":
            continue
        sides = []
        for role in ("left", "right"):
            nodes = [n for ref in relation.member("way", role) for n in document.nodes_of(document.ways[ref])]
            check_vertices(
                f"{document.where}, line {relation.line}: {role} border of lanelet {relation.id}", len(nodes)
            )
            rows = places.rows(nodes)
            sides.append(
                np.column_stack([places.lon_rad[rows] * np.cos(places.lat_rad[rows[:1]]), places.lat_rad[rows]])
            )
        met = crossing_of(sides[0], sides[1])
        if met is not None:
            raise BadGeometry(
                f"{document.where}, line {relation.line}: the borders of lanelet {relation.id} cross each other "
                f"(segment {met[0] + 1} of {len(sides[0]) - 1} on the left, {met[1] + 1} of {len(sides[1]) - 1} on the "
                "right)"
            )
