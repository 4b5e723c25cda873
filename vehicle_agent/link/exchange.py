"""One question about tiles of one district and its answer: verified, put into the cache, booked tile by tile."""

import logging
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Generic, Literal

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.ledger import Share
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.gnd_map.content import TileT, codecs_of_layer
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.errors import SchemaError, WrongHash
from gnd.schemas.keys import batch_key
from gnd.schemas.tile_answer import content_of_answer
from gnd.schemas.tiles import TileBlob
from gnd.schemas.tiles_batch import HeldVersion, TileAnswer, TilesReply, TilesRequest
from gnd.vehicle_agent.errors import CacheError
from gnd.vehicle_agent.link.cache import TileCache

Head = tuple[int, bytes]
"""Version and sha of what is held."""
NOTHING: Head = (0, b"")

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Fetched(Generic[TileT]):
    """The answer about one tile: `blob` or `delta` (downloaded), `unchanged` (the cached one holds), `absent` (the
    store has none) or `cached` (no answer, the cached one will have to do).
    """

    tile_id: TileId
    status: Literal["blob", "delta", "unchanged", "absent", "cached"]
    tile: TileT | None


@dataclass(slots=True)
class ExchangeOutcome(Generic[TileT]):
    """What one question came to."""

    fetched: list[Fetched[TileT]] = field(default_factory=list)
    later: list[TileId] = field(default_factory=list)
    """Did not fit into the answer: ask again."""
    wrong: dict[TileId, str] = field(default_factory=dict)
    """The content was not what its hash says: ask for the whole tile."""
    body_bytes: dict[TileId, int] = field(default_factory=dict)
    """Size of each tile that came whole."""


class Exchange(Generic[TileT]):
    """Asks for several tiles of one district at once, in the layer of the cache. Thread-safe."""

    def __init__(self, bus: Bus, cache: TileCache[TileT], request_s: float) -> None:
        self._bus, self._cache, self._request_s = bus, cache, request_s
        # One attempt may take all the time there is: a second one would fetch a slow answer twice.
        self._retry = RetryPolicy(attempt_timeout_s=request_s)

    def ask(self, tiles: Sequence[TileId], whole: Collection[TileId], max_bytes: int) -> ExchangeOutcome[TileT]:
        """Ask for tiles of one district, the one needed soonest first; those in `whole` as if nothing were cached.

        Raises:
            BusError: no answer before the deadline.
            SchemaError: the answer is none to this question.
        """
        held = self._held(t for t in tiles if t not in whole)
        ask = partial(self._answers, tiles[0].district, held, max_bytes=max_bytes)
        answers = ask(tiles, with_hashes=False)
        unclear = [t for t in tiles if answers[t].status == "hash"]
        if unclear:
            answers |= ask(unclear, with_hashes=True)
        outcome = ExchangeOutcome[TileT]()
        for tile_id in tiles:
            self._take(tile_id, answers[tile_id], held.get(tile_id, NOTHING), outcome)
        return outcome

    def _held(self, tiles: Iterable[TileId]) -> dict[TileId, Head]:
        """A cache that cannot be read holds nothing."""
        try:
            return self._cache.heads(tiles)
        except CacheError as error:
            _log.warning("asked for as if nothing were cached: %s", error)
            return {}

    def _answers(
        self,
        district: District,
        held: dict[TileId, Head],
        tiles: Sequence[TileId],
        *,
        max_bytes: int,
        with_hashes: bool,
    ) -> dict[TileId, TileAnswer]:
        wanted = [HeldVersion(t, *held.get(t, NOTHING)) for t in tiles]
        codecs = codecs_of_layer(self._cache.layer)
        request = TilesRequest.of(wanted, codecs=codecs, max_bytes=max_bytes, near=tiles[0], with_hashes=with_hashes)
        payload = self._bus.request(
            batch_key(self._cache.layer, district),
            request.encode(),
            kind="tile",
            retry=self._retry,
            timeout_s=self._request_s,
            shares_of=partial(shares_of, request, district),
        )
        return dict(TilesReply.decode(payload).of_request(request, district))

    def _take(self, tile_id: TileId, answer: TileAnswer, held: Head, outcome: ExchangeOutcome[TileT]) -> None:
        if answer.status in ("later", "hash"):
            outcome.later.append(tile_id)
            return
        try:
            outcome.fetched.append(self._fetched(tile_id, answer, held))
        except WrongHash as error:
            outcome.wrong[tile_id] = str(error)
        except SchemaError as error:  # a body that is none of its codec: what came is not the tile
            outcome.wrong[tile_id] = f"tile {tile_id}: {error}"
        if answer.status == "blob":
            outcome.body_bytes[tile_id] = len(answer.body)

    def _fetched(self, tile_id: TileId, answer: TileAnswer, held: Head) -> Fetched[TileT]:
        """Raises WrongHash, SchemaError."""
        if answer.status == "absent":
            return Fetched(tile_id, "absent", None)
        if answer.status == "blob":
            return self._blob(tile_id, answer, held)
        if answer.status == "delta":
            return self._delta(tile_id, answer, held)
        return Fetched(tile_id, "unchanged", self._from_cache(tile_id))

    def _blob(self, tile_id: TileId, answer: TileAnswer, held: Head) -> Fetched[TileT]:
        tile = content_of_answer(tile_id, answer, self._cache.kind)
        blob = TileBlob(tile_id, answer.version, tile.sha, answer.codec_id, answer.body, answer.day)
        newest = self._newest(tile, lambda: self._cache.keep(blob, over=held[1]))
        return Fetched(tile_id, "blob", newest)

    def _delta(self, tile_id: TileId, answer: TileAnswer, held: Head) -> Fetched[TileT]:
        cached = self._from_cache(tile_id)
        if cached.sha != held[1] and (cached.version >= answer.version or cached.sha.startswith(answer.sha)):
            return Fetched(tile_id, "unchanged", cached)  # a notice brought it while the answer was on its way
        tile = content_of_answer(tile_id, answer, self._cache.kind, cached)
        newest = self._newest(tile, lambda: self._cache.put(tile, over=held[1]))
        return Fetched(tile_id, "delta", newest)

    def _newest(self, tile: TileT, keep: Callable[[], bool]) -> TileT:
        """Keep the tile; gives what is in the cache instead where that is newer. A full disk stops no drive."""
        try:
            return tile if keep() else self._from_cache(tile.tile_id)
        except CacheError as error:
            _log.warning("tile %s is not kept: %s", tile.tile_id, error)
            return tile

    def _from_cache(self, tile_id: TileId) -> TileT:
        tile = self._cache.get(tile_id)
        if tile is None:
            raise WrongHash(f"tile {tile_id}: the cached copy does not have its hash; fetch it again")
        return tile


def shares_of(request: TilesRequest, district: District, payload: bytes) -> list[Share]:
    """How the ledger books an answer: each body and its hash with its tile, the rest as what the question costs.

    An answer that cannot be read has no shares: it is booked whole.
    """
    try:
        answers = TilesReply.decode(payload).of_request(request, district)
    except SchemaError:
        return []
    kinds = {"blob": "tile", "delta": "delta"}
    bodies = [Share(kinds[a.status], len(a.body) + len(a.sha), tile_id) for tile_id, a in answers if a.status in kinds]
    return [Share("tile", len(payload) - sum(share.app_bytes for share in bodies)), *bodies]
