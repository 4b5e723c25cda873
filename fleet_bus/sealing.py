"""The seals of one session: what it says is sealed; of what it hears only that counts which the right part has sealed.

A part with an identity demands seals by the tables of `seals`; a part without one neither makes nor looks at any.
"""

import logging
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from gnd.fleet_bus.errors import BusError, NotMine, SealError
from gnd.fleet_bus.seal_keys import KnownCertificates, certificates_of, holder_of, load_authority, load_signer
from gnd.fleet_bus.seals import (
    ANSWERED_BY,
    ASKED_BY,
    MARK,
    NOTICED_BY,
    OWN_NAME,
    Holder,
    Seal,
    Signer,
    check_signature,
    question_digest,
)

if TYPE_CHECKING:
    from gnd.fleet_bus.serving import Request

_LOG = logging.getLogger(__name__)
MOST_SKEW_S: Final = 600.0
"""So far the clocks of who asks and who answers may differ; a question that is older was kept by somebody."""
NONCES: Final = 65_536
ASK_AGAIN_S: Final = 5.0
"""A certificate that nobody has shown is asked for again after this time."""
SAY_S: Final = 60.0
CERTIFICATE_ROOT: Final = "gnd/v1/certificate"
Fetch = Callable[[str], bytes]


class CertificateWanted(SealError):
    """A question whose certificate is not known here: the asker sends it along with the next attempt."""


@dataclass(frozen=True, slots=True)
class SealedQuestion:
    """A question as it goes out: its attachment, and what its answers must be bound to."""

    attachment: bytes
    digest: bytes


class Sealing:
    """Makes and checks the seals of a session. Safe in several threads.

    Args:
        signer: of this part.
        certificates: of others.
        own: whom the own certificate names.

    Attributes:
        refused: how many messages were thrown away, by reason.
    """

    def __init__(self, signer: Signer, certificates: KnownCertificates, own: Holder) -> None:
        self.own, self.refused = own, Counter[str]()
        self.fetch: Fetch | None = None
        self._signers: tuple[Signer, ...] = (signer,)
        self._certificates = certificates
        self._lock = threading.Lock()
        self._nonces: OrderedDict[bytes, float] = OrderedDict()
        self._in_vain: dict[bytes, float] = {}
        self._said_s = -SAY_S

    @classmethod
    def of_folder(cls, folder: Path) -> Self:
        """From an identity folder. Whether its certificate is good is for others to say: they are told by whom.

        Raises:
            IdentityError: a file is missing or cannot be read.
            SealError: the certificate names no part of a fleet.
        """
        signer = load_signer(folder)
        return cls(signer, load_authority(folder), holder_of(certificates_of(signer.chain)[0]))

    def renew(self, folder: Path) -> None:
        """Sign with the certificate that lies in the folder now; errors as `of_folder`."""
        signer = load_signer(folder)
        self.own = holder_of(certificates_of(signer.chain)[0])
        self._signers = (signer, *self._signers[:1])

    @property
    def _signer(self) -> Signer:
        return self._signers[0]

    def answer_certificate(self, request: "Request") -> bytes:
        """The own certificates, to who asks for them by id; those of the certificate before the last renewal, too.

        Raises:
            NotMine: another part's.
        """
        for signer in self._signers:
            if _chunk(request.key, 3) == signer.certificate_id.hex():
                return signer.chain
        raise NotMine

    def question(self, key: str, payload: bytes, *, count_wanted: bool, with_chain: bool) -> SealedQuestion:
        """Seal a question."""
        seal = self._signer.question(key, payload, count_wanted=count_wanted, with_chain=with_chain)
        return SealedQuestion(seal.encode(), question_digest(key, payload, seal.nonce))

    def answer(self, key: str, payload: bytes, digest: bytes, *, refusal: bool = False) -> bytes:
        """Seal an answer."""
        return self._signer.answer(key, payload, digest, refusal=refusal).encode()

    def notice(self, key: str, payload: bytes) -> bytes:
        """Seal a notice."""
        return self._signer.notice(key, payload).encode()

    def check_question(
        self, key: str, payload: bytes, attachment: bytes, handler: int = 0
    ) -> tuple[Holder | None, bytes]:
        """Who asks, where that matters, and what the answers are to be bound to.

        Args:
            key: that was asked.
            payload: of the question.
            attachment: with its seal.
            handler: number of who answers: a question may reach several handlers of a session, each once.

        Raises:
            CertificateWanted: the certificate is not known here.
            SealError: the question does not count.
        """
        wanted = ASKED_BY.get(_chunk(key, 2))
        if wanted is None and not attachment.startswith(MARK):
            return None, question_digest(key, payload, b"")
        seal = Seal.decode(attachment)
        digest = question_digest(key, payload, seal.nonce)
        if wanted is None and seal.what == "number":
            return None, digest
        if seal.what != "question":
            raise SealError(f"the seal of a {seal.what} on a question")
        if wanted is None:
            return None, digest
        if abs(time.time() - seal.time_ms / 1000) > MOST_SKEW_S:
            raise SealError(
                f"a question that was sealed {time.time() - seal.time_ms / 1000:.0f} s ago, the limit is"
                f" {MOST_SKEW_S:.0f} s: check the vehicle's clock"
            )
        holder = self._certificates.learn(seal.chain) if seal.chain else self._certificates.holder(seal.certificate_id)
        if holder is None:
            raise CertificateWanted("certificate wanted")
        self._check(seal, holder, wanted, key, payload, b"")
        self._note_nonce(seal.certificate_id + seal.nonce + handler.to_bytes(8, "little"))
        return holder, digest

    def check_answer(self, asked: str, key: str, payload: bytes, attachment: bytes, digest: bytes) -> bool:
        """Whether an answer to a question on `asked` is a refusal; it counts if this returns.

        Raises:
            SealError: it does not count.
        """
        wanted = ANSWERED_BY.get(_chunk(asked, 2))
        if wanted is None:
            return False
        seal = Seal.decode(attachment)
        if seal.what not in ("answer", "refusal"):
            raise SealError(f"the seal of a {seal.what} on an answer")
        self._check(seal, self._holder(seal), wanted, key, payload, digest)
        return seal.what == "refusal"

    def answers_are_bare(self, asked: str) -> bool:
        """Whether anybody may answer a question on this key."""
        return _chunk(asked, 2) not in ANSWERED_BY

    def check_notice(self, key: str, payload: bytes, attachment: bytes) -> None:
        """Whether a notice counts.

        Raises:
            SealError: it does not.
        """
        wanted = NOTICED_BY.get(_chunk(key, 2))
        if wanted is None:
            return
        seal = Seal.decode(attachment)
        if seal.what != "notice":
            raise SealError(f"the seal of a {seal.what} on a notice")
        self._check(seal, self._holder(seal), wanted, key, payload, b"")

    def note_refused(self, key: str, error: BusError) -> None:
        """Count a message that was thrown away, and say so once a minute."""
        with self._lock:
            self.refused[_chunk(key, 2)] += 1
            if time.monotonic() - self._said_s < SAY_S:
                return
            self._said_s = time.monotonic()
            total = sum(self.refused.values())
        _LOG.warning("%s: %d messages without a good seal until now, the last on %s: %s", self.own, total, key, error)

    def _check(self, seal: Seal, holder: Holder, role: str, key: str, payload: bytes, digest: bytes) -> None:
        if holder.role != role:
            raise SealError(f"{holder} has sealed what a part in role {role} says")
        if _chunk(key, 2) in OWN_NAME and role == "vehicle" and _chunk(key, 3) != holder.name:
            raise SealError(f"{holder} speaks on the key of {_chunk(key, 3)[:80]}")
        check_signature(seal, holder, key, payload, digest)

    def _holder(self, seal: Seal) -> Holder:
        """Whom the certificate of an answer or a notice names; one that is not known is asked for."""
        holder = self._certificates.holder(seal.certificate_id)
        if holder is not None:
            return holder
        now_s = time.monotonic()
        with self._lock:
            if self._in_vain.get(seal.certificate_id, 0.0) > now_s or self.fetch is None:
                raise SealError(f"the certificate {seal.certificate_id.hex()} is not known")
            self._in_vain = {one: until_s for one, until_s in self._in_vain.items() if until_s > now_s}
            if len(self._in_vain) >= 16:  # somebody invents certificates: no more questions for a while
                raise SealError(f"{len(self._in_vain)} certificates that nobody shows")
            self._in_vain[seal.certificate_id] = now_s + ASK_AGAIN_S
        holder = self._certificates.learn(self.fetch(f"{CERTIFICATE_ROOT}/{seal.certificate_id.hex()}"))
        if holder.certificate_id != seal.certificate_id:
            raise SealError(f"asked for certificate {seal.certificate_id.hex()}, got that of {holder}")
        with self._lock:
            self._in_vain.pop(seal.certificate_id, None)
        return holder

    def _note_nonce(self, nonce: bytes) -> None:
        """A question counts once: who keeps it and asks it again is told nothing."""
        now_s = time.monotonic()
        with self._lock:
            while self._nonces and (
                len(self._nonces) >= NONCES or next(iter(self._nonces.values())) < now_s - 2 * MOST_SKEW_S
            ):
                self._nonces.popitem(last=False)
            if nonce in self._nonces:
                raise SealError("a question that was asked before: somebody repeats it")
            self._nonces[nonce] = now_s


def _chunk(key: str, number: int) -> str:
    chunks = key.split("/", number + 1)
    return chunks[number] if len(chunks) > number else ""
