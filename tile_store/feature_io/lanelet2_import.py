"""Lanelet2 maps in OSM XML, and plain OSM files, as features.

Borders of lanelets become polylines of kind "lane_boundary" with the tags of their ways; signs, lights, poles and lamps
become points, whether they are drawn as nodes or as linestrings (then in the middle of these). Lanelets, regulatory
elements and all else that is no feature stay in the document, which is kept beside the features and exported again.

Format: github.com/fzi-forschungszentrum-informatik/Lanelet2, lanelet2_core/doc/*.md.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import isnan
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import feature_id_of
from gnd.gnd_map.geodesy import LocalFrame
from gnd.tile_store.feature_io.errors import BadGeometry, NeedsGeoreference
from gnd.tile_store.feature_io.lane_crossing import crossing_of
from gnd.tile_store.feature_io.lane_network import Border, MapLane
from gnd.tile_store.feature_io.osm_document import (
    OsmDocument,
    OsmNode,
    OsmRelation,
    OsmWay,
    Progress,
    read_osm,
    real,
)
from gnd.tile_store.feature_io.osm_kinds import POINT_KINDS, kind_of, told_of
from gnd.tile_store.feature_io.values import (
    LEFT_OUT,
    FeatureFile,
    Findings,
    ImportOptions,
    MapFeature,
    attributes_of,
    check_positions,
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
    findings = Findings(options.strict)
    drawn, left_out = drawn_features(document, source, options, findings)
    for one in drawn:
        findings.check_simple(one.feature)
    borders = lanelet_borders(document, places_of(document, options))
    check_lanelets(document, borders, findings)
    features = tuple(one.feature for one in drawn)
    ways = {one.element.id: one.feature.feature_id for one in drawn if isinstance(one.element, OsmWay)}
    kept = Counter(one.tags.get("type", "untyped relation") for one in document.relations.values())
    return FeatureFile(
        FORMAT, features, left_out, data, findings.told(), _lanes(borders, ways), dict(sorted(kept.items()))
    )


def drawn_features(
    document: OsmDocument, source: str, options: ImportOptions, findings: Findings | None = None
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
        _refuse_placeholders(document, nodes, has_local, options)
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
    document: OsmDocument,
    nodes: list[OsmNode],
    has_local: "np.ndarray[tuple[int], np.dtype[np.bool_]]",
    options: ImportOptions,
) -> None:
    if has_local.any() and not options.trust_latlon:
        raise NeedsGeoreference(
            f"{document.where}: {has_local.sum()} of {len(has_local)} nodes have local_x and local_y, so that their "
            "lat and lon may be placeholders; say --georeference latlon if they hold, an anchor "
            "(LAT,LON[,HEIGHT[,BEARING]]) or track if they do not"
        )
    empty = [node for node in nodes if isnan(node.lat_deg) or isnan(node.lon_deg)]
    if empty:
        raise NeedsGeoreference(
            f"{document.where}, line {empty[0].line}: {len(empty)} of {len(nodes)} nodes have no lat or lon, first "
            f"node {empty[0].id}; say --georeference with an anchor (LAT,LON[,HEIGHT[,BEARING]]) or track"
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


@dataclass(frozen=True, slots=True, eq=False)
class LaneletBorders:
    """The two borders of a lanelet, each way in the lanelet's direction.

    Attributes:
        relation: the lanelet.
        left: the way on the left and whether its nodes are in the direction of the lanelet.
        right: the way on the right, likewise.
        left_m: (N, 2) vertices in an ENU frame at the lanelet, one scale for both borders.
        right_m: (M, 2).
    """

    relation: OsmRelation
    left: tuple[OsmWay, bool]
    right: tuple[OsmWay, bool]
    left_m: F64
    right_m: F64


def lanelet_borders(document: OsmDocument, places: NodePlaces) -> list[LaneletBorders]:
    """The borders of each lanelet, brought into one direction as the official library does (`geometry::align`).

    Raises:
        FileTooLarge: a border has too many vertices to be held against the other.
    """
    return [
        _aligned(document, places, relation)
        for relation in document.relations.values()
        if relation.tags.get("type") == "lanelet"
    ]


def _aligned(document: OsmDocument, places: NodePlaces, relation: OsmRelation) -> LaneletBorders:
    ways = [document.ways[relation.member("way", role)[0]] for role in ("left", "right")]
    rows = [places.rows(document.nodes_of(way)) for way in ways]
    for role, of_way in zip(("left", "right"), rows, strict=True):
        name = f"{document.where}, line {relation.line}: {role} border of lanelet {relation.id}"
        check_vertices(name, len(of_way))
        if not of_way:
            raise BadGeometry(f"{name} has no nodes, so no position")
    first = rows[0][0]
    frame = LocalFrame(float(places.lat_rad[first]), float(places.lon_rad[first]), 0.0)
    left_m, right_m = (
        frame.enu_from_geodetic(places.lat_rad[r], places.lon_rad[r], np.zeros(len(r)))[:, :2] for r in rows
    )
    left_ahead, right_ahead = directions(left_m, right_m)
    return LaneletBorders(relation, (ways[0], left_ahead), (ways[1], right_ahead), left_m, right_m)


def directions(left_m: F64, right_m: F64) -> tuple[bool, bool]:
    """Whether the vertices of borders (N, 2) and (M, 2) come in the direction of their lane.

    The borders run side by side when their ends are nearer to each other than crosswise; the lane's direction is the
    one in which the area between them, from the left border round to the right, is turned to the right.
    """
    along = np.linalg.norm(left_m[0] - right_m[0]) + np.linalg.norm(left_m[-1] - right_m[-1])
    across = np.linalg.norm(left_m[0] - right_m[-1]) + np.linalg.norm(left_m[-1] - right_m[0])
    same = bool(along <= across)
    ring = np.concatenate([left_m, (right_m if same else right_m[::-1])[::-1]])
    x, y = (ring - ring[0]).T
    ahead = bool(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) <= 0.0)
    return ahead, ahead == same


def check_lanelets(document: OsmDocument, borders: Iterable[LaneletBorders], findings: Findings) -> None:
    """A finding for each lanelet whose borders cross each other."""
    for lane in borders:
        met = crossing_of(lane.left_m, lane.right_m)
        if met is not None:
            findings.add(
                f"{document.where}, line {lane.relation.line}: the borders of lanelet {lane.relation.id} cross each "
                f"other (segment {met[0] + 1} of {len(lane.left_m) - 1} on the left, {met[1] + 1} of "
                f"{len(lane.right_m) - 1} on the right)"
            )


def _lanes(borders: Iterable[LaneletBorders], feature_of_way: Mapping[int, int]) -> tuple[MapLane, ...]:
    """The lanelets whose borders are features; the one that begins with both last nodes of another follows it."""
    known = [one for one in borders if one.left[0].id in feature_of_way and one.right[0].id in feature_of_way]
    starts: dict[tuple[int, int], list[str]] = defaultdict(list)
    for one in known:
        starts[_ends(one, 0)].append(str(one.relation.id))
    return tuple(
        MapLane(
            str(one.relation.id),
            Border(feature_of_way[one.left[0].id], one.left[1]),
            Border(feature_of_way[one.right[0].id], one.right[1]),
            tuple(starts[_ends(one, -1)]) if _ends(one, -1) in starts else (),
            tuple(sorted(one.relation.tags.items())),
        )
        for one in known
    )


def _ends(lane: LaneletBorders, which: int) -> tuple[int, int]:
    """The nodes that both borders begin (0) or end (-1) with."""
    left, right = (way.nodes[which if ahead else -1 - which] for way, ahead in (lane.left, lane.right))
    return left, right
