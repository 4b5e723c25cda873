"""Many tiles of a district, and of some others beside it, in one query: what a client holds in half a byte a tile, the
answer in a bit where it holds the newest already.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from typing import Final, Self

from gnd.gnd_map.codec import PREFERRED, decode_tiles, encode_tiles
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import limits
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import tiles_reply_pb2, tiles_request_pb2
from gnd.schemas.other_tiles import (
    HASH_BYTES,
    TILES,
    OtherTiles,
    check_indices,
    check_others,
    n_held_of,
    other_tiles,
    step_between,
)
from gnd.schemas.ticket import TICKETS
from gnd.schemas.tile_answer import (
    ANSWER_HASH_BYTES,
    ANSWER_STATUS,
    WITH_BODY,
    AnswerStatus,
    TileAnswer,
    tile_of_answer,
)
from gnd.schemas.tiles import check_codecs
from gnd.schemas.version_signature import VersionSignature, decode_signatures, signatures_message
from gnd.schemas.wire import (
    MAJOR,
    check_length,
    check_major,
    check_pair,
    number_of,
    parse,
    refusing,
    serialise,
    word_of,
)
from gnd.schemas.wire_fields import submessages

__all__ = [
    "ANSWER_HASH_BYTES",
    "EVERY_CODEC",
    "HASH_BYTES",
    "HeldVersion",
    "OtherTiles",
    "TileAnswer",
    "TilesReply",
    "TilesRequest",
    "digest_of",
    "index_of",
    "tile_of_answer",
]

EVERY_CODEC: Final = (4, 3, 2, 7, 6, 5, 1, 0)
"""What a request means that names no codecs; frozen, whatever later programs read besides."""
OTHERS_FIELD: Final = tiles_reply_pb2.TilesReply.OTHERS_FIELD_NUMBER


@dataclass(frozen=True, slots=True)
class HeldVersion:
    """A tile that is wanted, and what the client holds of it."""

    tile: TileId
    version: int = 0
    """0 = nothing."""
    sha: bytes = b""
    """32 bytes; empty = nothing."""

    def __post_init__(self) -> None:
        check_pair(f"held tile {self.tile}", self.version, self.sha)


@dataclass(frozen=True, slots=True)
class TilesRequest:
    """Which tiles of a district a client wants; `of` makes it from the tiles that it holds. `with_others` adds some of
    other districts.
    """

    wanted: tuple[tuple[int, int], ...]
    """(index in the district = lowest ten bits of the Morton code, version held, 0 = none), ascending."""
    held_digest: bytes = b""
    """`digest_of` the hashes of what is held; empty = nothing is, or `held_hashes` say what."""
    held_hashes: tuple[bytes, ...] = ()
    """The first 8 bytes of the hash of each tile held, in order: only when the server has asked for them."""
    codecs: tuple[int, ...] = PREFERRED
    """In order of preference, at least one."""
    max_bytes: int = limits.MAX_TILE_BODY_BYTES
    """Bodies beyond so many bytes, over all districts, wait for another request; the first always fits."""
    near: int | None = None
    """Index of the tile around which tiles are needed first; None = in order."""
    ticket: int = 0
    """Of a vehicle (`ticket_of`): who gets a version that is on trial; 0 = no vehicle, which gets what is released."""
    newest: bool = False
    """The newest versions are wanted, released or not."""
    others: tuple[OtherTiles, ...] = ()
    """Tiles of other districts; a server answers for those that it has."""

    def __post_init__(self) -> None:
        check_indices(self.wanted)
        if not 0 <= self.ticket <= TICKETS:
            raise BadValue(f"TilesRequest with ticket {self.ticket}: 0 .. {TICKETS}")
        check_codecs("TilesRequest", self.codecs)
        if not 1 <= self.max_bytes <= limits.MAX_TILE_BODY_BYTES:
            raise BadValue(f"TilesRequest for {self.max_bytes} bytes: 1 .. {limits.MAX_TILE_BODY_BYTES}")
        if self.near is not None and not 0 <= self.near < TILES:
            raise BadValue(f"TilesRequest near tile {self.near}: a district has 0 .. {TILES - 1}")
        _check_held(self)
        check_others(self.others)

    @property
    def n_held(self) -> int:
        """Of how many tiles of the key's district the client holds a version."""
        return n_held_of(self.wanted)

    @classmethod
    def of(
        cls,
        held: Iterable[HeldVersion],
        *,
        codecs: tuple[int, ...] = PREFERRED,
        max_bytes: int = limits.MAX_TILE_BODY_BYTES,
        near: TileId | None = None,
        with_hashes: bool = False,
        ticket: int = 0,
        newest: bool = False,
    ) -> Self:
        """A request for these tiles of one district, each once, in any order.

        `with_hashes`: after the server has answered "hash", which a store that has lost a version does.
        """
        tiles = sorted(held, key=lambda one: one.tile)
        if len({one.tile.district for one in tiles}) > 1:
            raise BadValue(f"TilesRequest for tiles of {len({t.tile.district for t in tiles})} districts: one only")
        shas = [one.sha for one in tiles if one.version]
        return cls(
            wanted=tuple((index_of(one.tile), one.version) for one in tiles),
            held_digest=digest_of(shas) if shas and not with_hashes else b"",
            held_hashes=tuple(sha[:HASH_BYTES] for sha in shas) if with_hashes else (),
            codecs=codecs,
            max_bytes=max_bytes,
            near=None if near is None else index_of(near),
            ticket=ticket,
            newest=newest,
        )

    def with_others(self, district: District, others: Mapping[District, "TilesRequest"]) -> "TilesRequest":
        """This request of a district, with those of others: their codecs and the like are taken from this one.

        Raises:
            BadValue: one of the others tells hashes, which needs a question of its own.
        """
        for other, one in others.items():
            if one.held_hashes:
                raise BadValue(f"TilesRequest with the hashes of what is held of another district, {other}")
        return replace(
            self,
            others=tuple(
                OtherTiles(step_between(district, other), one.wanted, one.held_digest) for other, one in others.items()
            ),
        )

    def by_district(self, district: District) -> dict[District, "TilesRequest"]:
        """A request a district, that of the key first; `BadValue` where another is none."""
        alone = replace(self, others=())
        found = {district: alone}
        for one in self.others:
            found[one.district(district)] = replace(
                alone, wanted=one.wanted, held_digest=one.held_digest, held_hashes=(), near=None
            )
        return found

    def tiles(self, district: District) -> tuple[TileId, ...]:
        """The tiles wanted of the key's district, in the order of the answers."""
        return tuple(TileId(district.first_morton + index) for index, _ in self.wanted)

    def encode(self) -> bytes:
        """Bytes of gnd.v1.TilesRequest."""
        message = tiles_request_pb2.TilesRequest(
            major=MAJOR,
            wanted=encode_tiles(self.wanted),
            held_digest=self.held_digest,
            held_hashes=b"".join(self.held_hashes),
            codecs=() if self.codecs == EVERY_CODEC else self.codecs,
            max_bytes=0 if self.max_bytes == limits.MAX_TILE_BODY_BYTES else self.max_bytes,
            near=self.near,
            ticket=self.ticket,
            newest=self.newest,
            others=(one.message() for one in self.others),
        )
        return serialise(message, limits.MAX_TILES_REQUEST_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """The value in `data`; `SchemaError` when it is none."""
        message = parse(tiles_request_pb2.TilesRequest, data, limits.MAX_TILES_REQUEST_BYTES)
        check_major(message, "TilesRequest")
        with refusing("TilesRequest"):
            wanted = tuple((int(index), int(version)) for index, version in decode_tiles(message.wanted))
        return cls(
            wanted=wanted,
            held_digest=message.held_digest,
            held_hashes=tuple(_cut("TilesRequest", message.held_hashes, HASH_BYTES)),
            codecs=tuple(message.codecs) or EVERY_CODEC,
            max_bytes=message.max_bytes or limits.MAX_TILE_BODY_BYTES,
            near=message.near if message.HasField("near") else None,
            ticket=message.ticket,
            newest=message.newest,
            others=tuple(map(other_tiles, message.others)),
        )


def index_of(tile: TileId) -> int:
    """A tile's number in its district: 0 .. 1023."""
    return tile.morton % TILES


def digest_of(shas: Iterable[bytes]) -> bytes:
    """First 8 bytes of SHA-256 over the hashes (32 bytes each) of what is held, in order."""
    return hashlib.sha256(b"".join(shas)).digest()[:HASH_BYTES]


def _check_held(request: TilesRequest) -> None:
    if request.held_hashes:
        good = len(request.held_hashes) == request.n_held and all(len(h) == HASH_BYTES for h in request.held_hashes)
        good &= not request.held_digest
    else:
        good = len(request.held_digest) == (HASH_BYTES if request.n_held else 0)
    if not good:
        raise BadValue(
            f"TilesRequest with {request.n_held} tiles held, a digest of {len(request.held_digest)} bytes and"
            f" {len(request.held_hashes)} hashes: a digest of {HASH_BYTES} bytes, or a hash of so many for each"
        )


def _cut(name: str, hashes: bytes, each: int) -> Iterator[bytes]:
    if len(hashes) % each:
        raise BadValue(f"{name} with hashes of {len(hashes)} bytes, not a multiple of {each}")
    return (hashes[at : at + each] for at in range(0, len(hashes), each))


@dataclass(frozen=True, slots=True)
class TilesReply:
    """The tile server's answers, one a tile, in the order of the request."""

    answers: tuple[TileAnswer, ...]
    watched: tuple[int, ...] = ()
    """Places, ascending, of the answers about tiles of which a version is on trial."""
    others: tuple["TilesReply | None", ...] = ()
    """Of each other district of the request; None = this server does not answer for it. Empty: for none of them."""

    def __post_init__(self) -> None:
        check_length("TilesReply", len(self.others), limits.MAX_OTHER_DISTRICTS, "other districts")
        if any(one is not None and one.others for one in self.others):
            raise BadValue("TilesReply about another district that is itself about others")
        check_length("TilesReply", len(self.answers), TILES, "tiles")
        watched = self.watched
        if watched and (watched[-1] >= len(self.answers) or any(a >= b for a, b in pairwise(watched))):
            raise BadValue(f"TilesReply watches places {watched[:9]}… of {len(self.answers)}: ascending, once each")

    def of_request(self, request: TilesRequest, district: District) -> list[tuple[TileId, TileAnswer]]:
        """Each tile of the request in the key's district with its answer.

        Raises:
            BadValue: it answers more or fewer tiles than were asked for, or a delta where nothing is held.
        """
        if len(self.answers) != len(request.wanted):
            raise BadValue(f"TilesReply about {len(self.answers)} tiles, asked for {len(request.wanted)}")
        for (index, version), answer in zip(request.wanted, self.answers, strict=True):
            if version == 0 and answer.status in ("delta", "unchanged", "hash"):
                raise BadValue(f"TilesReply says {answer.status!r} of tile {index}, of which nothing is held")
        return list(zip(request.tiles(district), self.answers, strict=True))

    def by_district(self, request: TilesRequest, district: District) -> dict[District, "TilesReply"]:
        """What is answered of each district of the request, that of the key first.

        Raises:
            BadValue: it answers more or fewer others than were asked for.
        """
        if len(self.others) not in (0, len(request.others)):
            raise BadValue(f"TilesReply about {len(self.others)} other districts, asked for {len(request.others)}")
        found = {district: replace(self, others=())}
        for asked, one in zip(request.others, self.others, strict=False):
            if one is not None:
                found[asked.district(district)] = one
        return found

    def encode(self) -> bytes:
        """Bytes of gnd.v1.TilesReply."""
        brought = [answer for answer in self.answers if answer.status in WITH_BODY]
        message = tiles_reply_pb2.TilesReply(
            major=MAJOR,
            runs=_runs(self.answers),
            versions=(answer.version for answer in brought),
            hashes=b"".join(answer.sha for answer in brought),
            codecs=(answer.codec_id for answer in brought if answer.status == "blob"),
            bodies=(answer.body for answer in brought),
            days=_days([answer.day for answer in brought]),
            watched=self.watched,
            signatures=signatures_message([answer.signature for answer in brought]),
            others=(b"" if one is None else one.encode() for one in self.others),
        )
        return serialise(message, limits.MAX_TILES_REPLY_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """The value in `data`; `SchemaError` when it is none. Contents are checked by `tile_of_answer`."""
        message = parse(
            tiles_reply_pb2.TilesReply,
            data,
            limits.MAX_TILES_REPLY_BYTES,
            max_fields=limits.MAX_TILES_REPLY_FIELDS,
        )
        check_major(message, "TilesReply")
        check_length("TilesReply", len(message.others), limits.MAX_OTHER_DISTRICTS, "other districts")
        return cls(tuple(_answers(message)), tuple(message.watched), tuple(map(_other_reply, message.others)))


def _other_reply(data: bytes) -> TilesReply | None:
    """The answer about another district: none where it is empty, and about no others of its own."""
    if not data:
        return None
    others = submessages("TilesReply", data, OTHERS_FIELD, limits.MAX_TILES_REPLY_FIELDS)
    if any(True for _ in others):  # before they are read, however deep
        raise BadValue("TilesReply about another district that is itself about others")
    return TilesReply.decode(data)


def _days(days: Sequence[int]) -> Sequence[int]:
    """As few numbers as say the days of all: most tiles of a map were surveyed on one day."""
    if not any(days):
        return ()
    return days if any(day != days[0] for day in days) else days[:1]


def _days_of(days: Sequence[int], n_brought: int) -> Sequence[int]:
    """The days of all tiles that are brought."""
    if len(days) == n_brought:
        return days
    if len(days) > 1:
        raise BadValue(f"TilesReply that brings {n_brought} tiles has {len(days)} days: one for each, one, or none")
    return n_brought * (list(days) or [0])


def _runs(answers: Iterable[TileAnswer]) -> Iterator[int]:
    for status, run in groupby(answers, lambda answer: answer.status):
        yield 8 * sum(1 for _ in run) + number_of(status, ANSWER_STATUS)


def _statuses(runs: Sequence[int]) -> list[AnswerStatus]:
    check_length("TilesReply", len(runs), TILES, "runs")
    check_length("TilesReply", sum(run // 8 for run in runs), TILES, "tiles")
    if any(run < 8 for run in runs):
        raise BadValue("TilesReply with an empty run")
    return [status for run in runs for status in [word_of(run % 8, ANSWER_STATUS, "answer status")] * (run // 8)]


def _signatures(message: tiles_reply_pb2.TilesReply, count: int) -> Sequence[VersionSignature | None]:
    return decode_signatures(message.signatures, count) if message.HasField("signatures") else [None] * count


def _answers(message: tiles_reply_pb2.TilesReply) -> Iterator[TileAnswer]:
    statuses = _statuses(message.runs)
    n_brought, n_blobs = sum(s in WITH_BODY for s in statuses), statuses.count("blob")
    hashes = list(_cut("TilesReply", message.hashes, ANSWER_HASH_BYTES))
    counts = (len(message.versions), len(hashes), len(message.bodies), len(message.codecs))
    if counts != (n_brought, n_brought, n_brought, n_blobs):
        raise BadValue(
            f"TilesReply that brings {n_brought} tiles, {n_blobs} of them whole, has {counts[0]} versions,"
            f" {counts[1]} hashes, {counts[2]} bodies and {counts[3]} codecs"
        )
    days = _days_of(message.days, n_brought)
    signed = _signatures(message, n_brought)
    brought = iter(zip(message.versions, hashes, message.bodies, days, signed, strict=True))
    codecs = iter(message.codecs)
    for status in statuses:
        if status in WITH_BODY:
            version, sha, body, day, signature = next(brought)
            yield TileAnswer(status, version, sha, next(codecs) if status == "blob" else 0, body, day, signature)
        else:
            yield TileAnswer(status)
