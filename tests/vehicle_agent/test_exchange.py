"""One question about tiles of a district: answers in parts, out of date, forged or none at all."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import apsw
import numpy as np
import pytest
from vehicle_scene import ground, published
from waiting import wait_until

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.serving import Request
from gnd.gnd_map.codec import encode_delta
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.schemas.keys import batch_key, batch_keys, parse_batch_key
from gnd.schemas.tiles import blob_of
from gnd.schemas.tiles_batch import TileAnswer, TilesReply, TilesRequest
from gnd.tile_client.exchange import Exchange, shares_of
from gnd.tile_store.answers import TileAnswers
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher

LARGE = 1 << 20


@pytest.fixture(scope="module")
def tiles() -> dict[TileId, Tile]:
    return {t: tile for t, tile in published(ground(20.0)).items() if len(tile.gaussians) > 100}


@pytest.fixture
def cache(tmp_path: Path) -> Iterator[TileCache]:
    opened = TileCache(tmp_path / "cache.sqlite")
    yield opened
    opened.close()


@pytest.fixture
def exchange(bus: Bus, cache: TileCache) -> Exchange:
    return Exchange(bus, cache, 5.0)


def one(tiles: dict[TileId, Tile]) -> Tile:
    return tiles[min(tiles)]


def without(tile: Tile, count: int, version: int) -> Tile:
    return Tile(tile.tile_id, version, tile.gaussians.take(np.arange(count, len(tile.gaussians))))


def delta(old: Tile, new: Tile) -> TileAnswer:
    return TileAnswer("delta", new.version, new.sha[:4], 0, encode_delta(new.tile_id, old.gaussians, new.gaussians))


def blob(tile: Tile) -> TileAnswer:
    return TileAnswer("blob", tile.version, tile.sha[:4], 3, blob_of(tile, 3).body)


def serve(cloud: Bus, tile: Tile, *answers: TileAnswer, before: Callable[[], object] = lambda: None) -> list[Request]:
    """A server that gives these answers to every question."""
    asked: list[Request] = []

    def answer(request: Request) -> bytes:
        asked.append(request)
        before()
        return TilesReply(answers).encode()

    cloud.serve(batch_key("ndt", tile.tile_id.district), answer)
    return asked


def test_what_does_not_fit_comes_with_a_later_question_and_nothing_twice(
    exchange: Exchange, cache: TileCache, cloud: Bus, tmp_path: Path, tiles: dict[TileId, Tile]
) -> None:
    district = min(tiles).district
    waiting = [t for t in tiles if t.district == district]
    with SqliteStore(tmp_path / "store.sqlite") as store:
        store.put_tiles(list(tiles.values()))
        with TileServer(store, cloud):
            came = []
            for _ in range(len(waiting)):
                outcome = exchange.ask(waiting, (), 1)
                assert len(outcome.fetched) == 1, "the first body always fits, a second never does"
                came += [fetched.tile_id for fetched in outcome.fetched]
                waiting = outcome.later
    assert waiting == []
    assert sorted(came) == sorted(t for t in tiles if t.district == district)
    assert all(cache.head(t)[1] == tiles[t].sha for t in came)


def two_districts(tiles: dict[TileId, Tile]) -> list[TileId]:
    """Tiles of two districts: where the ground's do not reach a border, absent ones of the next."""
    first = sorted(tiles)[0]
    return [*sorted(t for t in tiles if t.district == first.district)[:3], TileId(first.morton + 1024)]


def test_tiles_of_two_districts_are_asked_for_at_once(
    exchange: Exchange, cache: TileCache, cloud: Bus, tmp_path: Path, tiles: dict[TileId, Tile]
) -> None:
    """With what is held of both; a store that does not know that is told by hashes, district by district."""
    here = one(tiles)
    there = Tile(TileId(here.tile_id.morton + 1024), 1, here.gaussians)
    wanted = [here.tile_id, there.tile_id]
    with SqliteStore(tmp_path / "store.sqlite") as store:
        store.put_tiles([here, there])
        with TileServer(store, cloud):
            first = exchange.ask(wanted, (), LARGE, near=here.tile_id)
            assert [fetched.status for fetched in first.fetched] == ["blob", "blob"]
            store.put_tiles([without(there, 3, version=2)])
            again = exchange.ask(wanted, (), LARGE)
            assert [fetched.status for fetched in again.fetched] == ["unchanged", "delta"]
            cache.put(without(there, 9, version=7), over=cache.head(there.tile_id)[1])
            foreign = exchange.ask(wanted, (), LARGE)
    assert [fetched.status for fetched in foreign.fetched] == ["unchanged", "blob"]
    assert foreign.unanswered == []


@pytest.mark.parametrize("told", ["an older server", "a server of other districts"])
def test_districts_that_do_not_go_along_are_asked_for_one_by_one(
    bus: Bus, cache: TileCache, cloud: Bus, tmp_path: Path, tiles: dict[TileId, Tile], told: str
) -> None:
    wanted, asked = two_districts(tiles), list[TilesRequest]()
    with SqliteStore(tmp_path / "store.sqlite") as store:
        store.put_tiles(list(tiles.values()))
        answers = TileAnswers(store)

        def answer(request: Request) -> bytes:
            layer, district = parse_batch_key(request.key)
            asked.append(TilesRequest.decode(request.payload))
            others = (None,) * len(asked[-1].others) if told == "a server of other districts" else ()
            return replace(answers.many(layer, district, asked[-1]), others=others).encode()

        cloud.serve(batch_keys(), answer)
        fetcher = TileFetcher(bus, cache, DownloadParameters(in_flight=1))
        fetcher.want(wanted)
        assert fetcher.wait_for(wanted, 15.0, threading.Event()) == set()
        fetcher.recheck()
        wait_until(lambda: fetcher.counts.total() == 2 * len(wanted))
        bus.close()
        fetcher.close()
    assert [len(request.others) for request in asked] == [1, 0, 0, 0], "they go along no more"
    assert fetcher.counts == {"blob": 3, "absent": 2, "unchanged": 3}


def test_bodies_of_all_districts_share_the_room_of_an_answer(
    exchange: Exchange, cloud: Bus, tmp_path: Path, tiles: dict[TileId, Tile]
) -> None:
    """Those around the tile that is needed first come first, whichever district they are of."""
    here = one(tiles)
    copies = [Tile(TileId(here.tile_id.morton + 1024 * step), 1, here.gaussians) for step in range(4)]
    wanted = [tile.tile_id for tile in copies]
    with SqliteStore(tmp_path / "store.sqlite") as store:
        store.put_tiles(copies)
        with TileServer(store, cloud):
            outcome = exchange.ask(wanted, (), 1, near=wanted[0])
    assert [fetched.tile_id for fetched in outcome.fetched] == wanted[:1]
    assert sorted(outcome.later) == sorted(wanted[1:])
    districts = [tile.district for tile in wanted]
    fifth = TileId(wanted[0].morton + 4096).district
    assert exchange.goes_along(districts[:3], districts[3])
    assert not exchange.goes_along(districts, fifth)
    assert exchange.goes_along(districts, districts[0])


def test_a_store_that_does_not_know_what_is_held_is_told_by_hashes(
    exchange: Exchange, cache: TileCache, cloud: Bus, tmp_path: Path, tiles: dict[TileId, Tile]
) -> None:
    tile = one(tiles)
    cache.put(without(tile, 9, version=7))  # of a store that is gone
    with SqliteStore(tmp_path / "store.sqlite") as store:
        store.put_tiles([tile])
        with TileServer(store, cloud):
            outcome = exchange.ask([tile.tile_id], (), LARGE)
    assert [fetched.status for fetched in outcome.fetched] == ["blob"]
    assert cache.head(tile.tile_id) == (1, tile.sha), "a store that was built anew counts from 1"


@pytest.mark.parametrize("kind", ["delta", "blob"])
def test_an_answer_overtaken_by_a_notice_changes_nothing(
    exchange: Exchange, cache: TileCache, cloud: Bus, tiles: dict[TileId, Tile], kind: str
) -> None:
    old = one(tiles)
    newer, newest = without(old, 3, version=2), without(old, 6, version=3)
    cache.put(old)
    asked = serve(cloud, old, delta(old, newer) if kind == "delta" else blob(newer), before=lambda: cache.put(newest))
    (fetched,) = exchange.ask([old.tile_id], (), LARGE).fetched
    assert fetched.tile == newest
    assert cache.head(old.tile_id) == (3, newest.sha)
    assert len(asked) == 1


def test_the_same_news_by_notice_and_by_delta_is_one_version(
    exchange: Exchange, cache: TileCache, cloud: Bus, tiles: dict[TileId, Tile]
) -> None:
    old = one(tiles)
    new = without(old, 3, version=2)
    cache.put(old)
    serve(cloud, old, delta(old, new), before=lambda: cache.put(new, over=old.sha))
    (fetched,) = exchange.ask([old.tile_id], (), LARGE).fetched
    assert (fetched.status, fetched.tile) == ("unchanged", new)


def test_a_delta_for_another_content_is_refused_and_the_whole_tile_asked_for(
    bus: Bus, cache: TileCache, cloud: Bus, tiles: dict[TileId, Tile]
) -> None:
    old = one(tiles)
    new = without(old, 3, version=2)
    cache.put(old)
    requests: list[TilesRequest] = []

    def answer(request: Request) -> bytes:
        requests.append(TilesRequest.decode(request.payload))
        wrong = delta(without(old, 50, version=1), new)
        return TilesReply((wrong if requests[-1].n_held else blob(new),)).encode()

    cloud.serve(batch_key("ndt", old.tile_id.district), answer)
    fetcher = TileFetcher(bus, cache, DownloadParameters(in_flight=2))
    fetcher.want([old.tile_id])
    wait_until(lambda: fetcher.counts["blob"] == 1)
    bus.close()
    fetcher.close()
    assert fetcher.counts == {"refused": 1, "blob": 1}
    assert [request.n_held for request in requests] == [1, 0]
    assert cache.head(old.tile_id) == (2, new.sha)


def test_forged_bodies_are_named_and_never_kept(
    exchange: Exchange, cache: TileCache, cloud: Bus, tiles: dict[TileId, Tile]
) -> None:
    tile = one(tiles)
    good = blob(tile)
    forged = [
        replace(good, body=good.body[:-1]),
        replace(good, body=bytes([good.body[0] ^ 1]) + good.body[1:]),
        replace(good, sha=bytes(4)),
        replace(good, codec_id=4711),
        replace(good, body=b"\xff" * 40),
        replace(good, body=b""),
    ]
    for answer in forged:
        handler = cloud.serve(batch_key("ndt", tile.tile_id.district), lambda _, a=answer: TilesReply((a,)).encode())
        outcome = exchange.ask([tile.tile_id], (), LARGE)
        handler.close()
        assert outcome.fetched == []
        assert tile.tile_id.path in outcome.wrong[tile.tile_id]
    assert len(cache) == 0


@pytest.mark.parametrize(
    "reply",
    [
        b"\xff rubbish",
        TilesReply((TileAnswer("absent"), TileAnswer("absent"))).encode(),
        TilesReply((TileAnswer("unchanged"),)).encode(),
        TilesReply((TileAnswer("delta", 2, bytes(4), 0, b"x"),)).encode(),
    ],
    ids=["none", "about two tiles", "unchanged, yet nothing is held", "a delta, yet nothing is held"],
)
def test_an_answer_to_another_question_is_refused(
    exchange: Exchange, cache: TileCache, cloud: Bus, tiles: dict[TileId, Tile], reply: bytes
) -> None:
    tile = one(tiles)
    cloud.serve(batch_key("ndt", tile.tile_id.district), lambda _: reply)
    with pytest.raises(SchemaError):
        exchange.ask([tile.tile_id], (), LARGE)
    assert len(cache) == 0
    request = TilesRequest(((tile.tile_id.morton % 1024, 0),))
    assert shares_of(request, tile.tile_id.district, reply) == [], "booked whole"


def test_a_server_that_always_says_later_is_not_asked_without_a_pause(
    bus: Bus, cache: TileCache, cloud: Bus, tiles: dict[TileId, Tile], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gnd.vehicle_agent.link.download.RETRY_S", 60.0)
    tile = one(tiles)
    cache.put(tile)
    asked = serve(cloud, tile, TileAnswer("later"))
    fetcher = TileFetcher(bus, cache, DownloadParameters(in_flight=2))
    fetcher.want([tile.tile_id])
    wait_until(lambda: fetcher.counts["cached"] == 1)
    fetcher.want([tile.tile_id])
    assert fetcher.wait_for([TileId(tile.tile_id.morton + 1)], 0.5, threading.Event())
    bus.close()
    fetcher.close()
    assert len(asked) == 1


def test_the_shares_of_an_answer_add_up_to_it(tiles: dict[TileId, Tile]) -> None:
    old = one(tiles)
    district = old.tile_id.district
    index = old.tile_id.morton % 1024
    request = TilesRequest(((index, 1), (index + 1, 0), (index + 2, 0)), held_digest=bytes(8))
    answers = (delta(old, without(old, 3, version=2)), TileAnswer("absent"), blob(old))
    payload = TilesReply(answers).encode()
    shares = shares_of(request, district, payload)
    assert [share.kind for share in shares] == ["tile", "delta", "tile"]
    assert [share.tile for share in shares] == [None, old.tile_id, TileId(old.tile_id.morton + 2)]
    assert sum(share.app_bytes for share in shares) == len(payload)
    assert [share.app_bytes for share in shares[1:]] == [4 + len(answers[0].body), 4 + len(answers[2].body)]


def test_a_cache_that_cannot_be_read_nor_written_stops_no_download(
    bus: Bus, cache: TileCache, cloud: Bus, tmp_path: Path, tiles: dict[TileId, Tile]
) -> None:
    with apsw.Connection(str(tmp_path / "cache.sqlite")) as other:
        other.execute("DROP TABLE tile")
    fetcher = TileFetcher(bus, cache, DownloadParameters(in_flight=2))
    with SqliteStore(tmp_path / "store.sqlite") as store:
        store.put_tiles(list(tiles.values()))
        with TileServer(store, cloud):
            fetcher.want(list(tiles))
            assert fetcher.wait_for(tiles, 15.0, threading.Event()) == set()
    bus.close()
    fetcher.close()
    assert {f.tile_id: f.tile and f.tile.sha for f in fetcher.take()} == {t: tile.sha for t, tile in tiles.items()}
    assert fetcher.counts == {"blob": len(tiles)}
