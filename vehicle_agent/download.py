"""Tiles from the tile server: nearest first, several requests in flight, only what the cache lacks."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

from fleet_bus.bus import Bus
from fleet_bus.errors import BusClosed
from gnd_map.tile import Tile
from gnd_map.tile_id import TileId
from schemas.errors import WrongHash
from schemas.keys import tile_key
from schemas.tiles import TileReply, TileRequest, tile_of
from vehicle_agent.cache import TileCache
from vehicle_agent.config import DownloadParameters

POLL_S = 0.25
WRONG_TRIES = 3

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Fetched:
    """The answer about one tile: `blob` (downloaded), `unchanged` (the cached one holds), `absent` (the store has none)
    or `cached` (no answer, the cached one will have to do).
    """

    tile_id: TileId
    status: Literal["blob", "unchanged", "absent", "cached"]
    tile: Tile | None


class TileFetcher:
    """Worker threads that ask for the tiles that are wanted, in the order given; answers wait to be taken.

    A tile is asked for once until `forget` or `refresh`. A tile whose content does not have its hash is refused and
    asked for again without the cache; no answer at all gives the cached tile, if there is one, and another try later.
    """

    def __init__(self, bus: Bus, cache: TileCache, parameters: DownloadParameters) -> None:
        self.counts: Counter[str] = Counter()
        self.last_error = ""
        self._bus, self._cache, self._parameters = bus, cache, parameters
        self._changed = threading.Condition()
        self._waiting: list[TileId] = []
        self._not_before: dict[TileId, float] = {}
        self._in_flight: set[TileId] = set()
        self._answered: set[TileId] = set()
        self._stale: set[TileId] = set()
        self._arrived: list[Fetched] = []
        self._closed = False
        self._threads = [
            threading.Thread(target=self._work, name=f"tiles-{n}", daemon=True) for n in range(parameters.in_flight)
        ]
        for thread in self._threads:
            thread.start()

    def want(self, tiles: Sequence[TileId]) -> None:
        """These tiles are wanted, the first one most; what was wanted before and is not among them no longer is."""
        with self._changed:
            done = (self._answered - self._stale) | self._in_flight
            self._waiting = [t for t in tiles if t not in done]
            self._changed.notify_all()

    def refresh(self, tile_id: TileId) -> None:
        """Ask for a tile again, before all others."""
        with self._changed:
            self._answered.discard(tile_id)
            self._not_before.pop(tile_id, None)
            self._waiting = [tile_id, *(t for t in self._waiting if t != tile_id)]
            self._changed.notify_all()

    def refresh_if_answered(self, tile_id: TileId) -> None:
        """As `refresh`, for a tile that was asked for before; others are asked for when they are wanted."""
        if tile_id in self._answered:
            self.refresh(tile_id)

    def forget(self, tile_id: TileId) -> None:
        """The tile was let go: the next `want` asks for it again."""
        with self._changed:
            self._answered.discard(tile_id)
            self._stale.discard(tile_id)

    def take(self) -> list[Fetched]:
        """The answers since the last call."""
        with self._changed:
            arrived, self._arrived = self._arrived, []
            return arrived

    def wait_for(self, tiles: Collection[TileId], timeout_s: float, stop: threading.Event) -> set[TileId]:
        """Wait until all of `tiles` are answered, time is up or `stop` is set; returns those that are not answered."""
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            while (missing := set(tiles) - self._answered) and not (stop.is_set() or self._closed):
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    break
                self._changed.wait(min(left_s, POLL_S))
            return missing

    def close(self) -> None:
        """End the threads; requests under way end with the bus."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    def _work(self) -> None:
        while (tile_id := self._next()) is not None:
            answer = self._try(tile_id)
            with self._changed:
                self._in_flight.discard(tile_id)
                self._settle(tile_id, answer)
                self._changed.notify_all()

    def _next(self) -> TileId | None:
        """The first tile that may be asked for now; None when closed."""
        with self._changed:
            while not self._closed:
                now_s = time.monotonic()
                for tile_id in self._waiting:
                    if self._not_before.get(tile_id, 0.0) <= now_s:
                        self._waiting.remove(tile_id)
                        self._in_flight.add(tile_id)
                        return tile_id
                self._changed.wait(POLL_S)
            return None

    def _settle(self, tile_id: TileId, answer: Fetched | None) -> None:
        """Note an answer; without one the tile waits for its next try."""
        if answer is None or answer.status == "cached":
            self._not_before[tile_id] = time.monotonic() + self._parameters.retry_s
            self._waiting.append(tile_id)
            if answer is None or tile_id in self._stale:
                return
            self._stale.add(tile_id)
        else:
            self._stale.discard(tile_id)
        self.counts[answer.status] += 1
        self._answered.add(tile_id)
        self._arrived.append(answer)

    def _try(self, tile_id: TileId) -> Fetched | None:
        try:
            return self._fetch(tile_id)
        except BusClosed:
            return None
        except Exception as error:  # whatever it was: a worker that ends would never fetch again
            self._note("failed", f"tile {tile_id}: {error}")
            cached = self._cache.get(tile_id)
            return None if cached is None else Fetched(tile_id, "cached", cached)

    def _fetch(self, tile_id: TileId) -> Fetched:
        """Ask until the content is what its hash says.

        Raises:
            BusError: no answer before the deadline.
            WrongHash: the content was wrong three times.
            SchemaError: the answer is no tile.
        """
        for attempt in range(WRONG_TRIES):
            request = self._request_for(tile_id, with_cache=attempt == 0)
            try:
                return self._ask(tile_id, request)
            except WrongHash as error:
                self._note("refused", str(error))
                if attempt == WRONG_TRIES - 1:
                    raise
        raise AssertionError("the loop returns or raises")

    def _request_for(self, tile_id: TileId, *, with_cache: bool) -> TileRequest:
        version, sha = self._cache.head(tile_id) if with_cache else (0, b"")
        return TileRequest(version, sha)

    def _ask(self, tile_id: TileId, request: TileRequest) -> Fetched:
        key = tile_key(self._cache.layer, tile_id)
        timeout_s = self._parameters.request_s
        reply = TileReply.decode(
            self._bus.request(key, request.encode(), kind="tile", tile=tile_id, timeout_s=timeout_s)
        )
        if reply.status == "absent":
            return Fetched(tile_id, "absent", None)
        if reply.blob is None:
            return Fetched(tile_id, "unchanged", self._from_cache(tile_id))
        tile = tile_of(reply.blob)
        if tile.tile_id != tile_id:
            raise WrongHash(f"asked for tile {tile_id}, got tile {tile.tile_id}; fetch it again")
        self._cache.put(tile)
        return Fetched(tile_id, "blob", tile)

    def _from_cache(self, tile_id: TileId) -> Tile:
        tile = self._cache.get(tile_id)
        if tile is None:
            raise WrongHash(f"tile {tile_id}: the cached copy does not have its hash; fetch it again")
        return tile

    def _note(self, what: str, message: str) -> None:
        with self._changed:
            self.counts[what] += 1
            self.last_error = message
        _log.warning("%s", message)
