"""What people type for a tile, a time, two versions."""

import math
import re
from datetime import UTC, datetime
from typing import Final

from gnd.gnd_map.errors import MapError
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.errors import StoreError
from gnd.tile_store.regions import morton_range

_VERSIONS: Final = re.compile(r"(\d+)\.\.(\d+)")


def parse_tile(text: str) -> TileId:
    """A tile by its path (13033/03021/23031/22102), its Morton number (497353963154), or a place in it (lat,lon in °).

    Raises:
        StoreError: it is none of these.
    """
    try:
        if "," in text:
            lat_deg, lon_deg = map(float, text.split(","))
            return TileId.from_geodetic(math.radians(lat_deg), math.radians(lon_deg))
        return TileId.from_path(text) if "/" in text else TileId(int(text))
    except (ValueError, MapError) as error:
        raise StoreError(
            f"tile {text!r} is not a path (13033/03021/23031/22102), a number (497353963154)"
            f" or lat,lon in degrees (37.5597,127.0365): {error}"
        ) from None


def parse_place(text: str) -> TileId | str:
    """A tile as `parse_tile` reads it, or a region: the leading part of paths and a slash ("/": everywhere).

    Raises:
        StoreError: it is neither.
    """
    if not text.endswith("/"):
        if text.count("/") in (1, 2):
            raise StoreError(f"{text!r} is not a whole path; a region ends in a slash: {text}/")
        if len(text) in (5, 10, 15) and set(text) <= set("0123"):
            raise StoreError(f"{text!r} may be the number of a tile; a region ends in a slash: {text}/")
        return parse_tile(text)
    region = text.rstrip("/")
    morton_range(region)
    return region


def parse_time_ns(text: str) -> int:
    """ISO 8601 (2026-01-31T12:00:00Z; UTC when it names no zone) as int ns UTC; StoreError when it is no time."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise StoreError(f"time {text!r} is not like 2026-01-31T12:00:00Z") from None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    since = moment - datetime(1970, 1, 1, tzinfo=UTC)
    time_ns = ((since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds) * 1_000
    if not 0 <= time_ns < 2**63:
        raise StoreError(f"time {text!r} is not between 1970 and 2262")
    return time_ns


def parse_versions(text: str) -> tuple[int, int]:
    """Two versions, "3..5"; StoreError when it is something else."""
    match = _VERSIONS.fullmatch(text)
    if match is None:
        raise StoreError(f"versions {text!r} are not like 3..5")
    return int(match[1]), int(match[2])
