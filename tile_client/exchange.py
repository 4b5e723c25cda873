"""One question about tiles and its answer: verified, handed to a holder, booked tile by tile.

Tiles of several districts go into one question, on the key of the first. A server that does not know that answers for
the first district alone, as one does that has not the others: those are to be asked for one by one, for a while.
"""

import logging
import threading
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final, Generic, Literal, Protocol, cast

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.ledger import Share
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.gnd_map.content import TileT, codecs_of_layer, kind_of_layer
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.errors import SchemaError, WrongHash
from gnd.schemas.keys import batch_key
from gnd.schemas.limits import MAX_OTHER_DISTRICTS
from gnd.schemas.tile_answer import content_of_answer
from gnd.schemas.tiles import TileBlob
from gnd.schemas.tiles_batch import HeldVersion, TileAnswer, TilesReply, TilesRequest
from gnd.tile_client.checking import VersionCheck

Head = tuple[int, bytes]
"""Version and sha of a tile that is held."""
NOTHING: Head = (0, b"")
ALONE_S: Final = 600.0
"""A district that was not answered along with another one is asked for alone for so long."""
MOST_ALONE: Final = 256

_log = logging.getLogger(__name__)


class TileHolder(Protocol[TileT]):
    """The tiles of one layer that a client holds, on a disk or in memory; all methods may raise `GndError`."""

    @property
    def layer(self) -> str:
        """Name of the layer."""

    def heads(self, tiles: Iterable[TileId]) -> Mapping[TileId, Head]:
        """(version, sha) of those tiles that are held."""

    def get(self, tile_id: TileId) -> TileT | None:
        """A tile; None where it is not held, or is not what its hash says."""

    def put(self, tile: TileT, over: bytes = b"", blob: TileBlob | None = None) -> bool:
        """Hold a tile, unless a newer one came meanwhile; False then.

        Args:
            tile: the new version.
            over: sha of the version that was held when it was asked for; that one is replaced whatever its number.
            blob: the tile as it arrived, where it came whole.
        """


@dataclass(frozen=True, slots=True)
class TilesInMemory(Generic[TileT]):
    """A holder of given tiles; what arrives is left to who has asked."""

    layer: str
    tiles: Mapping[TileId, TileT]

    def heads(self, tiles: Iterable[TileId]) -> dict[TileId, Head]:
        """(version, sha) of those tiles that are held."""
        return {t: (self.tiles[t].version, self.tiles[t].sha) for t in tiles if t in self.tiles}

    def get(self, tile_id: TileId) -> TileT | None:
        """A tile; None where it is not held."""
        return self.tiles.get(tile_id)

    def put(self, tile: TileT, over: bytes = b"", blob: TileBlob | None = None) -> bool:  # noqa: ARG002
        """Always True."""
        return True


@dataclass(frozen=True, slots=True)
class Fetched(Generic[TileT]):
    """The answer about one tile: `blob` or `delta` (downloaded), `unchanged` (the one that is held is the
    newest), `absent` (the store has none) or `cached` (no answer: the one that is held has to do).
    """

    tile_id: TileId
    status: Literal["blob", "delta", "unchanged", "absent", "cached"]
    tile: TileT | None


@dataclass(slots=True)
class ExchangeOutcome(Generic[TileT]):
    """The answers to one question."""

    fetched: list[Fetched[TileT]] = field(default_factory=list)
    later: list[TileId] = field(default_factory=list)
    """Did not fit into the answer: ask again."""
    unanswered: list[TileId] = field(default_factory=list)
    """Of districts that do not go along with the first one: ask for each district alone."""
    wrong: dict[TileId, str] = field(default_factory=dict)
    """The content was not what its hash says, or nobody answers for it: ask for the whole tile."""
    body_bytes: dict[TileId, int] = field(default_factory=dict)
    """Size of each tile that came whole."""
    watched: set[TileId] = field(default_factory=set)
    """A version of these is on trial: the vehicle is asked how it fares there."""


class Exchange(Generic[TileT]):
    """Asks for several tiles at once, in the layer of the holder. Thread-safe where the holder is.

    Args:
        bus: an open bus.
        holder: the tiles that are held; those that arrive are put there.
        timeout_s: how long a question is asked again before it fails.
        attempt_s: how long one attempt may take.
        ticket: of a vehicle, see `TilesRequest`.
        newest: ask for the newest versions, released or not.
        check: of the versions that come; None: they are taken as they are.
    """

    def __init__(
        self,
        bus: Bus,
        holder: TileHolder[TileT],
        timeout_s: float,
        attempt_s: float = 10.0,
        *,
        ticket: int = 0,
        newest: bool = False,
        check: VersionCheck | None = None,
    ) -> None:
        self._check = check
        self._ticket, self._wants_newest = ticket, newest
        self._bus, self._holder, self._timeout_s = bus, holder, timeout_s
        self._retry = RetryPolicy(attempt_timeout_s=attempt_s)
        self._alone_until_s: dict[District, float] = {}
        self._lock = threading.Lock()
        self._kind = cast("type[TileT]", kind_of_layer(holder.layer))

    def goes_along(self, districts: Collection[District], other: District) -> bool:
        """Whether tiles of another district may go into a question about these."""
        if other in districts or not districts:
            return True
        if len(districts) > MAX_OTHER_DISTRICTS:
            return False
        with self._lock:
            return self._alone_until_s.get(other, 0.0) <= time.monotonic()

    def ask(
        self, tiles: Sequence[TileId], whole: Collection[TileId], max_bytes: int, near: TileId | None = None
    ) -> ExchangeOutcome[TileT]:
        """Ask for tiles of one district, or of some that go along with that of the first tile (`goes_along`).

        Args:
            tiles: which, at least one.
            whole: those of them that are asked for as if nothing were held.
            max_bytes: bodies beyond so many bytes wait for a later question; the first always fits.
            near: a tile of the first one's district: the tiles around it come first; None = in the order of their ids.

        Raises:
            BusError: no answer before the deadline.
            SchemaError: the answer is none to this question.
        """
        held = self._held(t for t in tiles if t not in whole)
        outcome = ExchangeOutcome[TileT]()
        answers = self._answers(tiles, held, max_bytes, near, outcome)
        outcome.unanswered = [t for t in tiles if t not in answers]
        self._note_alone(_by_district(outcome.unanswered))
        for some in _by_district(t for t, answer in answers.items() if answer.status == "hash").values():
            beside = None if near is None else some[0]
            answers |= self._answers(some, held, max_bytes, beside, outcome, with_hashes=True)
        for tile_id in (t for t in tiles if t in answers):
            self._take(tile_id, answers[tile_id], held.get(tile_id, NOTHING), outcome)
        return outcome

    def _note_alone(self, districts: Collection[District]) -> None:
        """These were not answered along with another one."""
        now_s = time.monotonic()
        with self._lock:
            self._alone_until_s |= dict.fromkeys(districts, now_s + ALONE_S)
            for one in list(self._alone_until_s)[:-MOST_ALONE]:
                del self._alone_until_s[one]

    def _held(self, tiles: Iterable[TileId]) -> Mapping[TileId, Head]:
        """A cache that cannot be read holds nothing."""
        try:
            return self._holder.heads(tiles)
        except GndError as error:
            _log.warning("asked for as if nothing were held: %s", error)
            return {}

    def _answers(
        self,
        tiles: Sequence[TileId],
        held: Mapping[TileId, Head],
        max_bytes: int,
        near: TileId | None,
        outcome: ExchangeOutcome[TileT],
        *,
        with_hashes: bool = False,
    ) -> dict[TileId, TileAnswer]:
        """The answers to one question, on the key of the first tile's district; those of others may be missing."""
        layer, district = self._holder.layer, tiles[0].district
        requests = {
            one: TilesRequest.of(
                [HeldVersion(t, *held.get(t, NOTHING)) for t in some],
                codecs=codecs_of_layer(layer),
                max_bytes=max_bytes,
                near=near if one == district else None,
                with_hashes=with_hashes,
                ticket=self._ticket,
                newest=self._wants_newest,
            )
            for one, some in _by_district(tiles).items()
        }
        request = requests.pop(district).with_others(district, requests)
        payload = self._bus.request(
            batch_key(layer, district),
            request.encode(),
            kind="tile",
            retry=self._retry,
            timeout_s=self._timeout_s,
            shares_of=partial(shares_of, request, district),
        )
        found: dict[TileId, TileAnswer] = {}
        for reply, answers in _answered(request, district, payload):
            outcome.watched.update(answers[place][0] for place in reply.watched)
            found |= dict(answers)
        return found

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
        return Fetched(tile_id, "unchanged", self._from_holder(tile_id))

    def _blob(self, tile_id: TileId, answer: TileAnswer, held: Head) -> Fetched[TileT]:
        tile = self._checked(content_of_answer(tile_id, answer, self._kind), answer)
        blob = TileBlob(tile_id, answer.version, tile.sha, answer.codec_id, answer.body, answer.day)
        return Fetched(tile_id, "blob", self._newest(tile, held[1], blob))

    def _delta(self, tile_id: TileId, answer: TileAnswer, held: Head) -> Fetched[TileT]:
        cached = self._from_holder(tile_id)
        if cached.sha != held[1] and (cached.version >= answer.version or cached.sha.startswith(answer.sha)):
            return Fetched(tile_id, "unchanged", cached)  # a notice brought it while the answer was on its way
        tile = self._checked(content_of_answer(tile_id, answer, self._kind, cached), answer)
        return Fetched(tile_id, "delta", self._newest(tile, held[1]))

    def _checked(self, tile: TileT, answer: TileAnswer) -> TileT:
        """The tile itself, if it is one to use; raises NotSigned."""
        if self._check is not None:
            self._check.check(tile, answer.signature)
        return tile

    def _newest(self, tile: TileT, over: bytes, blob: TileBlob | None = None) -> TileT:
        """Keep the tile; gives the one that is held instead where that is newer. A full disk stops no drive."""
        try:
            return tile if self._holder.put(tile, over, blob) else self._from_holder(tile.tile_id)
        except WrongHash:
            raise
        except GndError as error:
            _log.warning("tile %s is not kept: %s", tile.tile_id, error)
            return tile

    def _from_holder(self, tile_id: TileId) -> TileT:
        tile = self._holder.get(tile_id)
        if tile is None:
            raise WrongHash(f"tile {tile_id}: the copy that is held does not have its hash; fetch it again")
        return tile


def shares_of(request: TilesRequest, district: District, payload: bytes) -> list[Share]:
    """How the ledger books an answer: each body and its hash with its tile, the rest as the cost of the question.

    An answer that cannot be read has no shares: it is booked whole.
    """
    try:
        answers = [one for _, some in _answered(request, district, payload) for one in some]
    except SchemaError:
        return []
    kinds = {"blob": "tile", "delta": "delta"}
    bodies = [Share(kinds[a.status], len(a.body) + len(a.sha), tile_id) for tile_id, a in answers if a.status in kinds]
    return [Share("tile", len(payload) - sum(share.app_bytes for share in bodies)), *bodies]


def _answered(
    request: TilesRequest, district: District, payload: bytes
) -> list[tuple[TilesReply, list[tuple[TileId, TileAnswer]]]]:
    """The reply about each district that is answered, and what it says of each tile; `SchemaError` where it is none to
    the request.
    """
    asked = request.by_district(district)
    replies = TilesReply.decode(payload).by_district(request, district)
    return [(reply, reply.of_request(asked[one], one)) for one, reply in replies.items()]


def _by_district(tiles: Iterable[TileId]) -> dict[District, list[TileId]]:
    """Tiles by their district, in the order in which the districts come first."""
    found: dict[District, list[TileId]] = {}
    for tile in tiles:
        found.setdefault(tile.district, []).append(tile)
    return found
