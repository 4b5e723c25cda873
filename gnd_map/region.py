"""Regions a person can type: a wildcard, a tile, or a circle."""

import math
import posixpath
from dataclasses import dataclass

from gnd.gnd_map.errors import GndError, RegionError
from gnd.gnd_map.tile_id import District, TileId, covering_circle

MAX_RADIUS_M = 20_000.0


@dataclass(frozen=True, slots=True)
class Region:
    """A set of tiles as a key prefix and, where the prefix covers too much, the tiles themselves.

    Attributes:
        prefix: leading chunks of the tile path, empty for the whole world.
        tiles: the tiles of the region, or None when it is all tiles below the prefix.
    """

    prefix: str
    tiles: frozenset[TileId] | None = None

    @classmethod
    def circle(cls, lat_deg: float, lon_deg: float, radius_m: float) -> "Region":
        """The tiles within `radius_m` of a position (WGS-84, degrees).

        Raises:
            RegionError: no such position, or a radius that is not in 0 … 20 km.
        """
        try:
            return _circle(float(lat_deg), float(lon_deg), float(radius_m))
        except (ValueError, GndError) as error:
            raise RegionError(f"no circle of {radius_m} m around {lat_deg}, {lon_deg} degrees: {error}") from error

    def __contains__(self, tile: TileId) -> bool:
        """Tell whether a tile belongs to the region."""
        return tile.path.startswith(self.prefix) if self.tiles is None else tile in self.tiles

    def touches(self, district: District) -> bool:
        """Tell whether the region has tiles in a district."""
        if self.tiles is not None:
            return any(tile.district == district for tile in self.tiles)
        return district.path.startswith(self.prefix) or self.prefix.startswith(district.path)


def parse_region(text: str) -> Region:
    """Read a region.

    Args:
        text: a wildcard `13033/03021/**` (`**` is the world), a tile id `497353963154`, a tile path
            `13033/03021/23031/22102`, or a circle `lat,lon,radius` in degrees and metres.

    Returns:
        The region.

    Raises:
        RegionError: the text is none of these.
    """
    try:
        return _parse(text.strip())
    except (ValueError, GndError) as error:
        raise RegionError(
            f"cannot read the region {text!r} ({error}): give a wildcard like 13033/03021/**, a tile id, "
            "a tile path, or lat,lon,radius in degrees and metres"
        ) from error


def as_region(region: "Region | TileId | str | None") -> Region:
    """A region from what users give: one, a tile, the text of `parse_region`; None or "" is the whole world.

    Raises:
        RegionError: a text that is no region.
    """
    if isinstance(region, Region):
        return region
    if isinstance(region, TileId):
        return _single(region)
    return parse_region(region) if region else Region("")


def _parse(text: str) -> Region:
    if "," in text:
        lat_deg, lon_deg, radius_m = (float(part) for part in text.split(","))
        return _circle(lat_deg, lon_deg, radius_m)
    if text.isdecimal():
        return _single(TileId(int(text)))
    if text.endswith("**"):
        return Region(_checked_prefix(text.removesuffix("**").rstrip("/")))
    if text.count("/") == 3:
        return _single(TileId.from_path(text))
    raise ValueError("neither wildcard, tile nor circle")


def _single(tile: TileId) -> Region:
    return Region(tile.path, frozenset((tile,)))


def _circle(lat_deg: float, lon_deg: float, radius_m: float) -> Region:
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180 and 0 < radius_m <= MAX_RADIUS_M):
        raise ValueError(f"latitude within 90, longitude within 180 degrees, radius within {MAX_RADIUS_M:.0f} m")
    tiles = covering_circle(math.radians(lat_deg), math.radians(lon_deg), radius_m)
    return Region(_common_prefix([tile.path for tile in tiles]), frozenset(tiles))


def _common_prefix(paths: list[str]) -> str:
    return posixpath.commonpath(paths)


def _checked_prefix(prefix: str) -> str:
    for chunk in filter(None, prefix.split("/")):
        if len(chunk) != 5 or set(chunk) - set("0123"):
            raise ValueError(f"chunk {chunk!r} is not five digits 0 to 3")
    return prefix
