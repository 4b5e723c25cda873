"""Answering requests in threads of our own."""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import zenoh

from fleet_bus.connection import Connection
from fleet_bus.envelopes import REPLY_BYTES, REQUEST_BYTES, head_bytes
from fleet_bus.errors import BusClosed, BusError, NotMine, Refused
from fleet_bus.part import Part
from fleet_bus.requesting import END_OF_ANSWERS, FAILED, REFUSED
from fleet_bus.workers import Workers

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Request:
    """A request as its handler sees it: the key expression that was asked, and the payload."""

    key: str
    payload: bytes

    @property
    def is_wild(self) -> bool:
        """Whether the key is a region rather than one key."""
        return "*" in self.key


Answer = bytes | Iterable[tuple[str, bytes]]
Handler = Callable[[Request], Answer]


class Serving(Part):
    """A declared handler; `close` finishes requests in hand and drops waiting ones (their senders ask again)."""

    def __init__(
        self, connection: Connection, keyexpr: str, handler: Handler, *, complete: bool, workers: int, kind: str
    ) -> None:
        super().__init__()
        self._connection, self._handler, self._kind = connection, handler, kind
        self._workers: Workers[zenoh.Query] = Workers(
            f"serve {keyexpr}", self._answer, workers, connection.config.queue_limit
        )
        self._queryable: Any = connection.session.declare_queryable(keyexpr, self._accept, complete=complete)

    def _end(self) -> None:
        self._queryable.undeclare()
        self._workers.close()

    def _accept(self, query: zenoh.Query) -> None:
        # Runs in zenoh's thread: hand over, or say at once that we cannot.
        if not self._workers.offer(query):
            with query:
                limit = self._connection.config.queue_limit
                query.reply_err(f"busy: {limit} requests are waiting", encoding=FAILED)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            try:
                self._reply(query)
            except (NotMine, BusClosed):
                pass  # no reply: another handler gives it, or the asker tries again
            except Refused as refusal:
                query.reply_err(str(refusal), encoding=REFUSED)
            except zenoh.ZError as error:
                _LOG.warning("%s: cannot reply: %s", query.key_expr, error)
            except Exception as error:
                _LOG.exception("handler of %s failed", query.key_expr)
                query.reply_err(f"{type(error).__name__}: {error}", encoding=FAILED)

    def _reply(self, query: zenoh.Query) -> None:
        request = Request(str(query.key_expr), query.payload.to_bytes() if query.payload is not None else b"")
        head = head_bytes(request.key, REQUEST_BYTES)
        self._connection.incoming(request.payload, self._kind, None, head_bytes=head)
        answer = self._handler(request)
        if isinstance(answer, bytes):
            self._send(query, request.key, answer)
            return
        count = 0
        for count, (key, payload) in enumerate(answer, start=1):  # noqa: B007 - the last count is sent below
            self._send(query, key, payload)
        query.reply_err(str(count), encoding=END_OF_ANSWERS)

    def _send(self, query: zenoh.Query, key: str, payload: bytes) -> None:
        if "*" in key:
            raise BusError(f"an answer needs a key without wildcards, got {key}: give (key, payload) pairs")
        self._connection.outgoing(payload, self._kind, None, head_bytes(key, REPLY_BYTES))
        with self._connection.sending():
            query.reply(key, payload)
