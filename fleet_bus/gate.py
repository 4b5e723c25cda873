"""A router that lets in who belongs: rights by the list of members, the revoked cut off, all without a restart.

zenoh reads its access control and its certificate once, when a session is opened. So a change opens another router
session in this process, which takes over the listening ports, while the old one keeps the connections that it has and
is linked with the new one over a Unix socket: nobody is interrupted, and who comes, comes to the new rights. A revoked
member is cut off by its sockets; its listening ports are closed before, so that it finds no way back to the old rights.
(Linux: sockets are found in /proc.)

While two sessions link up, zenoh (1.10) may lose what a client declares at one of them: nobody at the other would ever
reach it. So the new session listens only when its links have settled, and who connected shortly before connects anew.

A router that links with others does so in a session of its own, the trunk, which listens at a Unix socket alone: a list
that adds vehicles leaves these links as they are. A list that adds or revokes routers opens another trunk.
"""

import contextlib
import logging
import shutil
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Self

import zenoh

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusConfigError, IdentityError
from gnd.fleet_bus.guard import USUAL_LIMITS, Address, ConnectionGuard, address
from gnd.fleet_bus.identity.folder import MEMBERS, MemberIdentity
from gnd.fleet_bus.identity.following import take_revoked
from gnd.fleet_bus.identity.lists import MemberList, replace_file
from gnd.fleet_bus.identity.names import MemberName
from gnd.fleet_bus.identity.renewal import CertificateWatch
from gnd.fleet_bus.rights import AUTHORITY_KEYS, access_control
from gnd.fleet_bus.router_links import LINK_OPEN_S, RouterLinks
from gnd.fleet_bus.sockets import Ends, address_of, cut, is_listening, stop_listening
from gnd.fleet_bus.subscribing import OnMessage

LOOK_S: Final = 0.5
"""How often the list of members and the links are looked at."""
GENERATIONS: Final = 3
"""So many router sessions keep their clients; those of an older one are sent to the newest."""
_SETTLE_S: Final = 0.5
"""From a link between sessions to its use: zenoh computes its routes 0.1 s after the link has come."""
FRESH_LOOKS: Final = 4
"""Who has come since so many looks may not have declared everything yet."""
_AFTER_THE_HUB_S: Final = 2.5
"""All linked routers hear of a list at once. Sessions that link up on both sides of a link at one time may not find
each other: a hub is done after so long, then those that link with it begin."""
_TAKEN_OVER_S: Final = 5.0
_POLL_S: Final = 0.01
_ROUTER: Final = "router."
_SAY_S: Final = 60.0
_LOG = logging.getLogger(__name__)


class SecureRouter:
    """A running router with rights; use it in a `with` block.

    Args:
        listen: endpoints to open, "tls/host:port".
        connect: endpoints of other routers to link with.
        identity: folder of a router's certificate with the signed list of members.

    Raises:
        IdentityError: the folder cannot be used, is not a router's, or holds no list of members.
        PortInUse: another process listens there.
        BusConfigError: a malformed endpoint, or one without TLS.
    """

    def __init__(self, listen: Sequence[str], connect: Sequence[str], identity: Path) -> None:
        self._listen, self._connect, self._folder = tuple(listen), tuple(connect), identity
        plain = [one for one in self._listen if not one.startswith("tls/")]
        if plain:
            raise BusConfigError(f"a router with an identity listens at tls/host:port alone, not at {', '.join(plain)}")
        self._ports = frozenset(address_of(one)[1] for one in self._listen)
        self._lock = threading.RLock()
        self._changed = threading.Event()
        self._closed = threading.Event()
        self._generations: list[_Generation] = []
        self._trunk: _Trunk | None = None
        self._number, self._due_s = 0, 0.0
        self._heard: bytes | None = None
        self._refused = b""
        self._said_s: dict[str, float] = {}
        self._looks: deque[set[Ends]] = deque([set()], FRESH_LOOKS)
        self._guard: ConnectionGuard | None = None
        self._sockets = Path(tempfile.mkdtemp(prefix="gnd-router-"))  # mode 0700: nobody else's
        self.certificate = CertificateWatch(identity, lambda _new: self._on_renewed(), "router")
        try:
            self._check(self.certificate.identity)
            self.members = read_members(self.certificate.identity)
            if self._connect:
                self._open_trunk()
            self._open_generation()
        except BaseException:
            self.close()
            raise
        self._guard = ConnectionGuard(set(self._ports), self._others, USUAL_LIMITS)
        self._thread = threading.Thread(target=self._run, name="gate", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    @property
    def is_closed(self) -> bool:
        """Whether it has been ended."""
        return self._closed.is_set()

    def neighbours(self) -> list[str]:
        """What is connected right now, without the links between the sessions of this router."""
        with self._lock:
            links = [link for one in self._sessions() for link in one.links()]
        return ["router" if _is_router(link) else "client" for link in links]

    def _others(self) -> set[Address]:
        """The other sides of all sessions."""
        with self._lock:
            return {address(*_ends(link)[1]) for one in self._generations for link in one.links()}

    def close(self) -> None:
        """Ends it."""
        self._closed.set()
        self._changed.set()
        if self._guard is not None:
            self._guard.close()
        self.certificate.close()
        with self._lock:
            while self._generations:
                self._generations.pop().close()
            if self._trunk is not None:
                self._trunk.close()
        shutil.rmtree(self._sockets, ignore_errors=True)

    def take(self, data: bytes) -> bool:
        """Takes a list of members, if it is signed by our authority and newer than ours; whether it was taken.

        Raises:
            IdentityError: damaged, or not signed by our authority.
        """
        new = MemberList.decode(data, self.certificate.identity.authority)
        with self._lock:
            if new.number <= self.members.number or self.is_closed:
                return False
            old, self.members = self.members, new
            self._due_s = time.monotonic() + (_AFTER_THE_HUB_S if self._connect else 0.0)
            _LOG.info("list %d: %d members, %d revoked", new.number, len(new.members), len(new.revoked))
            gone = new.revoked | {one.common_name for one in old.members - new.members}
            if gone & {one.common_name for one in old.members}:
                # Nobody gets in until the new rights are there, or the revoked might come back to the old ones.
                stop_listening(self._ports)
                self._cut_revoked()
            self._keep(data)
            return True

    def _catch_up(self) -> None:
        """Opens a session with the rights of now, unless the newest has them; tried again where it fails."""
        with self._lock:
            if self._closed.is_set() or time.monotonic() < self._due_s:
                return
            gone = None
            if self._trunk is not None and self._trunk.names != self._routers():
                gone = self._trunk
                self._open_trunk()
            try:
                if self._generations[-1].names != self._names():
                    self._open_generation()
            finally:
                if gone is not None:  # last: sessions that lose a link while others link up may not find each other
                    gone.close()

    def _names(self) -> frozenset[str]:
        """Common names of all that have rights: this router, too."""
        own = self.certificate.identity.member
        return frozenset(one.common_name for one in self.members.members | {own})

    def _run(self) -> None:
        while not self._closed.is_set():
            self._changed.wait(LOOK_S)
            self._changed.clear()
            try:
                self._look()
            except Exception:
                _LOG.exception("router: cannot follow the list of members")

    def _look(self) -> None:
        heard, self._heard = self._heard, None
        if heard is not None:
            self._take(heard, "heard on the bus")
        with contextlib.suppress(OSError):
            self._take((self._folder / MEMBERS).read_bytes(), f"in {self._folder}")
        self._catch_up()
        with self._lock:
            if self._closed.is_set():
                return
            self._cut_revoked()
            for old in self._generations[:-1]:
                if not old.links():
                    self._generations.remove(old)
                    old.close()
            self._looks.append(self._clients())

    def _clients(self) -> set[Ends]:
        links = (link for one in self._generations for link in one.links())
        return {_ends(link) for link in links if not _is_router(link)}

    def _sessions(self) -> "list[_Generation | _Trunk]":
        return [*self._generations, *([] if self._trunk is None else [self._trunk])]

    def _cut_revoked(self) -> None:
        """Ends the connections of who does not belong, and of who came before its rights did: it comes again."""
        belong = {one.common_name for one in self.members.members}
        found: dict[str, Ends] = {}
        for session in self._sessions():
            known = belong & session.names
            links = ((str(link.auth_identifier), link) for link in session.links())
            found |= {name: _ends(link) for name, link in links if name not in known}
        if found:
            cut(set(found.values()))
            self._say_cut(set(found))

    def _say_cut(self, names: set[str]) -> None:
        """Tells whose connections were ended: each name once a minute, since who is refused comes again at once."""
        now_s = time.monotonic()
        new = sorted(name for name in names if now_s - self._said_s.get(name, -_SAY_S) >= _SAY_S)
        if new:
            _LOG.warning("cut off: %s", ", ".join(new[:10]) + (" ..." if len(new) > 10 else ""))
            self._said_s = {name: at for name, at in self._said_s.items() if now_s - at < _SAY_S}
            self._said_s |= dict.fromkeys(new, now_s)

    def _routers(self) -> frozenset[str]:
        """Common names of the routers that have rights."""
        return frozenset(name for name in self._names() if name.startswith(_ROUTER))

    def _open_trunk(self) -> None:
        """Links with the other routers, with the rights of now; the next session of this router links with it."""
        self._number += 1
        socket = f"unixsock-stream/{self._sockets / f'trunk-{self._number}'}"
        names = self._routers()
        rights = access_control(map(MemberName.parse, names), links=True)
        self._trunk = _Trunk(self._connect, socket, self._folder, rights, names)

    def _open_generation(self) -> None:
        """Opens a session with the rights of now; it takes over the ports, and the others keep their connections."""
        with self._lock:
            self._number += 1
            socket = f"unixsock-stream/{self._sockets / str(self._number)}"
            members = self.members.members | {self.certificate.identity.member}
            config = BusConfig(
                mode="router",
                listen=(*self._listen, socket),
                connect=tuple(one.socket for one in self._sessions()),
                identity=self._folder,
                rights=access_control(members, links=True),
            )
            holds_ports = is_listening(self._ports)  # not after a revocation, nor at the start
            bus = open_bus(replace(config, takes_over=holds_ports), name="router")
            self._generations.append(_Generation(bus, socket, self._names(), self._on_list))
            self._settle(holds_ports)
            for old in self._generations[:-GENERATIONS]:
                cut({_ends(link) for link in old.links()})  # its clients come to the newest; then it is closed

    def _settle(self, holds_ports: bool) -> None:
        """Lets the newest session listen once it knows what the clients of all others have declared; who came while
        they linked up comes again.
        """
        new = self._generations[-1]
        others = [one for one in self._sessions() if one is not new]
        if not others:
            return
        if not _wait(lambda: new.routers() >= {one.router_id for one in others}):
            _LOG.warning("the sessions of this router do not find each other: what is served at one is not at all")
        time.sleep(_SETTLE_S)
        fresh = self._clients() - self._looks[0]
        if holds_ports:
            stop_listening(self._ports)
        if not _wait(lambda: is_listening(self._ports)):
            _LOG.warning("port %s is not free: trying on", ", ".join(map(str, sorted(self._ports))))
        cut(fresh)

    def _on_renewed(self) -> None:
        with self._lock:
            if not self.is_closed:
                self._open_generation()

    def _on_list(self, key: str, payload: bytes) -> None:
        if key.endswith("/members"):
            self._heard = payload  # the newest: this thread belongs to a session that may have to be closed
            self._changed.set()
        else:
            self._take_revoked(payload)

    def _take_revoked(self, data: bytes) -> None:
        try:
            take_revoked(self._folder, data)
        except (IdentityError, OSError) as error:
            _LOG.warning("router: a list of the revoked is not taken: %s", error)

    def _take(self, data: bytes, where: str) -> None:
        try:
            self.take(data)
        except IdentityError as error:
            if data != self._refused:
                self._refused = data
                _LOG.warning("router: a list of members %s is not taken: %s", where, error)

    def _keep(self, data: bytes) -> None:
        path = self._folder / MEMBERS
        try:
            if path.read_bytes() != data:
                replace_file(path, data)
        except OSError as error:
            _LOG.warning("list %d is not kept for the next start: %s", self.members.number, error)

    def _check(self, identity: MemberIdentity) -> None:
        if identity.role != "router":
            raise IdentityError(f"{self._folder} is the identity of {identity.member.common_name}, not of a router")


def read_members(identity: MemberIdentity) -> MemberList:
    """The list of members in an identity folder; `IdentityError` where there is none, or not of its authority."""
    path = identity.folder / MEMBERS
    try:
        return MemberList.decode(path.read_bytes(), identity.authority)
    except OSError as error:
        raise IdentityError(f"cannot read {path}: {error.strerror}; `gnd certs publish` writes it") from error


class _Generation:
    """One router session: those that came while its rights were the newest."""

    def __init__(self, bus: Bus, socket: str, names: frozenset[str], on_list: OnMessage) -> None:
        self.bus, self.socket, self.names = bus, socket, names
        self.router_id = str(bus.connection.session.info.zid())
        bus.keep(RouterLinks(bus))  # of routers that link with this one
        bus.subscribe(AUTHORITY_KEYS, on_list, kind="control")

    def routers(self) -> set[str]:
        """Ids of the router sessions that it is linked with."""
        return {str(one) for one in self.bus.connection.session.info.routers_zid()}

    def links(self) -> list[zenoh.Link]:
        """Its connections to others, without those to other generations."""
        return [link for link in self.bus.connection.session.info.links() if "/" in link.dst and _is_ip(link)]

    def close(self) -> None:
        """Ends it."""
        self.bus.close()


class _Trunk:
    """The session that links with other routers: it reaches them, and nobody reaches it but the sessions beside it."""

    def __init__(
        self, connect: Sequence[str], socket: str, folder: Path, rights: Mapping[str, Any], names: frozenset[str]
    ) -> None:
        self.socket, self.names = socket, names
        config = BusConfig(
            mode="router",
            listen=(socket,),
            connect=tuple(connect),
            identity=folder,
            rights=rights,
            open_timeout_s=LINK_OPEN_S,
        )
        self.bus = open_bus(config, name="router")
        self.router_id = str(self.bus.connection.session.info.zid())
        self.bus.keep(RouterLinks(self.bus))

    def links(self) -> list[zenoh.Link]:
        """Its connections to other routers."""
        return [link for link in self.bus.connection.session.info.links() if _is_ip(link)]

    def close(self) -> None:
        """Ends it."""
        self.bus.close()


def _wait(condition: Callable[[], bool]) -> bool:
    """Whether it came true in time."""
    deadline_s = time.monotonic() + _TAKEN_OVER_S
    while not condition():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(_POLL_S)
    return True


def _is_router(link: zenoh.Link) -> bool:
    return str(link.auth_identifier).startswith(_ROUTER)


def _is_ip(link: zenoh.Link) -> bool:
    return str(link.dst).startswith(("tls/", "tcp/"))


def _ends(link: zenoh.Link) -> Ends:
    return address_of(str(link.src)), address_of(str(link.dst))
