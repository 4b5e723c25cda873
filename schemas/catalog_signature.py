"""Who answers for the catalog of a district: a publisher's signature over which tiles there are, in which versions.

Signed are the root of a tree over the district's 1024 tiles (32 groups of 32), how many tiles there are, a number that
counts up and the time. Who publishes a tile hashes its group anew and the root, not the district; who has the whole
catalog computes the root from it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Final, Literal, Protocol

from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District, TileId
from gnd.schemas.archive_seal import SealNumber, check_signed_state
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import catalog_signature_pb2
from gnd.schemas.wire import LAYER_PATTERN, check_text, check_word, number_of, word_of

GROUPS: Final = 32
TILES_OF_GROUP: Final = TILES_OF_DISTRICT // GROUPS
DIGEST_BYTES: Final = 32
NO_TILES: Final = bytes(DIGEST_BYTES)
"""Stands for a group without a tile."""
_TEXT: Final = b"gnd catalog 1"
_GROUP: Final = b"\x00"
_ROOT: Final = b"\x01"

CatalogKind = Literal["published", "rollback", "renewed", "whole"]
_KIND: Final[dict[int, CatalogKind]] = {1: "published", 2: "rollback", 3: "renewed", 4: "whole"}


class NamedVersion(Protocol):
    """A tile with its version, as a catalog names it."""

    @property
    def tile(self) -> TileId:
        """Which tile."""

    @property
    def version(self) -> int:
        """Its number."""

    @property
    def sha(self) -> bytes:
        """SHA-256 of its content, 32 bytes."""


def group_of(tile: TileId) -> int:
    """The group of its district that a tile belongs to, 0 .. 31."""
    return tile.morton % TILES_OF_DISTRICT // TILES_OF_GROUP


def digest_of_group(entries: Sequence[NamedVersion]) -> bytes:
    """The digest of the tiles of one group, which are ascending; 32 bytes.

    SHA-256 over a zero byte and of each tile: its Morton code (8 bytes), version (4), hash of its content (32); all
    integers little-endian.
    """
    return digest_of_rows([(one.tile.morton, one.version, one.sha) for one in entries])


def digest_of_rows(rows: Sequence[tuple[int, int, bytes]]) -> bytes:
    """As `digest_of_group`, of Morton codes, versions and hashes."""
    if not rows:
        return NO_TILES
    told = [tile.to_bytes(8, "little") + version.to_bytes(4, "little") + sha for tile, version, sha in rows]
    return sha256(_GROUP + b"".join(told)).digest()


def digests_of(entries: Iterable[NamedVersion]) -> bytes:
    """The digests of all groups of a district, 32 times 32 bytes, given its tiles, which are ascending."""
    groups: list[list[NamedVersion]] = [[] for _ in range(GROUPS)]
    for one in entries:
        groups[group_of(one.tile)].append(one)
    return b"".join(map(digest_of_group, groups))


def with_group(digests: bytes, group: int, digest: bytes) -> bytes:
    """The digests of a district with another one for one group."""
    return digests[: group * DIGEST_BYTES] + digest + digests[(group + 1) * DIGEST_BYTES :]


def digest_at(digests: bytes, group: int) -> bytes:
    """That of one group."""
    return digests[group * DIGEST_BYTES : (group + 1) * DIGEST_BYTES]


@dataclass(frozen=True, slots=True)
class CatalogStatement:
    """What a publisher says of a district.

    Attributes:
        layer: name of the layer.
        district: of the layer.
        tiles: how many tiles it has.
        digests: of its groups, 32 times 32 bytes.
    """

    layer: str
    district: District
    tiles: int
    digests: bytes

    def __post_init__(self) -> None:
        check_text("layer", self.layer, LAYER_PATTERN)
        if not 0 <= self.tiles <= TILES_OF_DISTRICT or len(self.digests) != GROUPS * DIGEST_BYTES:
            raise BadValue(
                f"catalog of {self.tiles} tiles with {len(self.digests)} bytes of digests: 0 .. {TILES_OF_DISTRICT},"
                f" {GROUPS * DIGEST_BYTES}"
            )

    @classmethod
    def of(cls, layer: str, district: District, entries: Sequence[NamedVersion]) -> "CatalogStatement":
        """That of the tiles of a catalog, which are ascending.

        Raises:
            BadValue: a tile is not of the district.
        """
        for one in entries:
            if not district.contains(one.tile):
                raise BadValue(f"tile {one.tile} is not in district {district}")
        return cls(layer, district, len(entries), digests_of(entries))

    def text(self, kind: CatalogKind, order: SealNumber, signer: bytes) -> bytes:
        """The bytes that are signed: all integers little-endian.

        Args:
            kind: how the catalog came about.
            order: its number and time.
            signer: id of the certificate, 8 bytes.
        """
        layer = self.layer.encode()
        return b"".join(
            (
                _TEXT,
                len(layer).to_bytes(1, "little") + layer,
                self.district.first_morton.to_bytes(8, "little"),
                self.tiles.to_bytes(2, "little"),
                sha256(_ROOT + self.digests).digest(),
                number_of(kind, _KIND).to_bytes(1, "little"),
                order.number.to_bytes(8, "little"),
                order.signed_s.to_bytes(8, "little"),
                signer,
            )
        )


@dataclass(frozen=True, slots=True)
class CatalogSignature:
    """The signature of a catalog, with what its entries do not tell.

    Attributes:
        number: how often the catalog of this district was signed, from 1.
        signed_s: when it was signed, POSIX seconds.
        kind: how it came about.
        signer: first 8 bytes of the SHA-256 of the signer's certificate (DER).
        signature: r and s, 32 bytes each.
    """

    number: int
    signed_s: int
    kind: CatalogKind
    signer: bytes
    signature: bytes

    def __post_init__(self) -> None:
        check_word(self.kind, _KIND, "kind of catalog")
        check_signed_state("catalog", self.number, self.signed_s, self.signer, self.signature)

    @property
    def order(self) -> SealNumber:
        """Which state of the district it is."""
        return SealNumber(self.signed_s, self.number)

    def text(self, statement: CatalogStatement) -> bytes:
        """The bytes that must have been signed, if it is that of this statement."""
        return statement.text(self.kind, self.order, self.signer)


def catalog_signature_message(
    signature: CatalogSignature | None,
) -> catalog_signature_pb2.CatalogSignature | None:
    """The signature as a part of a message; None: there is none."""
    if signature is None:
        return None
    message = catalog_signature_pb2.CatalogSignature(
        number=signature.number,
        signed_s=signature.signed_s,
        signer=signature.signer,
        signature=signature.signature,
    )
    message.kind = catalog_signature_pb2.CatalogSignature.Kind.ValueType(number_of(signature.kind, _KIND))
    return message


def decode_catalog_signature(message: catalog_signature_pb2.CatalogSignature) -> CatalogSignature:
    """The signature in a part of a message; BadValue where it is none."""
    kind = word_of(message.kind, _KIND, "kind of catalog")
    return CatalogSignature(message.number, message.signed_s, kind, message.signer, message.signature)
