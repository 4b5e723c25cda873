"""The lanelets of a document: their borders in one direction and on one scale, what crosses, and which follow."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.tile_store.feature_io.errors import BadGeometry
from gnd.tile_store.feature_io.lane_crossing import crossing_of
from gnd.tile_store.feature_io.lane_network import Border, MapLane
from gnd.tile_store.feature_io.lanelet2_places import NodePlaces
from gnd.tile_store.feature_io.osm_document import OsmDocument, OsmRelation, OsmWay
from gnd.tile_store.feature_io.values import MapFindings, check_vertices


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


def check_lanelets(document: OsmDocument, borders: Iterable[LaneletBorders], findings: MapFindings) -> None:
    """A finding for each lanelet whose borders cross each other."""
    for lane in borders:
        met = crossing_of(lane.left_m, lane.right_m)
        if met is not None:
            findings.add(
                f"{document.where}, line {lane.relation.line}: the borders of lanelet {lane.relation.id} cross each "
                f"other (segment {met[0] + 1} of {len(lane.left_m) - 1} on the left, {met[1] + 1} of "
                f"{len(lane.right_m) - 1} on the right)"
            )


def lanes_of_lanelets(borders: Iterable[LaneletBorders], feature_of_way: Mapping[int, int]) -> tuple[MapLane, ...]:
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
