"""What a client is sent of a tile: nothing where it holds the newest, a delta against what it holds, or the whole tile
in a codec that it reads.

Every version that is still in the store can be the base of a delta. A delta that is no shorter than the whole tile, or
whose base is gone or damaged, is not sent; tiles of plain floats have none. Features come in the one codec they have.
"""

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, Literal
from zlib import crc32

from gnd.fleet_bus.errors import Refused
from gnd.gnd_map.codec import CODECS, DELTA_CODECS, best_codec, codec_of, lattice_of
from gnd.gnd_map.content import FEATURE_CODECS, AnyTile, codecs_of_layer, encode_content_delta, has_deltas
from gnd.gnd_map.day import UNKNOWN_DAY
from gnd.gnd_map.errors import CodecError, GndError
from gnd.gnd_map.features import FeatureTile
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.errors import SchemaError
from gnd.schemas.limits import MAX_TILE_BODY_BYTES
from gnd.schemas.tiles import CatalogEntry, CodedDelta, TileBlob, TileReply, TileRequest, as_kind
from gnd.schemas.tiles_batch import ANSWER_HASH_BYTES, TileAnswer, TilesReply, TilesRequest, digest_of
from gnd.tile_store.errors import StoreDamaged
from gnd.tile_store.memory import Memory
from gnd.tile_store.released import heads_for
from gnd.tile_store.store import Store
from gnd.tile_store.values import StoredTile

BYTES_A_VOXEL: Final = 48
BYTES_A_FEATURE: Final = 2_000  # as Python objects, with its points and attributes
BYTES_A_POINT: Final = 24
BYTES_A_CRC: Final = 200  # with its key
REMEMBERED_BYTES: Final = 64 * 1024 * 1024  # of decoded tiles, and again of deltas and bodies in other codecs
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Sent:
    """What goes out for one tile."""

    status: Literal["blob", "delta"]
    codec_id: int
    body: bytes


@dataclass(frozen=True, slots=True)
class _DistrictAnswers:
    """What is answered of one district.

    Attributes:
        heads: the newest version of each tile for who asks.
        held: see `TileAnswers._held`.
        on_trial: tiles of which a version is on trial.
        answers: of each tile that is asked for, in order; filled while there is room.
        is_of_vehicle: whether a vehicle asks.
    """

    heads: Mapping[TileId, CatalogEntry]
    held: Mapping[TileId, bytes | None]
    on_trial: frozenset[TileId]
    answers: dict[TileId, TileAnswer]
    is_of_vehicle: bool

    @property
    def wanting(self) -> list[TileId]:
        """Tiles whose body is to be sent."""
        return [tile for tile, answer in self.answers.items() if answer.status == "later"]

    def version_of(self, tile: TileId) -> int | None:
        """Which version is sent; None: the newest."""
        return self.heads[tile].version if tile in self.on_trial else None

    def reply(self) -> TilesReply:
        """As it goes out."""
        watched = (place for place, tile in enumerate(self.answers) if tile in self.on_trial)
        return TilesReply(tuple(self.answers.values()), tuple(watched) if self.is_of_vehicle else ())


class TileAnswers:
    """Answers about tiles from a store; remembers what it has decoded and encoded. Any thread may ask."""

    def __init__(self, store: Store, remembered_bytes: int = REMEMBERED_BYTES) -> None:
        self._store = store
        self._decoded: Memory[AnyTile] = Memory(remembered_bytes, _bytes_of)
        self._encoded: Memory[bytes] = Memory(remembered_bytes, len)
        self._whole: Memory[int] = Memory(remembered_bytes, lambda _crc: BYTES_A_CRC)

    def one(self, stored: StoredTile | None, wanted: TileRequest) -> TileReply:
        """The answer about one tile; `Refused` when it cannot be written in a codec that the client reads."""
        if stored is None:
            return TileReply("absent")
        if stored.sha == wanted.cached_sha:
            return TileReply("unchanged")
        held = self._by_sha(stored, wanted.cached_sha) if wanted.deltas else None
        sent = self._sent(stored, held, wanted.codecs)
        if sent.status == "delta":
            delta = CodedDelta(stored.tile, stored.version, stored.sha, sent.body, stored.day)
            return TileReply("delta", delta=delta, signature=stored.signature)
        blob = TileBlob(stored.tile, stored.version, stored.sha, sent.codec_id, sent.body, stored.day)
        return TileReply("blob", blob, signature=stored.signature)

    def many(
        self, layer: str, district: District, request: TilesRequest, others: Collection[District] = ()
    ) -> TilesReply:
        """The answers about tiles of a district, and of those `others` that the request names, too. Those around
        `request.near` come first while bytes are left.

        A tile whose body is damaged is "later", so that it does not keep the others; alone it is an error.

        Raises:
            Refused: a tile cannot be written in a codec that the client reads.
            StoreError: the store has failed, or nothing but damaged bodies is left to send.
            SchemaError: nothing but bodies that cannot be decoded is left to send, or there is no such district.
        """
        asked = request.by_district(district)
        parts = {one: self._part(layer, one, part) for one, part in asked.items() if one == district or one in others}
        wanting = [(tile, part) for part in parts.values() for tile in part.wanting]
        left, damaged = request.max_bytes, list[GndError]()
        for tile, part in _nearest_first(wanting, district, request.near):
            if left <= 0:
                break
            try:
                answer = self._answer(layer, tile, part.version_of(tile), part.held[tile] or b"", request.codecs)
            except (SchemaError, CodecError, StoreDamaged) as error:
                _LOG.error("tile %s cannot be sent: %s", tile, error)
                damaged.append(error)
                continue
            left, part.answers[tile] = _within(left, request.max_bytes, answer)
        if damaged and left == request.max_bytes:
            raise damaged[0]
        of_district, *of_others = (parts[one].reply() if one in parts else None for one in asked)
        assert of_district is not None
        return replace(of_district, others=tuple(of_others))

    def _part(self, layer: str, district: District, request: TilesRequest) -> "_DistrictAnswers":
        """What can be said of a district without any body."""
        tiles = request.tiles(district)
        newest = {entry.tile: entry for entry in self._store.heads(layer, district.path)}
        trials = self._store.trials(layer, district.path)
        held = self._held(layer, district, request, newest)
        heads = heads_for(request, newest, trials, held) if trials else newest
        answers = {tile: _without_body(heads.get(tile), held[tile]) for tile in tiles}
        return _DistrictAnswers(heads, held, frozenset(trials), answers, is_of_vehicle=request.ticket > 0)

    def _answer(
        self, layer: str, tile: TileId, version: int | None, held: bytes, codecs: tuple[int, ...]
    ) -> TileAnswer:
        """A version (None: the newest) for a client that holds the content with this hash (b"": none that the store
        knows).
        """
        stored = self._store.get(layer, tile, version)
        if stored is None:
            return TileAnswer("absent")
        sent = self._sent(stored, self._by_sha(stored, held), codecs)
        codec_id = sent.codec_id if sent.status == "blob" else 0
        day = UNKNOWN_DAY if stored.codec_id in FEATURE_CODECS else stored.day
        sha = stored.sha[:ANSWER_HASH_BYTES]
        return TileAnswer(sent.status, stored.version, sha, codec_id, sent.body, day, stored.signature)

    # What the client holds

    def _held(
        self, layer: str, district: District, request: TilesRequest, heads: dict[TileId, CatalogEntry]
    ) -> dict[TileId, bytes | None]:
        """The hash of what the client holds of each tile: b"" = nothing that the store knows, None = it must say."""
        tiles = request.tiles(district)
        versions = {tile: version for tile, (_, version) in zip(tiles, request.wanted, strict=True) if version}
        held: dict[TileId, bytes | None] = dict.fromkeys(tiles, b"")
        if request.held_hashes:
            told = zip(versions.items(), request.held_hashes, strict=True)
            return held | {tile: self._with_hash(layer, tile, number, start) for (tile, number), start in told}
        shas = {tile: self._sha_of(layer, tile, version, heads) for tile, version in versions.items()}
        agreed = all(shas.values()) and digest_of(shas.values()) == request.held_digest
        return held | (shas if agreed else dict.fromkeys(versions, None))

    def _sha_of(self, layer: str, tile: TileId, version: int, heads: dict[TileId, CatalogEntry]) -> bytes:
        """The hash of a version; empty when it is not in the store."""
        head = heads.get(tile)
        if head is not None and head.version == version:
            return head.sha
        stored = self._store.get(layer, tile, version)
        return stored.sha if stored else b""

    def _with_hash(self, layer: str, tile: TileId, version: int, start: bytes) -> bytes:
        """The whole hash that begins like this, of the version that the client names or of any other; else empty."""
        lines = sorted(self._store.history(layer, tile), key=lambda line: line.version != version)
        return next((line.sha for line in lines if line.sha.startswith(start)), b"")

    def _by_sha(self, stored: StoredTile, sha: bytes) -> StoredTile | None:
        return self._store.by_sha(stored.layer, stored.tile, sha) if sha else None

    # What is sent

    def _sent(self, stored: StoredTile, held: StoredTile | None, codecs: Sequence[int]) -> _Sent:
        # A delta is coded like the body in the store; floats have no short one.
        if held is not None and has_deltas(stored.codec_id) and reads_deltas(stored.codec_id, codecs):
            body = self._delta(held, stored)
            if body is not None and len(body) < len(stored.body):
                return _Sent("delta", 0, body)
        return _Sent("blob", *self._body(stored, codecs))

    def _delta(self, base: StoredTile, new: StoredTile) -> bytes | None:
        """The delta; None when one of the two bodies is damaged."""
        try:
            return self._encoded.get(
                (new.tile, base.sha, new.sha),
                lambda: encode_content_delta(self._tile(base), self._tile(new)),
            )
        except GndError as error:
            _LOG.error("tile %s: no delta from version %d to %d: %s", new.tile, base.version, new.version, error)
            return None

    def _body(self, stored: StoredTile, codecs: Sequence[int]) -> tuple[int, bytes]:
        """Codec and bytes of the version for a client that reads these codecs, in its order of preference."""
        codec_id = self._codec_for(stored, codecs)
        if codec_id == stored.codec_id:
            self._check(stored)
            return codec_id, stored.body
        encode, tile = codec_of(codec_id).encode, as_kind(self._tile(stored), Tile)
        body = self._encoded.get((stored.tile, stored.sha, codec_id), lambda: encode(stored.tile, tile.gaussians))
        if len(body) > MAX_TILE_BODY_BYTES:
            raise Refused(
                f"tile {stored.tile.path} has {len(body)} bytes in codec {codec_id}, a message holds"
                f" {MAX_TILE_BODY_BYTES}; it comes in codec {stored.codec_id}"
            )
        return codec_id, body

    def _check(self, stored: StoredTile) -> None:
        """StoreDamaged where the body is not what its hash says: no client could use it, and all would ask again.

        It was encoded from that content, if its check tells so. Any other, also one that is older than checks, is
        decoded once; from then on its checksum tells whether the same bytes were read.
        """
        if stored.is_as_encoded:
            return

        def crc_of_a_whole_one() -> int:
            stored.decode()
            return crc32(stored.body)

        name = f"tile {stored.tile.path} version {stored.version}"
        try:
            is_whole = self._whole.get((stored.tile, stored.sha, stored.codec_id), crc_of_a_whole_one) == crc32(
                stored.body
            )
        except SchemaError as error:
            raise StoreDamaged(f"{name}: damaged: {error}") from error
        if not is_whole:
            raise StoreDamaged(f"{name}: damaged: other bytes than before")

    def _codec_for(self, stored: StoredTile, codecs: Sequence[int]) -> int:
        """The first codec of the client that can express the version.

        Bodies lie in the store in the best codec there is, so most versions need not be decoded to know: the codec is
        the stored one, another of its lattice, or one of floats.
        """
        if stored.codec_id in FEATURE_CODECS:
            return self._only_codec(stored, codecs)
        known = _codec_like(stored.codec_id, tuple(codecs))
        if known is not None:
            return known
        try:
            return best_codec(as_kind(self._tile(stored), Tile).gaussians, codecs)
        except GndError:
            return self._only_codec(stored, codecs)

    @staticmethod
    def _only_codec(stored: StoredTile, codecs: Sequence[int]) -> int:
        """The codec of the body in the store, for a client that reads it; else Refused."""
        if stored.codec_id not in codecs:
            raise Refused(
                f"tile {stored.tile.path} of layer {stored.layer} comes in codec {stored.codec_id}, asked for"
                f" {tuple(codecs)}"
            )
        return stored.codec_id

    def _tile(self, stored: StoredTile) -> AnyTile:
        return self._decoded.get((stored.tile, stored.sha), stored.decode)


def _bytes_of(tile: AnyTile) -> int:
    """About what a decoded tile takes in memory."""
    if isinstance(tile, FeatureTile):
        return sum(BYTES_A_FEATURE + BYTES_A_POINT * len(feature.points_m) for feature in tile.features)
    return BYTES_A_VOXEL * len(tile.gaussians)


def reads_layer(layer: str, codecs: Sequence[int]) -> bool:
    """Whether a client that names these codecs reads any of those that a layer may come in."""
    return not set(codecs).isdisjoint(codecs_of_layer(layer))


def reads_deltas(codec_id: int, codecs: Sequence[int]) -> bool:
    """Whether a client that names these codecs reads deltas of content in a codec: it reads that one, or another range
    codec of its lattice, for deltas are range coded in one way.
    """
    return codec_id in codecs or any(
        other in DELTA_CODECS and lattice_of(other) is lattice_of(codec_id) for other in codecs if codec_id in CODECS
    )


def same_lattice(one: int, other: int) -> bool:
    """Whether two known codecs write the same lattice (or both floats)."""
    return lattice_of(one) is lattice_of(other)


@lru_cache(maxsize=256)
def _codec_like(stored_id: int, codecs: tuple[int, ...]) -> int | None:
    """The first of the codecs that writes floats or the lattice of the stored one; None: none of them."""
    for codec_id in codecs:
        if codec_id in CODECS and (lattice_of(codec_id) is None or same_lattice(codec_id, stored_id)):
            return codec_id
    return None


def _without_body(head: CatalogEntry | None, held: bytes | None) -> TileAnswer:
    """What can be said of a tile without its body: "later" where that is wanted; `held` None = the client must say."""
    if head is None:
        return TileAnswer("absent")
    if held is None:
        return TileAnswer("hash")
    return TileAnswer("unchanged" if held == head.sha else "later")


def _nearest_first(
    tiles: list[tuple[TileId, _DistrictAnswers]], district: District, near: int | None
) -> list[tuple[TileId, _DistrictAnswers]]:
    """The tiles by their distance from the one of the district with index `near`; in order without one."""
    if near is None:
        return tiles
    centre = TileId(district.first_morton + near)
    lon, lat = centre.lon_index, centre.lat_index
    return sorted(tiles, key=lambda one: ((one[0].lon_index - lon) ** 2 + (one[0].lat_index - lat) ** 2, one[0].morton))


def _within(left: int, limit: int, answer: TileAnswer) -> tuple[int, TileAnswer]:
    """Bytes left after an answer, and the answer: "later" where its body does not fit; the first one always does."""
    size = len(answer.body)  # what signs it is small, and comes on top
    if size <= left or (size and left == limit):
        return left - size, answer
    return 0, TileAnswer("later")
