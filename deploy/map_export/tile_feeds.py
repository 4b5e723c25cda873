"""Where the tiles of a served map come from, and their new versions: a store's file, or the fleet over its router."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Protocol

from gnd.client import Client, connect
from gnd.deploy.map_export.scene import store_of
from gnd.fleet_bus.config import check_endpoint
from gnd.fleet_bus.errors import BusConfigError
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.region import Region
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.export import ExportError, region_tiles
from gnd.tile_store.options import to_read
from gnd.tile_store.store import Store

LOOK_S: Final = 1.0
"""So often a store is looked at for new versions."""
_POLL_S: Final = 0.2


class TileFeed(Protocol):
    """The tiles of a region, all at first, then those that are new."""

    def all(self) -> list[Tile]:
        """The newest version of every tile; empty where there is none."""

    def newer(self) -> list[Tile]:
        """New versions since the last call, of a tile the last one only; waits a moment for one.

        Raises:
            GndError: they cannot be had now; the next call tries again.
        """


class StoreFeed:
    """The tiles of a store that somebody else writes.

    Raises:
        ExportError: the layer holds features.
    """

    def __init__(self, store: Store, layer: str, prefix: str) -> None:
        self._store, self._layer, self._prefix = store, layer, prefix
        self._known: dict[TileId, bytes] = {}
        self._looked_s = time.monotonic()

    def all(self) -> list[Tile]:
        """As `TileFeed.all`; ExportError: there are none."""
        tiles = region_tiles(self._store, self._layer, self._prefix)
        self._known = {tile.tile_id: tile.sha for tile in tiles}
        return tiles

    def newer(self) -> list[Tile]:
        """As `TileFeed.newer`."""
        time.sleep(_POLL_S)
        if time.monotonic() - self._looked_s < LOOK_S:
            return []
        self._looked_s = time.monotonic()
        tiles = []
        for entry in self._store.heads(self._layer, self._prefix):
            if self._known.get(entry.tile) != entry.sha:
                stored = self._store.get(self._layer, entry.tile, entry.version)
                if stored is not None:
                    tiles.append(stored.decode_gaussians())
                    self._known[entry.tile] = entry.sha
        return tiles


class FleetFeed:
    """The tiles of a fleet's map as its tile server gives them and its merger announces them."""

    def __init__(self, client: Client, layer: str, prefix: str) -> None:
        self._stream = client.subscribe(Region(prefix), layers=(layer,), existing=True)

    def all(self) -> list[Tile]:
        """As `TileFeed.all`."""
        return self._waiting(0.0)

    def newer(self) -> list[Tile]:
        """As `TileFeed.newer`."""
        return self._waiting(_POLL_S)

    def _waiting(self, wait_s: float) -> list[Tile]:
        found: dict[TileId, Tile] = {}
        while (update := self._stream.next(timeout_s=0.0 if found else wait_s)) is not None:
            if isinstance(update.tile, Tile):
                found[update.tile.tile_id] = update.tile
        return list(found.values())


@contextmanager
def open_feed(source: str, layer: str, prefix: str) -> Iterator[TileFeed]:
    """The feed of what a user names.

    Args:
        source: a store's file, the folder of a run, or the endpoint of a fleet's router.
        layer: a layer of Gaussians.
        prefix: leading chunks of tile paths; "" = all.

    Raises:
        ExportError: the layer holds features.
        NoRouter, RequestFailed: no router or no tile server answers.
        StoreUnavailable: there is neither such a file nor is it an endpoint.
    """
    if is_feature_layer(layer):
        raise ExportError(f"layer {layer!r} holds features, not Gaussians: `gnd features export`")
    if not Path(source).exists() and _is_endpoint(source):
        with connect(source) as client:
            yield FleetFeed(client, layer, prefix)
    else:
        with to_read(store_of(Path(source))) as store:
            yield StoreFeed(store, layer, prefix)


def _is_endpoint(text: str) -> bool:
    try:
        check_endpoint(text)
    except BusConfigError:
        return False
    return True
