import numpy as np
import pytest
from load_testing import FIRST, street_tiles, track_along, whole_report

from gnd.cloud_merger.errors import MissingBase
from gnd.cloud_merger.expanding import expand, with_measured
from gnd.deploy.errors import LoadError
from gnd.deploy.load.shift import (
    DISTRICT_TILES,
    DISTRICTS_ROUND,
    DistrictShift,
    places_of_streets,
    shifted_district,
    shifted_tile,
    shifted_tile_id,
)
from gnd.gnd_map.codec import encode_mask
from gnd.gnd_map.tile_id import LON_TILES, TileId
from gnd.vehicle_agent.report.packing import askable, pack, pack_measured


@pytest.mark.parametrize("districts", [0, 1, -1, 7, -1000, 20_000])
def test_there_and_back_again(districts):
    for tile in street_tiles():
        there = shifted_tile_id(tile.tile_id, districts)
        assert shifted_tile_id(there, -districts) == tile.tile_id
        assert there.lat_index == tile.tile_id.lat_index
        assert (there.lon_index - tile.tile_id.lon_index - DISTRICT_TILES * districts) % LON_TILES == 0
        assert there.district == shifted_district(tile.tile_id.district, districts)
        assert there.morton % 1024 == tile.tile_id.morton % 1024  # the same place in its district


@pytest.mark.parametrize("districts", [3, -250, 4000])
def test_lines_of_sight_of_a_shifted_report_are_the_shifted_lines_of_sight(districts):
    tile = street_tiles()[1]
    whole = whole_report("v", 0, tile)
    packed = pack(whole, {tile.sha: tile.gaussians}, track_along(tile))
    shift = DistrictShift(districts, {tile.tile_id: tile})
    here = expand(packed, "ndt", whole.district, [tile])
    moved = shift.packed(packed, [(tile.tile_id, tile.sha)])
    there = expand(moved, "ndt", shifted_district(whole.district, districts), [shifted_tile(tile, districts)])
    assert there.encode() == shift.whole(here).encode()
    assert len(there.tiles[0].observed) > 500
    assert there.tiles[0].tile == shifted_tile_id(tile.tile_id, districts)
    # The bytes that say what was seen are those of the kept report.
    assert (moved.flags, moved.track, moved.tiles) == (packed.flags, packed.track, packed.tiles)


def test_the_gaussians_of_a_report_are_read_where_it_was_moved_to():
    tile = street_tiles()[0]
    whole = whole_report("v", 0, tile)
    packed = pack(whole, {tile.sha: tile.gaussians}, track_along(tile))
    shift = DistrictShift(12, {tile.tile_id: tile})
    moved_tile = shifted_tile(tile, 12)
    there = expand(shift.packed(packed, [(tile.tile_id, tile.sha)]), "ndt", moved_tile.tile_id.district, [moved_tile])
    mask = np.ones(askable(whole), np.bool_)
    half = pack_measured(whole, {tile.sha: tile.gaussians}, encode_mask(mask))
    told = with_measured(there, {moved_tile.tile_id: moved_tile.gaussians}, mask, half.measured).tiles[0].changed
    said = whole.tiles[0].changed
    assert np.array_equal(told.voxel_id, said.voxel_id)
    assert np.array_equal(told.mean_m, said.mean_m)
    # It is what a vehicle there would have coded.
    assert (
        pack_measured(shift.whole(whole), {moved_tile.sha: tile.gaussians}, encode_mask(mask)).measured == half.measured
    )


def test_a_report_that_was_not_moved_with_its_street_is_not_understood_there():
    tile = street_tiles()[0]
    whole = whole_report("v", 0, tile)
    packed = pack(whole, {tile.sha: tile.gaussians}, track_along(tile))
    with pytest.raises(MissingBase):
        expand(packed, "ndt", shifted_district(whole.district, 5), [shifted_tile(tile, 5)])


def test_a_report_against_another_map_is_refused():
    tile = street_tiles()[0]
    with pytest.raises(LoadError, match="which is not its map"):
        DistrictShift(1, {tile.tile_id: tile}).sha(tile.tile_id, b"\1" * 32)


def test_streets_lie_side_by_side():
    tiles = [tile.tile_id for tile in street_tiles()]
    places = places_of_streets(tiles, 1000)
    districts = [{shifted_tile_id(tile, place).lon_index // DISTRICT_TILES for tile in tiles} for place in places]
    assert places[0] == 0
    every = sorted(column for columns in districts for column in columns)
    assert len(set(every)) == len(every)
    assert min(np.diff(every)) == 2  # an empty one between


def test_there_is_no_room_for_more_streets_than_the_parallel_has():
    with pytest.raises(LoadError, match="has room for"):
        places_of_streets([FIRST, TileId.from_indices(0, FIRST.lat_index)], DISTRICTS_ROUND)
