"""A watcher on a real router: notices of its region, nothing else, and what it missed from the catalog."""

import queue
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gnd.deploy.watch import TileWatch, WatchEvent
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.region import parse_region
from gnd.gnd_map.tile import Tile, diff
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import update_key
from gnd.schemas.updates import TileUpdate
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore

HERE, ELSEWHERE = TileId(497353963154), TileId(0)
DEADLINE_S = 30.0


def flat(voxels: int) -> Gaussians:
    cov = np.tile(np.array([0.08, 0, 0, 0.08, 0, 0.0009], np.float32), (voxels, 1))
    count = np.full(voxels, 100, np.int32)
    return Gaussians(np.arange(voxels, dtype=np.int32), count, count, np.zeros((voxels, 3), np.float32), cov)


def notice(tile: TileId, version: int) -> TileUpdate:
    before, after = Tile(tile, version - 1, flat(version - 1)), Tile(tile, version, flat(version))
    delta = diff(before.gaussians, after.gaussians)
    return TileUpdate(tile, "ndt", version, version - 1, after.sha, before.sha, "merged", delta)


@pytest.fixture
def bus(free_port: int) -> Iterator[Bus]:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_router((endpoint,)), open_bus(BusConfig(connect=(endpoint,)), name="test") as bus:
        yield bus


@pytest.fixture
def store(tmp_path: Path, bus: Bus) -> Iterator[SqliteStore]:
    with SqliteStore(tmp_path / "store.sqlite") as store:
        store.put_tiles([Tile(tile, 1, flat(1)) for tile in (HERE, ELSEWHERE)])
        with TileServer(store, bus):
            yield store


@pytest.fixture
def seen(bus: Bus, store: SqliteStore) -> Iterator["queue.Queue[WatchEvent]"]:
    """Events of the 39 km around the tile of Figure 2."""
    events: queue.Queue[WatchEvent] = queue.Queue()
    stop = threading.Event()
    watch = TileWatch(bus, parse_region("13033/03021/**"), events.put)
    thread = threading.Thread(target=watch.run, args=(stop,))
    thread.start()
    yield events
    stop.set()
    thread.join(DEADLINE_S)
    assert not thread.is_alive()


def publish_until_seen(bus: Bus, events: "queue.Queue[WatchEvent]", update: TileUpdate) -> WatchEvent:
    """Publish a notice again until the subscription has taken effect."""
    for _ in range(int(DEADLINE_S / 0.2)):
        bus.publish(update_key("ndt", update.tile), update.encode(), kind="update")
        try:
            return events.get(timeout=0.2)
        except queue.Empty:
            continue
    raise AssertionError(f"no notice within {DEADLINE_S} s")


def test_a_notice_of_the_region_is_seen_once_and_others_never(
    bus: Bus, store: SqliteStore, seen: "queue.Queue[WatchEvent]"
) -> None:
    event = publish_until_seen(bus, seen, notice(HERE, 2))
    assert (event.tile, event.version, event.previous_version, event.reason) == (HERE.morton, 2, 1, "merged")
    assert (event.put, event.removed) == (1, 0)
    assert "v1 -> v2" in event.line()
    for update in (notice(ELSEWHERE, 2), notice(HERE, 2), notice(HERE, 3)):
        bus.publish(update_key("ndt", update.tile), update.encode(), kind="update")
    assert seen.get(timeout=DEADLINE_S).version == 3  # neither the other region's nor the repeated notice came before


def test_a_version_whose_notice_was_lost_is_found_in_the_catalog(
    bus: Bus, store: SqliteStore, seen: "queue.Queue[WatchEvent]"
) -> None:
    publish_until_seen(bus, seen, notice(HERE, 2))
    for version in (2, 3):
        store.put_tiles([Tile(HERE, version, flat(version + 4))])
    event = seen.get(timeout=DEADLINE_S)
    assert (event.tile, event.version, event.reason, event.put) == (HERE.morton, 3, "catalog", None)


def test_an_unreadable_notice_is_passed_over(bus: Bus, store: SqliteStore, seen: "queue.Queue[WatchEvent]") -> None:
    publish_until_seen(bus, seen, notice(HERE, 2))
    bus.publish(update_key("ndt", HERE), b"\xff" * 40, kind="update")
    assert publish_until_seen(bus, seen, notice(HERE, 3)).version == 3
