"""Notices and signs of life, delivered in one thread of our own each."""

import logging
from collections.abc import Callable
from typing import Any, Final

import zenoh
from zenoh import ext

from gnd.fleet_bus.config import QUEUE_LIMIT
from gnd.fleet_bus.connection import Connection
from gnd.fleet_bus.envelopes import NOTICE_BYTES, attachment_bytes, head_bytes
from gnd.fleet_bus.errors import BusClosed, NoRouter, RequestFailed, SealError
from gnd.fleet_bus.part import Part
from gnd.fleet_bus.workers import Workers
from gnd.gnd_map.tile_id import TileId

_LOG = logging.getLogger(__name__)
# Notices let answers and acknowledgements pass.
NOTICE_LANE: Final = zenoh.Priority.DATA_LOW
OnMessage = Callable[[str, bytes], None]
OnAlive = Callable[[str, bool], None]
TileOf = Callable[[str], TileId | None]


class Subscription(Part):
    """A declared subscription; `close` ends it and throws away what waits for the callback.

    Attributes:
        dropped: how many notices were thrown away because the callback was too slow (they can be read again).
    """

    def __init__(
        self,
        connection: Connection,
        keyexpr: str,
        callback: OnMessage,
        *,
        history: bool,
        kind: str,
        tile_of: TileOf | None,
    ) -> None:
        super().__init__()
        self.dropped = 0
        self._connection, self._callback, self._kind = connection, callback, kind
        self._tile_of = tile_of if tile_of is not None else lambda _key: None
        self._workers: Workers[zenoh.Sample] = Workers(f"subscribe {keyexpr}", self._deliver, 1, QUEUE_LIMIT)
        self.declare(connection, lambda session: _declare(session, keyexpr, self._accept, history=history))

    def _end(self) -> None:
        self.undeclare()
        self._workers.close()

    def _accept(self, sample: zenoh.Sample) -> None:
        if not self._workers.offer_newest(sample):
            self.dropped += 1
            if self.dropped & (self.dropped - 1) == 0:  # 1, 2, 4, 8 …: one line a doubling
                _LOG.warning("slow subscriber: %d notices dropped, the last of %s", self.dropped, sample.key_expr)

    def _deliver(self, sample: zenoh.Sample) -> None:
        key, payload = str(sample.key_expr), sample.payload.to_bytes()
        try:
            head = head_bytes(key, NOTICE_BYTES) + attachment_bytes(sample.attachment)
            self._connection.incoming(payload, self._kind, self._tile_of(key), head_bytes=head)
        except BusClosed:
            return
        if self._connection.sealing is not None and not self._counts(sample, key, payload):
            return
        self._callback(key, payload)

    def _counts(self, sample: zenoh.Sample, key: str, payload: bytes) -> bool:
        """Whether a notice has the seal that is demanded."""
        sealing = self._connection.sealing
        try:
            if sealing is not None:
                sealing.check_notice(key, payload, b"" if sample.attachment is None else sample.attachment.to_bytes())
        except (SealError, RequestFailed, BusClosed) as error:
            if sealing is not None:
                sealing.note_refused(key, error)
            return False
        return True


class AliveWatch(Part):
    """A declared watch for signs of life; `close` ends it."""

    def __init__(self, connection: Connection, keyexpr: str, callback: OnAlive) -> None:
        super().__init__()
        self._callback = callback
        self._workers: Workers[zenoh.Sample] = Workers(f"alive {keyexpr}", self._deliver, 1, 1 << 20)
        self.declare(
            connection,
            lambda session: session.liveliness().declare_subscriber(keyexpr, self._workers.offer, history=True),
        )

    def _end(self) -> None:
        self.undeclare()
        self._workers.close()

    def _deliver(self, sample: zenoh.Sample) -> None:
        self._callback(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)


class AliveToken(Part):
    """A sign of life of this session; `close` takes it back, which watchers see."""

    def __init__(self, connection: Connection, key: str) -> None:
        super().__init__()
        self.declare(connection, lambda session: session.liveliness().declare_token(key))

    def _end(self) -> None:
        self.undeclare()


class RecallingPublisher(Part):
    """Publishes on one key and repeats its last notices to those who come late or missed some.

    The memory dies with the publisher: subscribers still compare the catalog.
    """

    def __init__(self, connection: Connection, key: str, *, kind: str, remember: int) -> None:
        super().__init__()
        self._connection, self._key, self._kind = connection, key, kind
        self.declare(
            connection,
            lambda session: ext.declare_advanced_publisher(
                session,
                key,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=NOTICE_LANE,
                cache=ext.CacheConfig(max_samples=remember),
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
                publisher_detection=True,
            ),
        )

    def put(self, payload: bytes, *, tile: TileId | str | None = None) -> None:
        """Publishes; without a router the notice is remembered and fetched by subscribers after the reconnection.

        Raises:
            NoRouter: there has not been one yet.
            MessageTooLarge, BusClosed.
        """
        if self.declared is None:
            raise NoRouter(f"no router until now: {len(payload)} bytes for {self._key} were not published")
        seal = seal_of_notice(self._connection, self._key, payload)
        head = head_bytes(self._key, NOTICE_BYTES) + attachment_bytes(seal)
        self._connection.outgoing(payload, self._kind, tile, head)
        with self._connection.sending():
            self.declared.put(payload, attachment=seal)

    def _end(self) -> None:
        self.undeclare()


def publish(
    connection: Connection, key: str, payload: bytes, *, kind: str, tile: TileId | str | None, wait_s: float
) -> None:
    """Puts a notice; see `Bus.publish`."""
    connection.check_open()
    # A put without a router is silent, so look first.
    if not connection.wait_connected(wait_s):
        where = ", ".join(connection.config.connect)
        raise NoRouter(f"no router at {where} for {wait_s:g} s: {len(payload)} bytes for {key} were not published")
    seal = seal_of_notice(connection, key, payload)
    connection.outgoing(payload, kind, tile, head_bytes(key, NOTICE_BYTES) + attachment_bytes(seal))
    with connection.sending() as session:
        session.put(
            key, payload, attachment=seal, congestion_control=zenoh.CongestionControl.BLOCK, priority=NOTICE_LANE
        )


def seal_of_notice(connection: Connection, key: str, payload: bytes) -> bytes | None:
    """The seal of a notice; None without an identity."""
    return None if connection.sealing is None else connection.sealing.notice(key, payload)


def _declare(session: zenoh.Session, keyexpr: str, accept: Callable[[zenoh.Sample], Any], *, history: bool) -> Any:
    if not history:
        return session.declare_subscriber(keyexpr, accept)
    return ext.declare_advanced_subscriber(
        session,
        keyexpr,
        accept,
        history=ext.HistoryConfig(detect_late_publishers=True),
        recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
    )
