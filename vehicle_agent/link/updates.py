"""What others changed: update notices refresh the cache, by their delta where it fits and by a download where not."""

import logging
import queue
import time
from collections import Counter
from collections.abc import Callable, Collection
from typing import Generic

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.subscribing import Subscription
from gnd.gnd_map.content import TileT
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.errors import WrongHash
from gnd.schemas.keys import parse_update_key, update_keys
from gnd.schemas.updates import TileUpdate, updated
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher

RECHECK_S = 120.0
"""A notice may be lost: what is held for so long is asked about again. Who drives has left it behind before."""
RECHECK_LOOK_S = 1.0
MOST_DISTRICTS = 4  # as many meet at a corner: a vehicle that turns there need not declare anything anew

_log = logging.getLogger(__name__)


class Updates(Generic[TileT]):
    """Subscribes to the districts around and ahead; notices wait until the main thread applies them.

    Only what happens from now on is listened to: what happened before is in the answers to the vehicle's own
    questions, which it puts after it has subscribed. After a lost connection, a notice that was dropped here, and every
    two minutes (a router may drop notices, too) it asks again about what it holds.
    """

    def __init__(
        self, bus: Bus, cache: TileCache[TileT], fetcher: TileFetcher[TileT], on_tile: Callable[[TileT], object]
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._bus, self._cache, self._fetcher, self._on_tile = bus, cache, fetcher, on_tile
        self._followed: dict[District, Subscription] = {}
        self._notices: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._missed_at = (bus.connections, 0)
        self._rechecked_s = time.monotonic()

    def follow(self, tiles: Collection[TileId]) -> None:
        """Listen to the districts of these tiles; those that were left first are no longer listened to."""
        districts = sorted({tile.district for tile in tiles})
        for district in districts:
            followed = self._followed.pop(district, None)
            self._followed[district] = followed or self._subscribe(district)
        for district in list(self._followed)[: -max(MOST_DISTRICTS, len(districts))]:
            self._followed.pop(district).close()

    def close(self) -> None:
        """Listen to nothing any more."""
        while self._followed:
            self._followed.popitem()[1].close()

    def _subscribe(self, district: District) -> Subscription:
        """A whole district: a subscription a tile costs more to declare than the notices that it keeps away."""
        return self._bus.subscribe(
            update_keys(self._cache.layer, district.path),
            lambda _key, payload: self._notices.put(payload),
            tile_of=lambda key: parse_update_key(key)[1],
        )

    def apply(self) -> int:
        """Apply the notices that have come; returns how many. A bad one is named, counted and left out."""
        self._catch_up()
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

    def _catch_up(self) -> None:
        """Notices of the time without a router are lost, and of those with one the router may drop some."""
        connections, dropped = self._bus.connections, sum(one.dropped for one in self._followed.values())
        if (connections, dropped) != self._missed_at:
            self._missed_at = connections, dropped
            self._fetcher.recheck()
        elif time.monotonic() - self._rechecked_s >= RECHECK_LOOK_S:
            self._rechecked_s = time.monotonic()
            self._fetcher.recheck(RECHECK_S)

    def _apply(self, update: TileUpdate) -> None:
        self.counts["received"] += 1
        version, sha = self._cache.head(update.tile)
        if version and (version >= update.version or sha == update.sha):
            return  # old news
        if version and sha == update.previous_sha and update.has_delta:
            self._use_delta(update)
        else:
            self._fetcher.refresh(update.tile)

    def _use_delta(self, update: TileUpdate) -> None:
        cached = self._cache.get(update.tile)
        if cached is None:
            return self._fetcher.refresh(update.tile)
        try:
            tile = updated(update, cached)
        except WrongHash:
            self._fetcher.refresh(update.tile)
            raise
        if self._cache.put(tile, over=update.previous_sha):
            self.counts["delta"] += 1
            self._on_tile(tile)
        return None
