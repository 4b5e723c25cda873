"""The kinds of routes by name."""

from collections.abc import Callable
from functools import partial
from typing import Final

from gnd.fleet_sim.errors import RoadError
from gnd.fleet_sim.roads.motorway import motorway
from gnd.fleet_sim.roads.route import Route
from gnd.fleet_sim.roads.streetlights import streetlight_motorway
from gnd.fleet_sim.roads.test_track import test_track

_KINDS: Final[dict[str, Callable[[int], Route]]] = {
    "motorway": motorway,
    "test-track": test_track,
    "streetlights": streetlight_motorway,
    "streetlights-straight": partial(streetlight_motorway, straight=True),
}


def route_named(kind: str, seed: int) -> Route:
    """Return the route of a kind and a seed.

    Raises:
        RoadError: there is no such kind.
    """
    if kind not in _KINDS:
        raise RoadError(f"unknown road {kind!r}, known are {', '.join(_KINDS)}")
    return _KINDS[kind](seed)
