"""The dense window: what it says of held, absent and unknown tiles, and where the Gaussians end up."""

import numpy as np
import pytest
from vehicle_scene import FIGURE_2, FRAME, GRID_FRAME, ground, tiles_of, wall

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent import local_map as local_map_module
from gnd.vehicle_agent.errors import WindowTooLarge
from gnd.vehicle_agent.local_map import EMPTY, UNKNOWN, LocalMap


@pytest.fixture(scope="module")
def tiles() -> dict[TileId, Tile]:
    return tiles_of(np.concatenate([ground(), wall(6.3)]))


def filled(tiles: dict[TileId, Tile]) -> LocalMap:
    local_map = LocalMap(GRID_FRAME)
    for tile in tiles.values():
        local_map.set_tile(tile)
    return local_map


def state_of(local_map: LocalMap, g: np.ndarray) -> int:
    return int(local_map.index[tuple(g - local_map.window_origin_g)])


def test_every_gaussian_is_found_at_its_voxel_with_its_mean_and_covariance(tiles: dict[TileId, Tile]) -> None:
    local_map = filled(tiles)
    assert local_map.count == sum(len(t.gaussians) for t in tiles.values())
    for tile_id, tile in tiles.items():
        frame = LocalFrame.of_tile(tile_id)
        R = FRAME.R_ecef_enu.T @ frame.R_ecef_enu
        for k in range(0, len(tile.gaussians), 97):
            voxel = tile.gaussians.voxel_id[k]
            g = GRID_FRAME.grid_of_voxel(tile_id, [voxel])[0]
            row = state_of(local_map, g)
            p_tile = VoxelGrid.of(tile_id).centre_m([voxel])[0] + tile.gaussians.mean_m[k]
            p_map = FRAME.enu_from_ecef(frame.ecef_from_enu(p_tile))
            np.testing.assert_allclose(local_map.mean_map_m[row], p_map, atol=1e-6)
            expected = R @ tile.gaussians.full_cov()[k] @ R.T
            np.testing.assert_allclose(
                local_map.cov_m2[row], expected[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], atol=1e-9
            )


def test_window_of_neighbouring_tiles_has_no_gap_and_no_overlap(tiles: dict[TileId, Tile]) -> None:
    local_map = filled(tiles)
    columns = np.zeros(local_map.index.shape[:2], int)
    for tile_id in local_map.tiles:
        columns[local_map.box_of(tile_id)] += 1
    np.testing.assert_array_equal(columns == 1, (local_map.index != UNKNOWN).all(axis=2))
    assert columns.max() == 1


def test_a_tile_that_is_not_held_is_unknown_and_an_absent_one_is_empty(tiles: dict[TileId, Tile]) -> None:
    first, second, *_ = sorted(tiles)
    local_map = LocalMap(GRID_FRAME)
    local_map.set_tile(tiles[first])
    beside = GRID_FRAME.grid_of_voxel(second, VoxelGrid.of(second).voxel_id([3], [3], [30]))[0]
    local_map.set_absent(second)
    assert state_of(local_map, beside) == EMPTY
    assert local_map.is_absent(second)
    assert local_map.tile(second) == Tile(second, 0, Gaussians.empty())
    local_map.remove_tile(second)
    assert local_map.tiles == (first,)
    assert local_map.tile(second) is None
    local_map.set_tile(tiles[max(tiles)])  # the window spans the removed tile again
    assert state_of(local_map, beside) == UNKNOWN


def test_a_newer_version_replaces_the_older_one(tiles: dict[TileId, Tile]) -> None:
    local_map = filled(tiles)
    tile_id = min(tiles)
    fewer = Tile(tile_id, 2, tiles[tile_id].gaussians.take(np.arange(10)))
    before, generation = local_map.count, local_map.generation
    local_map.set_tile(fewer)
    assert local_map.generation > generation
    assert local_map.count == before - len(tiles[tile_id].gaussians) + 10
    rows = local_map.tile_rows[tile_id]
    assert rows.stop - rows.start == 10


def test_floors_are_covered_where_the_map_says_nothing(tiles: dict[TileId, Tile]) -> None:
    local_map = LocalMap(GRID_FRAME)
    local_map.set_absent(FIGURE_2[0])
    assert local_map.index.shape[2] == 1
    local_map.cover_floors(25, 40)
    assert local_map.window_origin_g[2] == 25
    assert local_map.index.shape[2] == 16
    generation = local_map.generation
    local_map.cover_floors(30, 35)
    assert local_map.generation == generation


def test_an_empty_map_has_an_empty_window() -> None:
    local_map = LocalMap(GRID_FRAME)
    assert local_map.count == 0
    assert local_map.index.size == 0
    local_map.remove_tile(FIGURE_2[0])
    assert local_map.generation == 0


def test_tiles_too_far_apart_are_refused_with_numbers(
    tiles: dict[TileId, Tile], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local_map_module, "MAX_WINDOW_VOXELS", 1000)
    with pytest.raises(WindowTooLarge, match=r"9 tiles span \d+ x \d+ x \d+ voxels; the limit is 1000"):
        _ = filled(tiles).index
