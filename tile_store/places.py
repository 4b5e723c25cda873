"""Where a vehicle says to have been: two of its reports that no vehicle can have made, their places are too far apart.

A report was made near its tiles when its last scan was taken: it is sent soon after the last of them was left behind.
So two reports of a vehicle tell how fast it must have been in between, whatever order they come in. The begin of a
trip, of which private vehicles tell the hour alone, is not needed.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import cos, hypot
from typing import Final

from gnd.gnd_map.tile_id import LAT_TILES, LON_TILES, TILE_RAD, TileId
from gnd.tile_store.connection import SqlConnection, change, fetch, post
from gnd.tile_store.errors import ImpossiblePlace

FASTEST_MPS: Final = 70.0
PLACE_REACH_M: Final = 2000.0
"""A vehicle is no farther from some tile of its report when the last scan is taken: it may tell of ground that did not
change after a kilometre only."""
PLACE_CLOCK_S: Final = 30.0
"""A clock may be set by so much between two reports."""
REMEMBERED_PLACES: Final = 64
"""Of a vehicle, the newest."""
_METRES_A_TILE: Final = TILE_RAD * 6_335_439.0
"""At least, north and south: the Earth's smallest radius of curvature along a meridian."""
_NS_PER_S: Final = 1e9


@dataclass(frozen=True, slots=True)
class ReportPlace:
    """The tiles of a report as a rectangle of their indices, and the time of its last scan, ns UTC."""

    report_id: str
    last_ns: int
    west: int
    south: int
    east: int
    north: int

    @classmethod
    def of(cls, report_id: str, last_ns: int, tiles: Iterable[TileId]) -> "ReportPlace":
        """Of a report with at least one tile."""
        at = [(tile.lon_index, tile.lat_index) for tile in tiles]
        (west, south), (east, north) = (tuple(map(least, zip(*at, strict=True))) for least in (min, max))
        return cls(report_id, last_ns, west, south, east, north)


def apart_m(one: ReportPlace, other: ReportPlace) -> float:
    """How far two places are apart at least, metres; 0 where they touch."""
    east = max(0, other.west - one.east - 1, one.west - other.east - 1)
    around = LON_TILES - 1 - max(one.east, other.east) + min(one.west, other.west)  # over the date line
    north = max(0, other.south - one.north - 1, one.south - other.north - 1)
    farthest = max(abs(row - LAT_TILES // 2) for place in (one, other) for row in (place.south, place.north + 1))
    return _METRES_A_TILE * hypot(max(min(east, around), 0) * cos(min(farthest * TILE_RAD, 1.57)), north)


def why_impossible(one: ReportPlace, other: ReportPlace) -> str:
    """Why no vehicle can have made both reports; "": it can."""
    way_m = apart_m(one, other) - 2 * PLACE_REACH_M
    between_s = abs(one.last_ns - other.last_ns) / _NS_PER_S
    if way_m <= FASTEST_MPS * (between_s + PLACE_CLOCK_S):
        return ""
    return (
        f"{apart_m(one, other) / 1000:.1f} km from report {other.report_id} and {between_s:.0f} s apart: more than"
        f" {FASTEST_MPS:.0f} m/s; its clock or its place is wrong"
    )


def put_place(c: SqlConnection, vehicle: str, place: ReportPlace) -> None:
    """Remember where a vehicle was.

    Raises:
        ImpossiblePlace: it cannot have been there, by what it said before.
    """
    known = [ReportPlace(*row) for row in fetch(c, "places_of_vehicle", {"vehicle": vehicle, "n": REMEMBERED_PLACES})]
    for one in known:
        if one.report_id != place.report_id and (why := why_impossible(place, one)):
            raise ImpossiblePlace(f"report {place.report_id} of {vehicle}: {why}")
    post(c, "put_place", {"vehicle": vehicle} | {name: getattr(place, name) for name in ReportPlace.__slots__})
    if len(known) == REMEMBERED_PLACES:
        change(c, "forget_places", {"vehicle": vehicle, "before": known[-1].last_ns})
