"""Tiles from the tile server: soonest needed first, in batches of a few districts, several on their way at a time."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Final, Generic

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.config import QUEUED_BATCHES
from gnd.fleet_bus.errors import BusClosed
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.seldom import Seldom
from gnd.gnd_map.content import TileT
from gnd.gnd_map.tile_id import District, TileId
from gnd.tile_client.archive import Archive, ArchiveTiles
from gnd.tile_client.archive_check import SeenStates
from gnd.tile_client.checking import VersionCheck
from gnd.tile_client.exchange import Exchange, ExchangeOutcome, Fetched
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.errors import CacheError
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.plan import batch_bytes

DOWNLOAD_BATCH_S: Final = 0.25
"""One answer holds what the link carries in this time (4 to 128 kB): something more urgent waits no longer."""

POLL_S = 0.25
OFFLINE_WAIT_S = 0.5
RETRY_S = 1.0
"""Pause before a tile that got no answer is asked for again."""
WRONG_TRIES = 3
MOST_DOUBLINGS = 7
"""Of the pause, while what comes stays wrong: to a minute."""
MOST_TILES = 1024  # of one district, and of one answer
FIRST_GUESS_BYTES = 4_096
HELD_GUESS_BYTES = 64
LEAST_BESIDES_BYTES: Final = 256
"""Bodies in the answer to a question that names tiles besides: those that are wanted are expected to be few."""

_log = logging.getLogger(__name__)
_SELDOM: Final = Seldom(_log)


@dataclass(frozen=True, slots=True)
class _TilesQuestion:
    """What is asked at once, of a few districts.

    Attributes:
        tiles: that are wanted, the first one most.
        besides: others of which only that they are on no map is to be heard.
        max_bytes: of the bodies in the answer.
    """

    tiles: tuple[TileId, ...]
    besides: tuple[TileId, ...]
    max_bytes: int


class TileFetcher(Generic[TileT]):
    """Worker threads that ask for the tiles that are wanted, in the order given; answers wait to be taken.

    A tile is asked for once until `forget`, `refresh` or `recheck`. A tile whose content does not have its hash, or
    that nobody answers for, is refused and asked for again without the cache; no answer at all gives the cached tile,
    if there is one, and another try later. What has arrived is in the cache at once, so an agent that was killed goes
    on where it was.

    With an archive what the cache has nothing of is brought from there first; then the bus is asked as if it had been
    held for long: it answers with what is newer, or with nothing. `archives_seen`: where it is kept which states of
    archives were seen; None: nowhere.
    """

    def __init__(
        self,
        bus: Bus,
        cache: TileCache[TileT],
        parameters: DownloadParameters,
        ticket: int = 0,
        archive: Archive | None = None,
        archives_seen: Path | None = None,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.last_error = ""
        self.link: LinkProfile = bus.config.link_profile
        self._bus, self._cache, self._parameters = bus, cache, parameters
        self._offline = False
        self.check = VersionCheck.on_the_bus(bus, cache.layer, cache)
        self._archive: ArchiveTiles[TileT] | None = None
        if archive is not None:
            self._archive = ArchiveTiles(archive, cache, self.check, SeenStates(archives_seen))
        # One attempt may take all the time there is: a second one would fetch a slow answer twice.
        self._exchange: Exchange[TileT] = Exchange(
            bus, cache, parameters.request_s, parameters.request_s, ticket=ticket, check=self.check
        )
        rate_byte_s = self.link.rate_byte_s("down")
        self._batch_bytes = batch_bytes(rate_byte_s, DOWNLOAD_BATCH_S)
        # More on its way than the router keeps for us would be thrown away.
        kept_bytes = 0.75 * QUEUED_BATCHES * self.link.batch_bytes
        self._window_bytes = min(kept_bytes, rate_byte_s * (DOWNLOAD_BATCH_S + 2 * self.link.delay_s))
        self._changed = threading.Condition()
        self._wanted: tuple[TileId, ...] = ()
        self._besides: tuple[TileId, ...] = ()
        self._on_a_map: set[TileId] = set()  # asked besides, and there is something
        self._waiting: list[TileId] = []
        self._not_before: dict[TileId, float] = {}
        self._in_flight: dict[TileId, float] = {}  # with the bytes expected
        self._again: set[TileId] = set()  # in flight, and already known to have changed
        self._answered: set[TileId] = set()
        self._answered_s: dict[TileId, float] = {}
        self._stale: set[TileId] = set()  # answered, but to be asked for again
        self._wrong: Counter[TileId] = Counter()
        self._whole = _Mean(FIRST_GUESS_BYTES)
        self._watched: set[TileId] = set()
        self._arrived: list[Fetched[TileT]] = []
        self._closed = False
        self._threads = [
            threading.Thread(target=self._work, name=f"tiles-{n}", daemon=True) for n in range(parameters.in_flight)
        ]
        for thread in self._threads:
            thread.start()

    def want(self, tiles: Sequence[TileId], besides: Sequence[TileId] = ()) -> None:
        """These tiles are wanted, the first one most; what was wanted before and is not among them no longer is.

        Args:
            tiles: the tiles.
            besides: tiles that a question names, too, if there is one that their district goes along with: that they
                are on no map costs next to nothing to hear; what is on one is not brought for that.
        """
        with self._changed:
            self._wanted, self._besides = tuple(tiles), tuple(besides)
            self._line_up()

    def refresh(self, tile_id: TileId) -> None:
        """A tile that was answered has changed: ask for it again, before all others, while it is wanted.

        One that is not wanted is asked for when it is wanted again.
        """
        with self._changed:
            if tile_id in self._in_flight:
                self._again.add(tile_id)
            elif tile_id in self._answered:
                self._stale.add(tile_id)
                self._not_before.pop(tile_id, None)
                self._line_up(first=tile_id)

    def recheck(self, older_than_s: float = 0.0) -> None:
        """Tiles whose answer is older may have changed unheard: ask again for those that are wanted.

        With them goes what is half as old: it would be a question of its own soon.
        """
        now_s = time.monotonic()
        with self._changed:
            if now_s - min(self._answered_s.values(), default=now_s) < older_than_s:
                return  # nearly always: thousands of tiles are not looked at one by one
            age_s = {tile_id: now_s - self._answered_s.get(tile_id, 0.0) for tile_id in self._answered - self._stale}
            if max(age_s.values(), default=-1.0) >= older_than_s:
                old = {tile_id for tile_id, one_s in age_s.items() if one_s >= older_than_s / 2}
                self._stale |= old
                self._line_up()

    def forget(self, tile_id: TileId) -> None:
        """The tile was let go: the next `want` asks for it again."""
        with self._changed:
            self._answered.discard(tile_id)
            self._answered_s.pop(tile_id, None)
            self._stale.discard(tile_id)
            self._watched.discard(tile_id)
            self._on_a_map.discard(tile_id)

    def take(self) -> list[Fetched[TileT]]:
        """The answers since the last call."""
        with self._changed:
            arrived, self._arrived = self._arrived, []
            return arrived

    def watched(self) -> frozenset[TileId]:
        """The tiles of which a version was on trial when they were last answered."""
        with self._changed:
            return frozenset(self._watched)

    def is_known(self, tile_id: TileId) -> bool:
        """Whether there is or will be an answer without asking anew."""
        with self._changed:
            return tile_id in self._in_flight or (tile_id in self._answered and tile_id not in self._stale)

    def is_held(self, tile_id: TileId) -> bool:
        """Whether the cache has a version of it."""
        try:
            return bool(self._cache.head(tile_id)[0])
        except CacheError:
            return False

    def held_of(self, districts: Iterable[District]) -> list[TileId]:
        """The tiles of some districts of which the cache has a version, in order."""
        try:
            return [tile_id for one in sorted(districts) for tile_id in self._cache.held_of(one)]
        except CacheError:
            return []

    def size_bytes(self, tile_id: TileId) -> float:
        """What the answer about a tile is likely to weigh: of one that is held little, of one not held the mean."""
        if self.is_known(tile_id):
            return 0.0
        return self._expected_bytes(tile_id)

    def wait_for(self, tiles: Collection[TileId], timeout_s: float, stop: threading.Event) -> set[TileId]:
        """Wait until all of `tiles` are answered, time is up or `stop` is set; returns those that are not answered.

        Without a router it waits only until the cache was asked.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            while (missing := set(tiles) - self._answered) and not (stop.is_set() or self._closed):
                left_s = deadline_s - time.monotonic()
                if left_s <= 0 or (self._offline and missing <= self._not_before.keys()):
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

    def _line_up(self, first: TileId | None = None) -> None:
        """What is wanted and not known waits, in order. The lock is held."""
        done = (self._answered - self._stale) | self._in_flight.keys()
        self._waiting = sorted((t for t in self._wanted if t not in done), key=lambda t: t != first)
        self._changed.notify_all()

    def _expected_bytes(self, tile_id: TileId) -> float:
        try:
            return HELD_GUESS_BYTES if self._cache.head(tile_id)[0] else self._whole.value
        except CacheError:  # what cannot be read is asked for whole
            return self._whole.value

    def _work(self) -> None:
        while question := self._next():
            outcome = self._try(question)
            done = {fetched.tile_id for fetched in outcome.fetched}
            instead = self._cached(t for t in question.tiles if t not in done) if not self._closed else {}
            with self._changed:
                for tile_id in (*question.tiles, *question.besides):
                    del self._in_flight[tile_id]
                self._settle_all(question.tiles, outcome, instead)
                self._on_a_map.update(set(question.besides).intersection(outcome.later))
                self._line_up()

    def _next(self) -> _TilesQuestion | None:
        """The next question: the first tile that may be asked for now, and more that go along; None when closed."""
        with self._changed:
            while not self._closed:
                now_s = time.monotonic()
                ready = [t for t in self._waiting if self._not_before.get(t, 0.0) <= now_s]
                if ready and sum(self._in_flight.values()) <= self._window_bytes:
                    batch = self._fitting(self._going_along(ready))
                    self._waiting = [t for t in self._waiting if t not in batch]
                    self._in_flight |= batch
                    question = self._question(batch)
                    self._in_flight |= dict.fromkeys(question.besides, 0.0)
                    return question
                self._changed.wait(POLL_S)
            return None

    def _going_along(self, tiles: Iterable[TileId], districts: Collection[District] = ()) -> Iterator[TileId]:
        """Those of `tiles`, from the first on, that one question can be about, if it is about these districts, too."""
        districts = set(districts)
        for tile_id in tiles:
            if self._exchange.goes_along(districts, tile_id.district):
                districts.add(tile_id.district)
                yield tile_id

    def _question(self, batch: dict[TileId, float]) -> _TilesQuestion:
        """A question about tiles that wait, given with the bytes expected. The lock is held."""
        districts = {tile_id.district for tile_id in batch}
        done = (self._answered - self._stale) | self._in_flight.keys() | self._on_a_map
        besides = tuple(self._going_along((t for t in self._besides if t not in done), districts))
        expected_bytes = max(LEAST_BESIDES_BYTES, round(sum(batch.values())))
        return _TilesQuestion(
            tuple(batch), besides, min(self._batch_bytes, expected_bytes) if besides else self._batch_bytes
        )

    def _fitting(self, tiles: Iterable[TileId]) -> dict[TileId, float]:
        """The first of `tiles`, and those after it that fit into one answer, with the bytes expected."""
        batch: dict[TileId, float] = {}
        for tile_id in tiles:
            expected_bytes = self._expected_bytes(tile_id)
            if batch and (sum(batch.values()) + expected_bytes > self._batch_bytes or len(batch) == MOST_TILES):
                break
            batch[tile_id] = expected_bytes
        return batch

    def _try(self, question: _TilesQuestion) -> ExchangeOutcome[TileT]:
        batch, asked = question.tiles, (*question.tiles, *question.besides)
        with self._changed:
            whole = {tile_id for tile_id in asked if self._wrong[tile_id]}
        try:
            if self._archive is not None:
                self._bring(self._archive, [tile_id for tile_id in batch if tile_id not in whole])
            if not self._has_router():
                return ExchangeOutcome[TileT]()
            return self._exchange.ask(asked, whole, question.max_bytes, near=batch[0])
        except BusClosed:
            return ExchangeOutcome[TileT]()
        except Exception as error:  # whatever it was: a worker that ends would never fetch again
            self._note("failed", f"{len(batch)} tiles from {batch[0]} on: {error}")
            return ExchangeOutcome[TileT]()

    def _bring(self, archive: ArchiveTiles[TileT], tiles: list[TileId]) -> None:
        """Fill the cache from the archive, so that the bus has little to add to it, or none is needed."""
        of_district = sorted(tiles, key=lambda tile_id: tile_id.district)
        brought = sum(archive.bring(list(some)) for _, some in groupby(of_district, lambda tile_id: tile_id.district))
        with self._changed:
            self.counts["archive"] += brought

    def _has_router(self) -> bool:
        """Whether there is a router within a moment; else the cache has to do. Says so once."""
        found = self._bus.wait_connected(OFFLINE_WAIT_S)
        with self._changed:
            changed, self._offline = self._offline == found, not found
        if changed:
            _log.warning("the router is there again" if found else "no router: tiles from the cache, as far as it goes")
        return found

    def _cached(self, tiles: Iterable[TileId]) -> dict[TileId, TileT]:
        """The cached ones of `tiles` that nobody has been given yet."""
        found = ((t, self._cache.get(t)) for t in tiles if t not in self._answered)
        try:
            return {tile_id: tile for tile_id, tile in found if tile is not None}
        except CacheError as error:
            _log.warning("nothing to do without an answer: %s", error)
            return {}

    def _settle_all(
        self, batch: Sequence[TileId], outcome: ExchangeOutcome[TileT], instead: dict[TileId, TileT]
    ) -> None:
        """Note the answers; what has none waits for its next try. The lock is held."""
        self._watched -= {fetched.tile_id for fetched in outcome.fetched}
        self._watched |= outcome.watched
        for fetched in outcome.fetched:
            self._settle(fetched)
            self._whole.add(outcome.body_bytes.get(fetched.tile_id, 0 if fetched.status == "absent" else None))
        refused = {tile_id for tile_id, why in outcome.wrong.items() if self._refuse(tile_id, why)}
        without = refused if outcome.fetched or outcome.wrong else set(batch)  # no progress: knock after a pause only
        for tile_id in without:
            self._do_without(tile_id, instead.get(tile_id))

    def _settle(self, fetched: Fetched[TileT]) -> None:
        tile_id = fetched.tile_id
        del self._wrong[tile_id]
        self._not_before.pop(tile_id, None)
        self.counts[fetched.status] += 1
        self._answered.add(tile_id)
        self._answered_s[tile_id] = time.monotonic()
        self._arrived.append(fetched)
        self._stale.discard(tile_id)
        if tile_id in self._again:
            self._again.discard(tile_id)
            self._stale.add(tile_id)

    def _do_without(self, tile_id: TileId, cached: TileT | None) -> None:
        """No answer: the cached tile has to do, once, and the tile is asked for again after a pause."""
        doublings = min(self._wrong[tile_id] // WRONG_TRIES, MOST_DOUBLINGS)
        self._not_before[tile_id] = time.monotonic() + RETRY_S * 2 ** max(doublings - 1, 0)
        if cached is not None:
            self._stale.add(tile_id)
            self._answered.add(tile_id)
            self.counts["cached"] += 1
            self._arrived.append(Fetched(tile_id, "cached", cached))

    def _refuse(self, tile_id: TileId, why: str) -> bool:
        """The content was wrong: ask for the whole tile; True = a pause is due, that did not help."""
        self._note("refused", why)
        self._wrong[tile_id] += 1
        hopeless = self._wrong[tile_id] % WRONG_TRIES == 0
        if hopeless:
            self._note("failed", why)
        return hopeless

    def _note(self, what: str, message: str) -> None:
        with self._changed:
            self.counts[what] += 1
            self.last_error = message
        _SELDOM.warning("%s", message)


class _Mean:
    """Mean size of what came whole, absent ones as 0; begins with a guess that counts as one."""

    def __init__(self, guess: float) -> None:
        self._sum, self._n = guess, 1

    def add(self, size_bytes: int | None) -> None:
        """None = nothing came."""
        if size_bytes is not None:
            self._sum += size_bytes
            self._n += 1

    @property
    def value(self) -> float:
        return self._sum / self._n
