"""What others changed: update notices refresh the cache, by their delta where it fits and by a download where not."""

import logging
import queue
from collections import Counter
from collections.abc import Callable, Iterable

from fleet_bus.bus import Bus
from gnd_map.errors import GndError
from gnd_map.tile import Tile, apply
from gnd_map.tile_id import District, TileId
from schemas.errors import WrongHash
from schemas.keys import update_keys
from schemas.updates import TileUpdate
from vehicle_agent.cache import TileCache
from vehicle_agent.download import TileFetcher

_log = logging.getLogger(__name__)


class Updates:
    """Subscribes to the districts that the vehicle comes near; notices wait until the main thread applies them."""

    def __init__(self, bus: Bus, cache: TileCache, fetcher: TileFetcher, on_tile: Callable[[Tile], object]) -> None:
        self.counts: Counter[str] = Counter()
        self._bus, self._cache, self._fetcher, self._on_tile = bus, cache, fetcher, on_tile
        self._districts: set[District] = set()
        self._notices: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def follow(self, tiles: Iterable[TileId]) -> None:
        """Subscribe to the districts of these tiles, each once."""
        for district in sorted({tile.district for tile in tiles} - self._districts):
            keys = update_keys(self._cache.layer, district.path)
            self._bus.subscribe(keys, lambda _key, payload: self._notices.put(payload), history=True)
            self._districts.add(district)

    def apply(self) -> int:
        """Apply the notices that have come; returns how many. A bad one is named, counted and left out."""
        applied = 0
        while True:
            try:
                payload = self._notices.get_nowait()
            except queue.Empty:
                return applied
            applied += 1
            try:
                self._apply(TileUpdate.decode(payload))
            except GndError as error:
                self.counts["refused"] += 1
                _log.warning("update refused: %s", error)

    def _apply(self, update: TileUpdate) -> None:
        self.counts["received"] += 1
        version, sha = self._cache.head(update.tile)
        if version == 0:
            return self._fetch_if_absent(update.tile)
        if version >= update.version or sha == update.sha:
            return None
        if update.delta is None or sha != update.previous_sha:
            return self._fetcher.refresh(update.tile)
        self._use_delta(update)
        return None

    def _fetch_if_absent(self, tile_id: TileId) -> None:
        """A tile that is not in the cache: it is asked for again if the store had none when it was asked for."""
        self._fetcher.refresh_if_answered(tile_id)

    def _use_delta(self, update: TileUpdate) -> None:
        cached = self._cache.get(update.tile)
        if cached is None or update.delta is None:
            return self._fetcher.refresh(update.tile)
        tile = Tile(update.tile, update.version, apply(cached.gaussians, update.delta))
        if tile.sha != update.sha:
            self._fetcher.refresh(update.tile)
            raise WrongHash(
                f"tile {update.tile}: the delta to version {update.version} gives sha {tile.sha.hex()[:16]}…,"
                f" announced is {update.sha.hex()[:16]}…; the tile is fetched again"
            )
        self._cache.put(tile)
        self.counts["delta"] += 1
        self._on_tile(tile)
        return None
