"""The bus as the rest of the project sees it: the only door to zenoh."""

import threading
from typing import TYPE_CHECKING, Final, Self, TypeVar

from gnd.fleet_bus import leftovers, requesting, subscribing
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.connection import Connection
from gnd.fleet_bus.ledger import Ledger, SharesOf
from gnd.fleet_bus.part import Part
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.fleet_bus.sealing import CERTIFICATE_ROOT
from gnd.fleet_bus.seals import PUBLISHERS
from gnd.fleet_bus.serving import Concerns, Handler, Serving, TurnOf
from gnd.fleet_bus.subscribing import (
    AliveToken,
    AliveWatch,
    OnAlive,
    OnMessage,
    RecallingPublisher,
    Subscription,
    TileOf,
)
from gnd.fleet_bus.wire import WireBytes
from gnd.gnd_map.tile_id import TileId

if TYPE_CHECKING:
    from gnd.fleet_bus.identity.renewal import CertificateWatch

_DEFAULT_RETRY = RetryPolicy()
CERTIFICATE_S: Final = 5.0
"""So long a certificate is asked for."""
PUBLISH_WAIT_S: Final = 10.0
"""So long a notice waits for a lost router to come back."""


_P = TypeVar("_P", bound=Part)


def open_bus(config: BusConfig | None = None, ledger: Ledger | None = None, name: str = "") -> "Bus":
    """Joins the bus; use it in a `with` block.

    Args:
        config: settings; by default a client of a router on this machine.
        ledger: account in which every message of this session is booked.
        name: for logs and errors.

    Raises:
        NoRouter: nothing answers within `open_timeout_s`.
        BusConfigError: a rule that protects data is broken.
        PortInUse: an endpoint to listen at is taken.
    """
    bus = Bus(Connection.open(config or BusConfig(), ledger, name))
    sealing = bus.connection.sealing
    if sealing is not None:
        sealing.fetch = lambda key: bus.request(key, b"", kind="control", timeout_s=CERTIFICATE_S)
        if sealing.own.role in PUBLISHERS:  # vehicles send theirs along
            bus.serve(f"{CERTIFICATE_ROOT}/*", sealing.answer_certificate, kind="control")
    return bus


class Bus:
    """One session. Methods may be called from any thread; every waiting call ends when the bus is closed."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._parts: list[Part] = []
        self._lock = threading.Lock()
        leftovers.remember(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    @property
    def config(self) -> BusConfig:
        """The settings of this session."""
        return self._connection.config

    @property
    def connection(self) -> Connection:
        """The session, for other parts of this package."""
        return self._connection

    @property
    def ledger(self) -> Ledger | None:
        """The account of this session."""
        return self._connection.ledger

    def request(
        self,
        key: str,
        payload: bytes,
        *,
        kind: str,
        tile: TileId | str | None = None,
        retry: RetryPolicy = _DEFAULT_RETRY,
        timeout_s: float = 30.0,
        shares_of: SharesOf | None = None,
    ) -> bytes:
        """Asks until answered. The request may arrive more than once: it must be idempotent.

        Args:
            key: key expression of `gnd.schemas.keys`.
            payload: encoded message.
            kind: ledger kind.
            tile: the tile it is about, for the ledger.
            retry: pauses between the attempts.
            timeout_s: deadline of the whole, s.
            shares_of: how an answer that is about several things is booked; none = as `kind` and `tile`.

        Returns:
            Payload of the first answer that is ok.

        Raises:
            RequestFailed: no answer before the deadline, with the number of attempts and the last cause.
            RequestRefused: the handler raised `Refused`.
            MessageTooLarge: payload over the limit.
            BusClosed: closed meanwhile.
        """
        return requesting.request(
            self._connection,
            key,
            payload,
            kind=kind,
            tile=tile,
            retry=retry,
            timeout_s=timeout_s,
            shares_of=shares_of,
        )

    def request_many(
        self,
        keyexpr: str,
        payload: bytes,
        *,
        kind: str,
        retry: RetryPolicy = _DEFAULT_RETRY,
        timeout_s: float = 60.0,
    ) -> list[tuple[str, bytes]]:
        """Asks a region until all handlers that answer have come to their end.

        Returns:
            (key, payload) of every answer; empty when the handlers have nothing there.

        Raises:
            RequestFailed, RequestRefused, MessageTooLarge, BusClosed: as `request`.
        """
        return requesting.request_many(self._connection, keyexpr, payload, kind=kind, retry=retry, timeout_s=timeout_s)

    def serve(
        self,
        keyexpr: str,
        handler: Handler,
        *,
        complete: bool = False,
        workers: int = 4,
        kind: str = "control",
        beside: Serving | None = None,
        turn_of: TurnOf | None = None,
        concerns: Concerns | None = None,
    ) -> Serving:
        """Answers requests in threads of our own, so that a handler may itself ask, wait or compute.

        Args:
            keyexpr: keys that are served.
            handler: gives bytes (one answer on the asked key) or (key, payload) pairs (answers to a region, which are
                given by one thread of their own, at `serving.REGION_BYTE_S`). It may
                raise `NotMine` (no reply), `Refused` (never ask again), `Busy` (ask again later); any other exception
                makes the asker try again.
            complete: whether this handler alone answers for all these keys; the router then asks no other.
            workers: number of threads.
            kind: ledger kind of requests and answers.
            beside: a handler that lives longer: its threads answer, and `workers` is not looked at.
            turn_of: whose a request is, of its key and payload: askers are served in turn; None: by key.
            concerns: whether a question is one for this handler, of its key and payload, asked before its seal is
                looked at; None: each is.
        """
        self._connection.check_open()
        serving = Serving(
            self._connection,
            keyexpr,
            handler,
            complete=complete,
            workers=workers,
            kind=kind,
            beside=beside,
            turn_of=turn_of,
            concerns=concerns,
        )
        return self.keep(serving)

    def publish(
        self, key: str, payload: bytes, *, kind: str, tile: TileId | str | None = None, wait_s: float = PUBLISH_WAIT_S
    ) -> None:
        """Publishes a notice that its receivers can also read again: delivery is not confirmed.

        The own link is waited for, and a lost router. A router drops the notice for subscribers that do not keep up.

        Args:
            key: key expression of `gnd.schemas.keys`.
            payload: encoded message.
            kind: ledger kind.
            tile: the tile it is about, for the ledger.
            wait_s: how long to wait for a router, s.

        Raises:
            NoRouter: there was none, so nothing was published.
            MessageTooLarge, BusClosed.
        """
        subscribing.publish(self._connection, key, payload, kind=kind, tile=tile, wait_s=wait_s)

    def advanced_publisher(self, key: str, *, kind: str = "update", remember: int = 1) -> RecallingPublisher:
        """A publisher of one key that repeats its last `remember` notices to late or interrupted subscribers."""
        self._connection.check_open()
        return self.keep(RecallingPublisher(self._connection, key, kind=kind, remember=remember))

    def subscribe(
        self,
        keyexpr: str,
        callback: OnMessage,
        *,
        history: bool = False,
        kind: str = "update",
        tile_of: TileOf | None = None,
    ) -> Subscription:
        """Calls back with (key, payload) for every notice, in order, in one thread of our own.

        The routers learn of the subscription a moment later: compare with what was there (the catalog) after that.

        Args:
            keyexpr: keys of interest; whole chunks as wildcards.
            callback: what it raises is logged and the next notice delivered.
            history: also get what advanced publishers remember, and what was missed during an interruption.
            kind: ledger kind.
            tile_of: tile of a key, for the ledger.
        """
        self._connection.check_open()
        return self.keep(Subscription(self._connection, keyexpr, callback, history=history, kind=kind, tile_of=tile_of))

    def declare_alive(self, key: str) -> AliveToken:
        """Shows that this process lives, until closed, killed or cut off for longer than the lease."""
        self._connection.check_open()
        return self.keep(AliveToken(self._connection, key))

    def watch_alive(self, keyexpr: str, callback: OnAlive) -> AliveWatch:
        """Calls back with (key, True) for each token present or new and (key, False) for each that goes.

        All go when the own connection is lost, and come again with it.
        """
        self._connection.check_open()
        return self.keep(AliveWatch(self._connection, keyexpr, callback))

    def wire(self) -> WireBytes:
        """Bytes on the wire of this session so far, over all its connections; also noted in the ledger."""
        wire = self._connection.meter.read()
        if self.ledger is not None:
            self.ledger.record_wire(wire)
        return wire

    @property
    def binds_answers(self) -> bool:
        """Whether an answer that `request` gives is proven to be one to that question, where its kind is sealed."""
        return self._connection.sealing is not None

    @property
    def connections(self) -> int:
        """How many connections to a router there have been: more than before = notices were missed (Linux)."""
        return self._connection.meter.read().connections

    def neighbours(self) -> list[str]:
        """What is connected to this session right now: "client", "router" or "peer" for each."""
        return [str(transport.whatami) for transport in self._connection.session.info.transports()]

    def is_connected(self) -> bool:
        """Whether a router is at the other end right now; a lost one is looked for without being asked."""
        return self._connection.is_connected()

    def wait_connected(self, timeout_s: float) -> bool:
        """Waits for a router; False when there is none in time. Raises `BusClosed` when closed meanwhile."""
        return self._connection.wait_connected(timeout_s)

    @property
    def certificate(self) -> "CertificateWatch | None":
        """The certificate that this session shows, None without TLS."""
        return self._connection.certificate

    @property
    def is_closed(self) -> bool:
        """Whether `close` was called."""
        return self._connection.closed.is_set()

    def close(self) -> None:
        """Ends handlers, subscriptions, waiting calls and the session, then writes the ledger. May be called again."""
        with self._lock:
            parts, self._parts = self._parts[::-1], []
            if self._connection.closed.is_set():
                return
            self._connection.closed.set()
        self._connection.meter.close_from_now()
        for part in parts:
            part.close()
        self._connection.close()
        leftovers.forget(self)
        if self.ledger is not None:
            self.wire()
            self.ledger.flush()

    def keep(self, part: _P) -> _P:
        """Close a part of this session with it."""
        with self._lock:
            self._parts = [other for other in self._parts if not other.is_closed]
            self._parts.append(part)
        return part
