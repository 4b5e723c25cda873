"""The families by name, and which of them nothing may be tuned on."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from gnd.fleet_sim.families.green import avenue, snow, suburb
from gnd.fleet_sim.families.highway import motorway, tunnel
from gnd.fleet_sim.families.site import FamilyPlace, FamilySite
from gnd.fleet_sim.families.works import car_park, construction, roundabout


@dataclass(frozen=True, slots=True)
class Family:
    """A kind of place.

    Attributes:
        build: makes a place of it from what a seed has drawn.
        reserved: for tests only: no parameter and no model may be chosen by its worlds.
        about: what is hard there.
    """

    build: Callable[[FamilySite], FamilyPlace]
    reserved: bool
    about: str


def _street(site: FamilySite) -> FamilyPlace:
    """The usual street, as it always was."""
    return FamilyPlace(site.street())


FAMILIES: Final[dict[str, Family]] = {
    "street": Family(_street, False, "the usual street"),
    "suburb": Family(suburb, False, "gardens with hedges and fences, a road over a hill"),
    "avenue": Family(avenue, False, "porous trees whose leaves come and go between the states, shop windows"),
    "motorway": Family(motorway, False, "noise barriers, rails, few things; fast vehicles"),
    "snow": Family(snow, False, "the usual street with banks of snow after"),
    "car_park": Family(car_park, True, "cars and vans that change between drives, not between the states of the map"),
    "construction": Family(construction, True, "fences, containers, excavators all along"),
    "roundabout": Family(roundabout, True, "lanes that swing around an island"),
    "tunnel": Family(tunnel, True, "a cutting and a smooth tube"),
}
