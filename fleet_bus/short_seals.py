"""Short seals: two parts that have agreed on a key prove in 9 to 16 bytes what they say to each other.

A seal with a signature (`seals`) convinces everybody and has 74 bytes or more. Who has asked needs to be convinced
alone: by HMAC-SHA-256 under a key that only the two know (`agreed_keys`), cut to 8 bytes. One guess in 2^64 is right,
and each guess is a message. A question that anybody may ask has 4: they keep others from having it answered in advance,
and prove nothing to anybody.

A question names the key by 3 bytes and has a number that counts up; its answer names neither, for it is bound to the
question. Each direction has a key of its own, so nothing can be sent back to who said it.

Two parts that both know the terse form leave out what the other one knows: the mark, a part of the key's name, and all
of the number but its lowest byte. What is proven is the same, with what was left out: 8 bytes prove an answer, 7 go
with a question about the map and 11 with a report.
"""

from dataclasses import dataclass
from hashlib import sha256
from hmac import compare_digest
from typing import Final, Literal

from gnd.fleet_bus.errors import SealError

ShortWhat = Literal["question", "answer", "refusal", "notice"]
_MARK: Final[dict[ShortWhat, int]] = {"question": 0xB1, "answer": 0xB2, "refusal": 0xB3, "notice": 0xB4}
_WHAT_OF: Final = {mark: what for what, mark in _MARK.items()}
_NUMBERED: Final = ("question", "notice")
KEY_ID_BYTES: Final = 3
MAC_BYTES: Final = 8
BARE_MAC_BYTES: Final = 4
"""Of a question that anybody may ask."""
MOST_COUNT: Final = (1 << 28) - 1
"""The largest number; then another key is agreed on."""
TERSE: Final = 0xC000
"""The two highest bits of a terse seal of a question or notice; no other attachment begins so. 14 bits of the key's
name follow."""
TERSE_BYTES: Final = 3
"""Of a terse seal beside its proof."""
LATE: Final = 64
"""A number that is told by its lowest byte is one of the 256 from so many before the newest one on."""


@dataclass(frozen=True, slots=True)
class ShortSeal:
    """A short seal as it travels.

    Attributes:
        what: kind of message that it belongs to.
        mac: the first 4 or 8 bytes of an HMAC-SHA-256.
        key_id: of a question or a notice, 3 bytes; else empty.
        count: of a question or a notice, 1 to `MOST_COUNT`, each used once; else 0.
    """

    what: ShortWhat
    mac: bytes
    key_id: bytes = b""
    count: int = 0

    @property
    def head(self) -> bytes:
        """All of it but the proof."""
        mark = bytes([_MARK[self.what]])
        return mark + self.key_id + _varint(self.count) if self.what in _NUMBERED else mark

    def encode(self) -> bytes:
        """The attachment."""
        return self.head + self.mac

    @classmethod
    def decode(cls, data: bytes) -> "ShortSeal":
        """Reads an attachment; there is one form of each.

        Raises:
            SealError: it is no short seal, or not whole.
        """
        what = _WHAT_OF.get(data[0]) if data else None
        if what is None:
            raise SealError("no short seal")
        if what not in _NUMBERED:
            return cls(what, _mac_of_size(data[1:], (MAC_BYTES,)))
        key_id, rest = data[1 : 1 + KEY_ID_BYTES], data[1 + KEY_ID_BYTES :]
        count, size = _read_varint(rest)
        sizes = (BARE_MAC_BYTES, MAC_BYTES) if what == "question" else (MAC_BYTES,)
        return cls(what, _mac_of_size(rest[size:], sizes), key_id, count)

    def encode_terse(self) -> bytes:
        """The attachment in the terse form; a refusal has none of its own."""
        if self.what == "answer":
            return self.mac
        if self.what == "refusal":
            return self.encode()
        return (TERSE | terse_id(self.key_id)).to_bytes(2, "big") + bytes([self.count & 0xFF]) + self.mac


@dataclass(frozen=True, slots=True)
class TerseSeal:
    """A question's or a notice's seal in the terse form, as it travels.

    Attributes:
        terse_id: 14 bits of the key's name; several keys may have the same.
        low_count: lowest byte of the number.
        mac: 4 or 8 bytes, of the seal in full.
    """

    terse_id: int
    low_count: int
    mac: bytes

    @classmethod
    def decode(cls, data: bytes) -> "TerseSeal":
        """Reads an attachment.

        Raises:
            SealError: it is none of this form, or not whole.
        """
        if not is_terse(data):
            raise SealError("no terse seal")
        head, mac = data[:TERSE_BYTES], _mac_of_size(data[TERSE_BYTES:], (BARE_MAC_BYTES, MAC_BYTES))
        return cls(int.from_bytes(head[:2], "big") & ~TERSE, head[2], mac)

    def encode(self) -> bytes:
        """The attachment."""
        return (TERSE | self.terse_id).to_bytes(2, "big") + bytes([self.low_count]) + self.mac

    def whole(self, what: ShortWhat, key_id: bytes, newest: int) -> ShortSeal:
        """The seal in full, if it is under that key, whose newest number is known; its proof tells whether it is.

        Raises:
            SealError: there is no such number.
        """
        first = max(newest - LATE + 1, 1)
        count = first + (self.low_count - first) % 256
        if count > MOST_COUNT:
            raise SealError(f"the number of a terse seal is {count}, expected 1 to {MOST_COUNT}")
        return ShortSeal(what, self.mac, key_id, count)


def terse_id(key_id: bytes) -> int:
    """The 14 bits by which a terse seal names a key."""
    return int.from_bytes(key_id[:2], "big") & ~TERSE


def is_terse(attachment: bytes) -> bool:
    """Whether an attachment begins as a terse seal of a question or a notice does."""
    return bool(attachment) and attachment[0] >= TERSE >> 8


def is_short(attachment: bytes) -> bool:
    """Whether an attachment begins as a short seal does, in full or terse."""
    return bool(attachment) and (attachment[0] in _WHAT_OF or is_terse(attachment))


def mac_of(secret: bytes, seal: ShortSeal, key: str, payload: bytes, question: bytes, size: int) -> bytes:
    """The proof of a short seal.

    Args:
        secret: 32 bytes, of this direction.
        seal: its head counts, its proof does not.
        key: key expression of the message.
        payload: of the message.
        question: digest of the question that an answer is for; else empty.
        size: bytes of the proof.
    """
    return mac_over(secret, seal, key, sha256(payload).digest(), question, size)


def mac_over(secret: bytes, seal: ShortSeal, key: str, payload_sha: bytes, question: bytes, size: int) -> bytes:
    """As `mac_of`, where the SHA-256 of the payload is known."""
    from cryptography.hazmat.primitives import hashes, hmac

    head, name = seal.head, key.encode()
    made = hmac.HMAC(secret, hashes.SHA256())
    for part in (b"gnd short seal 1", head, name, question):
        made.update(len(part).to_bytes(4, "little") + part)
    made.update(payload_sha)
    return made.finalize()[:size]


def check_mac(secret: bytes, seal: ShortSeal, key: str, payload: bytes, question: bytes, size: int) -> None:
    """Whether a short seal was made for this message by who knows the key.

    Raises:
        SealError: it was not.
    """
    if not compare_digest(mac_of(secret, seal, key, payload, question, size), seal.mac):
        raise SealError(f"the short seal of {len(seal.mac)} bytes does not fit the {seal.what} on {key[:160]}")


def _mac_of_size(data: bytes, sizes: tuple[int, ...]) -> bytes:
    if len(data) not in sizes:
        raise SealError(f"a short seal ends with {len(data)} bytes, expected {' or '.join(map(str, sizes))}")
    return data


def _varint(number: int) -> bytes:
    """7 bits a byte, the lowest first; the last byte is below 128."""
    if not 1 <= number <= MOST_COUNT:
        raise SealError(f"the number of a short seal is {number}, expected 1 to {MOST_COUNT}")
    found = bytearray()
    while number >= 0x80:
        found.append(0x80 | number & 0x7F)
        number >>= 7
    return bytes([*found, number])


def _read_varint(data: bytes) -> tuple[int, int]:
    """The number at the beginning, and how many bytes it has."""
    number = 0
    for size, byte in enumerate(data[:4], start=1):
        number |= (byte & 0x7F) << 7 * (size - 1)
        if byte < 0x80:
            if number == 0 or (byte == 0 and size > 1):
                raise SealError("the number of a short seal is 0 or longer than it needs to be")
            return number, size
    raise SealError(f"the number of a short seal has no end within {len(data[:4])} bytes")
