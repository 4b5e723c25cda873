"""Roads of an OpenDRIVE file: its XML as values that answer where a place (s, t, height) of the road is."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.tile_store.feature_io.errors import BadElement
from gnd.tile_store.feature_io.osm_document import number, real
from gnd.tile_store.feature_io.xml_spans import Element
from gnd.tile_store.feature_io.xodr_curves import (
    Curve,
    CurvePiece,
    HeightProfile,
    ReferenceLine,
    arc,
    line,
    param_poly3,
    poly3,
    spiral,
)

_COEFFICIENTS: Final = ("a", "b", "c", "d")
MAX_ROAD_M: Final = 1_000_000.0
_SAMPLE_M: Final = 0.5
_ROUNDS: Final = 20
"""Of stepping along the road to the foot of a perpendicular: each takes off the curvature times the distance."""


@dataclass(frozen=True, slots=True, eq=False)
class XodrLane:
    """A lane: id (left positive), type, width or border along it, its first mark, speed limit, and the lanes at its
    start and its end in s.
    """

    id: int
    type: str
    width: HeightProfile
    border: HeightProfile | None
    mark: str
    colour: str
    speed: str
    reversed: bool
    predecessors: tuple[int, ...]
    successors: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Lanes from start to end; the reference line is lane 0."""

    start_m: float
    end_m: float
    lanes: dict[int, XodrLane]

    def border_m(self, lane_id: int, s_m: F64) -> F64:
        """(N,) lateral places, from the offset reference line, of the outer border of a lane."""
        side, t = (1 if lane_id > 0 else -1), np.zeros(len(s_m))
        for id_ in range(side, lane_id + side, side) if lane_id else ():
            lane = self.lanes[id_]
            ds = s_m - self.start_m
            t = t + side * lane.width.at(ds) if lane.border is None else lane.border.at(ds)
        return t


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """A road: where its places are in the file's coordinates."""

    id: str
    where: str
    length_m: float
    plan: ReferenceLine
    elevation: HeightProfile
    superelevation: HeightProfile
    lane_offset: HeightProfile
    sections: tuple[Section, ...]
    element: Element

    def points_m(self, s_m: F64, t_m: F64, up_m: float = 0.0) -> F64:
        """(N, 3) places at distances s, t to the left and `up_m` above the surface."""
        x, y, heading = self.plan.at(s_m)
        roll = self.superelevation.at(s_m)
        across, up = t_m * np.cos(roll) - up_m * np.sin(roll), t_m * np.sin(roll) + up_m * np.cos(roll)
        z = self.elevation.at(s_m) + up
        return np.column_stack([x - across * np.sin(heading), y + across * np.cos(heading), z])

    def place_of(self, point_m: F64) -> tuple[float, float, float]:
        """s, t and height above the surface of a point (3,): the inverse of `points_m`, at the nearest place."""
        samples = np.linspace(0.0, self.length_m, max(2, int(self.length_m / _SAMPLE_M) + 2))
        x, y, _ = self.plan.at(samples)
        s = float(samples[np.hypot(x - point_m[0], y - point_m[1]).argmin()])
        for _ in range(_ROUNDS):
            off, heading = self._off(s, point_m)
            s = float(np.clip(s + off @ [np.cos(heading), np.sin(heading)], 0.0, self.length_m))
        off, heading = self._off(s, point_m)
        across, at = float(off @ [-np.sin(heading), np.cos(heading)]), np.array([s])
        up, roll = float(point_m[2] - self.elevation.at(at)[0]), float(self.superelevation.at(at)[0])
        return s, across * np.cos(roll) + up * np.sin(roll), up * np.cos(roll) - across * np.sin(roll)

    def _off(self, s_m: float, point_m: F64) -> tuple[F64, float]:
        x, y, heading = self.plan.at(np.array([s_m]))
        return np.array([point_m[0] - x[0], point_m[1] - y[0]]), float(heading[0])

    def heading_rad(self, s_m: float) -> float:
        """Direction of the reference line at a distance."""
        return float(self.plan.at(np.array([s_m]))[2][0])

    def lane_t_m(self, s_m: float, lane_id: int) -> float:
        """Lateral place of the outer border of a lane (0: of the lane reference) at a distance; of the last lane there
        is on that side when there are fewer.
        """
        section = next((one for one in reversed(self.sections) if one.start_m <= s_m), None)
        offset_m = float(self.lane_offset.at(np.array([s_m]))[0])
        if section is None:
            return offset_m
        while lane_id not in section.lanes and lane_id:
            lane_id -= 1 if lane_id > 0 else -1
        return offset_m + float(section.border_m(lane_id, np.array([s_m]))[0])


def road_of(element: Element, where: str) -> Road:
    """A <road>; BadElement says what it lacks."""
    name = f"{where}, line {element.line}: road {element.attributes.get('id', '?'):.40}"
    length_m = value(name, element, "length")
    if not 0.0 <= length_m <= MAX_ROAD_M:
        raise BadElement(f"{name}: length {length_m} m is not in 0 … {MAX_ROAD_M:.0f} m")
    plan = element.find("planView")
    pieces = tuple(_piece(name, one) for one in (plan.all("geometry") if plan else ()))
    if not pieces:
        raise BadElement(f"{name}: has no geometry, so no position")
    if any(a.s_m >= b.s_m for a, b in pairwise(pieces)):
        raise BadElement(f"{name}: its {len(pieces)} geometries do not ascend in s")
    lateral, lanes = element.find("lateralProfile"), element.find("lanes")
    return Road(
        element.attributes.get("id", ""), name, length_m, ReferenceLine(pieces),
        profile(name, element.find("elevationProfile"), "elevation"), profile(name, lateral, "superelevation"),
        profile(name, lanes, "laneOffset"), _sections(name, lanes, length_m), element,
    )  # fmt: skip


def value(where: str, element: Element, key: str, default: float | None = None) -> float:
    """An attribute that is a finite number; BadElement otherwise, or when it is missing without a default."""
    text = element.attributes.get(key)
    if text is None:
        if default is None:
            raise BadElement(f"{where}, line {element.line}: <{element.name}> without {key}")
        return default
    return real(f"{where}, line {element.line}", f"{key} of <{element.name}>", text)


def profile(where: str, parent: Element | None, name: str, start: str = "s") -> HeightProfile:
    """The cubics of a name below an element."""
    found = parent.all(name) if parent else []
    starts = np.array([value(where, one, start) for one in found], np.float64)
    rows = [[value(where, one, key) for key in _COEFFICIENTS] for one in found]
    if (np.diff(starts) < 0).any():
        raise BadElement(f"{where}: its {len(starts)} <{name}> do not ascend in {start}")
    return HeightProfile(starts, np.array(rows, np.float64).reshape(-1, 4))


def _piece(where: str, element: Element) -> CurvePiece:
    s, x, y, heading, length = (value(where, element, key) for key in ("s", "x", "y", "hdg", "length"))
    if length <= 0:
        raise BadElement(f"{where}, line {element.line}: a geometry of length {length} m")
    shape = next((child for child in element.children if child.name in _SHAPES), None)
    if shape is None:
        raise BadElement(f"{where}, line {element.line}: a geometry that is none of {', '.join(_SHAPES)}")
    return CurvePiece(s, x, y, heading, length, _SHAPES[shape.name](where, shape, length))


def _param(where: str, shape: Element, length: float) -> Curve:
    u, v = (np.array([value(where, shape, k + axis) for k in _COEFFICIENTS]) for axis in "UV")
    return param_poly3(u, v, 1.0 if shape.attributes.get("pRange") == "arcLength" else length)


_SHAPES: Final[dict[str, Callable[[str, Element, float], Curve]]] = {
    "line": lambda _where, _shape, _length: line(),
    "arc": lambda where, shape, length: arc(value(where, shape, "curvature"), length),
    "spiral": lambda where, shape, length: spiral(
        value(where, shape, "curvStart"), value(where, shape, "curvEnd"), length
    ),
    "poly3": lambda where, shape, length: poly3(np.array([value(where, shape, k) for k in _COEFFICIENTS]), length),
    "paramPoly3": _param,
}


def _sections(where: str, lanes: Element | None, length_m: float) -> tuple[Section, ...]:
    found = lanes.all("laneSection") if lanes else []
    starts = [value(where, one, "s") for one in found]
    if any(a >= b for a, b in pairwise([*starts, length_m + 1e-9])):
        raise BadElement(f"{where}: its {len(starts)} lane sections do not ascend in s up to {length_m} m")
    ends = [*starts[1:], length_m]
    return tuple(Section(a, b, _lanes(where, one)) for one, a, b in zip(found, starts, ends, strict=True))


def _lanes(where: str, section: Element) -> dict[int, XodrLane]:
    found: dict[int, XodrLane] = {}
    for side in section.children:
        for element in side.all("lane"):
            lane = _lane(where, element)
            if lane.id in found:
                raise BadElement(f"{where}, line {element.line}: lane {lane.id} comes twice in a section")
            found[lane.id] = lane
    if found and 0 not in found:  # required by the standard, and left out by some writers
        empty = profile(where, None, "width", "sOffset")
        found[0] = XodrLane(0, "none", empty, None, "none", "", "", False, (), ())
    for sign in (1, -1):
        ids = sorted(abs(id_) for id_ in found if id_ * sign > 0)
        if ids != list(range(1, len(ids) + 1)):
            raise BadElement(
                f"{where}, line {section.line}: lanes {[sign * n for n in ids]} do not count from the middle"
            )
    return found


def _lane(where: str, element: Element) -> XodrLane:
    lane_id = value(where, element, "id")
    if not lane_id.is_integer():
        raise BadElement(f"{where}, line {element.line}: lane id {lane_id} is no whole number")
    mark = element.find("roadMark")
    said = mark.attributes if mark else {}
    return XodrLane(
        int(lane_id), element.attributes.get("type", "none"), profile(where, element, "width", "sOffset"),
        profile(where, element, "border", "sOffset") if element.find("border") else None,
        _left_first(said.get("type", "none"), left=lane_id > 0), said.get("color", ""),
        speed_of(where, element), element.attributes.get("direction") == "reversed",
        _linked(where, element, "predecessor"), _linked(where, element, "successor"),
    )  # fmt: skip


def _left_first(mark: str, *, left: bool) -> str:
    """A mark with its left stripe first: OpenDRIVE names stripes from the inside of the road to its outside."""
    words = mark.split()
    return " ".join(words[::-1]) if left and sorted(words) == ["broken", "solid"] else mark


def _linked(where: str, lane: Element, name: str) -> tuple[int, ...]:
    link = lane.find("link")
    return tuple(number(where, one, "id") for one in (link.all(name) if link else ()))


_UNITS: Final = {"km/h": "km/h", "mph": "mph", "m/s": "m/s"}


def speed_of(where: str, element: Element) -> str:
    """The first speed limit below an element as Lanelet2 writes it, "" without one."""
    speed = element.find("speed")
    told = speed.attributes.get("max", "") if speed else ""
    if speed is None or told in ("", "no limit", "undefined"):
        return ""
    return f"{value(where, speed, 'max'):g} {_UNITS.get(speed.attributes.get('unit', 'm/s'), 'm/s')}"
