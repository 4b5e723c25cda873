"""Tiles: Figure 2 of the GND paper, then round trips and the edges of the Earth."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gnd.gnd_map.errors import GeodesyError, TileError
from gnd.gnd_map.tile_id import (
    LAT_TILES,
    LON_TILES,
    District,
    TileId,
    covering_circle,
    covering_corridor,
    deinterleave,
    interleave,
    morton_of,
)

WANGSIMNI = TileId(497353963154)
codes = st.integers(0, LON_TILES * LAT_TILES - 1)
latitudes = st.floats(-np.pi / 2, np.pi / 2)
longitudes = st.floats(-np.pi, np.pi)


@pytest.mark.parametrize(
    ("morton", "lon_index", "lat_index", "lat_deg", "lon_deg"),
    [
        (497353963152, 894308, 371544, 37.559509, 127.036285),  # south-west
        (497353963153, 894309, 371544, 37.559509, 127.036629),  # south-east
        (497353963154, 894308, 371545, 37.559853, 127.036285),  # north-west
        (497353963155, 894309, 371545, 37.559853, 127.036629),  # north-east
    ],
)
def test_the_four_tiles_of_figure_2(
    morton: int, lon_index: int, lat_index: int, lat_deg: float, lon_deg: float
) -> None:
    tile = TileId(morton)
    assert (tile.lon_index, tile.lat_index) == (lon_index, lat_index)
    assert np.degrees(tile.south_west_rad) == pytest.approx((lat_deg, lon_deg), abs=1e-6)
    assert TileId.from_indices(lon_index, lat_index) == tile
    assert TileId.from_geodetic(*tile.centre_rad) == tile


def test_path_and_district_of_figure_2() -> None:
    assert WANGSIMNI.path == "13033/03021/23031/22102"
    assert TileId.from_path("13033/03021/23031/22102") == WANGSIMNI
    assert WANGSIMNI.district == District("13033/03021/23031")
    assert WANGSIMNI.district.contains(WANGSIMNI)


@given(codes)
@example(0)
@example(LON_TILES * LAT_TILES - 1)
def test_path_indices_and_centre_lead_back_to_the_tile(code: int) -> None:
    tile = TileId(code)
    assert TileId.from_path(tile.path) == tile
    assert TileId.from_indices(tile.lon_index, tile.lat_index) == tile
    assert TileId.from_geodetic(*tile.centre_rad) == tile
    assert int(tile.path.replace("/", ""), 4) == code


@given(st.integers(0, LON_TILES - 1), st.integers(0, LAT_TILES - 1))
def test_interleaving_puts_longitude_on_even_bits(lon_index: int, lat_index: int) -> None:
    code = int(interleave(lon_index, lat_index))
    even = sum(((lon_index >> k) & 1) << (2 * k) for k in range(20))
    odd = sum(((lat_index >> k) & 1) << (2 * k + 1) for k in range(19))
    assert code == even + odd
    assert tuple(map(int, deinterleave(code))) == (lon_index, lat_index)


@given(latitudes, longitudes)
@example(np.pi / 2, 0.0)
@example(-np.pi / 2, -np.pi)
@example(0.0, np.pi)
def test_a_tile_holds_its_positions(lat: float, lon: float) -> None:
    tile = TileId.from_geodetic(lat, lon)
    south, west = tile.south_west_rad
    north, east = tile.north_east_rad
    rounding = 1e-14
    assert south - rounding <= lat <= north + rounding
    wrapped = lon if lon < np.pi - rounding else lon - 2.0 * np.pi  # a rounding error short of 180° is 180°
    assert west - rounding <= wrapped <= east + rounding


def test_morton_of_many_positions_is_that_of_each() -> None:
    rng = np.random.default_rng(1)
    lat, lon = rng.uniform(-np.pi / 2, np.pi / 2, 200), rng.uniform(-np.pi, np.pi, 200)
    assert [TileId.from_geodetic(*p).morton for p in zip(lat, lon, strict=True)] == morton_of(lat, lon).tolist()


def test_neighbours_wrap_at_the_date_line() -> None:
    tile = TileId.from_indices(LON_TILES - 1, 1000)
    assert len(tile.neighbours()) == 8
    assert {n.lon_index for n in tile.neighbours()} == {LON_TILES - 2, LON_TILES - 1, 0}


@pytest.mark.parametrize("lat_index", [0, LAT_TILES - 1])
def test_there_is_nothing_beyond_a_pole(lat_index: int) -> None:
    assert len(TileId.from_indices(7, lat_index).neighbours()) == 5


@given(codes)
def test_neighbourhood_is_mutual(code: int) -> None:
    assert all(TileId(code) in neighbour.neighbours() for neighbour in TileId(code).neighbours())


def test_a_district_is_1024_tiles_on_one_prefix() -> None:
    district = WANGSIMNI.district
    tiles = list(district.tiles())
    assert len(tiles) == len(set(tiles)) == 1024
    assert tiles == sorted(tiles)
    assert all(tile.path.startswith(district.path) and district.contains(tile) for tile in tiles)
    assert not district.contains(TileId(tiles[-1].morton + 1))
    assert TileId.from_geodetic(*district.centre_rad).district == district


@pytest.mark.parametrize("morton", [-1, LON_TILES * LAT_TILES])
def test_ids_beyond_39_bits_are_refused(morton: int) -> None:
    with pytest.raises(TileError, match=str(morton)):
        TileId(morton)


def test_an_id_must_be_a_python_int() -> None:
    with pytest.raises(TileError, match="int64"):
        TileId(np.int64(5))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "path", ["", "13033", "13033/03021/23031/2210", "23033/03021/23031/22102", "13033/03021/23031/22104"]
)
def test_paths_that_are_none_are_refused(path: str) -> None:
    with pytest.raises(TileError, match="tile path"):
        TileId.from_path(path)


def test_a_tile_path_is_no_district() -> None:
    with pytest.raises(TileError, match="district"):
        District(WANGSIMNI.path)


def test_indices_that_do_not_exist_are_refused() -> None:
    with pytest.raises(TileError, match="1048576"):
        TileId.from_indices(LON_TILES, 0)


@pytest.mark.parametrize(("lat", "lon"), [(37.0, 127.0), (float("nan"), 0.0), (0.0, float("inf"))])
def test_degrees_and_nan_are_refused(lat: float, lon: float) -> None:
    with pytest.raises(GeodesyError):
        TileId.from_geodetic(lat, lon)


def _nearest_m(tile: TileId, lat: float, lon: float) -> float:
    """Distance from a tile to a position by a dense grid of points over the tile and pyproj's geodesic."""
    from pyproj import Geod

    (south, west), (north, east) = tile.south_west_rad, tile.north_east_rad
    a, o = np.meshgrid(np.linspace(south, north, 41), np.linspace(west, east, 41))
    _, _, distance = Geod(ellps="WGS84").inv(o, a, np.full_like(o, lon), np.full_like(a, lat), radians=True)
    return 0.0 if TileId.from_geodetic(lat, lon) == tile else float(np.min(distance))


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg"), [(37.56, 127.036), (49.0, 8.4), (-33.0, 180.0), (0.0, 0.0), (85.0, -20.0)]
)
def test_a_circle_is_covered_by_exactly_the_tiles_it_touches(lat_deg: float, lon_deg: float) -> None:
    lat, lon, radius = np.radians(lat_deg), np.radians(lon_deg), 60.0
    found = set(covering_circle(lat, lon, radius))
    around = set(covering_circle(lat, lon, radius + 45.0))
    assert found < around
    for tile in around:
        distance = _nearest_m(tile, lat, lon)
        if abs(distance - radius) > 1.0:  # the oracle's points are up to 1 m apart
            assert (tile in found) == (distance < radius), f"{tile} at {distance} m"


def test_a_circle_of_no_radius_is_one_tile() -> None:
    assert covering_circle(*WANGSIMNI.centre_rad, 0.0) == (WANGSIMNI,)


def test_a_corridor_is_the_union_of_its_circles_without_gaps() -> None:
    lat = np.radians([37.5600, 37.5630])
    lon = np.radians([127.036, 127.041])
    corridor = set(covering_corridor(lat, lon, 30.0))
    for part in np.linspace(0.0, 1.0, 200):
        assert (
            set(covering_circle(lat[0] + part * (lat[1] - lat[0]), lon[0] + part * (lon[1] - lon[0]), 30.0)) <= corridor
        )
    grown = set(covering_corridor(lat, lon, 30.2))
    assert corridor <= grown
    assert len(covering_corridor(lat, lon, 80.0)) > len(corridor)


def test_a_corridor_crosses_the_date_line_the_short_way() -> None:
    tiles = covering_corridor(np.radians([10.0, 10.0]), np.radians([179.9995, -179.9995]), 5.0)
    assert len(tiles) < 20
    assert {tile.lon_index for tile in tiles} >= {0, LON_TILES - 1}


def test_a_circle_around_a_pole_is_refused_with_its_size() -> None:
    with pytest.raises(TileError, match="tiles, more than"):
        covering_circle(np.pi / 2, 0.0, 100.0)


def test_corridors_need_points_and_a_width() -> None:
    with pytest.raises(TileError, match="at least one"):
        covering_corridor(np.empty(0), np.empty(0), 10.0)
    with pytest.raises(TileError, match="radius"):
        covering_circle(0.0, 0.0, -1.0)
