"""One store with voxels and features: who reads only voxels gets, byte for byte, what a store of voxels alone gives."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from vehicle_scene import ground, published
from waiting import wait_until

from gnd.cloud_merger.announce import encoded, update_of
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusError
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.codec import PREFERRED
from gnd.gnd_map.features import Feature, FeatureTile, hit
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas import keys
from gnd.schemas.tiles import TileReply, TileRequest, content_of
from gnd.schemas.tiles_batch import HeldVersion, TilesRequest
from gnd.tile_store.server import PLAIN_REQUEST, TILE_ROOT, TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher
from gnd.vehicle_agent.link.feature_download import FeatureDownloader
from gnd.vehicle_agent.link.updates import Updates

BASE = published(ground(12.0))
TILE = max(BASE, key=lambda t: len(BASE[t].gaussians))
TIMEOUT_S = 20.0


def signs(*ids: int) -> FeatureTile:
    cov_m2 = np.array([0.04, 0.0, 0.0, 0.04, 0.0, 1e4])
    at = np.array([[1.0, 2.0, 30.0]])
    return FeatureTile.of(TILE, 1, [Feature(number, "traffic_sign", at, cov_m2, hit(0.9)) for number in ids])


@contextmanager
def served(folder: Path, port: int, *, with_features: bool) -> Iterator[tuple[SqliteStore, BusConfig]]:
    """A store behind a router of its own."""
    endpoint = f"tcp/127.0.0.1:{port}"
    config = BusConfig(connect=(endpoint,))
    with ExitStack() as stack:
        stack.enter_context(open_router((endpoint,)))
        store = stack.enter_context(SqliteStore(folder / f"store-{with_features}.sqlite", now_ns=lambda: 10**18))
        store.put_tiles(list(BASE.values()))
        for layer in ("signs", "a_layer_of_others") if with_features else ():
            store.put_tiles([signs(1, 2, 3)], layer=layer)
        stack.enter_context(TileServer(store, stack.enter_context(open_bus(config, name="store"))))
        yield store, config


def said_to_who_reads_voxels(config: BusConfig) -> list[object]:
    """All that an ndt-only client can ask, and the bytes of the answers."""
    wanted = TilesRequest.of([HeldVersion(t) for t in BASE if t.district == TILE.district], codecs=PREFERRED)
    region = keys.tiles_key("ndt", TILE.district.path)
    every_layer = f"{TILE_ROOT}*/{TILE.path}"
    with open_bus(config, name="voxels") as bus:
        one = bus.request(keys.tile_key("ndt", TILE), TileRequest().encode(), kind="tile", timeout_s=TIMEOUT_S)
        plain = bus.request(keys.tile_key("ndt", TILE), b"", kind="tile", timeout_s=TIMEOUT_S)
        batch = bus.request(keys.batch_key("ndt", TILE.district), wanted.encode(), kind="tile", timeout_s=TIMEOUT_S)
        catalog = bus.request(keys.catalog_key("ndt", TILE.district), b"", kind="catalog", timeout_s=TIMEOUT_S)
        asked = [
            sorted(bus.request_many(key, TileRequest().encode(), kind="tile", timeout_s=TIMEOUT_S))
            for key in (region, every_layer, f"{TILE_ROOT}**")
        ]
        return [one, plain, batch, catalog, *asked]


def test_who_reads_only_voxels_is_told_the_same_bytes(tmp_path: Path, free_port: int) -> None:
    with served(tmp_path, free_port, with_features=False) as (_, config):
        alone = said_to_who_reads_voxels(config)
    with served(tmp_path, free_port, with_features=True) as (_, config):
        beside = said_to_who_reads_voxels(config)
    assert beside == alone
    assert all(alone)


def test_a_vehicle_of_voxels_and_one_of_features_do_not_disturb_each_other(tmp_path: Path, free_port: int) -> None:
    with served(tmp_path, free_port, with_features=True) as (store, config), ExitStack() as stack:
        cloud = stack.enter_context(open_bus(config, name="cloud"))
        voxel_bus, feature_bus = (stack.enter_context(open_bus(config, name=name)) for name in ("voxels", "features"))
        cache: TileCache[Tile] = TileCache(tmp_path / "cache.sqlite")
        fetcher = TileFetcher(voxel_bus, cache, DownloadParameters(in_flight=2))
        updates = Updates(voxel_bus, cache, fetcher, lambda _tile: None)
        features = FeatureDownloader(feature_bus, tmp_path / "features.sqlite", ("signs",))

        updates.follow([TILE])
        fetcher.want([TILE])
        features.follow([TILE])
        wait_until(lambda: cache.head(TILE)[0] and features.step() and features.tile("signs", TILE))

        def announced(layer: str, version: int) -> None:
            stored, parent = store.get(layer, TILE, version), store.get(layer, TILE, version - 1)
            assert stored is not None
            cloud.publish(keys.update_key(layer, TILE), encoded(update_of(stored, parent)), kind="update")

        newest = FeatureTile(TILE, 2, signs(2, 3, 4).features)
        store.put_tiles([newest], layer="signs")
        store.put_tiles([Tile(TILE, 0, BASE[TILE].gaussians.take(np.arange(5, len(BASE[TILE].gaussians))))])

        def both_are_current() -> bool:
            for layer in ("signs", "ndt"):
                announced(layer, 2)
            updates.apply()
            features.step()
            return cache.head(TILE)[0] == 2 and features.tile("signs", TILE) == FeatureTile(
                TILE, 2, signs(2, 3, 4).features
            )

        wait_until(both_are_current)
        assert updates.counts["refused"] == features.counts["notice-refused"] == 0
        assert fetcher.counts["blob"] == features.counts["blob"] == 1, "the new versions came by notice"
        assert isinstance(cache.get(TILE), Tile)
        voxel_bus.close()
        feature_bus.close()
        fetcher.close()
        features.close()
        cache.close()


def test_who_asks_plainly_gets_what_a_layer_comes_in(tmp_path: Path, free_port: int) -> None:
    with served(tmp_path, free_port, with_features=True) as (_, config), open_bus(config, name="anyone") as bus:
        assert ask(bus, "signs", b"") == FeatureTile(TILE, 1, signs(1, 2, 3).features)
        assert ask(bus, "ndt", b"") == Tile(TILE, 1, BASE[TILE].gaussians)
        every = dict(bus.request_many(f"{TILE_ROOT}*/{TILE.path}", b"", kind="tile", timeout_s=TIMEOUT_S))
        assert {keys.parse_tile_key(key)[0] for key in every} == {"ndt", "signs", "a_layer_of_others"}
        with pytest.raises(BusError, match="of layer signs comes in codec 32, asked for"):
            ask(bus, "signs", TileRequest().encode())
        assert PLAIN_REQUEST.codecs == (0, 32)


def ask(bus: Bus, layer: str, payload: bytes, tile: TileId = TILE) -> Tile | FeatureTile:
    reply = TileReply.decode(bus.request(keys.tile_key(layer, tile), payload, kind="tile", timeout_s=TIMEOUT_S))
    assert reply.blob is not None
    return content_of(reply.blob)
