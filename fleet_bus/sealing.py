"""The seals of one session: what it says is sealed; of what it hears only that counts which the right part has sealed.

A part with an identity demands seals by the tables of `seals`; a part without one neither makes nor looks at any.
"""

import contextlib
import logging
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from gnd.fleet_bus.agreed_keys import AgreedKey, GrantedKeys, HeldKeys, KeyHalf, under_terse
from gnd.fleet_bus.errors import BusError, ClocksDiffer, NotMine, SealError
from gnd.fleet_bus.seal_keys import KnownCertificates, certificates_of, holder_of, load_authority, load_signer
from gnd.fleet_bus.seals import (
    ANSWERED_BY,
    ASKED_BY,
    MARK,
    NOTICED_BY,
    OWN_NAME,
    TO_ONE,
    Holder,
    Seal,
    Signer,
    check_signature,
    question_digest,
)
from gnd.fleet_bus.short_seals import ShortSeal, TerseSeal, is_short, is_terse

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


class SignatureWanted(SealError):
    """A question with a short seal that does not count here: the asker signs the next attempt."""


@dataclass(frozen=True, slots=True)
class SealedQuestion:
    """A question as it goes out.

    Attributes:
        attachment: its seal.
        digest: what its answers must be bound to.
        agreed: the key of a short seal; None = the question is signed, or has a number alone.
        half: of a key that it offers; None = none.
    """

    attachment: bytes
    digest: bytes
    agreed: AgreedKey | None = None
    half: KeyHalf | None = None


@dataclass(frozen=True, slots=True)
class HeardQuestion:
    """A question that counts.

    Attributes:
        asker: who asks, where that matters.
        digest: what the answers are to be bound to.
        agreed: the key of its short seal, by which it is answered; None = the answer is signed.
        share: half of a key that it offers.
    """

    asker: Holder | None
    digest: bytes
    agreed: AgreedKey | None = None
    share: bytes = b""

    @property
    def binds(self) -> bool:
        """Whether who asks checks that an answer is to this question, and does without what the answer says of that."""
        return self.agreed is not None and self.agreed.is_terse


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
        self._held, self._granted = HeldKeys(), GrantedKeys()

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
        self._held.clear()  # they are bound to the certificate before
        self._granted.clear()

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

    def question(
        self, key: str, payload: bytes, *, count_wanted: bool, with_chain: bool, short: bool = True
    ) -> SealedQuestion:
        """Seal a question.

        Args:
            key: that is asked.
            payload: of the question.
            count_wanted: the number of answers is wanted at their end: several parts may answer.
            with_chain: send the own certificates along.
            short: a short seal will do, where there is a key for it.
        """
        role, half = None if count_wanted else ANSWERED_BY.get(_chunk(key, 2)), None
        if role is not None and short:
            agreed = self._held.to_use(key, role)
            if agreed is not None and self._is_good(agreed):
                seal = agreed.question(key, payload, is_bare=_chunk(key, 2) not in ASKED_BY)
                return SealedQuestion(agreed.written(seal), question_digest(key, payload, seal.head), agreed)
        if role is not None and self._held.may_offer(role):
            half = KeyHalf.make()
        signed = self._signer.question(
            key, payload, count_wanted=count_wanted, with_chain=with_chain, share=b"" if half is None else half.share
        )
        return SealedQuestion(signed.encode(), question_digest(key, payload, signed.number), None, half)

    def answer(self, key: str, payload: bytes, heard: HeardQuestion, *, refusal: bool = False) -> bytes:
        """Seal an answer: in short where the question was; else signed, with half of a key if one was offered."""
        if heard.agreed is not None:
            return heard.agreed.written(heard.agreed.answer(key, payload, heard.digest, refusal=refusal))
        share = b""
        if heard.share and not refusal:
            share = self._granted.grant(heard.share, heard.digest, self.own, heard.asker)
        return self._signer.answer(key, payload, heard.digest, refusal=refusal, share=share).encode()

    def notice(self, key: str, payload: bytes) -> bytes | None:
        """Seal a notice: signed, but for one to a single member with whom there is a key; None where nobody looks."""
        if _chunk(key, 2) not in NOTICED_BY:
            return None
        agreed = self._granted.of_name(_chunk(key, 3)) if _chunk(key, 2) in TO_ONE else None
        if agreed is not None and self._is_good(agreed):
            return agreed.written(agreed.notice(key, payload))
        return self._signer.notice(key, payload).encode()

    def ended(self, key: str, sealed: SealedQuestion, *, signature_wanted: bool) -> None:
        """A question has got all its answers. `signature_wanted`: who answers there has no use for its key."""
        if sealed.half is not None:
            self._held.offer_ended(ANSWERED_BY.get(_chunk(key, 2), ""))
        if sealed.agreed is not None and signature_wanted:
            self._held.forget(key, sealed.agreed)

    def check_question(self, key: str, payload: bytes, attachment: bytes, handler: int = 0) -> HeardQuestion:
        """Who asks, where that matters, and what the answers are to be bound to.

        Args:
            key: that was asked.
            payload: of the question.
            attachment: with its seal.
            handler: number of who answers: a question may reach several handlers of a session, each once.

        Raises:
            CertificateWanted: the certificate is not known here.
            SignatureWanted: its short seal does not count.
            ClocksDiffer: it does not count now.
            SealError: the question does not count.
        """
        if is_short(attachment):
            try:
                return self._check_short_question(key, payload, attachment, handler)
            except SealError as error:
                raise SignatureWanted(str(error)) from None
        wanted = ASKED_BY.get(_chunk(key, 2))
        if wanted is None and not attachment.startswith(MARK):
            return HeardQuestion(None, question_digest(key, payload, b""))
        seal = Seal.decode(attachment)
        digest = question_digest(key, payload, seal.number)
        if seal.what not in ("question", "number") or (wanted is not None and seal.what == "number"):
            raise SealError(f"the seal of a {seal.what} on a question")
        if wanted is None:
            return HeardQuestion(None, digest, share=seal.share)
        if abs(time.time() - seal.time_ms / 1000) > MOST_SKEW_S:
            raise ClocksDiffer(
                f"a question that was sealed {time.time() - seal.time_ms / 1000:.0f} s ago, the limit is"
                f" {MOST_SKEW_S:.0f} s: check the vehicle's clock, and that of {self.own}"
            )
        holder = self._certificates.learn(seal.chain) if seal.chain else self._certificates.holder(seal.certificate_id)
        if holder is None:
            raise CertificateWanted("certificate wanted")
        self._check(seal, holder, wanted, key, payload, b"")
        self._note_nonce(seal.certificate_id + seal.nonce + handler.to_bytes(8, "little"))
        return HeardQuestion(holder, digest, share=seal.share)

    def _check_short_question(self, key: str, payload: bytes, attachment: bytes, handler: int) -> HeardQuestion:
        """As `check_question`; SealError where a signature would say more."""
        wanted = ASKED_BY.get(_chunk(key, 2))
        if is_terse(attachment):
            terse = TerseSeal.decode(attachment)
            of_key = under_terse(self._granted.find_alike(terse.terse_id), terse, "question", key, payload)
            seal = of_key.in_full(terse, "question")
        else:
            seal = ShortSeal.decode(attachment)
        agreed = self._granted.find(seal.key_id) if seal.what == "question" else None
        if agreed is None or (wanted is not None and agreed.other is None):
            raise SealError(f"the short seal of a {seal.what} under a key that is not known here")
        agreed.check_question(seal, key, payload, handler, is_bare=wanted is None)
        if agreed.other is not None:
            self._check_end(agreed, wanted or agreed.other.role, key)
        asker = None if wanted is None else agreed.other
        return HeardQuestion(asker, question_digest(key, payload, seal.head), agreed)

    def check_answer(self, asked: str, key: str, payload: bytes, attachment: bytes, sealed: SealedQuestion) -> bool:
        """Whether an answer to a question on `asked` is a refusal; it counts if this returns.

        Raises:
            SealError: it does not count.
        """
        wanted = ANSWERED_BY.get(_chunk(asked, 2))
        if wanted is None:
            return False
        if sealed.agreed is not None:  # a short question is too short to bind a signature to
            return self._check_short_answer(asked, key, payload, attachment, sealed)
        seal = Seal.decode(attachment)
        if seal.what not in ("answer", "refusal"):
            raise SealError(f"the seal of a {seal.what} on an answer")
        holder = self._holder(seal)
        self._check(seal, holder, wanted, key, payload, sealed.digest)
        if sealed.half is not None:
            self._agree(asked, holder, seal, sealed, sealed.half)
        return seal.what == "refusal"

    def _check_short_answer(
        self, asked: str, key: str, payload: bytes, attachment: bytes, sealed: SealedQuestion
    ) -> bool:
        agreed = sealed.agreed
        if agreed is None or agreed.other is None:
            raise SealError("a short seal on the answer to a question that was signed")
        seal = agreed.answer_seal(attachment)
        if seal.what not in ("answer", "refusal"):
            raise SealError(f"the short seal of a {seal.what} on an answer")
        agreed.check_answer(seal, key, payload, sealed.digest)
        self._check_end(agreed, ANSWERED_BY[_chunk(asked, 2)], key)
        self._held.answered(asked, agreed.other)
        return seal.what == "refusal"

    def _agree(self, asked: str, part: Holder, seal: Seal, sealed: SealedQuestion, half: KeyHalf) -> None:
        """Take the half of a key that an answer has brought; one that cannot be used only leaves things as they are."""
        if not seal.share:
            self._held.answered(asked, part)
            return
        asks = self.own if _chunk(asked, 2) in ASKED_BY else None
        with contextlib.suppress(SealError):
            self._held.add(asked, half.agree(seal.share, sealed.digest, part, asks, is_asker=True))

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
        if is_short(attachment):
            self._check_short_notice(wanted, key, payload, attachment)
            return
        seal = Seal.decode(attachment)
        if seal.what != "notice":
            raise SealError(f"the seal of a {seal.what} on a notice")
        self._check(seal, self._holder(seal), wanted, key, payload, b"")

    def _check_short_notice(self, wanted: str, key: str, payload: bytes, attachment: bytes) -> None:
        if is_terse(attachment):
            terse = TerseSeal.decode(attachment)
            of_key = under_terse(self._held.find_alike(terse.terse_id), terse, "notice", key, payload)
            seal = of_key.in_full(terse, "notice")
        else:
            seal = ShortSeal.decode(attachment)
        if seal.what != "notice" or _chunk(key, 2) not in TO_ONE:
            raise SealError(f"the short seal of a {seal.what} on a notice")
        agreed = self._held.find(seal.key_id)
        if agreed is None:
            raise SealError("a notice under a key that is not known here")
        agreed.check_notice(seal, key, payload)
        self._check_end(agreed, wanted, key)

    def _is_good(self, agreed: AgreedKey) -> bool:
        """Whether the certificate of who has the other half still counts."""
        try:
            return agreed.other is not None and self._certificates.holder(agreed.other.certificate_id) is not None
        except SealError:
            return False

    def _check_end(self, agreed: AgreedKey, role: str, key: str) -> None:
        """Whether who has the other half of a key may say this."""
        holder = None if agreed.other is None else self._certificates.holder(agreed.other.certificate_id)
        if holder is None:
            raise SealError("a short seal of somebody whose certificate is not known any more")
        self._check_role(holder, role, key)

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
        self._check_role(holder, role, key)
        check_signature(seal, holder, key, payload, digest)

    @staticmethod
    def _check_role(holder: Holder, role: str, key: str) -> None:
        if holder.role != role:
            raise SealError(f"{holder} has sealed what a part in role {role} says")
        if _chunk(key, 2) in OWN_NAME and role == "vehicle" and _chunk(key, 3) != holder.name:
            raise SealError(f"{holder} speaks on the key of {_chunk(key, 3)[:80]}")

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
