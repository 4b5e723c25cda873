"""Features back into the OpenDRIVE file that they came from.

The file is edited: its roads, junctions and all that is no feature stay byte by byte. Signals and objects that have
moved get a new place on their road, those that are gone are taken out, new ones stand at the nearest road. The road
network itself is not changed by features: a border that has moved is counted, not written.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from gnd.gnd_map.arrays import F64
from gnd.tile_store.feature_io.lanelet2_export import KEEP_WITHIN_M, Changes, apart_m
from gnd.tile_store.feature_io.opendrive_import import XodrFile, drawn_things, read_xodr
from gnd.tile_store.feature_io.osm_edit import Edits
from gnd.tile_store.feature_io.values import ImportOptions, MapFeature
from gnd.tile_store.feature_io.xml_spans import Element, escaped, tag_of, with_attributes
from gnd.tile_store.feature_io.xodr_road import Road
from gnd.tile_store.feature_io.xodr_things import Thing

_SIGNALS: Final = {"traffic_sign": "no", "traffic_light": "yes"}
"""Kinds that are signals, and whether these are dynamic."""
_OBJECTS: Final = {
    "streetlight": {"type": "pole", "subtype": "streetLamp"},
    "stop_line": {"type": "roadMark", "subtype": "stopLine"},
}
_LIE: Final = ("stop_line", "crosswalk")
_STEP_M: Final = 2.0
_STRAIGHT: Final = 1e-9


def write_opendrive(
    features: Iterable[MapFeature], document: bytes, source: str, options: ImportOptions
) -> tuple[bytes, Changes]:
    """The file with the features as they are now, and what that changed.

    Args:
        features: as they are now: all of the file's that are left, and new ones.
        document: the file that they came from.
        source: under which name it was imported.
        options: how it was read.

    Raises:
        FeatureFileError: the document cannot be read.
    """
    file = read_xodr(document, source, options)
    editing = _XodrEditing(file, document, options)
    now = {feature.feature_id: feature for feature in features}
    for road in file.roads.values():
        for thing, was in drawn_things(file, road, source, options):
            if was is not None:
                editing.update(road, thing, was, now.pop(was.feature_id, None))
    for feature in sorted(now.values(), key=lambda one: one.feature_id):
        editing.add(feature)
    return editing.finish()


class _XodrEditing:
    """Collects the changes of one file."""

    def __init__(self, file: XodrFile, data: bytes, options: ImportOptions) -> None:
        self._file, self._data, self._options = file, data, options
        self._edits = Edits()
        self._counts: dict[str, int] = defaultdict(int)
        self._new: dict[tuple[str, str], list[bytes]] = defaultdict(list)
        self._nearest: tuple[cKDTree, list[str]] | None = None

    def update(self, road: Road, thing: Thing, was: MapFeature, now: MapFeature | None) -> None:
        """A signal, object or border whose feature is as it is now, or gone (None)."""
        element = thing.element
        if now is None:
            if element is None:
                self._counts["unwritten"] += 1
            else:
                self._counts["removed"] += 1
                self._edits.replace(element.start, element.end, b"")
            return
        before, after = dict(was.attributes), dict(now.attributes)
        tags = {key: value for key, value in after.items() if before.get(key) != value}
        self._counts["unwritten"] += not before.keys() <= after.keys()
        moved = self._step_m(was, now)
        if element is None or moved is None or (element.name == "signal" and len(was) > 1 and moved.any()):
            self._counts["unwritten"] += bool(tags) or moved is None or bool(moved.any())
            return
        self._counts["moved"] += bool(moved.any())
        self._counts["retagged"] += bool(tags)
        if moved.any():
            self._move(road, thing, element, moved, tags)
        elif tags:
            self._retag(element, tags)

    def _step_m(self, was: MapFeature, now: MapFeature) -> F64 | None:
        """(3,) how a feature has moved in the file's coordinates, zeros for not at all; None: it has another shape."""
        if len(was) != len(now):
            return None
        if all(apart_m(a, b) <= KEEP_WITHIN_M for a, b in zip(_line(was), _line(now), strict=True)):
            return np.zeros(3)
        steps = self._file_m(now) - self._file_m(was)
        if np.abs(steps - steps.mean(axis=0)).max() > KEEP_WITHIN_M:
            return None
        return np.asarray(steps.mean(axis=0))

    def _file_m(self, feature: MapFeature) -> F64:
        """(N, 3) vertices in the file's coordinates."""
        height_m = feature.height_m - self._options.height_offset_m
        return self._file.georeference.from_earth(feature.lat_rad, feature.lon_rad, height_m)

    def _move(self, road: Road, thing: Thing, element: Element, step_m: F64, tags: Mapping[str, str]) -> None:
        inertial, other = element.find("positionInertial"), element.find("positionRoad")
        place_m = thing.points_m[0] + step_m
        if inertial is not None:
            self._retag(inertial, {key: _metres(v) for key, v in zip("xyz", place_m, strict=True)})
        elif other is not None:
            self._retag(other, _placed(self._file.roads[other.attributes["roadId"]].place_of(place_m)))
        else:
            own = {key: float(element.attributes.get(key, 0.0)) for key in ("s", "t", "zOffset")}
            origin_m = road.points_m(np.array([own["s"]]), np.array([own["t"]]), own["zOffset"])[0]
            place = road.place_of(origin_m + step_m)
            tags = dict(tags) | _placed(place)
            turn = road.heading_rad(own["s"]) - road.heading_rad(place[0])
            if len(thing.points_m) > 1 and abs(turn) > _STRAIGHT:  # what lies there keeps its direction in a bend
                tags["hdg"] = f"{float(element.attributes.get('hdg', 0.0)) + turn:.9f}"
            self._move_corners(road, element, step_m)
        if tags:
            self._retag(element, tags)

    def _move_corners(self, road: Road, element: Element, step_m: F64) -> None:
        """Corners that are given on the road do not move with the object."""
        for outline in (element.find("outlines") or element).all("outline"):
            for corner in outline.all("cornerRoad"):
                own = {key: float(corner.attributes.get(key, 0.0)) for key in ("s", "t", "dz")}
                corner_m = road.points_m(np.array([own["s"]]), np.array([own["t"]]), own["dz"])[0]
                values = map(_metres, road.place_of(corner_m + step_m))
                self._retag(corner, dict(zip(("s", "t", "dz"), values, strict=True)))

    def _retag(self, element: Element, values: Mapping[str, str]) -> None:
        tag = tag_of(self._data, element)
        self._edits.replace(element.start, element.start + len(tag), with_attributes(tag, values))

    def add(self, feature: MapFeature) -> None:
        """A feature that the file has not, at the road nearest to it."""
        points_m = self._file_m(feature)
        if not self._file.roads or (len(feature) > 1 and feature.kind not in _LIE):
            self._counts["unwritten"] += 1
            return
        road = self._road_near(points_m.mean(axis=0))
        self._counts["added"] += 1
        own = dict(feature.attributes)
        attributes = {"id": f"gnd{feature.feature_id}", **_placed(road.place_of(points_m[0]))}
        if feature.kind in _SIGNALS:
            attributes |= {"dynamic": _SIGNALS[feature.kind], "orientation": "none"}
            attributes |= {key: own.get(key, "-1") for key in ("type", "subtype", "country")}
            self._new[(road.id, "signals")].append(b"<signal%s/>" % _attributes(attributes))
            return
        attributes |= {"name": feature.kind} | _OBJECTS.get(feature.kind, {"type": feature.kind})
        corners = b"" if len(feature) == 1 else _outline(road, points_m)
        self._new[(road.id, "objects")].append(b"<object%s>%s</object>" % (_attributes(attributes), corners))

    def _road_near(self, point_m: F64) -> Road:
        if self._nearest is None:
            places, ids = [], []
            for road in self._file.roads.values():
                s = np.linspace(0.0, road.length_m, max(2, int(road.length_m / _STEP_M) + 1))
                places.append(np.column_stack(road.plan.at(s)[:2]))
                ids += [road.id] * len(s)
            self._nearest = cKDTree(np.concatenate(places)), ids
        tree, ids = self._nearest
        return self._file.roads[ids[int(tree.query(point_m[:2])[1])]]

    def finish(self) -> tuple[bytes, Changes]:
        """The file's new bytes."""
        for (road_id, name), lines in sorted(self._new.items()):  # objects come before signals
            self._append(self._file.roads[road_id].element, name, b"".join(b"\n" + line for line in lines))
        n = self._counts
        changes = Changes(n["moved"], n["retagged"], n["removed"], n["added"], unwritten=n["unwritten"])
        return self._edits.applied(self._data), changes

    def _append(self, road: Element, name: str, lines: bytes) -> None:
        """Elements at the end of a road's <objects> or <signals>, which are made when missing."""
        parent = road.find(name)
        if parent is None:
            before = ("planView", "lanes", "objects") if name == "signals" else ("planView", "lanes")
            after = [found for one in before if (found := road.find(one)) is not None][-1]
            whole = b"\n<%s>%s\n</%s>" % (name.encode(), lines, name.encode())
            self._edits.replace(after.end, after.end, whole)
        elif self._data[parent.end - 2 : parent.end] == b"/>":
            self._edits.replace(parent.start, parent.end, b"<%s>%s\n</%s>" % (name.encode(), lines, name.encode()))
        else:
            at = self._data.rindex(b"</", parent.start, parent.end)
            self._edits.replace(at, at, lines + b"\n")


def _line(feature: MapFeature) -> F64:
    return np.column_stack([feature.lat_rad, feature.lon_rad, feature.height_m])


def _metres(value: float) -> str:
    return f"{value:.4f}"


def _placed(place: tuple[float, float, float]) -> dict[str, str]:
    return {key: _metres(value) for key, value in zip(("s", "t", "zOffset"), place, strict=True)}


def _attributes(values: Mapping[str, str]) -> bytes:
    return b"".join(b' %s="%s"' % (key.encode(), escaped(value)) for key, value in values.items())


def _outline(road: Road, points_m: F64) -> bytes:
    """Corners of an outline on the road; the last vertex of a closed one is its first."""
    closed = len(points_m) > 2 and np.abs(points_m[0] - points_m[-1]).max() <= KEEP_WITHIN_M
    corners = []
    for number, point in enumerate(points_m[:-1] if closed else points_m):
        s, t, dz = road.place_of(point)
        values = {"id": str(number), "s": _metres(s), "t": _metres(t), "dz": _metres(dz), "height": "0"}
        corners.append(b"<cornerRoad%s/>" % _attributes(values))
    return b"<outline>" + b"".join(corners) + b"</outline>"
