"""What every form of a change report begins with: who sends it, of which time, about which tiles of a district."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Protocol

from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import limits
from gnd.schemas.errors import BadValue
from gnd.schemas.report_id import check_report_id
from gnd.schemas.wire import PRINTABLE_PATTERN, VEHICLE_PATTERN, check_length, check_text, check_unsigned


class ReportHead(Protocol):
    """What all reports have."""

    @property
    def report_id(self) -> str:
        """ULID."""

    @property
    def vehicle(self) -> str:
        """Pseudonym."""

    @property
    def sensor_model(self) -> str:
        """Of its LiDAR or camera."""

    @property
    def software(self) -> str:
        """Program and version."""

    @property
    def first_ns(self) -> int:
        """Begin of what the report rests on, UTC."""

    @property
    def last_ns(self) -> int:
        """Its end."""


class AboutTile(Protocol):
    """What a report says of one tile."""

    @property
    def tile(self) -> TileId:
        """Which one."""


def check_report_head(report: ReportHead) -> None:
    """`BadValue` unless the id is a ULID, names are of the characters allowed, and the end is not before the start."""
    check_report_id(report.report_id)
    check_text("vehicle", report.vehicle, VEHICLE_PATTERN)
    check_text("sensor model", report.sensor_model, PRINTABLE_PATTERN)
    check_text("software", report.software, PRINTABLE_PATTERN)
    check_unsigned("first_ns", report.first_ns, bits=63)
    check_unsigned("last_ns", report.last_ns, bits=63)
    if report.first_ns > report.last_ns:
        raise BadValue(
            f"report {report.report_id} begins at {report.first_ns} ns, after its end at {report.last_ns} ns"
        )


def check_tiles_of_district(report_id: str, district: District, tiles: Sequence[AboutTile]) -> None:
    """Refuse a report without tiles, or with tiles out of order, twice or of another district.

    Raises:
        TooLarge: more tiles than a district has.
        BadValue: all else.
    """
    if not tiles:
        raise BadValue(f"report {report_id} has no tiles")
    check_length(f"report {report_id}", len(tiles), limits.MAX_TILES_OF_DISTRICT, "tiles")
    for before, after in pairwise(tiles):
        if before.tile >= after.tile:
            raise BadValue(f"report {report_id} lists tile {after.tile} after {before.tile}: ascending, none twice")
    outside = [one.tile for one in tiles if not district.contains(one.tile)]
    if outside:
        raise BadValue(f"report {report_id}: tile {outside[0]} is not in district {district}")
