"""Requests that arrive: a query with payload, sent again until it is answered.

Only `reply.ok` is an answer. No handler, a denied key, a handler that raised or was killed, a router that went away:
zenoh reports all of them as an empty list of replies, so each of them is tried again until the deadline. Requests must
therefore be idempotent.
"""

import itertools
import queue
import random
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import zenoh

from gnd.fleet_bus.connection import Connection
from gnd.fleet_bus.envelopes import REPLY_BYTES, REQUEST_BYTES, attachment_bytes, head_bytes
from gnd.fleet_bus.errors import BusClosed, BusConfigError, RequestFailed, RequestRefused, SealError
from gnd.fleet_bus.ledger import SharesOf
from gnd.fleet_bus.sealing import SealedQuestion
from gnd.gnd_map.tile_id import TileId

END_OF_ANSWERS: Final = "gnd/end"
"""Encoding of the closing reply of a handler that gives many answers; its payload is their number in decimal."""
COUNT_WANTED: Final = b"gnd/end"
"""Attachment of a question about a region whose asker wants that closing reply."""
REFUSED: Final = "gnd/refused"
"""Encoding of a reply that says: do not ask again."""
CERTIFICATE_WANTED: Final = "gnd/certificate"
"""Encoding of a reply that says: ask again at once, with your certificate."""
SIGNATURE_WANTED: Final = "gnd/sign"
"""Encoding of a reply that says: ask again at once, signed; your short seal does not count here."""
FAILED: Final = "gnd/failed"
"""Encoding of a reply that says: the handler failed, ask again."""
BUSY: Final = "gnd/busy"
"""Encoding of a reply that says: not now. Its payload is "<milliseconds to wait>;<why>"."""
LONGEST_BUSY_S: Final = 60.0
"""A longer wait is not believed: who answers falsely shall not silence a vehicle for long."""
BUSY_SPREAD: Final = 1.5
"""Who was told to wait waits up to so many times as long, at random: a fleet does not come back in step."""

RETURN_SPREAD_S: Final = 0.4
"""Questions that have waited for a router go out within so long after it is found, at random: all who have lost a
router find it again at the same time."""

_REPLY_KIND: Final = {"change": "ack"}
# Questions about the map are short and urgent; they and their answers pass reports and acknowledgements.
_LANE: Final = dict.fromkeys(("tile", "delta", "catalog"), zenoh.Priority.DATA_HIGH)
_POLL_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """When a request is sent again.

    Attributes:
        first_wait_s: pause before the second attempt, s.
        factor: by which the pause grows.
        longest_wait_s: bound of the pause, s; up to half is taken off at random, lest a fleet knock in step.
        attempt_timeout_s: how long one attempt may take, s.
    """

    first_wait_s: float = 0.05
    factor: float = 2.0
    longest_wait_s: float = 2.0
    attempt_timeout_s: float = 10.0

    def __post_init__(self) -> None:
        if min(self.first_wait_s, self.longest_wait_s, self.attempt_timeout_s) <= 0 or self.factor < 1:
            raise BusConfigError(f"times must be positive and factor at least 1: {self}")

    def wait_s(self, attempt: int) -> float:
        """Pause after that attempt (counted from 1), s."""
        longest_s = min(self.longest_wait_s, self.first_wait_s * self.factor ** min(attempt - 1, 60))
        return longest_s * random.uniform(0.5, 1.0)


@dataclass(slots=True)
class RequestAnswers:
    """What one attempt brought back."""

    ok: list[tuple[str, bytes]] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    refusal: str | None = None
    announced: int | None = None
    certificate_wanted: bool = False
    signature_wanted: bool = False
    retry_after_s: float = 0.0

    def add_error(self, error: zenoh.ReplyError, *, final: bool = True) -> None:
        """Sorts a reply that is not an answer; `final`: a refusal is believed."""
        encoding, text = str(error.encoding), error.payload.to_bytes().decode(errors="replace")
        if encoding == END_OF_ANSWERS:
            self.announced = (self.announced or 0) + int(text)
        elif encoding == REFUSED and final:
            self.refusal = text
        elif encoding == CERTIFICATE_WANTED:
            self.certificate_wanted = True
            self.errors.append(text)
        elif encoding == SIGNATURE_WANTED:
            self.signature_wanted = True
            self.errors.append("a signature is wanted")
        elif encoding == BUSY:
            wait_s, why = _busy_of(text)
            self.retry_after_s = max(self.retry_after_s, wait_s)
            self.errors.append(f"busy: {why} (retry after {wait_s:g} s)")
        else:
            self.errors.append(text)

    @property
    def is_whole(self) -> bool:
        """Whether every handler that began to answer also came to its end."""
        return self.announced is not None and self.announced == len(self.ok)

    def cause(self) -> str:
        """Why this was no answer, in words."""
        if self.errors:
            return "; ".join(self.errors)
        if self.ok:
            return f"only {len(self.ok)} of {self.announced or 'an unknown number of'} answers came"
        return "empty reply: nobody serves this key now, or the handler died"


def busy_text(retry_after_s: float, why: str) -> str:
    """Payload of a reply in encoding `BUSY`."""
    return f"{max(1, round(1000 * retry_after_s))};{why}"


def _busy_of(text: str) -> tuple[float, str]:
    """Seconds to wait and why; of what makes no sense nothing to wait."""
    number, _, why = text.partition(";")
    is_number = number.isascii() and number.isdigit() and len(number) < 19
    return (min(int(number) / 1000, LONGEST_BUSY_S) if is_number else 0.0), why


def request(
    connection: Connection,
    key: str,
    payload: bytes,
    *,
    kind: str,
    tile: TileId | str | None,
    retry: RetryPolicy,
    timeout_s: float,
    shares_of: SharesOf | None = None,
) -> bytes:
    """The first answer to an idempotent request; see `Bus.request`."""
    asking = _Asking(connection, key, payload, kind, tile, shares_of)
    answers = asking.until(lambda got: bool(got.ok), retry, timeout_s, first_only=True)
    return answers.ok[0][1]


def request_many(
    connection: Connection, key: str, payload: bytes, *, kind: str, retry: RetryPolicy, timeout_s: float
) -> list[tuple[str, bytes]]:
    """All answers to an idempotent request; see `Bus.request_many`."""
    asking = _Asking(connection, key, payload, kind, None)
    return asking.until(lambda got: got.is_whole, retry, timeout_s, first_only=False).ok


@dataclass(frozen=True, slots=True)
class _Asking:
    connection: Connection
    key: str
    payload: bytes
    kind: str
    tile: TileId | str | None
    shares_of: SharesOf | None = None

    def until(
        self, good: Callable[[RequestAnswers], bool], retry: RetryPolicy, timeout_s: float, *, first_only: bool
    ) -> RequestAnswers:
        """Sends the request again and again until the answers are good.

        Raises:
            RequestFailed, RequestRefused, BusClosed.
        """
        deadline_s, with_chain, short = time.monotonic() + timeout_s, False, True
        cause = ""
        for attempt in itertools.count(1):
            left_s = max(deadline_s - time.monotonic(), 0.001)
            answers = self._once(
                min(left_s, retry.attempt_timeout_s), first_only=first_only, with_chain=with_chain, short=short
            )
            if good(answers):
                return answers
            if answers.errors or answers.ok:  # a last attempt cut short by the deadline often brings back nothing
                cause = answers.cause()
            was_short, short = short, short and bool(answers.retry_after_s)
            if answers.signature_wanted and was_short:
                continue
            if answers.certificate_wanted and not with_chain:
                with_chain = True
                continue
            if answers.refusal is not None:
                raise RequestRefused(self.key, attempt, f"refused: {answers.refusal}")
            wait_s = max(retry.wait_s(attempt), answers.retry_after_s * random.uniform(1.0, BUSY_SPREAD))
            if time.monotonic() + wait_s >= deadline_s:
                cause = f"{cause or answers.cause()} (gave up after {timeout_s:g} s)"
                raise RequestFailed(self.key, attempt, cause, answers.retry_after_s)
            if self.connection.closed.wait(wait_s):
                raise BusClosed(f"the bus was closed while asking {self.key} for the {attempt + 1}th time")
        raise AssertionError("unreachable")

    def _once(self, timeout_s: float, *, first_only: bool, with_chain: bool, short: bool) -> RequestAnswers:
        connection = self.connection
        connection.check_open()
        was_connected = connection.is_connected()
        if not connection.wait_connected(timeout_s):  # nothing would be sent, so nothing is paced nor booked
            return RequestAnswers(errors=[f"no router at {', '.join(connection.config.connect)}"])
        if not was_connected and connection.closed.wait(random.uniform(0.0, min(RETURN_SPREAD_S, timeout_s / 2))):
            raise BusClosed(f"the bus was closed while asking {self.key}")
        asked_at_s = time.monotonic()
        attachment, sealed = None if first_only else COUNT_WANTED, None
        if connection.sealing is not None:
            sealed = connection.sealing.question(
                self.key, self.payload, count_wanted=not first_only, with_chain=with_chain, short=short
            )
            attachment = sealed.attachment
        head = head_bytes(self.key, REQUEST_BYTES) + attachment_bytes(attachment)
        connection.outgoing(self.payload, self.kind, self.tile, head)
        inbox: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()
        cancel = zenoh.CancellationToken()
        with connection.sending() as session:
            session.get(
                self.key,
                zenoh.handlers.Callback(inbox.put, lambda: inbox.put(None)),
                payload=self.payload,
                timeout=timeout_s,
                # Answers pass at once and one by one; the default would hold all back until the last has come.
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.BLOCK,
                attachment=attachment,
                priority=_LANE.get(self.kind, zenoh.Priority.DATA),
                cancellation_token=cancel,
            )
        try:
            answers = self._collect(inbox, asked_at_s, sealed, first_only=first_only)
        finally:
            cancel.cancel()  # type: ignore[no-untyped-call]  # zenoh's stub
        if sealed is not None and connection.sealing is not None:
            connection.sealing.ended(self.key, sealed, signature_wanted=answers.signature_wanted)
        return answers

    def _collect(
        self,
        inbox: "queue.SimpleQueue[zenoh.Reply | None]",
        asked_at_s: float,
        sealed: SealedQuestion | None,
        *,
        first_only: bool,
    ) -> RequestAnswers:
        answers = RequestAnswers()
        while (reply := self._receive(inbox)) is not None:
            if reply.ok is None:
                if reply.err is not None:
                    answers.add_error(reply.err, final=self._is_believed_bare())
                continue
            key, payload = str(reply.ok.key_expr), reply.ok.payload.to_bytes()
            self.connection.incoming(
                payload,
                _REPLY_KIND.get(self.kind, self.kind),
                self.tile,
                self.shares_of,
                head_bytes=head_bytes(key, REPLY_BYTES) + attachment_bytes(reply.ok.attachment),
                asked_at_s=asked_at_s,
            )
            if self._counts(reply.ok, key, payload, sealed, answers):
                answers.ok.append((key, payload))
            if first_only and (answers.ok or answers.refusal is not None):
                break
        return answers

    def _is_believed_bare(self) -> bool:
        """Whether an error without a seal may end the request."""
        return self.connection.sealing is None or self.connection.sealing.answers_are_bare(self.key)

    def _counts(
        self, sample: zenoh.Sample, key: str, payload: bytes, sealed: SealedQuestion | None, answers: RequestAnswers
    ) -> bool:
        """Whether an answer is one; notes a refusal, and what has no good seal."""
        sealing = self.connection.sealing
        if sealing is None or sealed is None:
            return True
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        try:
            if not sealing.check_answer(self.key, key, payload, attachment, sealed):
                return True
            answers.refusal = payload.decode(errors="replace")
        except SealError as error:
            sealing.note_refused(self.key, error)
            answers.errors.append(str(error))
        return False

    def _receive(self, inbox: "queue.SimpleQueue[zenoh.Reply | None]") -> zenoh.Reply | None:
        while True:
            self.connection.check_open()
            try:
                return inbox.get(timeout=_POLL_S)
            except queue.Empty:
                continue
