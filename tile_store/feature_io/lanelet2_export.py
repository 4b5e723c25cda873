"""Features as a Lanelet2 map: into the file that they came from, or as a new one.

The file is edited, not written anew: an element is touched only when its feature has moved, changed its attributes or
gone, and what is no feature (lanelets, regulatory elements, unknown tags, comments, their order) stays byte by byte.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import meridian_radius_m, normal_radius_m
from gnd.tile_store.feature_io.errors import FeatureFileError
from gnd.tile_store.feature_io.lane_network import MapLane
from gnd.tile_store.feature_io.lanelet2_import import DrawnLane, drawn_features
from gnd.tile_store.feature_io.lanelet2_lanes import JoinedEnds, joined_ends, line_tags
from gnd.tile_store.feature_io.lanelet2_places import NodePlaces, places_of
from gnd.tile_store.feature_io.osm_document import MAX_ID, OsmDocument, OsmNode, OsmWay, read_osm
from gnd.tile_store.feature_io.osm_edit import (
    Edits,
    degrees,
    line_of,
    metres,
    node_lines,
    relation_lines,
    way_lines,
    with_nodes,
    with_values,
    without_members,
)
from gnd.tile_store.feature_io.osm_kinds import POINT_KINDS, kind_of
from gnd.tile_store.feature_io.values import ImportOptions, MapFeature

EMPTY: Final = b"""<?xml version="1.0" encoding="UTF-8"?>
<osm version="0.6" generator="gnd">
</osm>
"""
KEEP_WITHIN_M: Final = 0.002
"""Published positions are whole millimetres; a vertex that lies so near is where it was."""


@dataclass(frozen=True, slots=True)
class Changes:
    """What an export changed in the file.

    Attributes:
        moved: elements that lie elsewhere.
        retagged: elements with other attributes or tags.
        removed: elements that are gone.
        added: features that are new.
        lanelets: added with the lines between which they run.
        joined_m: the farthest that an end of a border was moved to meet the next one.
        apart: successors of lanes whose borders end too far from each other to be joined.
        unbounded: lanes that were left out because a border of theirs is not among the features.
        unwritten: features that have changed in a way that the format cannot say, so that they are as they were.
    """

    moved: int
    retagged: int
    removed: int
    added: int
    lanelets: int = 0
    joined_m: float = 0.0
    apart: int = 0
    unbounded: int = 0
    unwritten: int = 0


def write_lanelet2(
    features: Iterable[MapFeature],
    document: bytes = EMPTY,
    source: str = "",
    options: ImportOptions | None = None,
    *,
    keep_within_m: float = KEEP_WITHIN_M,
    lanes: Iterable[MapLane] = (),
) -> tuple[bytes, Changes]:
    """The file with the features as they are now, and what that changed.

    Args:
        features: as they are now: of the file's own layers all that are left, and new ones.
        document: the file that they came from; `EMPTY` for a new one.
        source: under which name it was imported.
        options: how it was read.
        keep_within_m: vertices that have moved less keep the bytes of their position; negative: all are written anew.
        lanes: to be added as lanelets, between borders that are new to the document.

    Raises:
        FeatureFileError: the document cannot be read.
    """
    options = options or ImportOptions(trust_latlon=True)
    read = read_osm(document, source or "new map")
    drawn = {one.feature.feature_id: one for one in drawn_features(read, source, options)[0]}
    editing = _Editing(read, places_of(read, options), options, keep_within_m)
    now = {feature.feature_id: feature for feature in features}
    for feature_id, one in drawn.items():
        if feature_id in now:
            editing.update(one, now[feature_id])
        else:
            editing.remove(one)
    new = {feature_id: now[feature_id] for feature_id in sorted(now.keys() - drawn.keys())}
    editing.add(new, lanes)
    return editing.finish()


class _Editing:
    """Collects what becomes of nodes and ways, then writes it."""

    def __init__(self, document: OsmDocument, places: NodePlaces, options: ImportOptions, keep_within_m: float) -> None:
        self._document, self._places, self._options, self._keep_within_m = document, places, options, keep_within_m
        self._moved: dict[int, list[F64]] = defaultdict(list)
        self._tags: dict[tuple[str, int], dict[str, str | None]] = {}
        self._refs: dict[int, list[int]] = {}
        self._gone: set[tuple[str, int]] = set()
        self._new_nodes: list[bytes] = []
        self._new_ways: list[bytes] = []
        self._new_relations: list[bytes] = []
        self._apart = self._unbounded = 0
        self._joined_m = 0.0
        self._next_id = document.highest_id + 1
        self._added = 0
        self._in_ways = {ref for way in document.ways.values() for ref in way.nodes}
        self._nodes = list(document.nodes.values())

    def update(self, drawn: DrawnLane, feature: MapFeature) -> None:
        """An element's feature as it is now."""
        tags = _changed_tags(drawn.feature.attributes, feature.attributes)
        if tags:
            self._tags[(_name(drawn.element), drawn.element.id)] = tags
        new, old = _line(feature), _line(drawn.feature)
        if drawn.feature.kind in POINT_KINDS:
            rows = self._places.rows(list(drawn.nodes))
            own = np.column_stack([self._places.lat_rad, self._places.lon_rad, self._places.height_m])[rows]
            self._move(drawn.nodes, own + (new.mean(axis=0) - old[0]), own)
        elif len(new) == len(old):
            self._move(drawn.nodes, new, old)
        else:
            assert isinstance(drawn.element, OsmWay)
            self._redraw(drawn.element, new, old)

    def _move(self, nodes: tuple[OsmNode, ...], new: F64, old: F64) -> None:
        for node, place, was in zip(nodes, new, old, strict=True):
            if apart_m(place, was) > self._keep_within_m:
                self._moved[node.id].append(place)

    def _redraw(self, way: OsmWay, new: F64, old: F64) -> None:
        """A line with other vertices: nodes that are where one was are kept, the others are new."""
        refs = []
        for place in new:
            apart = [apart_m(place, was) for was in old]
            nearest = int(np.argmin(apart))
            refs.append(way.nodes[nearest] if apart[nearest] <= KEEP_WITHIN_M else self._node(place, {}))
        self._refs[way.id] = refs

    def remove(self, drawn: DrawnLane) -> None:
        """An element whose feature is gone; a node that is part of a line only loses its tags."""
        key = _name(drawn.element), drawn.element.id
        if key[0] == "node" and key[1] in self._in_ways:
            self._tags[key] = {name: None for name, _ in drawn.feature.attributes}
        else:
            self._gone.add(key)

    def add(self, features: Mapping[int, MapFeature], lanes: Iterable[MapLane]) -> None:
        """Features that the file has not, by id, and lanelets between them."""
        lanes = list(lanes)
        bounded = [
            lane for lane in lanes if {lane.left.feature_id, lane.right.feature_id} <= features.keys()
        ]  # the others have lost a border
        ends = joined_ends(bounded, {feature_id: _line(one) for feature_id, one in features.items()})
        shared = {number: self._node(place, {}) for number, place in ends.place.items()}
        ways = {one: self._add(feature, ends, shared) for one, feature in features.items()}
        for lane in bounded:
            members = (("way", ways[lane.left.feature_id], "left"), ("way", ways[lane.right.feature_id], "right"))
            tags = {"type": "lanelet"} | dict(lane.tags)
            self._new_relations.append(relation_lines(self._new_id(), members, tags))
        self._apart, self._unbounded, self._joined_m = len(ends.apart), len(lanes) - len(bounded), ends.moved_m

    def _add(self, feature: MapFeature, ends: JoinedEnds, shared: Mapping[int, int]) -> int:
        """The id of the new element; ends of borders that meet are one node."""
        self._added += 1
        if len(feature) == 1:
            return self._node(_line(feature)[0], _tags_of(feature))
        line, last = _line(feature), len(feature) - 1
        group = {0: ends.group.get((feature.feature_id, 0)), last: ends.group.get((feature.feature_id, -1))}
        refs = []
        for row, place in enumerate(line):
            number = group.get(row)
            refs.append(self._node(place, {}) if number is None else shared[number])
        way_id = self._new_id()
        self._new_ways.append(way_lines(way_id, refs, _tags_of(feature)))
        return way_id

    def _new_id(self) -> int:
        self._next_id += 1
        if self._next_id > MAX_ID:
            raise FeatureFileError(f"{self._document.where}: its ids leave none for new elements below 2^63")
        return self._next_id - 1

    def _node(self, place: F64, tags: Mapping[str, str]) -> int:
        node_id = self._new_id()
        lat_deg, lon_deg, told = self._told(place)
        self._new_nodes.append(node_lines(node_id, lat_deg, lon_deg, told | dict(tags)))
        return node_id

    def _told(self, place: F64) -> tuple[float, float, dict[str, str]]:
        """Degrees and tags of a new node."""
        height_m = place[2] - self._options.height_offset_m
        if self._options.placement is None:
            return *np.degrees(place[:2]).tolist(), {"ele": metres(height_m)}
        local = self._options.placement.local(place[:1], place[1:2], np.array([height_m]))[0]
        assert self._places.local_m is not None
        near = int(np.linalg.norm(self._places.local_m[:, :2] - local[:2], axis=1).argmin())
        lat_deg, lon_deg = _shifted(self._nodes[near], local - self._places.local_m[near])
        return lat_deg, lon_deg, {"local_x": metres(local[0]), "local_y": metres(local[1]), "ele": metres(local[2])}

    def finish(self) -> tuple[bytes, Changes]:
        """The file's new bytes."""
        edits, data = Edits(), self._document.data
        removed = self._write_removed(edits)
        values = self._values()
        for (name, id_), (attributes, tags) in values.items():
            element = self._document.nodes[id_] if name == "node" else self._document.ways[id_]
            edits.replace(element.start, element.end, self._rewritten(data, element, attributes, tags))
        if self._new_nodes:
            edits.replace(self._document.end_of_nodes, self._document.end_of_nodes, b"".join(self._new_nodes))
        for new in (self._new_ways, self._new_relations):
            if new:
                edits.replace(self._document.end_of_ways, self._document.end_of_ways, b"".join(new))
        moved = len(self._moved) + len(self._refs)
        return edits.applied(data), Changes(
            moved, len(self._tags), removed, self._added,
            len(self._new_relations), round(self._joined_m, 4), self._apart, self._unbounded,
        )  # fmt: skip

    def _values(self) -> dict[tuple[str, int], tuple[dict[str, str], dict[str, str | None]]]:
        """Attributes and tags to write, by element."""
        values: dict[tuple[str, int], tuple[dict[str, str], dict[str, str | None]]] = {}
        moved = {node_id: np.mean(places, axis=0) for node_id, places in self._moved.items()}
        told = self._positions([self._document.nodes[node_id] for node_id in moved], np.array([*moved.values()]))
        values.update({("node", node_id): one for node_id, one in zip(moved, told, strict=True)})
        for key, tags in self._tags.items():
            attributes, others = values.get(key, ({}, {}))
            values[key] = (attributes, others | tags)
        for way_id in self._refs:
            values.setdefault(("way", way_id), ({}, {}))
        return values

    def _rewritten(
        self, data: bytes, element: OsmNode | OsmWay, attributes: dict[str, str], tags: dict[str, str | None]
    ) -> bytes:
        refs = self._refs.get(element.id) if isinstance(element, OsmWay) else None
        if refs is None:
            return with_values(data, element, attributes, tags)
        raw = with_nodes(data, element, refs)
        return with_values(raw, OsmWay(element.id, 0, len(raw), element.line, element.tags, ()), attributes, tags)

    def _positions(self, nodes: list[OsmNode], places: F64) -> list[tuple[dict[str, str], dict[str, str | None]]]:
        """Attributes and tags of nodes that have moved to places (N, 3)."""
        if not nodes:
            return []
        height_m = places[:, 2] - self._options.height_offset_m
        if self._options.placement is None:
            return [
                _global(node, *row) for node, row in zip(nodes, np.column_stack([places[:, :2], height_m]), strict=True)
            ]
        assert self._places.local_m is not None
        was = self._places.local_m[self._places.rows(nodes)]
        local_m = self._options.placement.local(places[:, 0], places[:, 1], height_m)
        return [_local(node, new, old) for node, new, old in zip(nodes, local_m, was, strict=True)]

    def _write_removed(self, edits: Edits) -> int:
        """Take elements out, with lanelets that lose a border and every mention of either."""
        gone, document = self._gone, self._document
        grown = True
        while grown:
            orphans = {
                ("relation", one.id)
                for one in document.relations.values()
                if one.tags.get("type") == "lanelet"
                and any((type_, ref) in gone and role in ("left", "right") for type_, ref, role in one.members)
            }
            grown = not orphans <= gone
            gone |= orphans
        gone |= self._orphaned_nodes(gone)
        for name, table in (("node", document.nodes), ("way", document.ways), ("relation", document.relations)):
            for id_ in (id_ for what, id_ in gone if what == name):
                edits.replace(*line_of(document.data, table[id_]), b"")
        for relation in document.relations.values():
            if ("relation", relation.id) not in gone and any((t, ref) in gone for t, ref, _ in relation.members):
                edits.replace(relation.start, relation.end, without_members(document.data, relation, gone))
        return len(gone)

    def _orphaned_nodes(self, gone: set[tuple[str, int]]) -> set[tuple[str, int]]:
        """Nodes that only ways used which are gone."""
        ways = self._document.ways.values()
        used = {ref for way in ways if ("way", way.id) not in gone for ref in self._refs.get(way.id, way.nodes)}
        mentioned = {ref for one in self._document.relations.values() for t, ref, _ in one.members if t == "node"}
        left = {ref for way in ways if ("way", way.id) in gone or way.id in self._refs for ref in way.nodes}
        orphans = left - used - mentioned
        for node_id in orphans:
            self._moved.pop(node_id, None)
        return {("node", ref) for ref in orphans}


def _global(node: OsmNode, lat: float, lon: float, height_m: float) -> tuple[dict[str, str], dict[str, str | None]]:
    attributes = {"lat": degrees(float(np.degrees(lat))), "lon": degrees(float(np.degrees(lon)))}
    tell = "ele" in node.tags or abs(height_m) > KEEP_WITHIN_M
    return attributes, {"ele": metres(height_m)} if tell else {}


def _local(node: OsmNode, local_m: F64, was_m: F64) -> tuple[dict[str, str], dict[str, str | None]]:
    lat_deg, lon_deg = _shifted(node, local_m - was_m)
    tags: dict[str, str | None] = {"local_x": metres(local_m[0]), "local_y": metres(local_m[1])}
    return {k: degrees(v) for k, v in (("lat", lat_deg), ("lon", lon_deg)) if not np.isnan(v)}, tags | (
        {"ele": metres(local_m[2])} if "ele" in node.tags else {}
    )


def _name(element: OsmNode | OsmWay) -> str:
    return "way" if isinstance(element, OsmWay) else "node"


def _tags_of(feature: MapFeature) -> dict[str, str]:
    """Tags of a new element: what it is, read back as the same kind; what they would hide keeps another name."""
    told = dict(feature.attributes)
    if feature.kind == "lane_boundary":
        return line_tags(told)
    if kind_of(told) == feature.kind:
        return told
    hidden = {f"source_{key}": told.pop(key) for key in ("type", "subtype") if key in told}
    return {"type": feature.kind} | told | hidden


def _line(feature: MapFeature) -> F64:
    """(N, 3) latitude, longitude, height."""
    return np.column_stack([feature.lat_rad, feature.lon_rad, feature.height_m])


def apart_m(a: F64, b: F64) -> float:
    """Distance of two near positions: latitude, longitude (radians), height."""
    lat = float(a[0])
    north, east = meridian_radius_m(lat) * (a[0] - b[0]), normal_radius_m(lat) * np.cos(lat) * (a[1] - b[1])
    return float(np.sqrt(north**2 + east**2 + (a[2] - b[2]) ** 2))


def _shifted(node: OsmNode, step_m: F64) -> tuple[float, float]:
    """A placeholder's degrees, moved as far as its local coordinates are (x east, y north); NaN stays."""
    lat = np.radians(node.lat_deg)
    north, east = step_m[1] / meridian_radius_m(lat), step_m[0] / (normal_radius_m(lat) * np.cos(lat))
    return node.lat_deg + float(np.degrees(north)), node.lon_deg + float(np.degrees(east))


def _changed_tags(old: tuple[tuple[str, str], ...], new: tuple[tuple[str, str], ...]) -> dict[str, str | None]:
    before, after = dict(old), dict(new)
    changed: dict[str, str | None] = {key: value for key, value in after.items() if before.get(key) != value}
    return changed | {key: None for key in before if key not in after}
