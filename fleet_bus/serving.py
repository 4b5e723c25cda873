"""Answering requests in threads of our own."""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Final

import zenoh

from gnd.fleet_bus.config import QUEUE_LIMIT
from gnd.fleet_bus.connection import Connection
from gnd.fleet_bus.envelopes import REPLY_BYTES, REQUEST_BYTES, attachment_bytes, head_bytes
from gnd.fleet_bus.errors import BusClosed, BusError, Busy, ClocksDiffer, NotMine, Refused, SealError
from gnd.fleet_bus.part import Part
from gnd.fleet_bus.refusals import counted
from gnd.fleet_bus.requesting import (
    BUSY,
    CERTIFICATE_WANTED,
    COUNT_WANTED,
    END_OF_ANSWERS,
    FAILED,
    REFUSED,
    SIGNATURE_WANTED,
    busy_text,
)
from gnd.fleet_bus.sealing import CertificateWanted, HeardQuestion, SignatureWanted
from gnd.fleet_bus.seals import MARK, Holder, number_of, question_digest, wants_count
from gnd.fleet_bus.seldom import Seldom
from gnd.fleet_bus.short_seals import is_short
from gnd.fleet_bus.turns import InTurn

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Request:
    """A request as its handler sees it: the key expression that was asked, and the payload.

    `asker` is who has sealed it, where seals are demanded and it matters who asks; else None. `binds`: who asks checks
    that an answer is to this question, so that the answer need not say so.
    """

    key: str
    payload: bytes
    asker: Holder | None = None
    binds: bool = False

    @property
    def is_wild(self) -> bool:
        """Whether the key is a region rather than one key."""
        return "*" in self.key


Answer = bytes | Iterable[tuple[str, bytes]]
Handler = Callable[[Request], Answer]


TurnOf = Callable[[str, bytes], str]
"""Whose a request is, of its key and payload: called in zenoh's thread, so it has to be short."""

Concerns = Callable[[str, bytes], bool]
"""Whether a question is one to answer here, of its key and payload."""

REGIONS_WAITING: Final = 64
FULL_RETRY_S: Final = 1.0
"""Who finds a full mailbox is to ask again after so long."""
CLOCK_RETRY_S: Final = 10.0
"""Whose seal or certificate does not count by the clock of here is to ask again after so long: each time costs it the
whole message, and somebody has to set a clock."""
# Answers to a region leave no faster, so that they do not fill the queue of an asker with an ordinary link.
REGION_BYTE_S: Final = 8_000_000


_Asked = tuple["Serving", zenoh.Query]
_FAILURES = Seldom(_LOG)


def _answer(asked: _Asked) -> None:
    serving, query = asked
    serving.answer(query)


class Serving(Part):
    """A declared handler; `close` finishes requests in hand and drops waiting ones (their senders ask again).

    Questions about regions have one thread and a short mailbox of their own: nobody who asks for one thing waits for
    somebody who asks for everything. One that serves `beside` another has the threads and the mailbox of that one.
    Within a mailbox askers are served in turn, as `turn_of` tells them apart: by their keys, if nothing else is said.
    What does not concern it, it says nothing to, not even that a seal does not count here.
    """

    def __init__(
        self,
        connection: Connection,
        keyexpr: str,
        handler: Handler,
        *,
        complete: bool,
        workers: int,
        kind: str,
        beside: "Serving | None" = None,
        turn_of: TurnOf | None = None,
        concerns: Concerns | None = None,
    ) -> None:
        super().__init__()
        self._turn_of, self._concerns = turn_of or _key_of, concerns
        self._is_retired = False
        self._connection, self._handler, self._kind = connection, handler, kind
        self._own: list[InTurn[_Asked]] = []
        if beside is None:
            self._own.append(InTurn(f"serve {keyexpr}", _answer, workers, QUEUE_LIMIT))
        self._workers: InTurn[_Asked] = self._own[0] if beside is None else beside._workers
        self._regions: InTurn[_Asked] = self._workers if beside is None else beside._regions
        if "*" in keyexpr and beside is None:
            self._regions = InTurn(f"regions {keyexpr}", _answer, 1, REGIONS_WAITING)
            self._own.append(self._regions)
        self.declare(connection, lambda session: session.declare_queryable(keyexpr, self._accept, complete=complete))

    def retire(self) -> None:
        """Hear nothing more; what has come is answered, until `close`."""
        if self.declared is None:
            self.close()
        elif not self._is_retired:
            self._is_retired = True
            self.undeclare()

    def _end(self) -> None:
        if not self._is_retired:
            self.undeclare()
        for workers in self._own:
            workers.close()

    def _accept(self, query: zenoh.Query) -> None:
        # Runs in zenoh's thread: hand over, or say at once that we cannot.
        key = str(query.key_expr)
        payload = query.payload.to_bytes() if query.payload is not None else b""
        workers = self._regions if "*" in key else self._workers
        for _, without_room in workers.offer(self._turn_of(key, payload), len(payload), (self, query)):
            with without_room:
                _say_busy(without_room, Busy(f"{workers.limit} requests are waiting", FULL_RETRY_S, "mailbox"))

    def answer(self, query: zenoh.Query) -> None:
        """Answer one query, in the caller's thread."""
        with query:
            try:
                self._reply(query)
            except (NotMine, BusClosed):
                pass  # no reply: another handler gives it, or the asker tries again
            except CertificateWanted as error:
                query.reply_err(str(error), encoding=CERTIFICATE_WANTED)
            except SignatureWanted:
                query.reply_err(b"", encoding=SIGNATURE_WANTED)
            except Busy as busy:
                _say_busy(query, busy)
            except Refused as refusal:  # while a region's answers were made
                counted("refused", self._kind)
                query.reply_err(str(refusal), encoding=REFUSED)
            except zenoh.ZError as error:
                _FAILURES.warning("%s: cannot reply: %s", query.key_expr, error)
            except Exception as error:
                _FAILURES.exception("handler of %s failed", query.key_expr)
                query.reply_err(f"{type(error).__name__}: {error}", encoding=FAILED)

    def _reply(self, query: zenoh.Query) -> None:
        key, payload = str(query.key_expr), query.payload.to_bytes() if query.payload is not None else b""
        if self._concerns is not None and not self._concerns(key, payload):
            raise NotMine
        attachment = query.attachment.to_bytes() if query.attachment is not None else b""
        head = head_bytes(key, REQUEST_BYTES) + attachment_bytes(query.attachment)
        self._connection.incoming(payload, self._kind, None, head_bytes=head)
        try:
            heard = self._heard(key, payload, attachment)
        except (CertificateWanted, SignatureWanted):
            raise
        except SealError as error:
            heard = HeardQuestion(None, question_digest(key, payload, number_of(attachment)))
            self._refuse(query, key, str(error), heard, attachment)
            return
        request = Request(key, payload, heard.asker, heard.binds)
        try:
            answer = self._handler(request)
        except Refused as refusal:
            self._refuse(query, key, str(refusal), heard, attachment)
            return
        if isinstance(answer, bytes):
            self._send(query, request.key, answer, heard, is_all=True)
            return
        heard = replace(heard, share=b"")
        count = 0
        for count, (key, payload) in enumerate(answer, start=1):  # noqa: B007 - the last count is sent below
            self._send(query, key, payload, heard)
            self._connection.closed.wait(len(payload) / REGION_BYTE_S)
        # To a program that knows only zenoh an error would mean that its question had failed.
        if attachment == COUNT_WANTED or wants_count(attachment):
            query.reply_err(str(count), encoding=END_OF_ANSWERS)

    def _heard(self, key: str, payload: bytes, attachment: bytes) -> HeardQuestion:
        """Who asks, where seals are demanded.

        Raises:
            CertificateWanted, SignatureWanted: another attempt may count.
            Busy: it may count later.
            SealError: it does not count.
        """
        sealing = self._connection.sealing
        if sealing is None:
            return HeardQuestion(None, b"")
        try:
            return sealing.check_question(key, payload, attachment, id(self))
        except CertificateWanted:
            raise
        except SealError as error:
            sealing.note_refused(key, error)
            if isinstance(error, ClocksDiffer):  # refused for good, a report would be given up by its vehicle
                _FAILURES.warning("%s is to be asked again: %s", key, error)
                raise Busy(str(error), CLOCK_RETRY_S, "clock") from None
            raise

    def _refuse(self, query: zenoh.Query, key: str, why: str, heard: HeardQuestion, attachment: bytes) -> None:
        """Say that there will be no answer, sealed to who looks at seals."""
        counted("refused", self._kind)
        sealing = self._connection.sealing
        if sealing is None or "*" in key or not (attachment.startswith(MARK) or is_short(attachment)):
            query.reply_err(why, encoding=REFUSED)
            return
        payload = why.encode()
        seal = sealing.answer(key, payload, heard, refusal=True)
        self._connection.outgoing(payload, self._kind, None, head_bytes(key, REPLY_BYTES) + attachment_bytes(seal))
        with self._connection.sending():
            query.reply(key, payload, attachment=seal)

    def _send(
        self, query: zenoh.Query, key: str, payload: bytes, heard: HeardQuestion, *, is_all: bool = False
    ) -> None:
        if "*" in key:
            raise BusError(f"an answer needs a key without wildcards, got {key}: give (key, payload) pairs")
        sealing = self._connection.sealing
        seal = None if sealing is None else sealing.answer(key, payload, heard)
        self._connection.outgoing(payload, self._kind, None, head_bytes(key, REPLY_BYTES) + attachment_bytes(seal))
        with self._connection.sending():
            query.reply(key, payload, attachment=seal)
            if is_all:  # at once: the end then mostly shares a packet, and a record of TLS, with the answer
                query.drop()  # type: ignore[no-untyped-call]  # zenoh's stub


def _say_busy(query: zenoh.Query, busy: Busy) -> None:
    counted("busy", busy.reason)
    query.reply_err(busy_text(busy.retry_after_s, str(busy)), encoding=BUSY)


def _key_of(key: str, _payload: bytes) -> str:
    return key
