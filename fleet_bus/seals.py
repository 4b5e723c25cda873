"""Seals: who says something on the bus is proven by a signature that travels beside the message.

A seal is an attachment of zenoh: programs that do not know seals read the message as before. It is made with the key of
the part's certificate (ECDSA on P-256, SHA-256), over the key expression, the payload, and

- of a report, or another question that not everybody may ask: the time, and a number that is used once;
- of an answer: the question that it answers, number included. So an answer cannot be kept and given again, and no clock
  is needed to know that it is new.

An old notice changes nothing: it applies to the content that it names alone. So neither a router nor a cache nor
another client can invent, alter or repeat what matters. What may be withheld is found by asking.
"""

import secrets
import time
from dataclasses import dataclass, field, replace
from hashlib import sha256
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Final, Literal

from gnd.fleet_bus.errors import SealError

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey, EllipticCurvePublicKey

What = Literal["question", "answer", "refusal", "notice", "number"]
_WHAT: Final[dict[What, int]] = {"question": 1, "answer": 2, "refusal": 3, "notice": 4, "number": 5}
_WHAT_OF: Final = {number: what for what, number in _WHAT.items()}

MARK: Final = b"\xa7"
ID_BYTES: Final = 8
SIGNATURE_BYTES: Final = 64
NONCE_BYTES: Final = 8
_TIME_BYTES: Final = 6
_COUNT_WANTED: Final = 0x10
_WITH_CHAIN: Final = 0x20
_WITH_SHARE: Final = 0x40
SHARE_BYTES: Final = 32
_SIZES: Final[dict[What, tuple[int, int, int, int]]] = {
    "question": (ID_BYTES, _TIME_BYTES, NONCE_BYTES, SIGNATURE_BYTES),
    "answer": (ID_BYTES, 0, 0, SIGNATURE_BYTES),
    "refusal": (ID_BYTES, 0, 0, SIGNATURE_BYTES),
    "notice": (ID_BYTES, 0, 0, SIGNATURE_BYTES),
    "number": (0, 0, NONCE_BYTES, 0),
}
"""Bytes of certificate id, time, nonce and signature. A "number" is what a question has that anybody may ask: nothing
but what its answers are bound to."""
MAX_CHAIN_BYTES: Final = 8192

# Who may say what, by the third chunk of the key: `gnd/v1/<chunk>/…`.
ANSWERED_BY: Final = {
    "tile": "tiles",
    "tiles": "tiles",
    "catalog": "tiles",
    "change": "shard",
    "state": "shard",
}
ASKED_BY: Final = {"change": "vehicle", "state": "vehicle"}
NOTICED_BY: Final = {"update": "shard", "want": "shard"}
"""All other notices have no seal: telemetry is believed by the router's rights alone, lists of the authority have a
signature of their own."""
TO_ONE: Final = frozenset({"want"})
"""Notices to the member whose name is the fourth chunk of the key; all others are for everybody."""
PUBLISHERS: Final = frozenset({"tiles", "shard"})
"""Roles whose certificates everybody asks for."""
OWN_NAME: Final = frozenset({"state"})
"""Keys whose fourth chunk is the name of who asks."""


@dataclass(frozen=True, slots=True)
class Holder:
    """Whom a certificate names, and the key that checks its seals."""

    role: str
    name: str
    owner: str
    certificate_id: bytes
    ends_s: float
    public_key: "EllipticCurvePublicKey" = field(repr=False)

    def __str__(self) -> str:
        return f"{self.role} {self.name}"


@dataclass(frozen=True, slots=True)
class Seal:
    """A seal as it travels.

    Attributes:
        what: kind of message that it belongs to.
        certificate_id: first 8 bytes of the SHA-256 of the signer's certificate (DER).
        time_ms: of a signed question: when it was made, ms since 1970-01-01 UTC; else 0.
        signature: r and s, 32 bytes each.
        nonce: of a question, 8 bytes; else empty.
        count_wanted: of a question about a region: the number of answers is wanted at their end.
        chain: certificates of the signer as DER, each with its length (2 bytes) before it; empty = not sent along.
        share: half of a key (`agreed_keys`), 32 bytes; empty = none is offered.
    """

    what: What
    certificate_id: bytes
    time_ms: int
    signature: bytes
    nonce: bytes = b""
    count_wanted: bool = False
    chain: bytes = b""
    share: bytes = b""

    @property
    def number(self) -> bytes:
        """What the answers to a question are bound to, beside its key and payload."""
        return self.nonce + self.share

    def encode(self) -> bytes:
        """The attachment."""
        flags = _WHAT[self.what] | (_COUNT_WANTED if self.count_wanted else 0)
        flags |= (_WITH_CHAIN if self.chain else 0) | (_WITH_SHARE if self.share else 0)
        time_ms = self.time_ms.to_bytes(_TIME_BYTES, "little") if _SIZES[self.what][1] else b""
        return (
            MARK
            + bytes([flags])
            + self.certificate_id
            + time_ms
            + self.nonce
            + self.signature
            + self.share
            + self.chain
        )

    @classmethod
    def decode(cls, data: bytes) -> "Seal":
        """Reads an attachment.

        Raises:
            SealError: it is no seal, or not whole.
        """
        if not data.startswith(MARK) or len(data) < len(MARK) + 1:
            raise SealError("no seal")
        flags = data[len(MARK)]
        what = _WHAT_OF.get(flags & 0x0F)
        if what is None or flags & ~(0x0F | _COUNT_WANTED | _WITH_CHAIN | _WITH_SHARE):
            raise SealError(f"a seal with flags {flags:#x} is not known")
        share_bytes = SHARE_BYTES if flags & _WITH_SHARE else 0
        ends = list(accumulate((*_SIZES[what], share_bytes), initial=len(MARK) + 1))
        chain = data[ends[-1] :]
        if len(data) < ends[-1] or bool(chain) != bool(flags & _WITH_CHAIN) or len(chain) > MAX_CHAIN_BYTES:
            raise SealError(f"a seal of {len(data)} bytes, {ends[-1]} and at most {MAX_CHAIN_BYTES} more expected")
        certificate_id, time_ms, nonce, signature, share = (data[begin:end] for begin, end in pairwise(ends))
        count_wanted, made_ms = bool(flags & _COUNT_WANTED), int.from_bytes(time_ms, "little")
        return cls(what, certificate_id, made_ms, signature, nonce, count_wanted, chain, share)

    def signed_text(self, key: str, payload: bytes, question: bytes) -> bytes:
        """What is signed: everything but the chain, which proves itself."""
        name = key.encode()
        flags = _WHAT[self.what] | (_COUNT_WANTED if self.count_wanted else 0)
        parts = (
            b"gnd seal 1",
            bytes([flags]),
            self.certificate_id,
            self.time_ms.to_bytes(_TIME_BYTES, "little"),
            len(name).to_bytes(4, "little") + name,
            len(self.nonce).to_bytes(1, "little") + self.nonce,
            len(question).to_bytes(1, "little") + question,
            sha256(payload).digest(),
            self.share,
        )
        return b"".join(parts)


def question_digest(key: str, payload: bytes, number: bytes) -> bytes:
    """What an answer is bound to: the question, with the number that was used once (empty: asked without a seal)."""
    name = key.encode()
    parts = (len(one).to_bytes(4, "little") + one for one in (name, number, payload))
    return sha256(b"gnd question 2" + b"".join(parts)).digest()


def number_of(attachment: bytes) -> bytes:
    """The number that a question was sealed with; empty where there is none."""
    try:
        return Seal.decode(attachment).number
    except SealError:
        return b""


def wants_count(attachment: bytes) -> bool:
    """Whether a sealed question wants the number of its answers."""
    try:
        return Seal.decode(attachment).count_wanted
    except SealError:
        return False


class Signer:
    """Makes seals with the key of one certificate. Safe in several threads.

    Args:
        key: of the certificate, on P-256.
        chain: the certificate and those that lead to the authority, DER.
    """

    def __init__(self, key: "EllipticCurvePrivateKey", chain: tuple[bytes, ...]) -> None:
        self._key = key
        self.certificate_id = certificate_id(chain[0])
        self.chain = b"".join(len(one).to_bytes(2, "little") + one for one in chain)

    def question(self, key: str, payload: bytes, *, count_wanted: bool, with_chain: bool, share: bytes = b"") -> Seal:
        """The seal of a question; one that anybody may ask has a number alone."""
        nonce = secrets.token_bytes(NONCE_BYTES)
        chunks = key.split("/", 3)
        if len(chunks) > 2 and chunks[2] not in ASKED_BY:
            return Seal("number", b"", 0, b"", nonce, count_wanted, share=share)
        chain, time_ms = self.chain if with_chain else b"", time.time_ns() // 1_000_000
        blank = Seal("question", self.certificate_id, time_ms, b"", nonce, count_wanted, chain, share)
        return self._signed(blank, key, payload, b"")

    def answer(self, key: str, payload: bytes, question: bytes, *, refusal: bool = False, share: bytes = b"") -> Seal:
        """The seal of an answer to that question."""
        blank = Seal("refusal" if refusal else "answer", self.certificate_id, 0, b"", share=share)
        return self._signed(blank, key, payload, question)

    def notice(self, key: str, payload: bytes) -> Seal:
        """The seal of a notice."""
        return self._signed(Seal("notice", self.certificate_id, 0, b""), key, payload, b"")

    def _signed(self, blank: Seal, key: str, payload: bytes, question: bytes) -> Seal:
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives.asymmetric import ec, utils

        der = self._key.sign(blank.signed_text(key, payload, question), ec.ECDSA(hashes.SHA256()))
        r, s = utils.decode_dss_signature(der)
        return replace(blank, signature=r.to_bytes(32, "big") + s.to_bytes(32, "big"))


def certificate_id(certificate_der: bytes) -> bytes:
    """How a seal names a certificate."""
    return sha256(certificate_der).digest()[:ID_BYTES]


def check_signature(seal: Seal, holder: Holder, key: str, payload: bytes, question: bytes) -> None:
    """Whether the holder has made this seal for this message.

    Raises:
        SealError: it has not.
    """
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec, utils

    r, s = int.from_bytes(seal.signature[:32], "big"), int.from_bytes(seal.signature[32:], "big")
    text = seal.signed_text(key, payload, question)
    try:
        holder.public_key.verify(utils.encode_dss_signature(r, s), text, ec.ECDSA(hashes.SHA256()))
    except InvalidSignature:
        raise SealError(f"the seal of {holder} does not fit the {seal.what} on {key[:160]}") from None
