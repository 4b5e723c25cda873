"""Who answers for an index or the root of an archive: a publisher signs all of the file that comes before the seal.

A file is read with its seal or without it: programs that do not know seals skip the last field. Signed are the bytes as
they lie there, so that nothing depends on how a program would write the same content.
"""

from dataclasses import dataclass
from hashlib import sha256
from typing import Final, Literal, TypeVar

from gnd.schemas.errors import BadValue
from gnd.schemas.generated import archive_index_pb2, archive_root_pb2, archive_seal_pb2
from gnd.schemas.version_signature import SIGNATURE_BYTES, SIGNER_BYTES, check_seconds
from gnd.schemas.wire import parse, serialise

ARCHIVE_ID_BYTES: Final = 8
DIGEST_BYTES: Final = 16
"""So much of a SHA-256 names an index in the root; nobody finds another content to it."""
MOST_NUMBER: Final = 2**48
_TEXT: Final = b"gnd archive 1"
SealedPart = Literal["index", "root"]
_PART: Final[dict[SealedPart, bytes]] = {"index": b"\x01", "root": b"\x02"}
_MessageT = TypeVar("_MessageT", archive_index_pb2.ArchiveIndex, archive_root_pb2.ArchiveRoot)


@dataclass(frozen=True, slots=True, order=True)
class SealNumber:
    """Which of two states of an object is the newer one: by its time, then by its number.

    Attributes:
        signed_s: when it was signed, POSIX seconds.
        number: how often the object was published, from 1.
    """

    signed_s: int = 0
    number: int = 0


def check_signed_state(what: str, number: int, signed_s: int, signer: bytes, signature: bytes) -> None:
    """`BadValue` unless these can be number, time, signer and signature of a state that is signed again and again."""
    check_seconds(signed_s)
    if not 1 <= number < MOST_NUMBER:
        raise BadValue(f"{what} with number {number}: 1 .. {MOST_NUMBER - 1}")
    if len(signer) != SIGNER_BYTES or len(signature) != SIGNATURE_BYTES:
        raise BadValue(
            f"{what} with a signature of {len(signature)} bytes by a signer of {len(signer)} bytes:"
            f" {SIGNATURE_BYTES} and {SIGNER_BYTES}"
        )


@dataclass(frozen=True, slots=True)
class ArchiveSeal:
    """A seal as it lies in a file.

    Attributes:
        archive: names the archive: 8 bytes, drawn when it was published first.
        number: how often the object was published, from 1.
        signed_s: when it was signed, POSIX seconds.
        signer: first 8 bytes of the SHA-256 of the signer's certificate (DER).
        signature: r and s, 32 bytes each.
    """

    archive: bytes
    number: int
    signed_s: int
    signer: bytes
    signature: bytes

    def __post_init__(self) -> None:
        check_signed_state("archive seal", self.number, self.signed_s, self.signer, self.signature)
        if len(self.archive) != ARCHIVE_ID_BYTES:
            raise BadValue(f"archive seal with {len(self.archive)} bytes of archive: {ARCHIVE_ID_BYTES}")

    @property
    def order(self) -> SealNumber:
        """Which state of the object it is."""
        return SealNumber(self.signed_s, self.number)


@dataclass(frozen=True, slots=True)
class Sealed:
    """The seal of a file that was read, with what it must have been made over.

    Attributes:
        part: what kind of object the file is.
        body_sha: SHA-256 of what is signed.
        seal: the seal; whether its signature is good is another question.
    """

    part: SealedPart
    body_sha: bytes
    seal: ArchiveSeal

    @property
    def text(self) -> bytes:
        """The bytes that must have been signed."""
        one = self.seal
        return sealed_text(self.part, self.body_sha, one.archive, one.order, one.signer)


def sealed_text(part: SealedPart, body_sha: bytes, archive: bytes, order: SealNumber, signer: bytes) -> bytes:
    """The bytes that are signed: all integers little-endian. Arguments as `Sealed` and `ArchiveSeal` have them."""
    return b"".join(
        (
            _TEXT,
            _PART[part],
            body_sha,
            archive,
            order.number.to_bytes(8, "little"),
            order.signed_s.to_bytes(8, "little"),
            signer,
        )
    )


def digest_of_index(body_sha: bytes) -> bytes:
    """How the root names the state of an index, given the SHA-256 of what is signed of it."""
    return body_sha[:DIGEST_BYTES]


def with_seal(part: SealedPart, body: bytes, seal: ArchiveSeal, limit: int) -> bytes:
    """A file with its seal: `body` and one more field.

    Raises:
        TooLarge: of more than `limit` bytes, which readers would refuse.
    """
    told = archive_seal_pb2.ArchiveSeal(
        archive=seal.archive,
        number=seal.number,
        signed_s=seal.signed_s,
        signer=seal.signer,
        signature=seal.signature,
        body_bytes=len(body),
    )
    if part == "index":
        return body + serialise(archive_index_pb2.ArchiveIndex(seal=told), limit - len(body))
    return body + serialise(archive_root_pb2.ArchiveRoot(seal=told), limit - len(body))


def without_seal(kind: type[_MessageT], part: SealedPart, data: bytes, limit: int) -> tuple[_MessageT, Sealed | None]:
    """The message in what is signed of a file, and the seal; None: there is none, and the message is the whole file.

    Raises:
        SchemaError: it is none, or not all but the seal is signed.
    """
    whole = parse(kind, data, limit)
    if not whole.HasField("seal"):
        return whole, None
    told = whole.seal
    body, tail = data[: told.body_bytes], data[told.body_bytes :]
    message = parse(kind, body, limit)
    if message.HasField("seal") or kind(seal=told).SerializeToString(deterministic=True) != tail:
        raise BadValue(f"archive {part}: {len(tail)} of {len(data)} bytes are not signed, nor a seal")
    seal = ArchiveSeal(told.archive, told.number, told.signed_s, told.signer, told.signature)
    return message, Sealed(part, sha256(body).digest(), seal)
