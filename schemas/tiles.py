"""Tiles on the bus: request, blob, reply, catalog. Each value checks itself; encode and decode stand side by side."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal

from gnd.gnd_map.codec import CODEC_FLOAT32, PREFERRED, codec_of
from gnd.gnd_map.content import AnyTile, TileT, dated, decode_content, decode_content_delta, noun_of
from gnd.gnd_map.day import LAST_DAY, UNKNOWN_DAY
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.features import FeatureTile
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas import limits
from gnd.schemas.catalog_signature import CatalogSignature, catalog_signature_message, decode_catalog_signature
from gnd.schemas.errors import BadValue, WrongHash
from gnd.schemas.generated import (
    catalog_entry_pb2,
    catalog_pb2,
    coded_delta_pb2,
    tile_blob_pb2,
    tile_reply_pb2,
    tile_request_pb2,
)
from gnd.schemas.version_signature import VersionSignature, decode_signatures, signatures_message
from gnd.schemas.wire import (
    MAJOR,
    check_length,
    check_major,
    check_pair,
    check_sha,
    check_version,
    check_word,
    number_of,
    parse,
    refusing,
    serialise,
    tile_id,
    word_of,
)

ReplyStatus = Literal["blob", "unchanged", "absent", "delta"]
_STATUS: Final[dict[int, ReplyStatus]] = {1: "blob", 2: "unchanged", 3: "absent", 4: "delta"}


@dataclass(frozen=True, slots=True)
class TileRequest:
    """What a client holds already and which codecs it can read."""

    cached_version: int = 0
    """0 = none."""
    cached_sha: bytes = b""
    """32 bytes; empty = none."""
    codecs: tuple[int, ...] = PREFERRED
    """In order of preference, at least one."""
    deltas: bool = True
    """Whether it can use a delta against what it holds."""

    def __post_init__(self) -> None:
        check_pair("cached", self.cached_version, self.cached_sha)
        check_codecs("TileRequest", self.codecs)

    def encode(self) -> bytes:
        """Bytes of gnd.v1.TileRequest."""
        message = tile_request_pb2.TileRequest(
            major=MAJOR,
            cached_version=self.cached_version,
            cached_sha=self.cached_sha,
            codecs=self.codecs,
            deltas=self.deltas,
        )
        return serialise(message, limits.MAX_TILE_REQUEST_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "TileRequest":
        """The value in `data`; `SchemaError` when it is none."""
        message = parse(tile_request_pb2.TileRequest, data, limits.MAX_TILE_REQUEST_BYTES)
        check_major(message, "TileRequest")
        return cls(message.cached_version, message.cached_sha, tuple(message.codecs), message.deltas)


def check_codecs(name: str, codecs: tuple[int, ...]) -> None:
    """`TooLarge`, `BadValue` unless `codecs` are a few ids, at least one."""
    check_length(name, len(codecs), limits.MAX_CODECS, "codecs")
    if not codecs or not all(0 <= codec < 2**32 for codec in codecs):
        raise BadValue(f"{name} with codecs {codecs}: at least one, each in 0 .. 2^32 - 1")


@dataclass(frozen=True, slots=True)
class TileBlob:
    """One version of one tile in one codec."""

    tile: TileId
    version: int
    sha: bytes
    """SHA-256 of the content, whatever the codec."""
    codec_id: int
    body: bytes
    day: int = UNKNOWN_DAY
    """When the world looked so (`gnd.gnd_map.day`)."""

    def __post_init__(self) -> None:
        check_version("tile version", self.version, lowest=1)
        check_sha("tile sha", self.sha)
        check_version("codec id", self.codec_id, lowest=0)
        check_day(self.day)
        check_length(f"tile {self.tile}", len(self.body), limits.MAX_TILE_BODY_BYTES, "bytes")

    def encode(self) -> bytes:
        """Bytes of gnd.v1.TileBlob."""
        return serialise(_blob_message(self), limits.MAX_TILE_REPLY_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "TileBlob":
        """The value in `data`; `SchemaError` when it is none. The body's hash is checked by `tile_of`."""
        return _blob_value(parse(tile_blob_pb2.TileBlob, data, limits.MAX_TILE_REPLY_BYTES))


def check_day(day: int) -> None:
    """`BadValue` unless this can be the day of a tile."""
    if not UNKNOWN_DAY <= day <= LAST_DAY:
        raise BadValue(f"day {day} is outside {UNKNOWN_DAY} .. {LAST_DAY}")


def _blob_message(blob: TileBlob) -> tile_blob_pb2.TileBlob:
    return tile_blob_pb2.TileBlob(
        tile=blob.tile.morton,
        version=blob.version,
        sha=blob.sha,
        codec_id=blob.codec_id,
        body=blob.body,
        day=blob.day,
    )


def _blob_value(message: tile_blob_pb2.TileBlob) -> TileBlob:
    return TileBlob(tile_id(message.tile), message.version, message.sha, message.codec_id, message.body, message.day)


def blob_of(tile: Tile, codec_id: int = CODEC_FLOAT32) -> TileBlob:
    """The tile in a codec; `CodecError` when that codec cannot express it."""
    return TileBlob(
        tile.tile_id,
        tile.version,
        tile.sha,
        codec_id,
        codec_of(codec_id).encode(tile.tile_id, tile.gaussians),
        tile.day,
    )


def content_of(blob: TileBlob) -> AnyTile:
    """The tile in a blob: its codec says whether it holds Gaussians or features.

    Raises:
        WrongHash: the content is not what the blob's sha says.
        BadValue: a codec that this program does not know, or a body that is none of it.
    """
    name = f"tile {blob.tile} version {blob.version}"
    with refusing(name):
        tile = decode_content(blob.tile, blob.version, blob.codec_id, blob.body)
    check_hash(name, tile, blob.sha)
    return dated(tile, blob.day)


def tile_of(blob: TileBlob) -> Tile:
    """As `content_of`, of a layer of Gaussians; BadValue where it holds features."""
    return as_kind(content_of(blob), Tile)


def features_of(blob: TileBlob) -> FeatureTile:
    """As `content_of`, of a feature layer; BadValue where it holds Gaussians."""
    return as_kind(content_of(blob), FeatureTile)


def as_kind(tile: AnyTile, kind: type[TileT]) -> TileT:
    """The tile itself, now known to be of this kind; BadValue when it is of the other."""
    if not isinstance(tile, kind):
        raise BadValue(f"tile {tile.tile_id} version {tile.version} holds {noun_of(tile)}, expected {noun_of(kind)}")
    return tile


@dataclass(frozen=True, slots=True)
class CodedDelta:
    """What turns the content of a tile that a client holds into another version."""

    tile: TileId
    version: int
    """That comes out."""
    sha: bytes
    """SHA-256 of the content that comes out."""
    body: bytes
    """`gnd.gnd_map.content.encode_content_delta` against what the client holds."""
    day: int = UNKNOWN_DAY
    """When the world looked so (`gnd.gnd_map.day`)."""

    def __post_init__(self) -> None:
        check_version("tile version", self.version, lowest=1)
        check_sha("tile sha", self.sha)
        check_length(f"delta of tile {self.tile}", len(self.body), limits.MAX_TILE_BODY_BYTES, "bytes")
        check_day(self.day)


def _delta_message(delta: CodedDelta) -> coded_delta_pb2.CodedDelta:
    return coded_delta_pb2.CodedDelta(
        tile=delta.tile.morton, version=delta.version, sha=delta.sha, body=delta.body, day=delta.day
    )


def _delta_value(message: coded_delta_pb2.CodedDelta) -> CodedDelta:
    return CodedDelta(tile_id(message.tile), message.version, message.sha, message.body, message.day)


def tile_after(delta: CodedDelta, held: TileT) -> TileT:
    """The tile that a delta makes of the one that the client holds.

    Raises:
        WrongHash: the delta does not fit what is held, or what comes out has not the delta's sha: fetch the tile whole.
    """
    return dated(tile_from_delta(delta.tile, delta.version, delta.body, held, delta.sha), delta.day)


def tile_from_delta(tile: TileId, version: int, body: bytes, held: TileT, sha: bytes) -> TileT:
    """The tile that the bytes of a coded delta make of the one held; `sha` may be the first bytes of the hash only.

    Raises:
        WrongHash: the delta is of another tile, does not fit what is held, or its outcome has not this hash.
    """
    name = f"delta of tile {tile} to version {version}"
    if held.tile_id != tile:
        raise WrongHash(f"{name} is not for tile {held.tile_id}; fetch the tile whole")
    try:
        after = decode_content_delta(held, version, body)
    except GndError as error:
        raise WrongHash(f"{name} does not fit version {held.version}: {error}; fetch the tile whole") from error
    check_hash(name, after, sha)
    return after


def check_hash(name: str, tile: AnyTile, sha: bytes) -> None:
    """`WrongHash` unless the tile's hash begins with `sha` (all 32 bytes of it, or the first few)."""
    if not sha or not tile.sha.startswith(sha):
        raise WrongHash(f"{name}: content has sha {tile.sha.hex()[:16]}…, claimed is {sha.hex()[:16]}…; fetch it again")


@dataclass(frozen=True, slots=True)
class TileReply:
    """The tile server's answer."""

    status: ReplyStatus
    blob: TileBlob | None = None
    """Set exactly when the status is "blob"."""
    delta: CodedDelta | None = None
    """Set exactly when the status is "delta"."""
    signature: VersionSignature | None = None
    """Of who answers for the version in the blob or delta; None: nobody does."""

    def __post_init__(self) -> None:
        check_word(self.status, _STATUS, "TileReply status")
        for name, part in (("blob", self.blob), ("delta", self.delta)):
            if (self.status == name) != (part is not None):
                raise BadValue(f"TileReply {self.status!r} {'without' if part is None else 'with'} a {name}")
        if self.signature is not None and self.blob is None and self.delta is None:
            raise BadValue(f"TileReply {self.status!r} with a signature")

    def encode(self) -> bytes:
        """Bytes of gnd.v1.TileReply."""
        message = tile_reply_pb2.TileReply(
            major=MAJOR,
            blob=_blob_message(self.blob) if self.blob else None,
            delta=_delta_message(self.delta) if self.delta else None,
            signatures=signatures_message([self.signature]),
        )
        message.status = tile_reply_pb2.TileReply.Status.ValueType(number_of(self.status, _STATUS))
        return serialise(message, limits.MAX_TILE_REPLY_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "TileReply":
        """The value in `data`; `SchemaError` when it is none."""
        message = parse(tile_reply_pb2.TileReply, data, limits.MAX_TILE_REPLY_BYTES)
        check_major(message, "TileReply")
        status = word_of(message.status, _STATUS, "TileReply status")
        return cls(
            status,
            _blob_value(message.blob) if message.HasField("blob") else None,
            _delta_value(message.delta) if message.HasField("delta") else None,
            decode_signatures(message.signatures, 1)[0] if message.HasField("signatures") else None,
        )


@dataclass(frozen=True, slots=True)
class CatalogEntry:
    """The newest version of one tile."""

    tile: TileId
    version: int
    sha: bytes

    def __post_init__(self) -> None:
        check_version("tile version", self.version, lowest=1)
        check_sha("tile sha", self.sha)


@dataclass(frozen=True, slots=True)
class Catalog:
    """What a district holds: one entry a tile, ascending."""

    entries: tuple[CatalogEntry, ...] = ()
    signature: CatalogSignature | None = None
    """Of who answers for the entries, all of them; None: nobody does."""

    def __post_init__(self) -> None:
        check_length("Catalog", len(self.entries), limits.MAX_TILES_OF_DISTRICT, "entries")
        for before, after in pairwise(self.entries):
            if before.tile >= after.tile:
                raise BadValue(f"Catalog lists tile {after.tile} after {before.tile}: ascending, none twice")

    def encode(self) -> bytes:
        """Bytes of gnd.v1.Catalog."""
        entries = (
            catalog_entry_pb2.CatalogEntry(tile=entry.tile.morton, version=entry.version, sha=entry.sha)
            for entry in self.entries
        )
        signature = catalog_signature_message(self.signature)
        message = catalog_pb2.Catalog(major=MAJOR, entries=entries, signature=signature)
        return serialise(message, limits.MAX_CATALOG_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "Catalog":
        """The value in `data`; `SchemaError` when it is none."""
        message = parse(catalog_pb2.Catalog, data, limits.MAX_CATALOG_BYTES)
        check_major(message, "Catalog")
        check_length("Catalog", len(message.entries), limits.MAX_TILES_OF_DISTRICT, "entries")
        return cls(
            tuple(CatalogEntry(tile_id(e.tile), e.version, e.sha) for e in message.entries),
            decode_catalog_signature(message.signature) if message.HasField("signature") else None,
        )
