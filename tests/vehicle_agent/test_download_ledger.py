"""Nothing is fetched twice: the ledger's word for it, over a real router from a real tile server."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from vehicle_scene import FRAME, GRID_FRAME, HEIGHT_M, ground, published
from waiting import wait_until

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.ledger_file import Booking, read_ledger
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.codec import LATTICES, encode_delta, snap
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import GnssFix
from gnd.schemas.keys import update_key
from gnd.schemas.tiles_batch import ANSWER_HASH_BYTES
from gnd.schemas.updates import TileUpdate
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher
from gnd.vehicle_agent.link.updates import Updates
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.surroundings import Surroundings

NEVER = threading.Event()
PARAMETERS = DownloadParameters(near_m=30.0, ahead_m=60.0, forget_m=60.0)
THIN = LinkProfile("thin", down_bit_s=2.2e5, up_bit_s=2.2e5, delay_ms=5.0, burst_bytes=0)


@pytest.fixture(scope="module")
def tiles() -> dict[TileId, Tile]:
    return published(ground(55.0, step_m=0.15))


@pytest.fixture
def store(tmp_path: Path, tiles: dict[TileId, Tile]) -> Iterator[SqliteStore]:
    with SqliteStore(tmp_path / "store.sqlite") as opened:
        opened.put_tiles(list(tiles.values()))
        yield opened


@pytest.fixture
def served(store: SqliteStore, endpoint: str) -> Iterator[Ledger]:
    """The tile server's own account."""
    ledger = Ledger("cloud")
    with open_bus(BusConfig(connect=(endpoint,)), ledger, "cloud") as bus, TileServer(store, bus):
        yield ledger


class Car:
    """The vehicle's side of the download, without the drive."""

    def __init__(self, bus: Bus, folder: Path) -> None:
        self.bus, self.cache = bus, TileCache(folder / "cache.sqlite")
        self.fetcher = TileFetcher(bus, self.cache, PARAMETERS)
        local_map = LocalMap(GRID_FRAME)
        self.surroundings = Surroundings(local_map, self.fetcher, ChangeDetector(local_map).touched, PARAMETERS)
        self.updates = Updates(bus, self.cache, self.fetcher, self.surroundings.replace)

    def drive(self, length_m: float = 100.0, speed_mps: float = 10.0) -> None:
        """East through the middle, metre by metre."""
        place = self.at(-0.5 * length_m)
        for east_m in np.arange(-0.5 * length_m, 0.5 * length_m):
            place.position_map_m = np.array([east_m, 0.0, HEIGHT_M])
            place.heading_rad, place.speed_mps = 0.0, speed_mps
            self.updates.follow(self.surroundings.look_ahead(place))
            self.surroundings.follow(place, NEVER, wait=True)
            self.updates.apply()

    def at(self, east_m: float) -> Place:
        lat, lon, height = FRAME.geodetic_from_enu(np.array([[east_m, 0.0, HEIGHT_M]]))
        return Place(FRAME, GnssFix(0, float(lat[0]), float(lon[0]), float(height[0]), 2.5))


@contextmanager
def car(endpoint: str, folder: Path, name: str, link: LinkProfile | str = "none") -> Iterator[Car]:
    """A life of the vehicle: its cache stays in `folder`, its ledger is `name`."""
    ledger = Ledger("vehicle", folder / f"{name}.jsonl")
    with open_bus(BusConfig(connect=(endpoint,), link=link), ledger, "vehicle") as bus:
        opened = Car(bus, folder)
        yield opened
        bus.close()
        opened.fetcher.close()
        opened.cache.close()


def booked(folder: Path, name: str, kind: str) -> dict[str, list[Booking]]:
    """What came down of a kind, by tile."""
    found: dict[str, list[Booking]] = {}
    for booking in read_ledger(folder / f"{name}.jsonl").bookings:
        if (booking.direction, booking.kind) == ("down", kind) and booking.tile is not None:
            found.setdefault(booking.tile, []).append(booking)
    return found


def down_bytes(folder: Path, name: str) -> int:
    return read_ledger(folder / f"{name}.jsonl").total_bytes("down")


def change(store: SqliteStore, tile_id: TileId, count: int = 5) -> tuple[Tile, Tile]:
    """A new version of a tile without `count` voxels and with others moved; (old, new)."""
    head = store.get("ndt", tile_id)
    assert head is not None
    old = head.decode()
    mean_m = old.gaussians.mean_m.copy()
    mean_m[:count, 2] += np.float32(0.04)
    moved = snap(replace(old.gaussians, mean_m=mean_m), LATTICES["standard"])
    new = Tile(tile_id, old.version + 1, moved.take(np.arange(len(moved) - count)))
    store.put_tiles([new])
    return old, new


def test_each_tile_comes_once_whole_then_by_delta_then_not_at_all(
    served: Ledger, store: SqliteStore, tiles: dict[TileId, Tile], endpoint: str, tmp_path: Path
) -> None:
    with car(endpoint, tmp_path, "first") as vehicle:
        vehicle.drive()
        got = {t for t in tiles if vehicle.cache.head(t)[0]}
        assert vehicle.fetcher.counts["blob"] == len(got) > 8
    bodies = booked(tmp_path, "first", "tile")
    assert {path: len(bookings) for path, bookings in bodies.items()} == {t.path: 1 for t in got}
    heads = {t: store.get("ndt", t) for t in got}
    assert all(bodies[t.path][0].app_bytes == ANSWER_HASH_BYTES + len(head.body) for t, head in heads.items() if head)
    sent = [line for line in served.totals() if (line.kind, line.direction) == ("tile", "up")]
    assert [down_bytes(tmp_path, "first")] == [line.app_bytes for line in sent]

    with car(endpoint, tmp_path, "again") as vehicle:
        vehicle.drive()
        assert vehicle.fetcher.counts["unchanged"] == len(got)
    assert booked(tmp_path, "again", "tile") == booked(tmp_path, "again", "delta") == {}
    assert down_bytes(tmp_path, "again") <= 4 * len(got)

    changed = max(got, key=lambda tile: bodies[tile.path][0].app_bytes)
    change(store, changed)
    with car(endpoint, tmp_path, "later") as vehicle:
        vehicle.drive()
        assert vehicle.fetcher.counts["delta"] == 1
    assert booked(tmp_path, "later", "tile") == {}
    assert {path: len(b) for path, b in booked(tmp_path, "later", "delta").items()} == {changed.path: 1}
    assert down_bytes(tmp_path, "later") < 0.1 * bodies[changed.path][0].app_bytes + 4 * len(got)


def test_what_a_notice_brought_is_not_downloaded_and_the_other_way_round(
    served: Ledger, store: SqliteStore, endpoint: str, tmp_path: Path
) -> None:
    with car(endpoint, tmp_path, "listening") as vehicle:
        vehicle.drive()
        tile_id = TileId.from_geodetic(*vehicle.at(40.0).geodetic)
        old, new = change(store, tile_id)
        coded = encode_delta(tile_id, old.gaussians, new.gaussians)
        notice = TileUpdate(tile_id, "ndt", new.version, old.version, new.sha, old.sha, "merged", None, coded, 5, 5)

        def heard() -> bool:  # a subscription takes a moment to be known
            vehicle.bus.publish(update_key("ndt", tile_id), notice.encode(), kind="update")
            vehicle.updates.apply()
            return vehicle.cache.head(tile_id)[1] == new.sha

        wait_until(heard)
    with car(endpoint, tmp_path, "back") as vehicle:
        vehicle.drive()
        vehicle.updates.apply()
        assert vehicle.fetcher.counts["delta"] == vehicle.fetcher.counts["blob"] == 0
    assert set(booked(tmp_path, "listening", "update")) == {tile_id.path}
    assert booked(tmp_path, "back", "delta") == booked(tmp_path, "back", "tile") == {}


DOWNLOADER = """
import sys, threading
from pathlib import Path
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.links import LinkProfile
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.link.download import TileFetcher

folder, tiles = Path(sys.argv[2]), [TileId(int(morton)) for morton in sys.argv[3:]]
thin = LinkProfile("thin", down_bit_s=2.2e5, up_bit_s=2.2e5, delay_ms=5.0, burst_bytes=0)
with open_bus(BusConfig(connect=(sys.argv[1],), link=thin), Ledger("vehicle", folder / "killed.jsonl")) as bus:
    fetcher = TileFetcher(bus, TileCache(folder / "cache.sqlite"), DownloadParameters())
    fetcher.want(tiles)
    fetcher.wait_for(tiles, 60.0, threading.Event())
    print("done", flush=True)
    threading.Event().wait()
"""


def test_a_download_that_was_killed_goes_on_where_it_was(
    served: Ledger, tiles: dict[TileId, Tile], endpoint: str, tmp_path: Path
) -> None:
    cache = TileCache(tmp_path / "cache.sqlite")
    arguments = [endpoint, str(tmp_path), *(str(t.morton) for t in tiles)]
    with subprocess.Popen([sys.executable, "-c", DOWNLOADER, *arguments]) as process:
        try:
            wait_until(lambda: len(cache) >= 4, 60.0)
        finally:
            process.kill()
    kept = {t for t in tiles if cache.head(t)[0]}
    assert 4 <= len(kept) < len(tiles)
    with car(endpoint, tmp_path, "second") as vehicle:
        vehicle.fetcher.want(list(tiles))
        assert vehicle.fetcher.wait_for(tiles, 15.0, NEVER) == set()
        assert all((tile := vehicle.cache.get(t)) is not None and tile.sha == tiles[t].sha for t in tiles)
        assert vehicle.fetcher.counts == {"unchanged": len(kept), "blob": len(tiles) - len(kept)}
    before, after = booked(tmp_path, "killed", "tile"), booked(tmp_path, "second", "tile")
    assert {t.path for t in kept} <= before.keys()
    assert not {t.path for t in kept} & after.keys()
    assert all(len(bookings) == 1 for bookings in (*before.values(), *after.values()))


@pytest.fixture
def weak_place(store: SqliteStore, free_port: int) -> Iterator[tuple[str, Bus]]:
    """A tile server, and a router that can be closed."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router = open_router((endpoint,))
    with open_bus(BusConfig(connect=(endpoint,)), name="cloud") as cloud, TileServer(store, cloud):
        yield endpoint, router
    router.close()


def test_a_download_goes_on_after_a_lost_link(
    weak_place: tuple[str, Bus], tiles: dict[TileId, Tile], tmp_path: Path
) -> None:
    endpoint, router = weak_place
    with car(endpoint, tmp_path, "cut", THIN) as vehicle:
        vehicle.fetcher.want(list(tiles))
        wait_until(lambda: vehicle.fetcher.counts["blob"] >= 3, 30.0)
        router.close()
        assert vehicle.fetcher.counts["blob"] < len(tiles), "the link was cut too late to matter"
        with open_router((endpoint,)):
            assert vehicle.fetcher.wait_for(tiles, 30.0, NEVER) == set()
            assert vehicle.fetcher.counts["blob"] == len(tiles)
    times = {path: len(bookings) for path, bookings in booked(tmp_path, "cut", "tile").items()}
    assert times == {t.path: 1 for t in tiles}


def test_what_was_announced_while_the_link_was_lost_is_asked_for(
    weak_place: tuple[str, Bus], store: SqliteStore, tmp_path: Path
) -> None:
    endpoint, router = weak_place
    with car(endpoint, tmp_path, "deaf") as vehicle:
        vehicle.drive()
        router.close()
        tile_id = TileId.from_geodetic(*vehicle.at(45.0).geodetic)
        _, new = change(store, tile_id)
        with open_router((endpoint,)):
            wait_until(lambda: vehicle.updates.apply() or vehicle.cache.head(tile_id)[1] == new.sha, 30.0)
    assert set(booked(tmp_path, "deaf", "delta")) == {tile_id.path}
