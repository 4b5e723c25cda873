"""Tiles on disk are verified at every read."""

from dataclasses import replace
from pathlib import Path

import apsw
import numpy as np
import pytest
from vehicle_scene import ground, tiles_of

from gnd.gnd_map.codec import CODEC_FLOAT32, CODEC_FLOAT32_ZSTD, CODEC_STANDARD, CODEC_STANDARD_ZSTD, LATTICES, snap
from gnd.gnd_map.day import UNKNOWN_DAY
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.tiles import blob_of
from gnd.vehicle_agent.errors import CacheError
from gnd.vehicle_agent.link.cache import TileCache


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


def test_a_tile_keeps_its_day_and_a_cache_of_an_older_release_gets_room_for_it(tmp_path: Path, tile: Tile) -> None:
    path = tmp_path / "cache.sqlite"
    TileCache(path).put(replace(tile, day=9000))
    with apsw.Connection(str(path)) as other:
        other.execute("ALTER TABLE tile DROP COLUMN day")
    cache: TileCache[Tile] = TileCache(path)
    old = cache.get(tile.tile_id)
    assert old is not None
    assert old.day == UNKNOWN_DAY
    cache.put(replace(tile, version=tile.version + 1, day=9750))
    new = TileCache(path).get(tile.tile_id)
    assert new is not None
    assert (new.version, new.day) == (tile.version + 1, 9750)


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


@pytest.mark.parametrize("codec_id", [CODEC_FLOAT32, CODEC_FLOAT32_ZSTD, CODEC_STANDARD, CODEC_STANDARD_ZSTD])
def test_a_body_is_kept_as_it_arrived(tmp_path: Path, tile: Tile, codec_id: int) -> None:
    published = Tile(tile.tile_id, 4, snap(tile.gaussians, LATTICES["standard"]))
    blob = blob_of(published, codec_id)
    cache = TileCache(tmp_path / "cache.sqlite")
    assert cache.keep(blob)
    assert cache.get(tile.tile_id) == published
    with apsw.Connection(str(tmp_path / "cache.sqlite")) as other:
        assert list(other.execute("SELECT codec_id, body FROM tile")) == [(codec_id, blob.body)]


def test_what_came_late_replaces_only_what_it_was_asked_over(tmp_path: Path, tile: Tile) -> None:
    cache = TileCache(tmp_path / "cache.sqlite")
    old, new, newest = (Tile(tile.tile_id, v, tile.gaussians.take(np.arange(10 * v))) for v in (1, 2, 3))
    assert cache.put(old)
    assert cache.put(newest)
    assert not cache.put(new, over=old.sha), "a late answer to a question that was put over version 1"
    assert cache.heads([tile.tile_id, TileId(1)]) == {tile.tile_id: (3, newest.sha)}
    assert cache.put(new, over=newest.sha), "what the store says now, although it counts anew"
    assert cache.head(tile.tile_id) == (2, new.sha)
