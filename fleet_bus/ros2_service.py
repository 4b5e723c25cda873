"""A service of ROS 2 without ROS: requests come as zenoh queries, as rmw_zenoh's clients send them.

The request is the payload of a query on the service's key, and the answer goes back with the client's number and name
beside it, by which the client finds whose answer it is. Source: rmw_zenoh_cpp/src/detail/rmw_service_data.cpp and
rmw_client_data.cpp, docs/design.md.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import zenoh

from gnd.fleet_bus.connection import Connection
from gnd.fleet_bus.errors import BusClosed, Refused
from gnd.fleet_bus.part import Part
from gnd.fleet_bus.ros2_attachments import RosAttachment
from gnd.fleet_bus.workers import Workers

RosHandler = Callable[[bytes], bytes]
"""The answer to a request, both CDR. `Refused`: the request is wrong, the client is told why."""
REQUESTS_WAITING: Final = 256
_WORKERS: Final = 2
_LOG = logging.getLogger(__name__)
_Asked = tuple[str, zenoh.Query]


class RosService(Part):
    """A service that is served; made by `RosNode.serve`.

    Args:
        connection: session on which it is asked.
        name: of the service.
        keys: at which it is asked.
        handler: gives the answers; it is called in threads of our own, several at a time.

    Attributes:
        name: of the service.
        answered: requests that got an answer.
        refused: requests that got an error.
    """

    def __init__(self, connection: Connection, name: str, keys: tuple[str, ...], handler: RosHandler) -> None:
        super().__init__()
        self.name, self.answered, self.refused = name, 0, 0
        self._connection, self._handler = connection, handler
        self._workers: Workers[_Asked] = Workers(f"ros2 {name}", self._answer, _WORKERS, REQUESTS_WAITING)
        self._queryables: list[Part] = [_Queryable(connection, key, self._accept) for key in keys]

    def _accept(self, key: str, query: zenoh.Query) -> None:
        # Runs in zenoh's thread: hand over, or say at once that we cannot.
        if not self._workers.offer((key, query)):
            with query:
                self._refuse(query, f"busy: {REQUESTS_WAITING} requests are waiting")

    def _answer(self, asked: _Asked) -> None:
        key, query = asked
        with query:
            try:
                self._reply(key, query)
                self.answered += 1
            except BusClosed:
                pass
            except Refused as refusal:
                self._refuse(query, str(refusal))
            except Exception as error:
                _LOG.exception("%s: no answer", self.name)
                self._refuse(query, f"{type(error).__name__}: {error}")

    def _reply(self, key: str, query: zenoh.Query) -> None:
        beside = b"" if query.attachment is None else query.attachment.to_bytes()
        client = RosAttachment.decode(beside)
        if client is None:
            raise Refused(f"{len(beside)} bytes beside the request do not tell its number, time and client")
        request = b"" if query.payload is None else query.payload.to_bytes()
        self._connection.incoming(request, "control", None)
        answer = self._handler(request)
        self._connection.outgoing(answer, "control", None)
        with self._connection.sending():
            query.reply(key, answer, attachment=replace(client, sent_ns=time.time_ns()).encode())

    def _refuse(self, query: zenoh.Query, why: str) -> None:
        self.refused += 1
        _LOG.warning("%s: refused: %s", self.name, why)
        try:
            query.reply_err(why)
        except zenoh.ZError as error:
            _LOG.warning("%s: the client cannot be told: %s", self.name, error)

    def _end(self) -> None:
        for queryable in self._queryables:
            queryable.close()
        self._workers.close()


class _Queryable(Part):
    """One key of a service. Complete: rmw_zenoh's clients ask only who answers for the whole key."""

    def __init__(self, connection: Connection, key: str, accept: Callable[[str, zenoh.Query], None]) -> None:
        super().__init__()
        self.declare(
            connection,
            lambda session: session.declare_queryable(key, lambda query: accept(key, query), complete=True),
        )

    def _end(self) -> None:
        self.undeclare()
