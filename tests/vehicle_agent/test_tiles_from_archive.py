"""A vehicle with an archive: tiles come from a web server, what is newer over the bus, all of it where that is away."""

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from vehicle_scene import ground, published
from web_fixtures import ServedFolder

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.ledger import Ledger
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_client.archive import Archive
from gnd.tile_client.http_reader import HURRIED
from gnd.tile_store.objects import FolderObjects
from gnd.tile_store.publishing import publish
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher

NEVER = threading.Event()


@pytest.fixture(scope="module")
def tiles() -> dict[TileId, Tile]:
    return {t: tile for t, tile in published(ground(20.0)).items() if len(tile.gaussians) > 100}


@pytest.fixture
def store(tmp_path: Path, tiles: dict[TileId, Tile]) -> Iterator[SqliteStore]:
    with SqliteStore(tmp_path / "store.sqlite") as opened:
        opened.put_tiles(list(tiles.values()))
        yield opened


@dataclass
class Vehicle:
    """Its fetcher, and what its ledger says of the archive."""

    bus: Bus
    cache: TileCache[Tile]
    ledger: Ledger
    fetcher: TileFetcher[Tile]

    def fetch(self, tiles: dict[TileId, Tile]) -> dict[TileId, str]:
        self.fetcher.want(list(tiles))
        assert self.fetcher.wait_for(tiles, 15.0, NEVER) == set()
        return {one.tile_id: one.status for one in self.fetcher.take()}


@pytest.fixture
def vehicle(bus: Bus, served: ServedFolder, tmp_path: Path) -> Iterator[Vehicle]:
    cache: TileCache[Tile] = TileCache(tmp_path / "cache.sqlite")
    ledger, quick = Ledger("v1"), DownloadParameters(in_flight=2, request_s=2.0)
    with Archive(served.url, ledger, HURRIED) as archive:
        fetcher: TileFetcher[Tile] = TileFetcher(bus, cache, quick, archive=archive)
        yield Vehicle(bus, cache, ledger, fetcher)
        bus.close()
        fetcher.close()
    cache.close()


def test_tiles_come_from_the_archive_and_the_bus_only_says_that_they_are_the_newest(
    vehicle: Vehicle, served: ServedFolder, cloud: Bus, store: SqliteStore, tiles: dict[TileId, Tile]
) -> None:
    publish(store, FolderObjects(served.folder), ["ndt"])
    with TileServer(store, cloud):
        statuses = vehicle.fetch(tiles)
    assert set(statuses.values()) == {"unchanged"}
    assert vehicle.fetcher.counts["archive"] == len(tiles)
    bodies = sum(line.size_bytes for line in store.head_lines())
    down = {line.kind: line.app_bytes for line in vehicle.ledger.totals() if line.direction == "down"}
    assert down["tile"] >= bodies  # all of it is in the vehicle's account
    by_tile = vehicle.ledger.by_tile()
    assert all(by_tile[tile.path][1] > 0 for tile in tiles)
    for tile_id, tile in tiles.items():
        assert vehicle.cache.head(tile_id) == (1, tile.sha)


def test_what_is_newer_than_the_archive_comes_over_the_bus_as_a_delta(
    vehicle: Vehicle, served: ServedFolder, cloud: Bus, store: SqliteStore, tiles: dict[TileId, Tile]
) -> None:
    publish(store, FolderObjects(served.folder), ["ndt"])
    changed = min(tiles)
    store.put_tiles([Tile(changed, 0, tiles[changed].gaussians.take(range(50)))])
    with TileServer(store, cloud):
        statuses = vehicle.fetch(tiles)
    assert statuses[changed] == "delta"
    assert set(statuses.values()) == {"delta", "unchanged"}
    assert vehicle.cache.head(changed)[0] == 2


def test_without_the_archive_all_comes_over_the_bus(
    vehicle: Vehicle, served: ServedFolder, cloud: Bus, store: SqliteStore, tiles: dict[TileId, Tile]
) -> None:
    served.server.end()
    with TileServer(store, cloud):
        assert set(vehicle.fetch(tiles).values()) == {"blob"}
    assert vehicle.fetcher.counts["archive"] == 0


def test_without_a_tile_server_the_archive_will_do(
    vehicle: Vehicle, served: ServedFolder, store: SqliteStore, tiles: dict[TileId, Tile]
) -> None:
    publish(store, FolderObjects(served.folder), ["ndt"])
    vehicle.fetcher.want(list(tiles))
    missing = vehicle.fetcher.wait_for(tiles, 60.0, NEVER)
    assert missing == set()
    assert {one.status for one in vehicle.fetcher.take()} == {"cached"}
    assert vehicle.fetcher.counts["archive"] == len(tiles)
