"""What lies in the store, as the merge reads it: the statements of reports, and tiles by version; both remembered."""

from collections import OrderedDict
from functools import lru_cache
from threading import Lock
from typing import Final

from gnd_map.gaussian import Gaussians
from gnd_map.tile import Tile
from gnd_map.tile_id import TileId
from schemas.changes import ChangeReport, TileChange
from tile_store.store import Store

REMEMBERED_REPORTS: Final = 1024  # some 20 kB each
REMEMBERED_TILES: Final = 512  # some 120 kB each


@lru_cache(maxsize=REMEMBERED_REPORTS)
def said(body: bytes) -> tuple[str, TileChange]:
    """Sensor model and the one tile of a stored report; remembered: each merge of a tile reads all reports again.

    Raises:
        SchemaError: it can no longer be read.
    """
    report = ChangeReport.decode(body)
    (change,) = report.tiles
    return report.sensor_model, change


class Bases:
    """Versions of tiles, decoded; a version never changes, so those used last are remembered. Safe in several threads.

    Args:
        store: that holds them.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = Lock()
        self._tiles: OrderedDict[tuple[str, TileId, int | bytes], Tile] = OrderedDict()

    def version(self, layer: str, tile: TileId, version: int) -> Tile | None:
        """A version of a tile; None: the store does not hold it. Version 0: the vehicle had no map, so no Gaussians."""
        if version == 0:
            return Tile(tile, 0, Gaussians.empty())
        return self._remembered(layer, tile, version)

    def content(self, layer: str, tile: TileId, sha: bytes) -> Gaussians | None:
        """The Gaussians of a tile by content hash; None: the store does not hold them."""
        found = self._remembered(layer, tile, sha)
        return None if found is None else found.gaussians

    def forget(self) -> None:
        """Read everything anew: after retention a version's number may have been given again."""
        with self._lock:
            self._tiles.clear()

    def _remembered(self, layer: str, tile: TileId, which: int | bytes) -> Tile | None:
        place = (layer, tile, which)
        with self._lock:
            if place in self._tiles:
                self._tiles.move_to_end(place)
                return self._tiles[place]
        if isinstance(which, bytes):
            stored = self._store.by_sha(layer, tile, which)
        else:
            stored = self._store.get(layer, tile, version=which)
        if stored is None:
            return None
        with self._lock:
            self._tiles[place] = stored.decode()
            while len(self._tiles) > REMEMBERED_TILES:
                self._tiles.popitem(last=False)
            return self._tiles[place]
