"""Lanes of OpenDRIVE as a network: which run between which borders, in which direction, and which follow.

Links are read from both sides (lanes and roads, junctions) and kept as joints: this end of a lane meets that end of
another. A joint is a successor where one lane is driven out of it and the other into it. ASAM OpenDRIVE 1.8, sections
11.5 (lane linkage), 10.3 (road linkage) and 12 (junctions).
"""

import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from typing import Final, TypeAlias

from gnd.tile_store.feature_io.lane_network import Border, MapLane
from gnd.tile_store.feature_io.xml_spans import Element
from gnd.tile_store.feature_io.xodr_road import Road, XodrLane, speed_of

LaneId: TypeAlias = tuple[str, int, int]
"""Road, number of the section, lane."""
LaneEnd: TypeAlias = tuple[LaneId, str]
"""A lane and which of its ends in s: "start" or "end"."""
SUBTYPE_OF_TYPE: Final = {
    **dict.fromkeys(
        (
            "driving", "entry", "exit", "offRamp", "onRamp", "connectingRamp", "slipLane", "bidirectional",
            "mwyEntry", "mwyExit", "HOV", "special1", "special2", "special3",
        ),
        "road",
    ),
    "bus": "bus_lane",
    "taxi": "bus_lane",
    "biking": "bicycle_lane",
    "sidewalk": "walkway",
    "walking": "walkway",
    "stop": "emergency_lane",
}  # fmt: skip
"""Types of lanes that become lanelets; borders of all types are features."""
_OTHER: Final = {"start": "end", "end": "start"}
_LANE_ID: Final = re.compile(r"[+-]?[0-9]{1,9}")


def lanes_of(
    roads: Mapping[str, Road], junctions: list[Element], border_id: Callable[[LaneId], int]
) -> tuple[MapLane, ...]:
    """The lanes that are driven, ridden or walked.

    Args:
        roads: by id.
        junctions: the file's.
        border_id: the feature that is the outer border of a lane.
    """
    lanes = {
        (road.id, number, lane_id): lane
        for road in roads.values()
        for number, section in enumerate(road.sections)
        for lane_id, lane in section.lanes.items()
        if lane_id and lane.type in SUBTYPE_OF_TYPE
    }
    ahead = {key: _along_s(roads[key[0]], lane) for key, lane in lanes.items()}
    successors: dict[LaneId, set[LaneId]] = defaultdict(set)
    for a, b in _joints(roads, junctions):
        for (one, end), (other, start) in ((a, b), (b, a)):
            if one in lanes and other in lanes and _leaves(ahead[one], end) and not _leaves(ahead[other], start):
                successors[one].add(other)
    return tuple(
        _lane(roads[key[0]], key, lane, border_id, sorted(successors[key]), ahead=ahead[key])
        for key, lane in lanes.items()
    )


def _along_s(road: Road, lane: XodrLane) -> bool:
    """Whether a lane is driven along s: on the right of the road where traffic keeps right."""
    right_hand = road.element.attributes.get("rule", "RHT") != "LHT"
    return ((lane.id < 0) == right_hand) != lane.reversed


def _leaves(along_s: bool, end: str) -> bool:
    return (end == "end") == along_s


def _lane(
    road: Road, key: LaneId, lane: XodrLane, border_id: Callable[[LaneId], int], following: list[LaneId], *, ahead: bool
) -> MapLane:
    inner = lane.id - (1 if lane.id > 0 else -1)
    ids = sorted((lane.id, inner), reverse=ahead)  # greater ids lie to the left of smaller ones along s
    left, right = (Border(border_id((*key[:2], id_)), ahead) for id_ in ids)
    tags = {"location": "urban", "source_lane": _name(key), "subtype": SUBTYPE_OF_TYPE[lane.type]}
    tags["one_way"] = "no" if lane.type in ("bidirectional", "sidewalk", "walking") else "yes"
    speed = lane.speed or next(filter(None, (speed_of(road.where, one) for one in road.element.all("type"))), "")
    tags |= {"speed_limit": speed} if speed else {}
    return MapLane(_name(key), left, right, tuple(map(_name, following)), tuple(sorted(tags.items())))


def _name(key: LaneId) -> str:
    return "/".join(map(str, key))


def _joints(roads: Mapping[str, Road], junctions: list[Element]) -> Iterator[tuple[LaneEnd, LaneEnd]]:
    """Ends of lanes that meet, as lanes, roads and junctions state it; most are stated twice."""
    for road in roads.values():
        for number, section in enumerate(road.sections):
            for lane in section.lanes.values():
                for end, linked in (("start", lane.predecessors), ("end", lane.successors)):
                    for other in linked:
                        meets = _beyond(roads, road, number, end)
                        if meets is not None:
                            yield ((road.id, number, lane.id), end), ((*meets[0], other), meets[1])
    for junction in junctions:
        yield from _junction_joints(roads, junction)


def _beyond(roads: Mapping[str, Road], road: Road, number: int, end: str) -> tuple[tuple[str, int], str] | None:
    """The section, and which end of it, that lies beyond an end of a section."""
    beside = number + (1 if end == "end" else -1)
    if 0 <= beside < len(road.sections):
        return (road.id, beside), _OTHER[end]
    link = _road_link(road, end)
    if link is None or link.attributes.get("elementType", "road") != "road":
        return None  # which lanes meet at a junction is listed there
    other = roads.get(link.attributes.get("elementId", ""))
    contact = link.attributes.get("contactPoint", "")
    return None if other is None or not other.sections or contact not in _OTHER else _at(other, contact)


def _at(road: Road, contact: str) -> tuple[tuple[str, int], str]:
    return (road.id, 0 if contact == "start" else len(road.sections) - 1), contact


def _road_link(road: Road, end: str) -> Element | None:
    link = road.element.find("link")
    return link.find("predecessor" if end == "start" else "successor") if link else None


def _junction_joints(roads: Mapping[str, Road], junction: Element) -> Iterator[tuple[LaneEnd, LaneEnd]]:
    for connection in junction.all("connection"):
        attributes = connection.attributes
        incoming = roads.get(attributes.get("incomingRoad", ""))
        other = roads.get(attributes.get("connectingRoad", attributes.get("linkedRoad", "")))
        contact = attributes.get("contactPoint", "start")
        if incoming is None or other is None or contact not in _OTHER or not (incoming.sections and other.sections):
            continue
        end = _end_at_junction(incoming, other, contact, junction.attributes.get("id", ""))
        if end is None:
            continue
        (near, near_end), (far, far_end) = _at(incoming, end), _at(other, contact)
        for link in connection.all("laneLink"):
            ids = link.attributes.get("from", ""), link.attributes.get("to", "")
            if all(_LANE_ID.fullmatch(text) for text in ids):
                yield ((*near, int(ids[0])), near_end), ((*far, int(ids[1])), far_end)


def _end_at_junction(incoming: Road, other: Road, contact: str, junction: str) -> str | None:
    """Which end of the incoming road the connection leaves: by the link of the connecting road, or by its own."""
    link = _road_link(other, contact)
    if link is not None and link.attributes.get("elementId") == incoming.id:
        end = link.attributes.get("contactPoint", "")
        if end in _OTHER:
            return end
    ends = [
        end
        for end in _OTHER
        if (road_link := _road_link(incoming, end)) is not None
        and road_link.attributes.get("elementType") == "junction"
        and road_link.attributes.get("elementId") == junction
    ]
    return ends[0] if len(ends) == 1 else None
