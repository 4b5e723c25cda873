"""The seeded street of the simulations: by default 200 m of Wangsimni-ro, Seoul, where the GND paper drove (section
7.1).

Everything is drawn from the seed by named random streams: the same seed and options give the same world to the bit, and
a change to the furniture leaves the buildings where they are.
"""

from dataclasses import dataclass, replace
from math import cos, isfinite, radians, sin
from typing import Final, Literal, get_args

import numpy as np

from gnd.fleet_sim.courses.terrain import TerrainProfile, raised
from gnd.fleet_sim.errors import WorldError
from gnd.fleet_sim.families.catalogue import FAMILIES
from gnd.fleet_sim.families.site import LANE_OFFSET_M as LANE_OFFSET_M
from gnd.fleet_sim.families.site import FamilySite
from gnd.fleet_sim.street_before import drawn_plan
from gnd.fleet_sim.street_edits import partly_edited
from gnd.fleet_sim.world import World
from gnd.gnd_map.geodesy import LocalFrame

SiteName = Literal["border", "wangsimni", "north49"]
SITES: Final[tuple[SiteName, ...]] = get_args(SiteName)

BORDER_LON_RAD: Final = radians(894304 * 360.0 / 2**20 - 180.0)
"""A border of districts near Figure 2 of the GND paper: longitude index 894304 = 27947 x 32."""
LAT_RAD: Final = radians(37.5597)
HEIGHT_M: Final = 30.0
LENGTH_M: Final = 200.0
MIN_LENGTH_M: Final = 100.0
MAX_LENGTH_M: Final = 1000.0
MAX_LAT_DEG: Final = 80.0

_FIGURE_2_DEG: Final = (37.5595, 127.0363)
_NORTH_49_DEG: Final = (49.0045, 8.4)
_INSIDE_M: Final = 20.0
_FAMILY_STREAM: Final = 0xFA311
_STREAMS: Final = ("site", "lots", "furniture", "greenery", "edits", "more", "share")


@dataclass(frozen=True, slots=True)
class StreetOptions:
    """What a street is like, beside what its seed decides.

    Attributes:
        length_m: stretch that is driven, 100 … 1000 m; what is built reaches 60 m farther at either end.
        site: where it lies. "border": its middle on a border of two districts near Figure 2 of the GND paper;
            "wangsimni": from Figure 2's tiles to the south-east, up to 800 m inside one district; "north49": 49° N.
        lat_deg, lon_deg: middle of the street, WGS-84, instead of a site; both or neither.
        edit_share: so many of the street's edits are made, drawn from the seed one by one; the other things stay as
            they were. 1: all, a construction zone and its neighbourhood.
        family: what kind of place it is, one of `families.catalogue.FAMILIES`.
        parking: share of the parking slots and bays that are taken on a drive that says nothing else; None: as usual
            in the family.
    """

    length_m: float = LENGTH_M
    site: SiteName = "border"
    lat_deg: float | None = None
    lon_deg: float | None = None
    edit_share: float = 1.0
    family: str = "street"
    parking: float | None = None

    def __post_init__(self) -> None:
        numbers = [self.length_m, self.lat_deg or 0.0, self.lon_deg or 0.0, self.edit_share]
        if self.family not in FAMILIES:
            raise WorldError(f"unknown family {self.family!r}, use one of {', '.join(FAMILIES)}")
        if self.parking is not None and not (isinstance(self.parking, (int, float)) and 0.0 <= self.parking <= 1.0):
            raise WorldError(f"parking must be in 0 … 1, got {self.parking!r}")
        if not all(isinstance(number, (int, float)) for number in numbers):
            raise WorldError(f"length_m, lat_deg, lon_deg and edit_share are numbers, got {numbers}")
        if not 0.0 <= self.edit_share <= 1.0:
            raise WorldError(f"edit_share must be in 0 … 1, got {self.edit_share}")
        if not MIN_LENGTH_M <= self.length_m <= MAX_LENGTH_M:
            raise WorldError(f"a street is {MIN_LENGTH_M:.0f} … {MAX_LENGTH_M:.0f} m long, got {self.length_m}")
        if self.site not in SITES:
            raise WorldError(f"unknown site {self.site!r}, use one of {', '.join(SITES)}")
        if (self.lat_deg is None) != (self.lon_deg is None):
            raise WorldError(f"give both lat_deg and lon_deg or neither, got {self.lat_deg} and {self.lon_deg}")
        if self.lat_deg is not None and not abs(self.lat_deg) <= MAX_LAT_DEG:
            raise WorldError(f"lat_deg must be in -{MAX_LAT_DEG:.0f} … {MAX_LAT_DEG:.0f}, got {self.lat_deg}")
        if self.lon_deg is not None and not (isfinite(self.lon_deg) and abs(self.lon_deg) <= 180.0):
            raise WorldError(f"lon_deg must be in -180 … 180, got {self.lon_deg}")


def street(seed: int, options: StreetOptions | None = None) -> World:
    """Make the world of a seed.

    Args:
        seed: any integer >= 0.
        options: length and place; by default 200 m across a district border.

    Raises:
        WorldError: the seed is negative.
    """
    if seed < 0:
        raise WorldError(f"the world seed must be >= 0, got {seed}")
    options = options or StreetOptions()
    streams = {name: np.random.default_rng([seed, index]) for index, name in enumerate(_STREAMS)}
    site = streams["site"]
    heading_rad, slope = _heading_rad(options, float(site.uniform(22.0, 38.0))), float(site.uniform(0.012, 0.022))
    plan = drawn_plan(options.length_m / 2, streams["lots"], site)
    place = FAMILIES[options.family](FamilySite(plan, streams, np.random.default_rng([seed, _FAMILY_STREAM])))
    lat_rad, lon_rad = _anchor(options, heading_rad)
    world = World(
        seed=seed,
        lat_rad=lat_rad,
        lon_rad=lon_rad + float(site.uniform(-2e-6, 2e-6)),
        height_m=HEIGHT_M,
        heading_rad=heading_rad,
        slope=slope,
        crown=place.crown,
        half_length_m=options.length_m / 2,
        lane_offset_m=place.lane_offset_m,
        kerb_m=place.kerb_m,
        objects=partly_edited(place.objects, options.edit_share, streams["share"]),
        family=options.family,
        bulge_m=place.bulge_m,
        bulge_half_m=place.bulge_half_m,
        kerb_parking=place.kerb_parking,
        bays=place.bays,
        parking=place.parking if options.parking is None else options.parking,
        cruise_mps=place.cruise_mps,
    )
    return world if place.profile is None else _on_hills(world, place.profile, plan.end_m)


def _on_hills(world: World, profile: TerrainProfile, end_m: float) -> World:
    """The world raised on a profile; its relief has the edges of the pieces in which `raised` lays the ground."""
    x = np.linspace(-end_m, end_m, round(end_m) + 1)
    knots = zip(x.tolist(), profile.height_m(x).tolist(), strict=True)
    return replace(raised(world, profile), relief=tuple(knots))


def _heading_rad(options: StreetOptions, drawn_deg: float) -> float:
    """At "wangsimni" the street runs to the south-east, where there is room in the district."""
    return radians(-drawn_deg if options.lat_deg is None and options.site == "wangsimni" else drawn_deg)


def _anchor(options: StreetOptions, heading_rad: float) -> tuple[float, float]:
    """Latitude and longitude of the middle of the street [rad]."""
    if options.lat_deg is not None and options.lon_deg is not None:
        return radians(options.lat_deg), radians(options.lon_deg)
    match options.site:
        case "border":
            return LAT_RAD, BORDER_LON_RAD
        case "north49":
            return radians(_NORTH_49_DEG[0]), radians(_NORTH_49_DEG[1])
    start = LocalFrame(radians(_FIGURE_2_DEG[0]), radians(_FIGURE_2_DEG[1]), HEIGHT_M)
    way_m = options.length_m / 2 - _INSIDE_M
    middle = np.array([[way_m * cos(heading_rad), way_m * sin(heading_rad), 0.0]])
    lat, lon, _ = start.geodetic_from_enu(middle)
    return float(lat[0]), float(lon[0])
