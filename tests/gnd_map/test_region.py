import math

import pytest

from gnd.gnd_map.errors import RegionError
from gnd.gnd_map.region import parse_region
from gnd.gnd_map.tile_id import TileId

SEOUL = TileId(497353963154)


def test_a_wildcard_is_every_tile_below_its_prefix() -> None:
    region = parse_region("13033/03021/**")
    assert region.prefix == "13033/03021"
    assert SEOUL in region
    assert TileId(0) not in region


def test_two_stars_are_the_world() -> None:
    assert TileId(0) in parse_region("**")


@pytest.mark.parametrize("text", ["497353963154", "13033/03021/23031/22102"])
def test_a_tile_is_itself_and_nothing_else(text: str) -> None:
    region = parse_region(text)
    assert region.prefix == SEOUL.path
    assert SEOUL in region
    assert all(neighbour not in region for neighbour in SEOUL.neighbours())


def test_a_circle_holds_the_tiles_it_touches() -> None:
    lat_rad, lon_rad = SEOUL.centre_rad
    region = parse_region(f"{math.degrees(lat_rad)},{math.degrees(lon_rad)},60")
    assert SEOUL in region
    assert all(neighbour in region for neighbour in SEOUL.neighbours())
    assert region.tiles is not None
    assert len(region.tiles) < 50
    assert all(tile.path.startswith(region.prefix) for tile in region.tiles)


@pytest.mark.parametrize(
    "text",
    ["", "seoul", "1,2", "91,0,10", "0,0,-5", "0,0,1e9", "nan,0,10", "99999999999999", "13/**", "54321/00000/**"],
)
def test_anything_else_is_refused_with_advice(text: str) -> None:
    with pytest.raises(RegionError, match="give a wildcard like"):
        parse_region(text)
