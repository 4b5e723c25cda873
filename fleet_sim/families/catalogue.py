"""The families by name."""

from collections.abc import Callable, Mapping
from typing import Final

from gnd.fleet_sim.families.green import avenue, snow, suburb
from gnd.fleet_sim.families.highway import motorway, tunnel
from gnd.fleet_sim.families.site import FamilyPlace, FamilySite
from gnd.fleet_sim.families.works import car_park, construction, roundabout


def usual_street(site: FamilySite) -> FamilyPlace:
    """The usual street, to the bit as it was before there were families."""
    return FamilyPlace(site.street())


FAMILIES: Final[Mapping[str, Callable[[FamilySite], FamilyPlace]]] = {
    "street": usual_street,
    "suburb": suburb,
    "avenue": avenue,
    "motorway": motorway,
    "snow": snow,
    "car_park": car_park,
    "construction": construction,
    "roundabout": roundabout,
    "tunnel": tunnel,
}
"""What makes a place of each of `names.FAMILY_NAMES` from what a seed has drawn."""
