"""Autoware's map services over a real router: a client like that of rmw_zenoh holds the map as it is."""

import struct
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from autoware_client import HASH, AutowareClient, read_answer, request
from export_testing import read_cell
from map_export_maps import TILE, some_tile
from zenoh import ext

from gnd.cloud_merger.announce import encoded, update_of
from gnd.deploy.map_export import autoware
from gnd.deploy.map_export.autoware import CLOUDS, PROJECTOR, export_autoware, read_metadata
from gnd.deploy.map_export.autoware_messages import partial_service
from gnd.deploy.map_export.map_service import MapService
from gnd.deploy.map_export.serve import follow
from gnd.deploy.map_export.served_map import ServedMap
from gnd.deploy.map_export.tile_feeds import StoreFeed, open_feed
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.ros2 import NO_HASH, RosNode
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import update_key
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore

EAST = TileId.from_geodetic(np.radians(49.01), np.radians(8.4306))
FAR = 1000.0
"""More than the map."""
DEADLINE_S = 30.0


@dataclass
class Fleet:
    """A router, and a tile server over a store."""

    endpoint: str
    store: SqliteStore
    bus: Bus

    def publish(self, tile: Tile) -> None:
        """Put the next version of a tile and announce it, as a merger does."""
        (result,) = self.store.put_tiles([tile])
        new, old = (self.store.get("ndt", tile.tile_id, n) for n in (result.version, result.version - 1))
        assert new is not None
        self.bus.publish(update_key("ndt", tile.tile_id), encoded(update_of(new, old)), kind="update")


@pytest.fixture
def fleet(tmp_path: Path, free_port: int) -> Iterator[Fleet]:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with (
        open_router((endpoint,)),
        SqliteStore(tmp_path / "map.sqlite") as store,
        open_bus(BusConfig(connect=(endpoint,)), name="cloud") as bus,
    ):
        store.put_tiles([some_tile(1), some_tile(2, EAST)])
        with TileServer(store, bus):
            yield Fleet(endpoint, store, bus)


@contextmanager
def serving(fleet: Fleet, folder: Path, source: str = "", **settings: int) -> Iterator[MapService]:
    """The services in this process, from the fleet's router unless a source is named."""
    stop, told = threading.Event(), []
    with open_feed(source or fleet.endpoint, "ndt", "") as feed:
        served = ServedMap(folder, feed.all(), None, "samples")
        with RosNode(open_bus(BusConfig(connect=(fleet.endpoint,)), name="serving"), 0, "gnd_map") as node:
            service = MapService(node, served, **settings)
            thread = threading.Thread(target=follow, args=(feed, served, stop, told.append))
            thread.start()
            try:
                yield service
            finally:
                stop.set()
                thread.join()


@pytest.fixture
def client(fleet: Fleet) -> Iterator[AutowareClient]:
    with AutowareClient(fleet.endpoint) as opened:
        yield opened


def fresh_export(fleet: Fleet, folder: Path, served: Path) -> dict[str, np.ndarray]:
    """The cells of an export that is made now, with the projection of the one that is served."""
    folder.mkdir()
    (folder / PROJECTOR).write_bytes((served / PROJECTOR).read_bytes())
    export_autoware(fleet.store, "ndt", "", folder)
    return {name: read_cell(folder / CLOUDS / name) for name in read_metadata(folder)}


def same_cells(held: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> bool:
    return held.keys() == wanted.keys() and all(np.array_equal(held[name], wanted[name]) for name in held)


def wait_until(condition: Callable[[], object], what: str) -> None:
    until_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < until_s, f"not within {DEADLINE_S} s: {what}"
        time.sleep(0.05)


@pytest.mark.parametrize("source", ["router", "store"])
def test_a_client_holds_the_map_as_it_is_and_follows_it(
    fleet: Fleet, client: AutowareClient, tmp_path: Path, source: str
) -> None:
    out = tmp_path / "autoware"
    with serving(fleet, out, str(tmp_path / "map.sqlite") if source == "store" else ""):
        client.wait_served()
        first = client.update(0.0, 0.0, FAR)
        assert not first.ids_to_remove
        assert same_cells(client.held, fresh_export(fleet, tmp_path / "before", out))
        for name, cell in first.new.items():
            x, y = (int(part) for part in name.split("_")[:2])
            assert cell.bounds == (x, y, x + 20, y + 20)
            assert ((cell.points[:, :2] >= (x, y)) & (cell.points[:, :2] < (x + 20, y + 20))).all()
        nothing = client.update(0.0, 0.0, FAR)
        assert (nothing.new, nothing.ids_to_remove) == ({}, [])

        gaussians = some_tile(1).gaussians  # what stood in one voxel is gone
        fleet.publish(Tile(TILE, 2, gaussians.take(np.arange(1, len(gaussians)))))
        before = dict(client.held)
        wait_until(lambda: client.update(0.0, 0.0, FAR).new, "the update")
        gone = before.keys() - client.held.keys()
        assert 1 <= len(gone) <= 2  # a voxel's points lie in one cell, or at its border in two
        assert len(client.held) == len(before)
        assert same_cells(client.held, fresh_export(fleet, tmp_path / "after", out))
        # the folder is the same map: Autoware's own loader, or the next start, finds these ids
        assert set(read_metadata(out)) == client.held.keys()


def test_a_new_tile_and_one_without_content(fleet: Fleet, client: AutowareClient, tmp_path: Path) -> None:
    out = tmp_path / "autoware"
    with serving(fleet, out):
        client.wait_served()
        client.update(0.0, 0.0, FAR)
        north = TileId.from_geodetic(np.radians(49.0109), np.radians(8.43))
        fleet.publish(some_tile(4, north))
        wait_until(lambda: client.update(0.0, 0.0, FAR).new, "the tile in the north")
        fleet.publish(Tile(EAST, 2, some_tile(2, EAST).gaussians.take(np.arange(0))))
        wait_until(lambda: client.update(0.0, 0.0, FAR).ids_to_remove, "the tile that is empty now")
        assert same_cells(client.held, fresh_export(fleet, tmp_path / "after", out))


def test_only_the_cells_of_the_area_come(fleet: Fleet, client: AutowareClient, tmp_path: Path) -> None:
    with serving(fleet, tmp_path / "autoware"):
        client.wait_served()
        corners = read_metadata(tmp_path / "autoware")
        for x in np.linspace(-30.0, 30.0, 7):
            client.update(float(x), 0.0, 12.0)
            nearest = {name: np.clip((x, 0.0), low, np.add(low, 20)) - (x, 0.0) for name, low in corners.items()}
            assert client.held.keys() == {name for name, off in nearest.items() if np.hypot(*off) <= 12.0}


def test_clients_of_humble_and_of_older_releases_are_answered(fleet: Fleet, tmp_path: Path) -> None:
    """Types of Humble have no hash; until spring 2025 attachments had names, and such a client reads no other."""
    with serving(fleet, tmp_path / "autoware"), AutowareClient(fleet.endpoint, type_hash=NO_HASH) as humble:
        wait_until(lambda: humble.raw(request(0, 0, 1, ()), b""), "the service")
        assert humble.ask(0.0, 0.0, FAR).new
        names = ("sequence_number", ext.Int64(4), "source_timestamp", ext.Int64(1), "source_gid", bytes(16))
        (reply,) = humble.raw(request(0.0, 0.0, FAR, ()), ext.z_serialize(names).to_bytes())
        assert reply.ok is not None
        got = ext.z_deserialize(tuple[str, ext.Int64, str, ext.Int64, str, bytes], reply.ok.attachment)
        assert got[::2] == names[::2]
        assert (got[1], got[5]) == (4, bytes(16))


def test_what_is_no_request_gets_an_error_and_the_service_goes_on(
    fleet: Fleet, client: AutowareClient, tmp_path: Path
) -> None:
    with serving(fleet, tmp_path / "autoware") as service:
        client.wait_served()
        beside = ext.z_serialize((ext.Int64(1), ext.Int64(0), bytes(16))).to_bytes()
        whole = request(0.0, 0.0, FAR, ["one", "another"])
        for cut in range(len(whole)):
            assert "GetDifferentialPointCloudMap_Request" in client.error(whole[:cut], beside)
        assert "0 bytes are no autoware_map_msgs" in client.error(None, beside)
        endless = whole[:16] + b"\xff\xff\xff\x7f" + whole[20:]
        assert "bytes are no" in client.error(endless, beside)
        assert "bytes are no" in client.error(whole[:20] + b"\x04\0\0\0\xff\xfe\xfd\0", beside)  # no UTF-8
        for strange in (None, b"", beside[:-1], b"\xff" * 60):
            assert "number, time and client" in client.error(whole, strange)
        assert service.refused == len(whole) + 3 + 4
        assert client.ask(0.0, 0.0, FAR).new


@pytest.mark.parametrize("area", [(np.nan, 0, 10), (0, np.inf, 10), (0, 0, np.nan), (0, 0, -1), (0, 0, np.inf)])
def test_an_area_that_is_none_changes_nothing(
    fleet: Fleet, client: AutowareClient, tmp_path: Path, area: tuple[float, ...], caplog: pytest.LogCaptureFixture
) -> None:
    """Autoware's localiser waits for ever for an answer that is an error."""
    with serving(fleet, tmp_path / "autoware"):
        client.wait_served()
        answer = client.ask(*area, ids=["mine"])
        assert (answer.new, answer.ids_to_remove) == ({}, [])
        assert "an area needs finite values" in caplog.text


def test_an_area_larger_than_the_earth_is_the_whole_map(fleet: Fleet, client: AutowareClient, tmp_path: Path) -> None:
    with serving(fleet, tmp_path / "autoware"):
        client.wait_served()
        assert client.ask(0.0, 0.0, 1e9).new.keys() == read_metadata(tmp_path / "autoware").keys()
        assert client.ask(3e38, -3e38, 1e9).new == {}


@pytest.mark.slow
def test_a_million_ids_are_answered(fleet: Fleet, client: AutowareClient, tmp_path: Path) -> None:
    with serving(fleet, tmp_path / "autoware"):
        client.wait_served()
        ids = [f"{n:x}" for n in range(1_000_000)]
        answer = client.ask(0.0, 0.0, FAR, ids)
        assert answer.new.keys() == read_metadata(tmp_path / "autoware").keys()
        assert sorted(answer.ids_to_remove) == sorted(ids)


def test_what_does_not_fit_comes_with_the_next_request_the_nearest_first(
    fleet: Fleet, client: AutowareClient, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with serving(fleet, tmp_path / "autoware", limit_bytes=60_000):
        client.wait_served()
        corners, came = read_metadata(tmp_path / "autoware"), []
        while answer := client.update(5.0, 5.0, FAR).new:
            came += list(answer)
            assert sum(cell.points.nbytes for cell in answer.values()) < 60_000
        assert set(came) == corners.keys()
        off_m = [np.hypot(*(np.clip((5.0, 5.0), corners[n], np.add(corners[n], 20)) - (5.0, 5.0))) for n in came]
        assert off_m == sorted(off_m)
        assert "the next request gets them" in caplog.text


def test_an_update_that_does_not_fit_leaves_no_hole(fleet: Fleet, client: AutowareClient, tmp_path: Path) -> None:
    """The old cell goes when the new one comes, not before."""

    def places() -> set[str]:
        return {name.rpartition("_")[0] for name in client.held}

    out = tmp_path / "autoware"
    with serving(fleet, out, limit_bytes=25_000):
        client.wait_served()
        while client.update(5.0, 5.0, FAR).new:
            pass
        whole = places()
        assert len(whole) == len(client.held)
        shifted = some_tile(1).gaussians
        fleet.publish(Tile(TILE, 2, replace(shifted, mean_m=shifted.mean_m * np.float32(0.5))))
        wait_until(lambda: set(read_metadata(out)) != client.held.keys(), "the update")
        rounds = 0
        while client.update(5.0, 5.0, FAR).new:
            rounds += 1
            assert places() == whole
            assert len(client.held) == len(whole)
        assert rounds > 1
        assert client.held.keys() == set(read_metadata(out))


def test_several_clients_at_once_each_get_their_own_answers(fleet: Fleet, tmp_path: Path) -> None:
    def drive(number: int) -> bool:
        with AutowareClient(fleet.endpoint) as one:
            one.wait_served()
            for x in np.linspace(-40.0, 40.0, 6):
                one.update(float(x) + number, 0.0, 15.0 + number)
            one.update(0.0, 0.0, FAR)
            return one.held.keys() == read_metadata(tmp_path / "autoware").keys()

    with serving(fleet, tmp_path / "autoware") as service, ThreadPoolExecutor(6) as pool:
        assert all(pool.map(drive, range(6)))
        assert (service.answered, service.refused) == (42, 0)


def test_the_partial_service_gives_all_cells_of_an_area(fleet: Fleet, client: AutowareClient, tmp_path: Path) -> None:
    with serving(fleet, tmp_path / "autoware"):
        client.wait_served()
        key = client.key.replace("differential", "partial").replace("Differential", "Partial")
        beside = ext.z_serialize((ext.Int64(1), ext.Int64(0), bytes(16))).to_bytes()
        (reply,) = client.raw(request(5.0, 5.0, 12.0), beside, key.replace(HASH, partial_service().type_hash))
        assert reply.ok is not None
        partial = read_answer(reply.ok.payload.to_bytes(), partial=True)
        assert partial.new.keys() == client.ask(5.0, 5.0, 12.0).new.keys()


def test_files_that_somebody_removes_or_damages_are_served_all_the_same(
    fleet: Fleet, client: AutowareClient, tmp_path: Path
) -> None:
    out = tmp_path / "autoware"
    with serving(fleet, out):
        client.wait_served()
        wanted = fresh_export(fleet, tmp_path / "before", out)
        removed, damaged, cut = sorted((out / CLOUDS).iterdir())[:3]
        removed.unlink()
        damaged.write_bytes(damaged.read_bytes()[:-4] + struct.pack("<f", 7.0))
        cut.write_bytes(cut.read_bytes()[:100])
        client.update(0.0, 0.0, FAR)
        assert same_cells(client.held, wanted)


def test_a_router_that_was_gone_finds_the_service_and_the_fleet_again(tmp_path: Path, free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with ExitStack() as stack, ExitStack() as routers:
        routers.enter_context(open_router((endpoint,)))
        store = stack.enter_context(SqliteStore(tmp_path / "map.sqlite"))
        store.put_tiles([some_tile(1), some_tile(2, EAST)])
        bus = stack.enter_context(open_bus(BusConfig(connect=(endpoint,)), name="cloud"))
        stack.enter_context(TileServer(store, bus))
        fleet = Fleet(endpoint, store, bus)
        stack.enter_context(serving(fleet, tmp_path / "autoware"))
        client = stack.enter_context(AutowareClient(endpoint))
        client.wait_served()
        client.update(0.0, 0.0, FAR)
        routers.close()
        stack.enter_context(open_router((endpoint,)))
        client.wait_served()
        fleet.publish(Tile(TILE, 2, some_tile(7).gaussians))
        wait_until(lambda: client.update(0.0, 0.0, FAR).new, "the update")
        assert same_cells(client.held, fresh_export(fleet, tmp_path / "after", tmp_path / "autoware"))


def test_a_store_is_followed_whoever_writes_it(fleet: Fleet, tmp_path: Path) -> None:
    feed = StoreFeed(fleet.store, "ndt", "")
    assert len(feed.all()) == 2
    assert feed.newer() == []
    fleet.store.put_tiles([Tile(TILE, 2, some_tile(7).gaussians)])
    found: list[Tile] = []
    wait_until(lambda: found.extend(feed.newer()) or found, "the new version")
    assert [(tile.tile_id, tile.version) for tile in found] == [(TILE, 2)]


class Given:
    """A feed that gives what it is told."""

    def __init__(self, *tiles: Tile) -> None:
        self.tiles, self.waits = list(tiles), 0

    def all(self) -> list[Tile]:
        return self.tiles

    def newer(self) -> list[Tile]:
        time.sleep(0.01)
        self.waits += 1
        given, self.tiles = self.tiles, []
        return given


def test_what_cannot_be_written_now_is_written_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    served = ServedMap(tmp_path, [some_tile(1)], None, "means")
    before, plain, full = read_metadata(tmp_path), autoware._write, threading.Event()

    def write(path: Path, data: bytes) -> None:
        if full.is_set():
            raise OSError(28, "No space left on device")
        plain(path, data)

    monkeypatch.setattr(autoware, "_write", write)
    full.set()
    berlin = some_tile(5, TileId.from_geodetic(np.radians(52.5), np.radians(13.4)))
    feed, stop, told = Given(berlin, Tile(TILE, 2, some_tile(7).gaussians)), threading.Event(), []
    thread = threading.Thread(target=follow, args=(feed, served, stop, told.append))
    thread.start()
    wait_until(lambda: feed.waits > 5, "some rounds")
    assert read_metadata(tmp_path) == before
    assert caplog.text.count("No space left") == 1  # said once, tried again and again
    assert caplog.text.count(f"tile {berlin.tile_id.path} is not served") == 1  # 570 km away
    full.clear()
    wait_until(lambda: told, "the tile")
    stop.set()
    thread.join()
    assert told[0].values["tile"] == TILE.path
    assert read_metadata(tmp_path).keys() == {path.name for path in (tmp_path / CLOUDS).iterdir()} != before.keys()
