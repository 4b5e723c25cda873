"""The local map follows the vehicle: over a real bus, from a real store."""

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from vehicle_scene import FRAME, GRID_FRAME, HEIGHT_M, SENSOR, ground, look, tiles_of
from waiting import wait_until

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.serving import Request
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import GnssFix
from gnd.schemas.keys import batch_keys, parse_batch_key
from gnd.schemas.tiles_batch import TileAnswer, TilesReply, TilesRequest
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.surroundings import AHEAD_S, LEAD_S, Surroundings, left_behind, tile_distance_m, tiles_along

NEVER = threading.Event()
PARAMETERS = DownloadParameters(near_m=30.0, ahead_m=60.0, forget_m=100.0, wait_s=10.0)


def at(east_m: float, north_m: float = 0.0) -> Place:
    lat, lon, height = FRAME.geodetic_from_enu(np.array([[east_m, north_m, HEIGHT_M]]))
    return Place(FRAME, GnssFix(0, float(lat[0]), float(lon[0]), float(height[0]), 2.5))


class Scene:
    def __init__(self, cloud: Bus, bus: Bus, ledger: Ledger, folder: Path) -> None:
        self.ledger = ledger
        self.tiles = tiles_of(ground(20.0))
        self.store = SqliteStore(folder / "store.sqlite")
        self.store.put_tiles(list(self.tiles.values()))
        self.server = TileServer(self.store, cloud).start()
        self.map = LocalMap(GRID_FRAME)
        self.detector = ChangeDetector(self.map)
        self.cache = TileCache[Tile](folder / "cache.sqlite")
        self.fetcher = TileFetcher(bus, self.cache, PARAMETERS)
        self.surroundings = Surroundings(self.map, self.fetcher, self.detector.touched, PARAMETERS)


@pytest.fixture
def scene(cloud: Bus, endpoint: str, tmp_path: Path) -> Iterator[Scene]:
    ledger = Ledger("vehicle")
    with open_bus(BusConfig(connect=(endpoint,)), ledger, "vehicle") as bus:
        opened = Scene(cloud, bus, ledger, tmp_path)
        yield opened
    opened.fetcher.close()
    opened.server.close()
    opened.store.close()


def test_the_tiles_that_are_near_are_held_before_the_drive_goes_on(scene: Scene) -> None:
    scene.surroundings.follow(at(0.0), NEVER, wait=True)
    near = tiles_along(FRAME, at(0.0).ahead_map_m(60.0), 30.0)
    assert set(near) <= set(scene.map.tiles)
    assert {t for t in scene.map.tiles if not scene.map.is_absent(t)} == set(near) & set(scene.tiles)
    assert scene.map.window_origin_g[2] <= HEIGHT_M - 5


def test_the_way_ahead_is_asked_for_in_advance(scene: Scene) -> None:
    place = at(0.0)
    place.heading_rad = np.pi / 2
    scene.surroundings.follow(place, NEVER, wait=True)
    north = TileId.from_geodetic(*at(0.0, 60.0).geodetic)
    assert north in scene.surroundings.wanted
    assert tile_distance_m(FRAME, north, place.position_map_m) > PARAMETERS.near_m
    wait_until(lambda: scene.fetcher.wait_for([north], 0.1, NEVER) == set())


def test_a_fast_vehicle_looks_farther_and_one_in_reverse_gear_back(scene: Scene) -> None:
    place = at(0.0)
    place.heading_rad = 0.0
    ahead = {}
    for speed_mps in (0.0, 30.0, -30.0):
        place.speed_mps = speed_mps
        scene.surroundings.look_ahead(place)
        east_m = [FRAME.enu_from_geodetic(*t.centre_rad, 0.0)[..., 0].item() for t in scene.surroundings.wanted]
        ahead[speed_mps] = (min(east_m), max(east_m))
    assert ahead[0.0][1] == pytest.approx(PARAMETERS.ahead_m + PARAMETERS.near_m, abs=40.0)
    assert ahead[30.0][1] == pytest.approx(30.0 * AHEAD_S + PARAMETERS.near_m, abs=40.0)
    assert ahead[-30.0][0] == pytest.approx(-30.0 * AHEAD_S - PARAMETERS.near_m, abs=40.0)


def test_what_is_ahead_is_asked_for_together(scene: Scene) -> None:
    place = at(-60.0)
    place.heading_rad, place.speed_mps = 0.0, 10.0
    for east_m in range(-60, 61):
        place.position_map_m = at(float(east_m)).position_map_m
        scene.surroundings.follow(place, NEVER, wait=True)
    ledger = scene.ledger.totals()
    (asked,) = [line.messages for line in ledger if (line.kind, line.direction) == ("tile", "up")]
    assert asked <= 2 + 120.0 / (10.0 * (AHEAD_S - LEAD_S)) * 2  # twice that: two districts


@pytest.mark.parametrize(("rate_bit_s", "all_of_them"), [(1e6, True), (3e4, False)])
def test_a_paced_drive_asks_for_what_its_link_brings_in_time(
    endpoint: str, cloud: Bus, tmp_path: Path, rate_bit_s: float, all_of_them: bool
) -> None:
    link = LinkProfile("slow", down_bit_s=rate_bit_s, up_bit_s=1e6, delay_ms=20.0, paced=False)
    with open_bus(BusConfig(connect=(endpoint,), link=link)) as bus:
        fetcher = TileFetcher(bus, TileCache(tmp_path / "cache.sqlite"), replace(PARAMETERS, in_flight=1))
        local_map = LocalMap(GRID_FRAME)
        surroundings = Surroundings(local_map, fetcher, ChangeDetector(local_map).touched, PARAMETERS)
        asked: list[TileId] = []

        def answer(request: Request) -> bytes:
            wanted = TilesRequest.decode(request.payload)
            asked.extend(wanted.tiles(parse_batch_key(request.key)[1]))
            return TilesReply((TileAnswer("absent"),) * len(wanted.wanted)).encode()

        cloud.serve(batch_keys(), answer)
        place = at(0.0)
        place.heading_rad, place.speed_mps = 0.0, 20.0
        surroundings.follow(place, NEVER, wait=False)
        here = TileId.from_geodetic(*place.geodetic)
        wait_until(lambda: here in asked and fetcher.wait_for(asked, 0.1, NEVER) == set())
        if all_of_them:
            wait_until(lambda: set(asked) == set(surroundings.wanted))
        else:
            assert 1 <= len(asked) < len(surroundings.wanted)
        bus.close()
        fetcher.close()


def test_tiles_far_behind_are_let_go_unless_there_is_evidence_about_them(scene: Scene) -> None:
    scene.surroundings.follow(at(0.0), NEVER, wait=True)
    hits = look([], np.random.default_rng(1))
    scene.detector.add_scan(hits[np.linalg.norm(hits - SENSOR, axis=1) < 10.0], SENSOR)
    touched = set(scene.detector.touched_tiles())
    held = set(scene.map.tiles)
    assert touched < held
    scene.surroundings.follow(at(300.0), NEVER, wait=True)
    assert touched <= set(scene.map.tiles)
    assert not (held - touched) & set(scene.map.tiles)
    scene.detector.finish(touched)
    scene.surroundings.follow(at(310.0), NEVER, wait=True)
    assert not touched & set(scene.map.tiles)


def test_a_newer_version_replaces_a_held_tile_only_without_evidence(scene: Scene) -> None:
    scene.surroundings.follow(at(0.0), NEVER, wait=True)
    tile_id = max(scene.tiles, key=lambda t: len(scene.tiles[t].gaussians))
    newer = [Tile(tile_id, v, scene.tiles[tile_id].gaussians.take(np.arange(v, 200))) for v in (2, 3)]
    assert scene.surroundings.replace(newer[0])
    assert not scene.surroundings.replace(newer[0])  # already there
    scene.detector.add_scan(look([], np.random.default_rng(1)), SENSOR)
    assert not scene.surroundings.replace(newer[1])
    assert scene.map.tile(tile_id) == newer[0]
    scene.detector.finish([tile_id])
    assert scene.surroundings.replace(newer[1])


def test_a_version_that_came_in_mid_pass_is_what_the_next_pass_is_compared_with(scene: Scene) -> None:
    """The vehicle turns on the spot: it never goes so far that the tile would be let go and asked for again."""
    scene.surroundings.follow(at(0.0), NEVER, wait=True)
    tile_id = max(scene.tiles, key=lambda t: len(scene.tiles[t].gaussians))
    newer = [Tile(tile_id, v, scene.tiles[tile_id].gaussians.take(np.arange(v, 200))) for v in (2, 3)]
    scene.detector.add_scan(look([], np.random.default_rng(1)), SENSOR)
    for tile in newer:
        assert not scene.surroundings.replace(tile)
    scene.surroundings.follow(at(10.0), NEVER, wait=True)
    held = scene.map.tile(tile_id)
    assert held is not None
    assert held.version == 1  # what rays said about version 1 is not counted for version 3
    evidence = scene.detector.finish([tile_id])[tile_id]
    assert evidence.base.version == 1
    scene.surroundings.follow(at(20.0), NEVER, wait=True)
    assert scene.map.tile(tile_id) == newer[1]
    assert scene.surroundings.counts["later"] == 1


def test_without_an_answer_the_drive_goes_on_after_a_while_and_does_not_wait_again(
    cloud: Bus, bus: Bus, tmp_path: Path
) -> None:
    impatient = DownloadParameters(near_m=30.0, ahead_m=0.0, wait_s=0.2, request_s=0.5)
    fetcher = TileFetcher(bus, TileCache(tmp_path / "cache.sqlite"), impatient)
    local_map = LocalMap(GRID_FRAME)
    surroundings = Surroundings(local_map, fetcher, ChangeDetector(local_map).touched, impatient)
    for _ in range(50):  # would be 10 s if it waited each time
        surroundings.follow(at(0.0), NEVER, wait=True)
    assert local_map.tiles == ()
    assert len(surroundings.given_up) > 3
    bus.close()
    fetcher.close()


def test_the_distance_to_a_tile_is_measured_to_its_nearest_edge() -> None:
    tile_id = TileId.from_geodetic(FRAME.lat_rad, FRAME.lon_rad)
    grid, frame = VoxelGrid.of(tile_id), LocalFrame.of_tile(tile_id)
    half_x, half_y = grid.nx * grid.dx_m / 2, grid.ny * grid.dy_m / 2
    assert tile_distance_m(frame, tile_id, np.array([3.0, -2.0, 99.0])) == 0.0
    assert tile_distance_m(frame, tile_id, np.array([half_x + 50.0, 0.0, 0.0])) == pytest.approx(50.0, abs=0.01)
    corner = np.array([half_x + 30.0, -half_y - 40.0, 0.0])
    assert tile_distance_m(frame, tile_id, corner) == pytest.approx(50.0, abs=0.01)
    assert left_behind(frame, [tile_id], corner, 49.0) == (tile_id,)
    assert left_behind(frame, [tile_id], corner, 51.0) == ()


def test_what_the_cache_holds_is_asked_about_farther_ahead(scene: Scene) -> None:
    """A second drive through known streets needs few questions, and is told all the same what has changed since."""
    place = at(-60.0)
    place.heading_rad, place.speed_mps = 0.0, 10.0

    def drive() -> int:
        before = sum(line.messages for line in scene.ledger.totals() if (line.kind, line.direction) == ("tile", "up"))
        for east_m in range(-60, 61):
            place.position_map_m = at(float(east_m)).position_map_m
            scene.surroundings.follow(place, NEVER, wait=True)
        lines = scene.ledger.totals()
        return sum(line.messages for line in lines if (line.kind, line.direction) == ("tile", "up")) - before

    first = drive()
    for tile_id in list(scene.map.tiles):
        scene.map.remove_tile(tile_id)
        scene.fetcher.forget(tile_id)
    scene.surroundings = Surroundings(scene.map, scene.fetcher, scene.detector.touched, PARAMETERS)
    changed = next(
        tile for tile in scene.tiles.values() if FRAME.enu_from_geodetic(*tile.tile_id.centre_rad, 0.0)[0] > 5
    )
    scene.store.put_tiles([Tile(changed.tile_id, 2, changed.gaussians.take(np.arange(len(changed.gaussians)) > 3))])
    assert drive() <= min(first, 4)
    held = scene.map.tile(changed.tile_id)
    assert held is not None
    assert held.version == 2


def test_what_is_on_no_map_is_asked_for_once_a_district(scene: Scene) -> None:
    """A vehicle on a street that it knows, whose course wavers, asks once: about its district and those nearby, so that
    it asks at most once more on its way through the next one.
    """
    for tile in scene.tiles.values():
        stored = scene.store.get("ndt", tile.tile_id)
        assert stored is not None
        scene.cache.put(stored.decode_gaussians())
    place = at(20.0)
    place.speed_mps = 10.0
    seen = set()
    for east_m in range(20, -21, -1):
        place.position_map_m, place.heading_rad = at(float(east_m)).position_map_m, np.pi + 0.2 * np.sin(east_m)
        scene.surroundings.follow(place, NEVER, wait=True)
        seen |= set(scene.surroundings.wanted)
    (asked,) = [line.messages for line in scene.ledger.totals() if (line.kind, line.direction) == ("tile", "up")]
    assert asked == 1
    assert len(seen) > len(scene.tiles), "most of them are on no map"
    for east_m in range(-40, -401, -40):
        place.position_map_m, place.heading_rad = at(float(east_m)).position_map_m, np.pi
        scene.surroundings.follow(place, NEVER, wait=True)
    (asked,) = [line.messages for line in scene.ledger.totals() if (line.kind, line.direction) == ("tile", "up")]
    assert min(scene.tiles).district not in {tile.district for tile in scene.surroundings.wanted}, "it has left its own"
    assert asked <= 2
