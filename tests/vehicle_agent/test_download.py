"""Tiles over a real bus from a real tile server: cached, absent, wrong, late."""

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from vehicle_scene import ground, published
from waiting import wait_until

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.serving import Request
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import batch_key, batch_keys, parse_batch_key
from gnd.schemas.tiles import blob_of
from gnd.schemas.tiles_batch import TileAnswer, TilesReply, TilesRequest
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher

QUICK = DownloadParameters(request_s=0.6, in_flight=3)
NEVER = threading.Event()


@pytest.fixture(scope="module")
def tiles() -> dict[TileId, Tile]:
    return {t: tile for t, tile in published(ground(20.0)).items() if len(tile.gaussians) > 100}


@pytest.fixture
def store(tmp_path: Path, tiles: dict[TileId, Tile]) -> Iterator[SqliteStore]:
    with SqliteStore(tmp_path / "store.sqlite") as opened:
        opened.put_tiles(list(tiles.values()))
        yield opened


@pytest.fixture
def cache(tmp_path: Path) -> TileCache:
    return TileCache(tmp_path / "cache.sqlite")


@pytest.fixture
def fetcher(bus: Bus, cache: TileCache) -> Iterator[TileFetcher]:
    opened = TileFetcher(bus, cache, QUICK)
    yield opened
    bus.close()
    opened.close()


def elsewhere(tiles: dict[TileId, Tile]) -> TileId:
    return TileId.from_indices(min(tiles).lon_index - 40, min(tiles).lat_index)


def test_tiles_arrive_and_absent_ones_are_remembered(
    fetcher: TileFetcher, cache: TileCache, cloud: Bus, store: SqliteStore, tiles: dict[TileId, Tile]
) -> None:
    nowhere = elsewhere(tiles)
    with TileServer(store, cloud):
        fetcher.want([nowhere, *tiles])
        assert fetcher.wait_for([nowhere, *tiles], 15.0, NEVER) == set()
        arrived = {f.tile_id: f for f in fetcher.take()}
        assert arrived[nowhere].status == "absent"
        for tile_id, tile in tiles.items():
            assert arrived[tile_id].status == "blob"
            assert arrived[tile_id].tile is not None
            assert arrived[tile_id].tile.gaussians == tile.gaussians
            assert cache.head(tile_id)[1] == tile.sha
        fetcher.want([nowhere, *tiles])  # all of it is known: nobody is asked again
        assert fetcher.wait_for([nowhere, *tiles], 1.0, NEVER) == set()
        assert fetcher.take() == []
    assert fetcher.counts == {"blob": len(tiles), "absent": 1}


def test_what_is_cached_is_not_sent_again_unless_it_changed(
    fetcher: TileFetcher, cache: TileCache, cloud: Bus, store: SqliteStore, tiles: dict[TileId, Tile]
) -> None:
    for tile_id in tiles:
        head = store.get("ndt", tile_id)
        assert head is not None
        cache.put(head.decode())
    changed = min(tiles)
    store.put_tiles([Tile(changed, 0, tiles[changed].gaussians.take(np.arange(50)))])
    with TileServer(store, cloud):
        fetcher.want(list(tiles))
        assert fetcher.wait_for(tiles, 15.0, NEVER) == set()
    assert fetcher.counts == {"unchanged": len(tiles) - 1, "delta": 1}
    assert all(f.tile is not None for f in fetcher.take())
    assert cache.head(changed)[0] == 2


def test_a_tile_with_the_wrong_hash_is_refused_by_name_and_fetched_again(
    fetcher: TileFetcher, cache: TileCache, cloud: Bus, tiles: dict[TileId, Tile]
) -> None:
    tile_id, tile = next(iter(tiles.items()))
    other = next(t for t in tiles.values() if t.tile_id != tile_id)
    requests: list[TilesRequest] = []
    cache.put(Tile(tile_id, 1, tile.gaussians.take(np.arange(9))))

    def answer(request: Request) -> bytes:
        requests.append(TilesRequest.decode(request.payload))
        body = blob_of(other).body if len(requests) == 1 else blob_of(tile).body
        return TilesReply((TileAnswer("blob", 2, tile.sha[:4], 0, body),)).encode()

    cloud.serve(batch_key("ndt", tile_id.district), answer)
    fetcher.want([tile_id])
    assert fetcher.wait_for([tile_id], 15.0, NEVER) == set()
    (fetched,) = fetcher.take()
    assert fetched.tile is not None
    assert fetched.tile.gaussians == tile.gaussians
    assert fetcher.counts == {"refused": 1, "blob": 1}
    assert "content has sha" in fetcher.last_error
    assert cache.head(tile_id)[1] == tile.sha
    assert requests[0].n_held == 1
    assert requests[1].n_held == 0, "asked for as if nothing were cached"


def test_a_tile_that_stays_wrong_never_reaches_the_cache(
    fetcher: TileFetcher, cache: TileCache, cloud: Bus, tiles: dict[TileId, Tile]
) -> None:
    tile_id, other_id = sorted(tiles)[:2]
    other = blob_of(tiles[other_id])
    reply = TilesReply((TileAnswer("blob", 1, other.sha[:4], 0, other.body),))
    cloud.serve(batch_key("ndt", tile_id.district), lambda _: reply.encode())
    fetcher.want([tile_id])
    wait_until(lambda: fetcher.counts["failed"] >= 1)
    assert fetcher.counts["refused"] == 3 * fetcher.counts["failed"] or fetcher.counts["refused"] > 3
    assert "claimed is" in fetcher.last_error
    assert fetcher.take() == []
    assert len(cache) == 0


def test_without_the_store_the_cached_tile_has_to_do_until_it_answers(
    fetcher: TileFetcher, cache: TileCache, cloud: Bus, store: SqliteStore, tiles: dict[TileId, Tile]
) -> None:
    tile_id, unknown = sorted(tiles)[:2]
    old = Tile(tile_id, 1, tiles[tile_id].gaussians.take(np.arange(20)))
    cache.put(old)
    fetcher.want([tile_id, unknown])
    assert fetcher.wait_for([tile_id], 15.0, NEVER) == set()
    assert fetcher.wait_for([tile_id, unknown], 0.0, NEVER) == {unknown}
    (late,) = fetcher.take()
    assert (late.status, late.tile and late.tile.sha) == ("cached", old.sha)
    with TileServer(store, cloud):
        wait_until(lambda: fetcher.counts["blob"] == 2)
    assert {f.tile_id: f.status for f in fetcher.take()} == {tile_id: "blob", unknown: "blob"}


def test_waiting_ends_when_the_drive_is_stopped(fetcher: TileFetcher, tiles: dict[TileId, Tile]) -> None:
    stop = threading.Event()
    stop.set()
    fetcher.want(list(tiles))
    assert fetcher.wait_for(tiles, 60.0, stop) == set(tiles)


def test_a_tile_that_was_let_go_is_asked_for_again(
    fetcher: TileFetcher, cloud: Bus, store: SqliteStore, tiles: dict[TileId, Tile]
) -> None:
    tile_id = min(tiles)
    with TileServer(store, cloud):
        fetcher.want([tile_id])
        wait_until(lambda: fetcher.counts["blob"] == 1)
        fetcher.forget(tile_id)
        fetcher.want([tile_id])
        wait_until(lambda: fetcher.counts["unchanged"] == 1)


def all_absent(request: Request) -> bytes:
    """What a server says that has no tile of any district that it is asked about."""
    _, district = parse_batch_key(request.key)
    asked = TilesRequest.decode(request.payload).by_district(district).values()
    first, *others = (TilesReply((TileAnswer("absent"),) * len(one.wanted)) for one in asked)
    return replace(first, others=tuple(others)).encode()


@pytest.mark.parametrize(("link", "most"), [("none", 3), (LinkProfile("thin", 8e4, 8e4, 1.0, burst_bytes=0), 1)])
def test_as_many_questions_are_on_their_way_as_the_link_carries(
    endpoint: str, cloud: Bus, cache: TileCache, link: LinkProfile | str, most: int
) -> None:
    """Three questions, of four districts each, are on their way at a time on a fast link; on a slow one the next waits
    for the first.
    """
    districts = [TileId(497353963152 + 1024 * k) for k in range(12)]
    asked: list[str] = []
    answer_now = threading.Event()

    def answer(request: Request) -> bytes:
        asked.append(request.key)
        answer_now.wait(15.0)
        return all_absent(request)

    cloud.serve(batch_keys(), answer)
    wanted = [TileId(first.morton + k) for first in districts for k in range(4)]
    with open_bus(BusConfig(connect=(endpoint,), link=link), name="vehicle") as bus:
        opened = TileFetcher(bus, cache, DownloadParameters(in_flight=3))
        opened.want(wanted)
        wait_until(lambda: len(asked) == most)
        assert opened.wait_for(wanted, 0.5, NEVER) == set(wanted)
        assert len(asked) == most
        answer_now.set()
        assert opened.wait_for(wanted, 15.0, NEVER) == set()
        bus.close()
        opened.close()
    assert len(asked) >= len(set(asked)) >= 3


def test_of_tiles_named_besides_it_is_heard_which_are_on_no_map(
    fetcher: TileFetcher, cache: TileCache, cloud: Bus, store: SqliteStore, tiles: dict[TileId, Tile]
) -> None:
    """What is on a map is not brought for that (but for one body, which an answer always has room for)."""
    held, *others = sorted(tiles)
    head = store.get("ndt", held)
    assert head is not None
    cache.put(head.decode())
    in_district = [tile_id for tile_id in others if tile_id.district == held.district]
    assert len(in_district) >= 2
    every = (TileId(held.district.first_morton + index) for index in range(1024))
    nowhere = next(tile_id for tile_id in every if store.get("ndt", tile_id) is None)
    with TileServer(store, cloud):
        fetcher.want([], besides=[*in_district, nowhere])
        assert fetcher.wait_for([nowhere], 0.5, NEVER) == {nowhere}, "they are no reason to ask"
        fetcher.want([held], besides=[*in_district, nowhere])
        assert fetcher.wait_for([held, nowhere], 15.0, NEVER) == set()
        brought = {one.tile_id for one in fetcher.take() if one.status == "blob"}
        assert len(brought) <= 1
        fetcher.want([held], besides=[*in_district, nowhere])
        assert fetcher.wait_for(in_district, 0.5, NEVER) == set(in_district) - brought, "once is enough"
        fetcher.want(in_district)
        assert fetcher.wait_for(in_district, 15.0, NEVER) == set()
    assert fetcher.counts == {"unchanged": 1, "absent": 1, "blob": len(in_district)}
