"""Update notices over a real bus refresh the cache: by delta where it fits, by a download where not."""

from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np
import pytest
from vehicle_scene import ground, published
from waiting import wait_until

from gnd.fleet_bus.bus import Bus
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile import Tile, TileDelta, diff
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import update_key
from gnd.schemas.updates import TileUpdate
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher
from gnd.vehicle_agent.link.updates import Updates


class World:
    """A store with a base map, a vehicle that has cached it, and somebody who announces."""

    def __init__(self, cloud: Bus, bus: Bus, folder: Path) -> None:
        self.base = published(ground(12.0))
        self.tile_id = max(self.base, key=lambda t: len(self.base[t].gaussians))
        self.cloud, self.store = cloud, SqliteStore(folder / "store.sqlite")
        self.store.put_tiles(list(self.base.values()))
        self.server = TileServer(self.store, cloud).start()
        self.cache = TileCache(folder / "cache.sqlite")
        self.fetcher = TileFetcher(bus, self.cache, DownloadParameters(in_flight=2))
        self.given: list[Tile] = []
        self.updates = Updates(bus, self.cache, self.fetcher, self.given.append)

    def next_version(self, cut: int) -> TileUpdate:
        """Publish a version without the first `cut` Gaussians and describe it."""
        head = self.store.get("ndt", self.tile_id)
        assert head is not None
        old = head.decode()
        new = Tile(self.tile_id, old.version + 1, old.gaussians.take(np.arange(cut, len(old.gaussians))))
        self.store.put_tiles([new])
        delta = diff(old.gaussians, new.gaussians)
        return TileUpdate(self.tile_id, "ndt", new.version, old.version, new.sha, old.sha, "merged", delta)

    def announce(self, update: TileUpdate) -> None:
        """Publish until the vehicle has heard it: a subscription takes a moment to be known."""
        heard = self.updates.counts["received"] + self.updates.counts["refused"]

        def again() -> bool:
            self.cloud.publish(update_key("ndt", update.tile), update.encode(), kind="update")
            self.updates.apply()
            return self.updates.counts["received"] + self.updates.counts["refused"] > heard

        wait_until(again)


@pytest.fixture
def world(cloud: Bus, bus: Bus, tmp_path: Path) -> Iterator[World]:
    opened = World(cloud, bus, tmp_path)
    opened.updates.follow([opened.tile_id])
    yield opened
    bus.close()
    opened.fetcher.close()
    opened.server.close()
    opened.store.close()


def cached(world: World) -> int:
    return world.cache.head(world.tile_id)[0]


def download(world: World) -> None:
    world.fetcher.want([world.tile_id])
    wait_until(lambda: cached(world) > 0)


def test_a_subscription_that_fails_is_tried_again_and_one_that_holds_is_not(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiles, asked = (world.tile_id,), list[Collection[str]]()

    def fail(keys: Collection[str]) -> None:
        asked.append(keys)
        if len(asked) == 1:
            raise GndError("no session")

    monkeypatch.setattr(world.updates._notices, "follow", fail)
    with pytest.raises(GndError, match="no session"):
        world.updates.follow(tiles)
    for _ in range(2):
        world.updates.follow(tiles)
    assert len(asked) == 2


def test_a_delta_that_fits_makes_the_new_version(world: World) -> None:
    download(world)
    update = world.next_version(cut=5)
    world.announce(update)
    assert world.cache.head(world.tile_id) == (2, update.sha)
    assert [t.version for t in world.given] == [2]
    assert world.updates.counts["delta"] == 1
    assert world.fetcher.counts == {"blob": 1}


def test_a_missed_version_is_made_up_for_by_asking(world: World) -> None:
    download(world)
    world.next_version(cut=5)
    last = world.next_version(cut=9)
    world.announce(last)
    wait_until(lambda: cached(world) == 3)
    assert world.updates.counts["delta"] == 0
    assert world.fetcher.counts == {"blob": 1, "delta": 1}


def test_a_lost_notice_is_made_up_for_without_another(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing tells a vehicle that stands still that a router has dropped a notice for it."""
    download(world)
    world.next_version(cut=5)
    world.updates.apply()
    assert world.fetcher.is_known(world.tile_id)
    monkeypatch.setattr("gnd.vehicle_agent.link.updates.RECHECK_S", 0.1)
    monkeypatch.setattr("gnd.vehicle_agent.link.updates.RECHECK_LOOK_S", 0.05)
    wait_until(lambda: world.updates.apply() or cached(world) == 2)
    assert world.updates.counts["received"] == 0


def test_what_was_just_answered_is_not_asked_for_again(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    download(world)
    monkeypatch.setattr("gnd.vehicle_agent.link.updates.RECHECK_LOOK_S", 0.0)
    for _ in range(20):
        world.updates.apply()
    assert world.fetcher.is_known(world.tile_id)
    assert world.fetcher.counts == {"blob": 1}


def test_a_notice_without_delta_makes_the_vehicle_fetch(world: World) -> None:
    download(world)
    update = world.next_version(cut=5)
    world.announce(TileUpdate(**{n: getattr(update, n) for n in update.__slots__} | {"delta": None}))
    wait_until(lambda: cached(world) == 2)


def test_a_delta_that_does_not_give_the_announced_hash_is_refused_and_the_tile_fetched(world: World) -> None:
    download(world)
    update = world.next_version(cut=5)
    assert update.delta is not None
    wrong = TileDelta(update.delta.removed[:2], update.delta.put)
    world.announce(TileUpdate(**{n: getattr(update, n) for n in update.__slots__} | {"delta": wrong}))
    assert world.updates.counts["refused"] >= 1
    assert world.given == []
    wait_until(lambda: world.cache.head(world.tile_id) == (2, update.sha))


def test_old_news_and_news_of_tiles_never_asked_for_change_nothing(world: World) -> None:
    update = world.next_version(cut=5)
    world.announce(update)  # not cached, never asked for
    assert cached(world) == 0
    download(world)
    assert cached(world) == 2
    world.announce(update)
    assert world.given == []
    assert world.fetcher.counts == {"blob": 1}


def test_a_tile_that_the_store_had_not_is_fetched_when_it_appears(world: World) -> None:
    district = [t for t in world.tile_id.district.tiles() if t not in world.base]
    new_id = TileId(district[0].morton)
    world.fetcher.want([new_id])
    wait_until(lambda: world.fetcher.counts["absent"] == 1)
    tile = Tile(new_id, 1, world.base[world.tile_id].gaussians)
    world.store.put_tiles([tile])
    world.announce(TileUpdate(new_id, "ndt", 1, 0, tile.sha, b"", "merged", None))
    wait_until(lambda: world.cache.head(new_id)[0] == 1)


def test_a_tile_that_is_not_wanted_any_more_is_not_fetched_for_a_notice(world: World) -> None:
    download(world)
    world.fetcher.want([])
    world.next_version(cut=5)
    world.announce(world.next_version(cut=9))  # the version between is missing, so the delta does not fit
    assert not world.fetcher.is_known(world.tile_id)
    assert cached(world) == 1
    download(world)
    wait_until(lambda: cached(world) == 3)


def test_districts_that_are_left_are_no_longer_listened_to(world: World) -> None:
    others = [TileId(world.tile_id.morton + 1024 * k) for k in range(1, 5)]
    for other in others:
        world.updates.follow([other])
    update = world.next_version(cut=5)

    def heard_of_the_other() -> bool:
        world.cloud.publish(update_key("ndt", world.tile_id), update.encode(), kind="update")
        world.cloud.publish(update_key("ndt", other), b"a sign", kind="update")
        world.updates.apply()
        return world.updates.counts["refused"] > 0

    wait_until(heard_of_the_other)
    assert world.updates.counts["received"] == 0


def test_rubbish_is_counted_and_left_out(world: World) -> None:
    def again() -> bool:
        world.cloud.publish(update_key("ndt", world.tile_id), b"\xff\xff rubbish", kind="update")
        world.updates.apply()
        return world.updates.counts["refused"] > 0

    wait_until(again)
    assert world.updates.counts["received"] == 0
