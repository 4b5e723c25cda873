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
from gnd.tile_store.feature_io.lanelet2_borders import check_lanelets, lanelet_borders, lanes_of_lanelets
from gnd.tile_store.feature_io.lanelet2_places import NodePlaces, places_of
from gnd.tile_store.feature_io.osm_document import OsmDocument, OsmNode, OsmWay, Progress, read_osm
from gnd.tile_store.feature_io.osm_kinds import POINT_KINDS, kind_of, told_of
from gnd.tile_store.feature_io.values import (
    LEFT_OUT,
    FeatureFile,
    ImportOptions,
    MapFeature,
    MapFindings,
    attributes_of,
)

FORMAT: Final = "lanelet2"


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
    findings = MapFindings(options.strict)
    drawn, left_out = drawn_features(document, source, options, findings)
    for one in drawn:
        findings.check_simple(one.feature)
    borders = lanelet_borders(document, places_of(document, options))
    check_lanelets(document, borders, findings)
    features = tuple(one.feature for one in drawn)
    ways = {one.element.id: one.feature.feature_id for one in drawn if isinstance(one.element, OsmWay)}
    kept = Counter(one.tags.get("type", "untyped relation") for one in document.relations.values())
    return FeatureFile(
        FORMAT, features, left_out, data, findings.told(), lanes_of_lanelets(borders, ways), dict(sorted(kept.items()))
    )


def drawn_features(
    document: OsmDocument, source: str, options: ImportOptions, findings: MapFindings | None = None
) -> tuple[list[DrawnLane], dict[str, int]]:
    """The features that elements of a document draw, and how many of which kinds have no layer.

    A way without two nodes draws no line: it is left out, and a finding when these are collected.
    """
    places, borders = places_of(document, options), _borders(document)
    left_out: Counter[str] = Counter()
    found: list[tuple[str, OsmNode | OsmWay, list[OsmNode]]] = []
    for way in document.ways.values():
        kind = kind_of(way.tags, border=way.id in borders)
        if kind is None:
            left_out["untyped_way"] += 1
        else:
            found.append((kind, way, document.nodes_of(way)))
    for node in document.nodes.values():
        kind = kind_of(node.tags)
        if kind == "lane_boundary":
            left_out["lane_boundary_node"] += 1  # a vertex that bears the type of its line
        elif kind is not None:
            found.append((kind, node, [node]))
    drawn = []
    for kind, element, nodes in found:
        layer = options.layer_of(kind)
        if layer == LEFT_OUT:
            left_out[kind] += 1
        elif len(nodes) < least_nodes(kind, element):
            left_out["short_way"] += 1
            if findings:
                findings.add(
                    f"{document.where}, line {element.line}: way {element.id} ({kind}) has {len(nodes)} nodes; a line "
                    f"needs {least_nodes(kind, element)}"
                )
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
    rows = places.rows(nodes)
    line = np.column_stack([places.lat_rad[rows], places.lon_rad[rows], places.height_m[rows]])
    if kind in POINT_KINDS:
        line = middle_of(line)[None]
    feature = MapFeature(
        feature_id_of(FORMAT, source, what, element.id), kind, layer,
        line[:, 0].copy(), line[:, 1].copy(), line[:, 2].copy(),
        options.cov_m2(height_known=bool(places.has_height[rows].all())), options.existence(),
        attributes_of(told_of(element.tags)), name,
    )  # fmt: skip
    return DrawnLane(feature, element, tuple(nodes))


def least_nodes(kind: str, element: OsmNode | OsmWay) -> int:
    """So many nodes draw a feature of a kind."""
    return 1 if kind in POINT_KINDS or isinstance(element, OsmNode) else 2


def middle_of(line: F64) -> F64:
    """(3,) the middle of what the vertices (N, 3) span: a plate drawn by its edges hangs there."""
    turn = np.array([0.0, 2.0 * np.pi, 0.0])
    line = line - turn * np.round((line - line[0]) / (2.0 * np.pi))  # a plate at 180 degrees does not span the Earth
    middle = (line.min(axis=0) + line.max(axis=0)) / 2.0
    return np.asarray(middle - turn * np.round(middle / (2.0 * np.pi)))


def _borders(document: OsmDocument) -> set[int]:
    """Ids of the ways that are borders of lanelets."""
    lanelets = (one for one in document.relations.values() if one.tags.get("type") == "lanelet")
    return {ref for lanelet in lanelets for role in ("left", "right") for ref in lanelet.member("way", role)}
