"""Many tiles of one district in one query: what a client holds in half a byte a tile, the answer in a bit where it
holds the newest already.
"""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Final, Self

from gnd.gnd_map.codec import PREFERRED, decode_tiles, encode_tiles
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import limits
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import tiles_reply_pb2, tiles_request_pb2
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

__all__ = [
    "ANSWER_HASH_BYTES",
    "EVERY_CODEC",
    "HASH_BYTES",
    "HeldVersion",
    "TileAnswer",
    "TilesReply",
    "TilesRequest",
    "digest_of",
    "index_of",
    "tile_of_answer",
]

HASH_BYTES: Final = 8
"""So much of a hash, or of a digest of hashes, says what a client holds: chance errs once in 10^19."""
EVERY_CODEC: Final = (4, 3, 2, 7, 6, 5, 1, 0)
"""What a request means that names no codecs; frozen, whatever later programs read besides."""
MAX_HELD_VERSION: Final = 2**31
TILES: Final = limits.MAX_TILES_OF_DISTRICT


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
    """Which tiles of a district a client wants; `of` makes it from the tiles that it holds."""

    wanted: tuple[tuple[int, int], ...]
    """(index in the district = lowest ten bits of the Morton code, version held, 0 = none), ascending."""
    held_digest: bytes = b""
    """`digest_of` the hashes of what is held; empty = nothing is, or `held_hashes` say what."""
    held_hashes: tuple[bytes, ...] = ()
    """The first 8 bytes of the hash of each tile held, in order: only when the server has asked for them."""
    codecs: tuple[int, ...] = PREFERRED
    """In order of preference, at least one."""
    max_bytes: int = limits.MAX_TILE_BODY_BYTES
    """Bodies beyond so many bytes wait for another request; the first always fits."""
    near: int | None = None
    """Index of the tile around which tiles are needed first; None = in order."""
    ticket: int = 0
    """Of a vehicle (`ticket_of`): who gets a version that is on trial; 0 = no vehicle, which gets what is released."""
    newest: bool = False
    """The newest versions are wanted, released or not."""

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

    @property
    def n_held(self) -> int:
        """Of how many tiles the client holds a version."""
        return sum(version > 0 for _, version in self.wanted)

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

    def tiles(self, district: District) -> tuple[TileId, ...]:
        """The tiles wanted, in the order of the answers."""
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
        )


def index_of(tile: TileId) -> int:
    """A tile's number in its district: 0 .. 1023."""
    return tile.morton % TILES


def digest_of(shas: Iterable[bytes]) -> bytes:
    """First 8 bytes of SHA-256 over the hashes (32 bytes each) of what is held, in order."""
    return hashlib.sha256(b"".join(shas)).digest()[:HASH_BYTES]


def check_indices(wanted: Sequence[tuple[int, int]]) -> None:
    """`BadValue`, `TooLarge` unless these are (index, version) of tiles of one district, ascending."""
    check_length("TilesRequest", len(wanted), TILES, "tiles")
    if not wanted:
        raise BadValue("TilesRequest for no tiles")
    for index, version in wanted:
        if not 0 <= version < MAX_HELD_VERSION:
            raise BadValue(f"held version {version} of tile {index} is outside 0 .. {MAX_HELD_VERSION - 1}")
    if wanted[0][0] < 0 or wanted[-1][0] >= TILES or any(a >= b for (a, _), (b, _) in pairwise(wanted)):
        raise BadValue(
            f"TilesRequest for tiles {[i for i, _ in wanted][:9]}…: ascending in 0 .. {TILES - 1}, once each"
        )


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

    def __post_init__(self) -> None:
        check_length("TilesReply", len(self.answers), TILES, "tiles")
        watched = self.watched
        if watched and (watched[-1] >= len(self.answers) or any(a >= b for a, b in pairwise(watched))):
            raise BadValue(f"TilesReply watches places {watched[:9]}… of {len(self.answers)}: ascending, once each")

    def of_request(self, request: TilesRequest, district: District) -> list[tuple[TileId, TileAnswer]]:
        """Each tile of the request with its answer.

        Raises:
            BadValue: it answers more or fewer tiles than were asked for, or a delta where nothing is held.
        """
        if len(self.answers) != len(request.wanted):
            raise BadValue(f"TilesReply about {len(self.answers)} tiles, asked for {len(request.wanted)}")
        for (index, version), answer in zip(request.wanted, self.answers, strict=True):
            if version == 0 and answer.status in ("delta", "unchanged", "hash"):
                raise BadValue(f"TilesReply says {answer.status!r} of tile {index}, of which nothing is held")
        return list(zip(request.tiles(district), self.answers, strict=True))

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
        return cls(tuple(_answers(message)), tuple(message.watched))


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
