"""Long clusters of changed voxels are cut into what somebody sees at one look, whatever the order of the voxels."""

from pathlib import Path

import numpy as np
import pytest
from map_export_maps import TILE

from gnd.deploy.map_export.changes import Change, changes_of_tiles
from gnd.deploy.map_export.pieces import LONGEST_M, pieces
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoredTile

RNG = np.random.default_rng(7)


def street(length_m: int, width_m: int, gap_m: int | None = None) -> F64:
    """Centres of a band of voxels, turned by 30 degrees; at `gap_m` it is one voxel wide."""
    x, y = (one.ravel().astype(float) for one in np.meshgrid(np.arange(length_m), np.arange(width_m)))
    kept = np.ones(len(x), bool) if gap_m is None else (x != gap_m) | (y == 0)
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    return np.asarray(np.stack([x[kept], y[kept]], axis=1) @ turn.T)


def span_m(at_m: F64) -> float:
    return float(np.linalg.norm(at_m[:, None] - at_m[None], axis=2).max())


@pytest.mark.parametrize(("length_m", "width_m"), [(76, 3), (40, 30), (15, 15), (200, 1)])
def test_no_piece_is_long_and_no_voxel_is_lost_or_twice(length_m: int, width_m: int) -> None:
    at_m = street(length_m, width_m)
    found = list(pieces(at_m))
    assert sorted(np.concatenate(found).tolist()) == list(range(len(at_m)))
    assert len(found) > 1
    # sixteen directions see a length within half a percent
    assert max(span_m(at_m[rows]) for rows in found) <= 1.005 * LONGEST_M
    assert min(len(rows) for rows in found) >= 2


def test_what_is_short_stays_whole_and_a_narrow_place_parts() -> None:
    assert [len(rows) for rows in pieces(street(12, 3))] == [36]
    first, second = sorted(pieces(street(20, 5, gap_m=7)), key=len)
    assert len(first) in (35, 36)  # what lies before the narrow place, with or without its one voxel
    assert len(second) == 35 + 61 - len(first)


def test_the_order_of_voxels_does_not_matter() -> None:
    at_m = street(76, 6, gap_m=30)
    order = RNG.permutation(len(at_m))
    once = {frozenset(rows.tolist()) for rows in pieces(at_m)}
    assert {frozenset(order[rows].tolist()) for rows in pieces(at_m[order])} == once


def _wall(tile: TileId, columns: range) -> Tile:
    grid = VoxelGrid.of(tile)
    ids = np.sort(np.array([int(grid.voxel_id(i, 5, z)) for i in columns for z in (116, 117)], np.int32))
    n = len(ids)
    six = np.tile(np.array([0.08, 0, 0, 0.01, 0, 0.08], np.float32), (n, 1))
    counts = np.full(n, 50, np.int32), np.full(n, 20, np.int32)
    return Tile(tile, 1, Gaussians(ids, *counts, np.zeros((n, 3), np.float32), six))


def test_a_wall_through_two_tiles_is_several_changes_the_same_for_any_order_of_tiles(tmp_path: Path) -> None:
    east = TileId.from_indices(TILE.lon_index + 1, TILE.lat_index)
    with SqliteStore(tmp_path / "walls.sqlite") as store:
        store.put_tiles([_wall(TILE, range(VoxelGrid.of(TILE).nx)), _wall(east, range(20))])
        pairs: list[tuple[TileId, StoredTile | None, StoredTile | None]]
        pairs = [(one, None, store.get("ndt", one)) for one in (TILE, east)]
        forwards = changes_of_tiles(store, "ndt", pairs, same_store=False)
        backwards = changes_of_tiles(store, "ndt", pairs[::-1], same_store=False)

    def told(one: Change) -> tuple[object, ...]:
        return [(part.tile, part.voxels) for part in one.parts], one.voxels, one.tiles, one.length_m

    assert len(forwards.changes) >= 4
    assert max(one.length_m for one in forwards.changes) <= LONGEST_M + 1.5
    assert sum(one.voxels for one in forwards.changes) == 2 * (VoxelGrid.of(TILE).nx + 20)
    assert [told(one) for one in forwards.changes] == [told(one) for one in backwards.changes]
    assert forwards.alone == backwards.alone == 0
