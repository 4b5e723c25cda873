"""Lanes of a map: between which borders they run, in which direction, and which lanes follow.

A lane names its borders by the features that draw them, so that lanes follow the features when these move. Two lanes
beside each other name one border both. A store keeps the lanes of a file beside it (`sources`); vehicles get none.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from gnd.tile_store.feature_io.errors import DuplicateId, FeatureFileError, MissingReference

SUBTYPES: Final = ("road", "highway", "bus_lane", "bicycle_lane", "emergency_lane", "walkway", "crosswalk")
"""Subtypes of lanelets that sources other than Lanelet2 give (Lanelet2, LaneletAndAreaTagging.md)."""


@dataclass(frozen=True, slots=True)
class Border:
    """One side of a lane.

    Attributes:
        feature_id: the polyline that draws it.
        ahead: whether the polyline's vertices come in the direction of the lane.
    """

    feature_id: int
    ahead: bool


@dataclass(frozen=True, slots=True)
class MapLane:
    """One lane.

    Attributes:
        key: what its file calls it.
        left: its left border, seen in its direction.
        right: its right border.
        successors: keys of the lanes that a vehicle comes into at its end.
        tags: Lanelet2's tags of it: subtype, speed_limit, ...; sorted.
    """

    key: str
    left: Border
    right: Border
    successors: tuple[str, ...]
    tags: tuple[tuple[str, str], ...]

    def as_list(self) -> list[Any]:
        """What `lane_of` reads, for JSON."""
        sides = [[side.feature_id, side.ahead] for side in (self.left, self.right)]
        return [self.key, *sides, list(self.successors), dict(self.tags)]


def lane_of(values: Sequence[Any]) -> MapLane:
    """The lane that `MapLane.as_list` gave; FeatureFileError when it is none."""
    try:
        key, left, right, successors, tags = values
        borders = [Border(int(side[0]), bool(side[1])) for side in (left, right)]
        keys, pairs = tuple(map(str, successors)), tuple(sorted(tags.items()))
        return MapLane(str(key), borders[0], borders[1], keys, pairs)
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        raise FeatureFileError(f"no lane: {type(error).__name__}: {error}") from None


def check_lanes(lanes: Iterable[MapLane], feature_ids: Iterable[int]) -> None:
    """Lanes name borders and successors that there are, and no key comes twice.

    Raises:
        DuplicateId: a key comes twice.
        MissingReference: a border that is no feature, or a successor that is no lane.
    """
    lanes, known = list(lanes), set(feature_ids)
    keys = Counter(lane.key for lane in lanes)
    for lane in lanes:
        if keys[lane.key] > 1:
            raise DuplicateId(f"lane {lane.key} comes {keys[lane.key]} times")
        for side in (lane.left, lane.right):
            if side.feature_id not in known:
                raise MissingReference(f"lane {lane.key}: its border {side.feature_id} is no feature")
        absent = [key for key in lane.successors if key not in keys]
        if absent:
            raise MissingReference(f"lane {lane.key}: {len(absent)} of its successors are no lanes, first {absent[0]}")


def neighbours(lanes: Iterable[MapLane]) -> tuple[dict[str, str], dict[str, str]]:
    """The lanes beside each lane that go in the same direction: on its left, and on its right, by key."""
    lanes = list(lanes)
    by_right = {(lane.right.feature_id, lane.right.ahead): lane.key for lane in lanes}
    left = {lane.key: by_right.get((lane.left.feature_id, lane.left.ahead)) for lane in lanes}
    found = {key: other for key, other in left.items() if other is not None and other != key}
    return found, {other: key for key, other in found.items()}


def counted(lanes: Sequence[MapLane]) -> Mapping[str, int]:
    """Numbers for people: lanes, lanes followed by another, lanes with one beside them."""
    left, right = neighbours(lanes)
    return {
        "lanes": len(lanes),
        "with_successor": sum(bool(lane.successors) for lane in lanes),
        "with_neighbour": len({*left, *right}),
    }
