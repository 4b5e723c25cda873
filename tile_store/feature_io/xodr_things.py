"""Signals and objects of OpenDRIVE roads: what they are, and where they stand or lie.

Street lamps, crosswalks and stop lines have no one way of being written: by type, by subtype, or by name alone, and
stop lines and crosswalks also as signals with the numbers of German road marks (294, 293). All of these are read.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features.feature import KIND_PATTERN
from gnd.tile_store.feature_io.errors import BadElement, DuplicateId, FileTooLarge
from gnd.tile_store.feature_io.xml_spans import Element
from gnd.tile_store.feature_io.xodr_road import Road, value

MAX_REPEATS: Final = 100_000
_PLACE: Final = frozenset({"s", "t", "zOffset", "id"})
_NAMED: Final = (
    (re.compile(r"stop_?line|halte?linie"), "stop_line"),
    (re.compile(r"cross_?walk|zebra|pedestrian_?crossing|fu(ß|ss)g(ä|ae)nger(ü|ue)berweg"), "crosswalk"),
    (
        re.compile(
            r"(^|_|street|road)lamp|(street|road|pole)_?light|light_?(pole|post|mast)|^lights?(_?\d+)?$|lantern|luminaire"
            r"|laterne|leuchte"
        ),
        "streetlight",
    ),
)
"""Words in type, subtype and name that say what an object is, whatever its type."""
_TRAFFIC: Final = re.compile(r"traffic|signal")
_MARKS: Final = {"294": "stop_line", "293": "crosswalk"}
_MARK_COUNTRIES: Final = frozenset({"", "-1", "DE", "DEU", "OPENDRIVE"})


@dataclass(frozen=True, slots=True, eq=False)
class Thing:
    """What a road has.

    Attributes:
        kind: of feature.
        key: what makes its id.
        points_m: (N, 3) in the file's coordinates.
        attributes: the element's own, without those of its place.
        element: the element that it alone is drawn by; None: one of several copies, or part of the road.
    """

    kind: str
    key: tuple[str | int, ...]
    points_m: F64
    attributes: dict[str, str]
    element: Element | None = None


def things_of(road: Road, roads: Mapping[str, Road]) -> Iterator[Thing]:
    """The signals and objects of a road; DuplicateId when an id comes twice."""
    for things in (_signals(road, roads), _objects(road)):
        seen = set()
        for thing in things:
            if thing.key in seen:
                raise DuplicateId(f"{road.where}: {' '.join(map(str, thing.key))} comes twice")
            seen.add(thing.key)
            yield thing


def _signals(road: Road, roads: Mapping[str, Road]) -> Iterator[Thing]:
    parent = road.element.find("signals")
    for signal in parent.all("signal") if parent else ():
        key, attributes = ("signal", _id(road, signal)), _attributes(signal)
        mark = (
            _MARKS.get(attributes.get("type", "")) if attributes.get("country", "").upper() in _MARK_COUNTRIES else None
        )
        if mark == "stop_line":
            yield Thing(mark, key, _across_m(road, signal), attributes, signal)
        else:
            kind = mark or ("traffic_light" if attributes.get("dynamic") == "yes" else "traffic_sign")
            yield Thing(kind, key, _signal_m(road, roads, signal), attributes, signal)


def _signal_m(road: Road, roads: Mapping[str, Road], signal: Element) -> F64:
    """(1, 3): where the signal stands, which may be elsewhere than where it holds."""
    inertial, other = signal.find("positionInertial"), signal.find("positionRoad")
    if inertial is not None:
        return np.array([[value(road.where, inertial, key) for key in "xyz"]])
    if other is not None:
        road_id = other.attributes.get("roadId", "")
        if road_id not in roads:
            raise BadElement(
                f"{road.where}, line {other.line}: stands at road {road_id!r:.40}, which is not in the file"
            )
        return _place_m(roads[road_id], other)
    return _place_m(road, signal)


def _across_m(road: Road, signal: Element) -> F64:
    """(2, 3) a stop line that is written as a signal: across the lanes that it holds for."""
    s = value(road.where, signal, "s")
    _place_m(road, signal)  # it is on its road
    validity = signal.find("validity")
    if validity is not None:
        ids = sorted(int(value(road.where, validity, key)) for key in ("fromLane", "toLane"))
        inner = [id_ for id_ in ids if id_]
        if inner:
            ends = [ids[0] if ids[0] < 0 else ids[0] - 1, ids[1] if ids[1] > 0 else ids[1] + 1]
            return _line_m(road, s, *(road.lane_t_m(s, id_) for id_ in ends))
    t, half = value(road.where, signal, "t"), value(road.where, signal, "width", 0.0) / 2.0
    if half > 0.0:
        return _line_m(road, s, t - half, t + half)
    return _line_m(road, s, *_driven_t_m(road, s, signal.attributes.get("orientation", "none")))


def _driven_t_m(road: Road, s_m: float, orientation: str) -> tuple[float, float]:
    """Lateral ends of the lanes that are driven in a direction: "+" along s, "-" against it."""
    section = next((one for one in reversed(road.sections) if one.start_m <= s_m), None)
    lanes = [id_ for id_, lane in section.lanes.items() if id_ and lane.type == "driving"] if section else []
    side = {"+": -1, "-": 1}.get(orientation)
    chosen = [id_ for id_ in lanes if side is None or id_ * side > 0]
    t = [road.lane_t_m(s_m, id_) for one in chosen for id_ in (one, one - (1 if one > 0 else -1))]
    return (min(t), max(t)) if t else (0.0, 0.0)


def _line_m(road: Road, s_m: float, t_from_m: float, t_to_m: float) -> F64:
    """(2, 3) across the road; (1, 3) where there is nothing to cross."""
    ends = np.array([t_from_m, t_to_m] if t_from_m != t_to_m else [t_from_m])
    return road.points_m(np.full(len(ends), s_m), ends)


def _place_m(road: Road, element: Element, s_m: float | None = None, t_m: float | None = None) -> F64:
    s = value(road.where, element, "s") if s_m is None else s_m
    t = value(road.where, element, "t") if t_m is None else t_m
    if not -1e-6 <= s <= road.length_m + 1e-6:
        raise BadElement(f"{road.where}, line {element.line}: s {s} m is not on its road of {road.length_m} m")
    return road.points_m(np.array([s]), np.array([t]), value(road.where, element, "zOffset", 0.0))


def _objects(road: Road) -> Iterator[Thing]:
    parent = road.element.find("objects")
    for element in parent.all("object") if parent else ():
        kind, name = object_kind(element), _id(road, element)
        repeats = [one for one in element.all("repeat") if value(road.where, one, "distance") > 0]
        if not repeats:
            lies = kind in ("crosswalk", "stop_line")
            points_m = _shape_m(road, element, kind) if lies else _place_m(road, element)
            yield Thing(kind, ("object", name), points_m, _attributes(element), element)
        for number, repeat in enumerate(repeats):
            for k, (s, t) in enumerate(_repeated(road, repeat)):
                yield Thing(kind, ("object", name, number, k), _place_m(road, element, s, t), _attributes(element))


def object_kind(element: Element) -> str:
    """What an object is: by its type, or by words of its subtype or name."""
    words = [_snake(element.attributes.get(key, "")) for key in ("type", "subtype", "name")]
    for pattern, kind in _NAMED:
        if any(pattern.search(word) and not _TRAFFIC.search(word) for word in words):
            return kind
    return words[0] if KIND_PATTERN.fullmatch(words[0]) else "unknown"


def _snake(text: str) -> str:
    return re.sub(r"[\s\-]+", "_", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", text)).lower()


def _shape_m(road: Road, element: Element, kind: str) -> F64:
    """(N, 3) the closed outline of a crosswalk, the middle line of a stop line; (1, 3) of one without extent."""
    origin = _place_m(road, element)
    ring = _outline_m(road, element, origin)
    if ring is None:
        return origin
    if kind == "crosswalk":
        return ring
    return _long_axis_m(ring)


def _outline_m(road: Road, element: Element, origin: F64) -> F64 | None:
    """(N, 3) the first outline, closed; from length and width where there is none."""
    parent = element.find("outlines") or element
    outline = parent.find("outline")
    if outline is not None:
        corners = [_corner(road, element, corner, origin) for corner in outline.children if corner.name in _CORNERS]
        if len(corners) >= 2:
            return np.concatenate([*corners, corners[0]])
    length, width = (value(road.where, element, key, 0.0) for key in ("length", "width"))
    if max(length, width) <= 0.0:
        return None
    u, v = np.array([-1.0, 1.0, 1.0, -1.0, -1.0]) * length / 2, np.array([-1.0, -1.0, 1.0, 1.0, -1.0]) * width / 2
    return _local_m(road, element, origin, np.column_stack([u, v, np.zeros(5)]))


_CORNERS: Final = ("cornerLocal", "cornerRoad")


def _corner(road: Road, element: Element, corner: Element, origin: F64) -> F64:
    """(1, 3) a corner of an outline."""
    if corner.name == "cornerRoad":
        s, t, dz = (value(road.where, corner, key, 0.0 if key == "dz" else None) for key in ("s", "t", "dz"))
        return road.points_m(np.array([s]), np.array([t]), dz)
    uvz = [value(road.where, corner, key, 0.0 if key == "z" else None) for key in ("u", "v", "z")]
    return _local_m(road, element, origin, np.array([uvz]))


def _local_m(road: Road, element: Element, origin: F64, uvz_m: F64) -> F64:
    """(N, 3) places of an object's own frame: turned by its heading against the road's."""
    heading = road.heading_rad(value(road.where, element, "s")) + value(road.where, element, "hdg", 0.0)
    c, s = np.cos(heading), np.sin(heading)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(origin + uvz_m @ R.T)


def _long_axis_m(ring_m: F64) -> F64:
    """(2, 3) from the middle of one short side of what a closed outline (N, 3) spans to the middle of the other."""
    corners = ring_m[:-1]
    if len(corners) == 2:
        return corners
    middle = corners.mean(axis=0)
    axis = np.linalg.svd(corners - middle, full_matrices=False)[2][0]
    reach = (corners - middle) @ axis
    return np.asarray(middle + np.outer([reach.min(), reach.max()], axis))


def _repeated(road: Road, repeat: Element) -> list[tuple[float, float]]:
    """(s, t) of every copy."""
    start, length, distance = (value(road.where, repeat, key) for key in ("s", "length", "distance"))
    ends = value(road.where, repeat, "tStart"), value(road.where, repeat, "tEnd")
    if not 0 <= length / distance <= MAX_REPEATS:
        raise FileTooLarge(
            f"{road.where}, line {repeat.line}: {length / distance:.0f} copies, the limit is {MAX_REPEATS}"
        )
    along = np.arange(0.0, length + 1e-9, distance)
    across = np.interp(along, [0.0, max(length, 1e-9)], ends)
    return list(zip((start + along).tolist(), across.tolist(), strict=True))


def _id(road: Road, element: Element) -> str:
    found = element.attributes.get("id")
    if not found:
        raise BadElement(f"{road.where}, line {element.line}: <{element.name}> without id")
    return found


def _attributes(element: Element) -> dict[str, str]:
    return {key: text for key, text in element.attributes.items() if key not in _PLACE}
