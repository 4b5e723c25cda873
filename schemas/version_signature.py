"""Who answers for a tile version: the publisher's signature over what it is, wherever it comes from.

A shard signs what it merges, an operator what he imports or rolls back. Signed is `VersionStatement.text`; a client
knows all of it but the signature from the tile itself, so that a version costs 64 bytes and what does not repeat of a
few numbers. The certificate behind it travels apart, by its id.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, TypeVar

from gnd.gnd_map.day import LAST_DAY, UNKNOWN_DAY
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import version_signatures_pb2
from gnd.schemas.wire import LAYER_PATTERN, check_sha, check_text, check_version, check_word, number_of, word_of

SIGNER_BYTES: Final = 8
"""So much of the SHA-256 of a certificate names it, as in a seal."""
SIGNATURE_BYTES: Final = 64
MOST_SECONDS: Final = 2**40
"""Later than any clock."""
_TEXT: Final = b"gnd version 1"
_T = TypeVar("_T", int, bytes)

SignedKind = Literal["merged", "base", "rollback"]
_KIND: Final[dict[int, SignedKind]] = {1: "merged", 2: "base", 3: "rollback"}


@dataclass(frozen=True, slots=True)
class VersionStatement:
    """What a publisher says of a version.

    Attributes:
        layer: name of the layer.
        tile: of the layer.
        version: its number; the one before it has the number before.
        sha: SHA-256 of its content, 32 bytes.
        kind: how it came about. A rollback is a new version, and signed as one.
        day: when the world looked so (`gnd.gnd_map.day`); of a feature layer not told.
        made_s: when it was made, POSIX seconds.
    """

    layer: str
    tile: TileId
    version: int
    sha: bytes
    kind: SignedKind
    day: int
    made_s: int

    def __post_init__(self) -> None:
        check_text("layer", self.layer, LAYER_PATTERN)
        check_version("tile version", self.version, lowest=1)
        check_sha("tile sha", self.sha)
        check_word(self.kind, _KIND, "kind of version")
        if not UNKNOWN_DAY <= self.day <= LAST_DAY:
            raise BadValue(f"day {self.day} is outside {UNKNOWN_DAY} .. {LAST_DAY}")
        check_seconds(self.made_s)

    def text(self, signer: bytes, signed_s: int) -> bytes:
        """The bytes that are signed: all integers little-endian.

        Args:
            signer: id of the certificate, 8 bytes.
            signed_s: when it is signed, POSIX seconds; not before it was made.
        """
        layer = self.layer.encode()
        day = UNKNOWN_DAY if is_feature_layer(self.layer) else self.day
        return b"".join(
            (
                _TEXT,
                len(layer).to_bytes(1, "little") + layer,
                self.tile.morton.to_bytes(8, "little"),
                self.version.to_bytes(4, "little"),
                (self.version - 1).to_bytes(4, "little"),
                self.sha,
                number_of(self.kind, _KIND).to_bytes(1, "little"),
                day.to_bytes(4, "little"),
                self.made_s.to_bytes(8, "little"),
                signed_s.to_bytes(8, "little"),
                signer,
            )
        )


@dataclass(frozen=True, slots=True)
class VersionSignature:
    """The signature of a version, with what a tile does not tell of itself.

    Attributes:
        signer: first 8 bytes of the SHA-256 of the signer's certificate (DER).
        kind: how the version came about.
        made_s: when it was made, POSIX seconds.
        signed_s: when it was signed, POSIX seconds.
        signature: r and s, 32 bytes each.
    """

    signer: bytes
    kind: SignedKind
    made_s: int
    signed_s: int
    signature: bytes

    def __post_init__(self) -> None:
        check_word(self.kind, _KIND, "kind of version")
        check_seconds(self.made_s)
        check_seconds(self.signed_s)
        if len(self.signer) != SIGNER_BYTES or len(self.signature) != SIGNATURE_BYTES:
            raise BadValue(
                f"version signature of {len(self.signature)} bytes by a signer of {len(self.signer)} bytes:"
                f" {SIGNATURE_BYTES} and {SIGNER_BYTES}"
            )
        if not 0 <= self.signed_s - self.made_s < 2**32:
            raise BadValue(f"version signature of {self.signed_s} s over a version of {self.made_s} s")

    def statement(self, layer: str, tile: TileId, version: int, sha: bytes, day: int) -> VersionStatement:
        """What must have been signed, if it is that of this tile."""
        return VersionStatement(layer, tile, version, sha, self.kind, day, self.made_s)


Signatures = Sequence[VersionSignature | None]


def signatures_message(signatures: Signatures) -> version_signatures_pb2.VersionSignatures | None:
    """The signatures of some versions as a part of a message; None where none is signed."""
    signed = [one for one in signatures if one is not None]
    if not signed:
        return None
    signers = list(dict.fromkeys(one.signer for one in signed))
    made = [one.made_s for one in signed]
    later = [one.signed_s - one.made_s for one in signed]
    return version_signatures_pb2.VersionSignatures(
        signers=b"".join(signers),
        signed_by=_short([0 if one is None else signers.index(one.signer) + 1 for one in signatures]),
        kinds=_short([number_of(one.kind, _KIND) for one in signed]),
        made_s=made[:1] if len(set(made)) == 1 else [b - a for a, b in zip([0, *made], made, strict=False)],
        later_s=_short(later) if any(later) else (),
        signatures=b"".join(one.signature for one in signed),
    )


def decode_signatures(message: version_signatures_pb2.VersionSignatures, count: int) -> list[VersionSignature | None]:
    """The signatures of `count` versions from a part of a message.

    Raises:
        BadValue: they are not those of so many versions.
    """
    signers = _cut(message.signers, SIGNER_BYTES)
    by = _long(list(message.signed_by), count)
    signed = sum(number > 0 for number in by)
    signatures = _cut(message.signatures, SIGNATURE_BYTES)
    if len(signatures) != signed or any(number > len(signers) for number in by):
        raise BadValue(
            f"{len(signatures)} version signatures by {len(signers)} signers for {count} versions of which {signed}"
            " are signed"
        )
    if not signed:
        return [None] * count
    kinds = _long(list(message.kinds), signed)
    later = _long(list(message.later_s) or [0], signed)
    rows = zip(kinds, _times(list(message.made_s), signed), later, signatures, strict=True)
    return [None if not number else _signature(signers[number - 1], *next(rows)) for number in by]


def _signature(signer: bytes, kind: int, made_s: int, later_s: int, signature: bytes) -> VersionSignature:
    return VersionSignature(signer, word_of(kind, _KIND, "kind of version"), made_s, made_s + later_s, signature)


def _times(told: list[int], count: int) -> list[int]:
    if len(told) == 1:
        return told * count
    _check_count(told, count)
    times, now = list[int](), 0
    for step in told:
        now += step
        times.append(now)
    return times


def _short(values: list[int]) -> list[int]:
    return values[:1] if len(set(values)) == 1 else values


def _long(told: list[int], count: int) -> list[int]:
    if len(told) == 1:
        return told * count
    _check_count(told, count)
    return told


def _check_count(told: Sequence[_T], count: int) -> None:
    if len(told) != count:
        raise BadValue(f"version signatures with {len(told)} values for {count} versions: one for each, or one for all")


def _cut(data: bytes, each: int) -> list[bytes]:
    if len(data) % each:
        raise BadValue(f"version signatures with {len(data)} bytes, not a multiple of {each}")
    return [data[at : at + each] for at in range(0, len(data), each)]


def check_seconds(time_s: int) -> None:
    """`BadValue` unless this can be a time in POSIX seconds."""
    if not 0 <= time_s < MOST_SECONDS:
        raise BadValue(f"a time of {time_s} s is outside 0 .. 2^40 - 1")
