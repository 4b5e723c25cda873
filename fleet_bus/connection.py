"""The open session behind a bus: state that all its parts share."""

import logging
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Self

import zenoh

from gnd.fleet_bus.config import MAX_MESSAGE_BYTES, BusConfig, zenoh_config
from gnd.fleet_bus.envelopes import RECORD_BYTES
from gnd.fleet_bus.errors import BusClosed, BusConfigError, MessageTooLarge, NoRouter, PortInUse
from gnd.fleet_bus.ledger import Ledger, Share, SharesOf
from gnd.fleet_bus.pacer import Pacer
from gnd.fleet_bus.sealing import Sealing
from gnd.fleet_bus.wire import WireMeter
from gnd.gnd_map.tile_id import TileId

if TYPE_CHECKING:  # a process without an identity loads nothing of it
    from gnd.fleet_bus.identity.renewal import CertificateWatch

_LOG = logging.getLogger(__name__)
_POLL_S: Final = 0.02
_CLOSE_S: Final = 1.0
_FIRST_WAIT_S: Final = 0.05
_LONGEST_WAIT_S: Final = 1.0
_SAY_S: Final = 60.0
_TURNED_AWAY_S: Final = 2.0
"""A connection that ends so soon after it began was turned away."""
_TURNED_AWAY: Final = 3
"""So many of them in a row are told of."""

Declare = Callable[[zenoh.Session], None]


class Connection:
    """A zenoh session with its pacer, its ledger and its wire meter.

    Everything sent or received passes `outgoing` or `incoming`, which check, pace and account for it.
    """

    def __init__(self, config: BusConfig, ledger: Ledger | None, name: str) -> None:
        self.config, self.ledger, self.name = config, ledger, name
        self._session: zenoh.Session | None = None
        self._declarations: list[Declare] = []
        self._opening = threading.RLock()
        self.closed = threading.Event()
        seals = config.identity is not None and config.mode == "client"  # a router only passes on
        self.sealing = Sealing.of_folder(config.identity) if seals and config.identity is not None else None
        self.meter = WireMeter(config.transmit_timeout_ms)
        self._pacer = Pacer(config.link_profile, self.closed)
        self._record_bytes = RECORD_BYTES if config.identity is not None and _is_tls(config.connect) else 0
        self._pid = os.getpid()
        self._calls = 0
        self._idle = threading.Condition()
        self._began_s, self._turned_away, self._told_s = 0.0, 0, -math.inf
        self.certificate: CertificateWatch | None = None
        if ledger is not None:
            ledger.begin(config.link_profile)

    @classmethod
    def open(cls, config: BusConfig, ledger: Ledger | None, name: str) -> Self:
        """Opens a session, trying again until `open_timeout_s` has passed; a patient one goes on in a thread.

        Raises:
            NoRouter: nothing answers there.
            PortInUse: an endpoint to listen at is taken.
            BusConfigError: zenoh refuses the configuration.
        """
        connection = cls(config, ledger, name)
        connection._watch_certificate()
        deadline_s = time.monotonic() + (0.0 if config.patient else config.open_timeout_s)
        wait_s = _FIRST_WAIT_S
        while not connection._try_open():
            if time.monotonic() + wait_s > deadline_s and not config.patient:
                where, why = ", ".join(config.connect), connection._why()
                connection.close()
                raise NoRouter(f"no router at {where} for {config.open_timeout_s:g} s: {why}")
            if config.patient:
                threading.Thread(target=connection._keep_trying, name=f"open {name}", daemon=True).start()
                break
            time.sleep(wait_s)
            wait_s = min(_LONGEST_WAIT_S, wait_s * 1.5)
        return connection

    def _keep_trying(self) -> None:
        """For a patient connection: look for a router for as long as it takes, and say so now and then."""
        began_s, wait_s, where = time.monotonic(), _FIRST_WAIT_S, ", ".join(self.config.connect)
        said_s = -math.inf
        while not self.closed.wait(wait_s):
            if self._try_open():
                _LOG.info("%s: found the router at %s after %.1f s", self.name, where, time.monotonic() - began_s)
                return
            if time.monotonic() - said_s >= _SAY_S:
                said_s = time.monotonic()
                _LOG.warning(
                    "%s: no router at %s for %.1f s, waiting for it: %s",
                    self.name,
                    where,
                    said_s - began_s,
                    self._why(),
                )
            wait_s = min(_LONGEST_WAIT_S, wait_s * 1.5)

    def _watch_certificate(self) -> None:
        """For a client over TLS: take a renewed certificate as soon as it lies in the folder."""
        if self.config.identity is None or self.config.mode == "router" or not _is_tls(self.config.connect):
            return
        from gnd.fleet_bus.identity.renewal import CertificateWatch

        name = self.name or "session"
        self.certificate = CertificateWatch(self.config.identity, lambda _new: self._connect_anew(), name)

    def _connect_anew(self) -> None:
        """Ends the connection in a moment in which nothing is being sent: zenoh makes another, with the new files."""
        if self.sealing is not None and self.config.identity is not None:
            self.sealing.renew(self.config.identity)
        with self._idle:
            self._idle.wait_for(lambda: self._calls == 0, _CLOSE_S)
            self.meter.cut()

    def _why(self) -> str:
        """What keeps a router from being reached, as far as it can be found out."""
        if self.config.identity is not None and _is_tls(self.config.connect):
            from gnd.fleet_bus.identity.cause import why_not

            causes = {one: why_not(one, self.config.identity) for one in self.config.connect if _is_tls((one,))}
            found = [f"{cause} ({one})" for one, cause in causes.items() if cause]
            if found:
                return "; ".join(found)
        return "start one with `gnd router`"

    def _try_open(self) -> bool:
        """One attempt; False when no router answers."""
        try:
            session = zenoh.open(zenoh_config(self.config))
        except zenoh.ZError as error:
            _raise_if_final(error, self.config)
            return False
        with self._opening:
            if self.closed.is_set():
                session.close()  # type: ignore[no-untyped-call]  # zenoh's stub
                return True
            if self.config.mode == "client":  # a router carries everybody's bytes, and needs its descriptors for them
                self._links = session.info.declare_link_events_listener(self._on_link)
                for link in session.info.links():  # now: the first event may come after the first message
                    self.meter.attach(link.src, link.dst)
            self._session = session
            for declare in self._declarations:
                declare(session)
            self._declarations.clear()
        return True

    def when_open(self, declare: Declare) -> None:
        """Declares something as soon as there is a session, that is now unless it is patient; a lost router is told
        again by zenoh.
        """
        with self._opening:
            if self._session is None:
                self._declarations.append(declare)
            else:
                declare(self._session)

    @property
    def session(self) -> zenoh.Session:
        """The open session.

        Raises:
            NoRouter: a patient one that has not found a router yet.
        """
        if self._session is None:
            raise NoRouter(f"no router at {', '.join(self.config.connect)} until now")
        return self._session

    def check_open(self) -> None:
        """Raises `BusClosed` when the bus was closed, or belongs to the parent of a fork."""
        if self.closed.is_set():
            raise BusClosed(f"bus {self.name or 'session'} is closed")
        if os.getpid() != self._pid:
            raise BusClosed(f"bus {self.name or 'session'} was opened in process {self._pid}: open one after the fork")

    def outgoing(self, payload: bytes, kind: str, tile: TileId | str | None, head_bytes: int = 0) -> None:
        """Checks, paces and accounts for a message that is about to be sent; `head_bytes` are its key and envelope.

        Raises:
            MessageTooLarge: the receiver would drop it.
            BusClosed: closed before or while waiting.
        """
        self.check_open()
        if len(payload) > MAX_MESSAGE_BYTES:
            raise MessageTooLarge(f"a {kind} message has {len(payload)} bytes, the limit is {MAX_MESSAGE_BYTES}")
        self._pacer.wait("up", len(payload))
        if self.ledger is not None:
            self.ledger.record("up", kind, len(payload), tile, head_bytes=head_bytes + self._record_bytes)

    def incoming(
        self,
        payload: bytes,
        kind: str,
        tile: TileId | str | None,
        shares_of: SharesOf | None = None,
        *,
        head_bytes: int = 0,
        asked_at_s: float | None = None,
    ) -> None:
        """Paces and accounts for a message that has been received, by its shares where it is about several things.

        Args:
            payload: the message.
            kind: ledger kind.
            tile: the tile it is about, if it is about one.
            shares_of: how it is booked otherwise.
            head_bytes: its key and envelope, bytes.
            asked_at_s: when it was asked for, by the monotonic clock, s.

        Raises:
            BusClosed: closed before or while waiting.
        """
        self.check_open()
        self._pacer.wait("down", len(payload))
        if self.ledger is None:
            return
        shares = shares_of(payload) if shares_of is not None else ()
        took_s = None if asked_at_s is None else time.monotonic() - asked_at_s
        shares = shares or (Share(kind, len(payload), tile),)
        head_bytes += self._record_bytes * (1 if asked_at_s is None else 2)  # the end of an answer has one of its own
        self.ledger.record_shares("down", shares, head_bytes=head_bytes, took_s=took_s)

    @contextmanager
    def sending(self) -> Iterator[zenoh.Session]:
        """The session, for one call that sends; `close` waits for such calls, or cuts their link.

        Raises:
            BusClosed: closed before, or so late meanwhile that its link had to be cut.
        """
        with self._idle:
            self.check_open()
            self._calls += 1
        try:
            yield self.session
        except zenoh.ZError:
            self.check_open()
            raise
        finally:
            with self._idle:
                self._calls -= 1
                self._idle.notify_all()

    def is_connected(self) -> bool:
        """Whether a router is at the other end right now."""
        session = self._session
        return session is not None and not session.is_closed() and bool(session.info.routers_zid())

    def wait_connected(self, timeout_s: float) -> bool:
        """Waits for a router to be there; False when the time is over.

        Raises:
            BusClosed: closed while waiting.
        """
        deadline_s = time.monotonic() + timeout_s
        while not self.is_connected():
            if time.monotonic() >= deadline_s:
                return False
            if self.closed.wait(_POLL_S):
                raise BusClosed(f"bus {self.name or 'session'} was closed while it waited for a router")
        return True

    def close(self) -> None:
        """Ends the session and every waiting call; the wire meter keeps its total."""
        self.closed.set()
        if self.certificate is not None:
            self.certificate.close()
        if not self._wait_idle():
            # Calls wait for a stalled link and would hold the session open: cut the link off.
            self.meter.cut()
            self._wait_idle()
        with self._opening:
            session = self._session
        if session is not None:
            try:
                session.close()  # type: ignore[no-untyped-call]  # zenoh's stub
            except zenoh.ZError as error:
                _LOG.warning("%s: session not closed cleanly: %s", self.name, error)
        self.meter.close()

    def _wait_idle(self) -> bool:
        with self._idle:
            return self._idle.wait_for(lambda: self._calls == 0, _CLOSE_S)

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        link = event.link
        if event.kind == zenoh.SampleKind.PUT:
            self._began_s = time.monotonic()
            self.meter.attach(link.src, link.dst)
        else:
            self.meter.detach(link.src, link.dst)
            self._note_end(link.dst)
        _LOG.debug("%s: link %s -> %s %s", self.name, link.src, link.dst, event.kind)

    def _note_end(self, router: str) -> None:
        """Tells of a router that ends every connection at once: TLS succeeds there, so nothing else would say why."""
        now_s = time.monotonic()
        self._turned_away = self._turned_away + 1 if now_s - self._began_s < _TURNED_AWAY_S else 0
        if self.certificate is None or self._turned_away < _TURNED_AWAY or now_s - self._told_s < _SAY_S:
            return
        self._told_s, own = now_s, self.certificate.identity.member.common_name
        _LOG.warning("%s: %s ends each connection of %s at once: is it revoked there?", self.name, router, own)


def _is_tls(endpoints: tuple[str, ...]) -> bool:
    return any(endpoint.startswith("tls/") for endpoint in endpoints)


def _raise_if_final(error: zenoh.ZError, config: BusConfig) -> None:
    """Raises what the error means for the user, unless another try may help."""
    text = str(error)
    if "Address already in use" in text:
        where = ", ".join(config.listen)
        raise PortInUse(
            f"cannot listen at {where}: port in use; stop that process or choose another with --listen"
        ) from error
    if "nable to connect" not in text:
        raise BusConfigError(f"zenoh cannot open a session: {text}") from error
