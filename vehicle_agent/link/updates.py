"""What others changed: update notices refresh the cache, by their delta where it fits and by a download where not."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Collection
from typing import Generic

from gnd.fleet_bus.bus import Bus
from gnd.gnd_map.content import TileT
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import WrongHash
from gnd.schemas.keys import update_keys
from gnd.schemas.updates import TileUpdate, updated
from gnd.tile_client.notices import Notices
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher

RECHECK_S = 120.0
"""A notice may be lost: a tile whose answer is so old is asked for again. A vehicle that drives has left it by then."""
RECHECK_LOOK_S = 1.0

_log = logging.getLogger(__name__)


class Updates(Generic[TileT]):
    """Subscribes to the districts around and ahead; notices wait until the main thread applies them.

    Only notices from now on are heard: earlier versions are in the answers to the vehicle's own questions, which it
    asks after it has subscribed. After a lost connection, a notice that was dropped here, and every two minutes (a
    router may drop notices, too) it asks again about the tiles that it holds.
    """

    def __init__(
        self, bus: Bus, cache: TileCache[TileT], fetcher: TileFetcher[TileT], on_tile: Callable[[TileT], object]
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._cache, self._fetcher, self._on_tile = cache, fetcher, on_tile
        self._notices = Notices(bus)
        self._rechecked_s = time.monotonic()
        self._followed: Collection[TileId] = ()

    def follow(self, tiles: Collection[TileId]) -> None:
        """Listen to the districts of these tiles, and to the few that were left last; of the same object as before
        nothing is to be done.

        A subscription a tile would cost more to declare than the notices that it keeps away.
        """
        if tiles is self._followed:
            return
        districts = sorted({tile.district for tile in tiles})
        self._notices.follow([update_keys(self._cache.layer, district.path) for district in districts])
        self._followed = tiles  # not before: what has failed is tried again

    def close(self) -> None:
        """Listen to nothing any more."""
        self._notices.close()

    def apply(self) -> None:
        """Apply the notices that have come. A bad one is named, counted and left out."""
        self._catch_up()
        while True:
            try:
                notice = self._notices.take()
                if notice is None:
                    return
                self._apply(notice.update)
            except GndError as error:
                self.counts["refused"] += 1
                _log.warning("update refused: %s", error)

    def _catch_up(self) -> None:
        if self._notices.may_have_been_lost():
            self._fetcher.recheck()
        elif time.monotonic() - self._rechecked_s >= RECHECK_LOOK_S:
            self._rechecked_s = time.monotonic()
            self._fetcher.recheck(RECHECK_S)

    def _apply(self, update: TileUpdate) -> None:
        self.counts["received"] += 1
        if self._fetcher.check is not None:
            self._fetcher.check.note_announced(update.tile, update.made_s, update.version)
        version, sha = self._cache.head(update.tile)
        if version and (version >= update.version or sha == update.sha):
            return  # known already
        cached = self._cache.get(update.tile) if version and update.follows(sha) else None
        if cached is None:
            self._fetcher.refresh(update.tile)
            return
        try:
            tile = updated(update, cached)
        except WrongHash:
            self._fetcher.refresh(update.tile)
            raise
        if self._cache.put(tile, over=update.previous_sha):
            self.counts["delta"] += 1
            self._on_tile(tile)
