"""The official Lanelet2 library as an oracle: what it reads of a file, and where it routes."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

lanelet2 = pytest.importorskip("lanelet2", reason="the lanelet2 wheel cannot be installed on this platform")

from lanelet2 import io, projection, routing, traffic_rules  # noqa: E402

PARTICIPANTS = ("Vehicle", "VehicleBus", "Bicycle", "Pedestrian")


@dataclass(frozen=True)
class Official:
    """A map as the library has read it, the errors that it reports, and a routing graph for each participant."""

    map: Any
    errors: list[str]
    graphs: dict[str, tuple[Any, Any]]

    @property
    def lanelets(self) -> dict[str, Any]:
        """By the lane's name in the file that it comes from, or by id."""
        return {dict(one.attributes).get("source_lane", str(one.id)): one for one in self.map.laneletLayer}

    def following(self, lanelet: Any) -> set[int]:
        """Ids of the lanelets that some participant may drive into at the end."""
        return {
            other.id
            for rules, graph in self.graphs.values()
            if rules.canPass(lanelet)
            for other in graph.following(lanelet)
        }

    def beside(self, lanelet: Any, side: str) -> set[int]:
        """Ids of the lanelets on its "left" or "right" that go in its direction, lane change allowed or not."""
        found = set()
        for rules, graph in self.graphs.values():
            if rules.canPass(lanelet):
                ways = (getattr(graph, side), getattr(graph, f"adjacent{side.capitalize()}"))
                found |= {other.id for way in ways if (other := way(lanelet)) is not None}
        return found

    def passable(self, lanelet: Any) -> bool:
        """Whether any participant may be there."""
        return any(rules.canPass(lanelet) for rules, _ in self.graphs.values())


def load(path: Path, lat_deg: float, lon_deg: float) -> Official:
    """Read a file about an origin."""
    read, errors = io.loadRobust(str(path), projection.UtmProjector(io.Origin(lat_deg, lon_deg)))
    graphs = {}
    for name in PARTICIPANTS:
        rules = traffic_rules.create(traffic_rules.Locations.Germany, getattr(traffic_rules.Participants, name))
        graphs[name] = (rules, routing.RoutingGraph(read, rules))
    return Official(read, list(errors), graphs)


@dataclass(frozen=True)
class Expected:
    """What a source says of a lane: names of the lanes after it, and of those beside it in its direction."""

    successors: frozenset[str]
    left: str | None
    right: str | None


def not_routable(official: Official, expected: dict[str, Expected]) -> list[str]:
    """The lanes that are no lanelet, that nobody may drive, or that have not the successors and neighbours."""
    lanelets = official.lanelets

    def ids(names: Iterable[str | None]) -> set[int]:
        return {lanelets[name].id for name in names if name is not None}

    return [
        name
        for name, lane in expected.items()
        if name not in lanelets
        or not official.passable(lanelets[name])
        or not ids(lane.successors) <= official.following(lanelets[name])
        or not ids([lane.left]) <= official.beside(lanelets[name], "left")
        or not ids([lane.right]) <= official.beside(lanelets[name], "right")
    ]
