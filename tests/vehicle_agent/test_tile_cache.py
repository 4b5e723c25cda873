"""Tiles on disk are verified at every read."""

from pathlib import Path

import apsw
import numpy as np
import pytest
from vehicle_scene import ground, tiles_of

from gnd_map.tile import Tile
from vehicle_agent.cache import TileCache
from vehicle_agent.errors import CacheError


@pytest.fixture(scope="module")
def tile() -> Tile:
    return next(iter(tiles_of(ground(6.0)).values()))


def test_a_tile_comes_back_as_it_was_also_after_a_restart(tmp_path: Path, tile: Tile) -> None:
    cache = TileCache(tmp_path / "cache.sqlite")
    assert cache.get(tile.tile_id) is None
    assert cache.head(tile.tile_id) == (0, b"")
    cache.put(tile)
    cache.close()
    again = TileCache(tmp_path / "cache.sqlite")
    found = again.get(tile.tile_id)
    assert found is not None
    assert (found.version, found.gaussians) == (tile.version, tile.gaussians)
    assert again.head(tile.tile_id) == (tile.version, tile.sha)
    assert TileCache(tmp_path / "cache.sqlite", "signs").get(tile.tile_id) is None


def test_a_newer_version_takes_the_place_of_the_older(tmp_path: Path, tile: Tile) -> None:
    cache = TileCache(tmp_path / "cache.sqlite")
    cache.put(tile)
    cache.put(Tile(tile.tile_id, 5, tile.gaussians.take(np.arange(3))))
    assert cache.head(tile.tile_id)[0] == 5
    assert len(cache) == 1


def test_a_tile_that_was_altered_on_disk_is_refused_and_dropped(tmp_path: Path, tile: Tile) -> None:
    cache = TileCache(tmp_path / "cache.sqlite")
    cache.put(tile)
    with apsw.Connection(str(tmp_path / "cache.sqlite")) as other:
        (body,) = next(other.execute("SELECT body FROM tile"))
        altered = body[:-1] + bytes([body[-1] ^ 1])
        other.execute("UPDATE tile SET body = ?", (altered,))
    assert cache.get(tile.tile_id) is None
    assert cache.refused == 1
    assert cache.head(tile.tile_id) == (0, b"")


def test_a_cache_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    (tmp_path / "cache.sqlite").mkdir()
    with pytest.raises(CacheError, match=r"cannot open .*cache.sqlite"):
        TileCache(tmp_path / "cache.sqlite")
