"""Feature layers over a real bus: fetched once, kept by version, kept current by notices, through lost links."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from waiting import wait_until

from gnd.cloud_merger.announce import encoded, update_of
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.features import Feature, FeatureTile, hit
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import update_key
from gnd.schemas.tiles import TileBlob
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.config import AgentConfig, DownloadParameters
from gnd.vehicle_agent.errors import AgentConfigError
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.feature_download import FeatureDownloader

TILE, EAST = TileId(497353963154), TileId(497353963155)
COV_M2 = np.array([0.04, 0.0, 0.0, 0.04, 0.0, 1e4])
NEVER = threading.Event()
QUICK = DownloadParameters(request_s=5.0)


def sign(number: int, x_m: float = 1.0) -> Feature:
    return Feature(number, "traffic_sign", np.array([[x_m, 2.0, 30.0]]), COV_M2, hit(0.9))


def tile(where: TileId, *signs: Feature) -> FeatureTile:
    return FeatureTile.of(where, 1, signs)


class Cloud:
    """A store of two feature layers, its server, and somebody who announces."""

    def __init__(self, bus: Bus, folder: Path) -> None:
        self.bus, self.store = bus, SqliteStore(folder / "store.sqlite")
        self.store.put_tiles([tile(TILE, *map(sign, range(1, 40)))], layer="signs")
        self.store.put_tiles([tile(TILE, sign(7)), tile(EAST, sign(8))], layer="streetlights")
        self.server = TileServer(self.store, bus).start()

    def publish(self, layer: str, new: FeatureTile) -> bytes:
        """Put the next version; the notice's bytes."""
        (result,) = self.store.put_tiles([new], layer=layer)
        stored = self.store.get(layer, new.tile_id)
        assert stored is not None
        return encoded(update_of(stored, self.store.get(layer, new.tile_id, result.version - 1)))

    def announce(self, layer: str, notice: bytes, downloader: FeatureDownloader) -> dict[str, set[TileId]]:
        """Publish until the vehicle has heard it: a subscription takes a moment to be known."""
        heard, changed = downloader.counts["notice-received"], {}

        def again() -> bool:
            self.bus.publish(update_key(layer, TILE), notice, kind="update")
            changed.update(downloader.step())
            return downloader.counts["notice-received"] > heard

        wait_until(again)
        return changed

    def close(self) -> None:
        self.server.close()
        self.store.close()


@pytest.fixture
def world(cloud: Bus, tmp_path: Path) -> Iterator[Cloud]:
    opened = Cloud(cloud, tmp_path)
    yield opened
    opened.close()


@pytest.fixture
def downloader(bus: Bus, tmp_path: Path) -> Iterator[FeatureDownloader]:
    opened = FeatureDownloader(bus, tmp_path / "cache.sqlite", ("signs", "streetlights"), QUICK)
    yield opened
    bus.close()
    opened.close()


def download(downloader: FeatureDownloader, *tiles: TileId) -> None:
    downloader.follow(tiles)
    assert downloader.wait_for(tiles, 15.0, NEVER) == {}


def test_each_layer_has_its_own_tiles(world: Cloud, downloader: FeatureDownloader) -> None:
    download(downloader, TILE, EAST)
    assert downloader.step() == {"signs": {TILE, EAST}, "streetlights": {TILE, EAST}}
    assert downloader.step() == {}
    signs = downloader.tile("signs", TILE)
    assert signs is not None
    assert [feature.feature_id for feature in signs.features] == list(range(1, 40))
    assert dict(downloader.tiles("signs")) == {TILE: signs, EAST: None}
    assert {t: len(one.features) for t, one in downloader.tiles("streetlights").items() if one} == {TILE: 1, EAST: 1}
    assert downloader.counts == {"blob": 3, "absent": 1}
    assert world.store.get("signs", TILE).sha == signs.sha  # type: ignore[union-attr]


def test_nothing_is_fetched_twice_even_by_another_drive(world: Cloud, bus: Bus, tmp_path: Path) -> None:
    for expected in ({"blob": 2}, {"unchanged": 2}):
        with open_bus(bus.config, name="drive") as own:
            downloader = FeatureDownloader(own, tmp_path / "c.sqlite", ("signs", "streetlights"), QUICK)
            for _ in range(3):
                download(downloader, TILE)
            assert downloader.counts == expected
            own.close()
            downloader.close()


def test_a_notice_is_applied_by_its_delta_and_only_in_its_layer(world: Cloud, downloader: FeatureDownloader) -> None:
    download(downloader, TILE)
    downloader.step()
    lights = downloader.tile("streetlights", TILE)
    new = tile(TILE, sign(3, x_m=-4.0), *map(sign, range(4, 41)))
    notice = world.publish("signs", new)
    assert len(notice) < 350
    assert world.announce("signs", notice, downloader) == {"signs": {TILE}}
    held = downloader.tile("signs", TILE)
    assert held is not None
    assert (held.version, held.features) == (2, new.features)
    assert downloader.counts["notice-delta"] == 1
    assert downloader.counts["blob"] == 2, "the tile came by its notice"
    assert downloader.tile("streetlights", TILE) is lights


def test_a_missed_notice_is_made_up_for_by_a_delta(world: Cloud, downloader: FeatureDownloader) -> None:
    download(downloader, TILE)
    world.publish("signs", tile(TILE, *map(sign, range(2, 40))))  # nobody hears of it
    notice = world.publish("signs", tile(TILE, *map(sign, range(3, 40))))
    world.announce("signs", notice, downloader)

    def current() -> bool:
        downloader.step()
        return downloader.tile("signs", TILE).version == 3  # type: ignore[union-attr]

    wait_until(current)
    assert downloader.counts["delta"] == 1


def test_a_tile_that_becomes_is_fetched_when_it_is_announced(world: Cloud, downloader: FeatureDownloader) -> None:
    download(downloader, EAST)
    assert downloader.tile("signs", EAST) is None
    notice = world.publish("signs", tile(EAST, sign(77)))

    def there() -> bool:
        world.bus.publish(update_key("signs", EAST), notice, kind="update")
        downloader.step()
        return downloader.tile("signs", EAST) is not None

    wait_until(there)


def test_what_is_behind_is_let_go_and_comes_back_from_the_cache(world: Cloud, downloader: FeatureDownloader) -> None:
    download(downloader, TILE)
    download(downloader, EAST)
    assert downloader.tile("signs", TILE) is None
    assert set(downloader.tiles("streetlights")) == {EAST}
    before = downloader.counts["blob"]
    download(downloader, TILE)
    assert downloader.tile("signs", TILE) is not None
    assert downloader.counts["blob"] == before


def test_without_a_router_the_cache_has_to_do_until_it_is_back(free_port: int, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_router((endpoint,)):
        with open_bus(BusConfig(connect=(endpoint,)), name="cloud") as cloud:
            world = Cloud(cloud, tmp_path)
            with open_bus(BusConfig(connect=(endpoint,)), name="first") as bus:
                downloader = FeatureDownloader(bus, tmp_path / "c.sqlite", ("signs",), QUICK)
                download(downloader, TILE)
                bus.close()
                downloader.close()
            world.server.close()
        with open_bus(BusConfig(connect=(endpoint,)), name="second") as bus:  # nobody answers
            short = DownloadParameters(request_s=0.5)
            downloader = FeatureDownloader(bus, tmp_path / "c.sqlite", ("signs",), short)
            download(downloader, TILE)
            assert downloader.counts["cached"] == 1
            assert len(downloader.tile("signs", TILE).features) == 39  # type: ignore[union-attr]
            world.publish("signs", tile(TILE, sign(1)))
            with open_bus(BusConfig(connect=(endpoint,)), name="cloud") as cloud, TileServer(world.store, cloud):

                def current() -> bool:
                    downloader.step()
                    return len(downloader.tile("signs", TILE).features) == 1  # type: ignore[union-attr]

                wait_until(current)
            bus.close()
            downloader.close()
        world.store.close()


def test_what_happened_while_the_link_was_down_is_asked_for_when_it_is_back(free_port: int, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    config = BusConfig(connect=(endpoint,))
    with ExitStack() as stack:
        router = stack.enter_context(ExitStack())
        router.enter_context(open_router((endpoint,)))
        cloud = stack.enter_context(open_bus(config, name="cloud"))
        world = Cloud(cloud, tmp_path)
        bus = stack.enter_context(open_bus(config, name="vehicle"))
        downloader = FeatureDownloader(bus, tmp_path / "c.sqlite", ("signs", "streetlights"), QUICK)
        download(downloader, TILE)
        before = bus.connections
        router.close()
        wait_until(lambda: not (bus.is_connected() or cloud.is_connected()))
        world.publish("signs", tile(TILE, *map(sign, range(2, 40))))  # its notice reaches nobody
        assert downloader.step().get("signs", set()) <= {TILE}
        assert downloader.tile("signs", TILE).version == 1  # type: ignore[union-attr]
        stack.enter_context(open_router((endpoint,)))
        wait_until(lambda: bus.connections > before)

        def current() -> bool:
            downloader.step()
            return downloader.tile("signs", TILE).version == 2  # type: ignore[union-attr]

        wait_until(current)
        assert (downloader.counts["blob"], downloader.counts["delta"]) == (2, 1), "what was held is not fetched again"
        bus.close()
        downloader.close()
        world.close()


def test_a_cache_that_is_damaged_or_holds_gaussians_is_downloaded_anew(
    world: Cloud, downloader: FeatureDownloader, tmp_path: Path
) -> None:
    stored = world.store.get("signs", TILE)
    assert stored is not None
    body = bytearray(stored.body)
    body[20] ^= 4
    cache: TileCache[FeatureTile] = TileCache(tmp_path / "cache.sqlite", "signs")
    cache.keep(TileBlob(TILE, 1, stored.sha, stored.codec_id, bytes(body)))
    assert cache.get(TILE) is None
    cache.keep(TileBlob(TILE, 1, stored.sha, 0, bytes(4)))
    assert cache.get(TILE) is None
    cache.keep(TileBlob(TILE, 1, stored.sha, stored.codec_id, bytes(body)))
    cache.close()
    download(downloader, TILE)
    assert len(downloader.tile("signs", TILE).features) == 39  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("layers", "reason"),
    [
        (("ndt",), "no feature layer"),
        (("ndt_winter",), "no feature layer"),
        (("Signs",), "no feature layer"),
        (("signs", "lanes", "signs"), "one comes twice"),
    ],
)
def test_layers_that_cannot_be_are_refused(bus: Bus, tmp_path: Path, layers: tuple[str, ...], reason: str) -> None:
    with pytest.raises(AgentConfigError, match=reason):
        FeatureDownloader(bus, tmp_path / "c.sqlite", layers)
    assert issubclass(AgentConfigError, GndError)


def test_the_voxel_map_of_an_agent_is_no_feature_layer(tmp_path: Path) -> None:
    with pytest.raises(AgentConfigError, match="layer = 'signs' holds features; that of the voxel map begins with ndt"):
        AgentConfig("car-1", tmp_path / "drive.mcap", tmp_path, layer="signs")


def test_a_layer_that_is_not_downloaded_is_named(downloader: FeatureDownloader) -> None:
    with pytest.raises(AgentConfigError, match="'lanes' is not downloaded; those that are: signs, streetlights"):
        downloader.tile("lanes", TILE)
