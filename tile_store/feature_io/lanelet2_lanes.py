"""Lanes as lanelets that the official library can route over.

Its routing graph knows a successor by the points that both borders share, and a neighbour by the border that both name
(`lanelet2_core/geometry/Lanelet.h`: `follows`, `leftOf`). So the ends of borders that meet become one node, and the
marks of borders become Lanelet2's types, which say who may change lanes (LinestringsAndPolygonTagging.md).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.tile_store.feature_io.lane_network import Border, MapLane
from gnd.tile_store.feature_io.osm_kinds import kind_of

JOIN_M: Final = 0.5
"""Ends of borders of following lanes that lie farther apart are not drawn together: the lane's shape would suffer."""
End: TypeAlias = tuple[int, int]
"""A feature, and 0 for its first vertex or -1 for its last."""
_STRIPES: Final = {"dash": "dashed", "broken": "dashed", "solid": "solid"}
_EDGES: Final = {
    "curb": {"type": "curbstone", "subtype": "high"},
    "grass": {"type": "road_border"},
    "edge": {"type": "road_border"},
    "botts dots": {"type": "line_thin", "subtype": "dashed"},
    "custom": {"type": "unknown"},
}
_DOUBLE: Final = {
    ("solid", "solid"): "solid_solid",
    ("solid", "dashed"): "solid_dashed",
    ("dashed", "solid"): "dashed_solid",
    ("dashed", "dashed"): "dashed",
}


@dataclass(slots=True)
class JoinedEnds:
    """Which ends of borders are one node.

    Attributes:
        group: of every joined end the number of its node.
        place: of every number latitude, longitude (radians) and height, (3,).
        joined: successors that are drawn together.
        moved_m: the farthest that an end lies from its node.
        apart: (lane, successor, distance in metres) of those that are too far apart.
    """

    group: dict[End, int] = field(default_factory=dict)
    place: dict[int, F64] = field(default_factory=dict)
    joined: int = 0
    moved_m: float = 0.0
    apart: list[tuple[str, str, float]] = field(default_factory=list)


def joined_ends(lanes: Iterable[MapLane], lines: Mapping[int, F64]) -> JoinedEnds:
    """The ends of borders that following lanes share.

    Args:
        lanes: whose borders are all among the lines.
        lines: (N, 3) latitude, longitude (radians) and height by feature.
    """
    by_key = {lane.key: lane for lane in lanes}
    found, parent = JoinedEnds(), _Forest()
    for lane in by_key.values():
        for key in lane.successors:
            if key not in by_key:
                continue
            pairs = [
                (_end_of(before, -1), _end_of(after, 0))
                for before, after in ((lane.left, by_key[key].left), (lane.right, by_key[key].right))
            ]
            apart_m = max(_apart_m(lines[a[0]][a[1]], lines[b[0]][b[1]]) for a, b in pairs)
            if apart_m > JOIN_M:
                found.apart.append((lane.key, key, apart_m))
                continue
            found.joined += 1
            for a, b in pairs:
                parent.unite(a, b)
    for number, members in enumerate(parent.groups()):
        found.group.update(dict.fromkeys(members, number))
        places = [lines[feature_id][which] for feature_id, which in members]
        found.place[number] = _middle(np.array(places))
        found.moved_m = max(found.moved_m, *(_apart_m(found.place[number], place) for place in places))
    return found


def _end_of(border: Border, which: int) -> End:
    """Where a border begins (0) or ends (-1) in the direction of its lane."""
    return border.feature_id, which if border.ahead else -1 - which


class _Forest:
    """Disjoint sets of ends."""

    def __init__(self) -> None:
        self._parent: dict[End, End] = {}

    def unite(self, a: End, b: End) -> None:
        self._parent[self._root(a)] = self._root(b)

    def _root(self, end: End) -> End:
        self._parent.setdefault(end, end)
        while self._parent[end] != end:
            self._parent[end] = end = self._parent[self._parent[end]]
        return end

    def groups(self) -> list[list[End]]:
        members: dict[End, list[End]] = {}
        for end in self._parent:
            members.setdefault(self._root(end), []).append(end)
        return [*members.values()]


def _frame(place: F64) -> LocalFrame:
    return LocalFrame(*place.tolist())


def _apart_m(a: F64, b: F64) -> float:
    """Horizontal distance of two near positions."""
    return float(np.linalg.norm(_frame(a).enu_from_geodetic(b[0], b[1], b[2]).reshape(3)[:2]))


def _middle(places: F64) -> F64:
    """(3,) the mean of near positions (N, 3); the position itself when all are one."""
    if (places == places[0]).all():
        return np.asarray(places[0])
    frame = _frame(places[0])
    mean = frame.enu_from_geodetic(*places.T).mean(axis=0)
    return np.array([column[0] for column in frame.geodetic_from_enu(mean[None])])


def line_tags(attributes: Mapping[str, str]) -> dict[str, str]:
    """Lanelet2's tags of a border: its own where it has them, otherwise by its mark."""
    if kind_of(attributes) == "lane_boundary":
        return dict(attributes)
    others = {key: value for key, value in attributes.items() if key not in ("type", "subtype")}
    if "mark" not in attributes:
        return {"type": "line_thin"} | others
    return _mark_tags(attributes["mark"]) | others


def _mark_tags(mark: str) -> dict[str, str]:
    """Type and subtype of a mark of Argoverse 2 ("DOUBLE_SOLID_YELLOW") or OpenDRIVE ("solid broken").

    Argoverse 2 names the left stripe first; so does Lanelet2. OpenDRIVE's importer writes them so, too.
    """
    first = mark.split()[0] if "_" in mark else mark  # lanes on either side may say different things of one border
    words = first.lower().replace("_", " ").split()
    if " ".join(words) in _EDGES:
        return _EDGES[" ".join(words)]
    stripes = [subtype for word in words for name, subtype in _STRIPES.items() if word.startswith(name)]
    if not stripes:
        return {"type": "unknown" if "unknown" in words else "virtual"}
    if "double" in words:
        stripes = stripes * 2
    subtype = _DOUBLE[(stripes[0], stripes[1])] if len(stripes) > 1 else stripes[0]
    colours = [word for word in words if word in ("white", "yellow", "blue")]
    return {"type": "line_thin", "subtype": subtype} | ({"color": colours[0]} if colours else {})
