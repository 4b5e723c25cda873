"""Closes connections to this process that do not become sessions: idle ones, half-open handshakes, a byte a second.

Zenoh keeps a place for each of them until its time is over, and refuses everybody else while all places are taken. It
names the connections that are sessions; all other sockets at the router's own ports are handshakes.
"""

import ipaddress
import logging
import math
import os
import socket
import stat
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from gnd.fleet_bus.errors import BusConfigError
from gnd.fleet_bus.refusals import counted
from gnd.fleet_bus.seldom import Seldom

_LOG = logging.getLogger(__name__)
_SELDOM = Seldom(_LOG)
_FD_FOLDER: Final = Path("/proc/self/fd")
_WHY: Final = {
    "handshake": "no session within its time",
    "handshakes": "too many at a time that are no session yet",
    "address": "too many of one address",
}
LOOK_S: Final = 0.25
Address = tuple[str, int]
"""Host and port of the other side."""


@dataclass(frozen=True, slots=True)
class GuardLimits:
    """What a router bears.

    Attributes:
        handshake_s: a connection that is no session after so long is closed, s.
        handshakes: so many at a time; beyond it the oldest of the address with the most are closed.
        of_address: connections of one remote address; beyond it the newest are closed. Many vehicles may share the
            address of their mobile network.
    """

    handshake_s: float
    handshakes: int
    of_address: int

    def __post_init__(self) -> None:
        if self.handshake_s <= 0 or self.handshakes < 1 or self.of_address < 1:
            raise BusConfigError(f"limits of a router must be positive: {self}")


USUAL_LIMITS: Final = GuardLimits(handshake_s=5.0, handshakes=256, of_address=4_096)


@dataclass(frozen=True, slots=True)
class SeenConnection:
    """A connection: its descriptor, the inode of its socket, the other side, since when it is known, s, and when it was
    last seen to be a session, s.
    """

    descriptor: int
    inode: int
    peer: Address
    since_s: float
    session_s: float = -math.inf


def to_close(
    open_ones: Iterable[SeenConnection], sessions: Collection[Address], limits: GuardLimits, now_s: float
) -> list[tuple[SeenConnection, str]]:
    """Which connections go, each with the reason.

    Args:
        open_ones: all connections at the router's ports.
        sessions: the other sides of those that are sessions.
        limits: what is borne.
        now_s: by the clock of `SeenConnection.since_s`.
    """
    ordered = sorted(open_ones, key=lambda one: (one.since_s, one.inode))
    going: dict[int, tuple[SeenConnection, str]] = {}
    handshakes = [one for one in ordered if one.peer not in sessions]
    for one in handshakes:
        if now_s - max(one.since_s, one.session_s) > limits.handshake_s:
            going[one.inode] = one, "handshake"
    young = [one for one in handshakes if one.inode not in going]
    of_host = Counter(one.peer[0] for one in young)
    for one in sorted(young, key=lambda one: (-of_host[one.peer[0]], one.since_s)):
        if sum(of_host.values()) <= limits.handshakes:
            break
        of_host[one.peer[0]] -= 1
        going[one.inode] = one, "handshakes"
    left = Counter[str]()
    for one in ordered:
        if one.inode not in going:
            left[one.peer[0]] += 1
            if left[one.peer[0]] > limits.of_address:
                going[one.inode] = one, "address"
    return list(going.values())


class ConnectionGuard:
    """Looks after the connections of this process until closed (Linux; elsewhere it sees none).

    Args:
        ports: at which the router listens.
        sessions: gives the other sides of the connections that are sessions now.
        limits: what is borne.
    """

    def __init__(
        self, ports: Collection[int], sessions: Callable[[], Collection[Address]], limits: GuardLimits
    ) -> None:
        self._ports, self._sessions, self._limits = frozenset(ports), sessions, limits
        self._seen: dict[int, SeenConnection | int] = {}  # by descriptor; an inode: of another socket
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="guard", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(LOOK_S):
            try:
                self.look()
            except Exception:
                _SELDOM.exception("looking at connections failed")

    def look(self) -> int:
        """Close what is beyond the limits; how many those were."""
        self._refresh()
        sessions, now_s = self._sessions(), time.monotonic()
        for at, one in self._seen.items():
            if isinstance(one, SeenConnection) and one.peer in sessions:
                self._seen[at] = replace(one, session_s=now_s)  # one that zenoh has just given up has time, too
        mine = [one for one in self._seen.values() if isinstance(one, SeenConnection)]
        going = to_close(mine, sessions, self._limits, now_s)
        ended = Counter((one.peer[0], reason) for one, reason in going if _shut(one))
        for (host, reason), n in ended.items():
            counted("connection", reason, n)
            _SELDOM.warning("closed %d connections of %s: %s", n, host, _WHY[reason])
        return len(going)

    def _refresh(self) -> None:
        """Look at the descriptors that are new; one may be another socket than at the last look."""
        found: dict[int, SeenConnection | int] = {}
        for descriptor in _descriptors():
            inode = _socket_inode(descriptor)
            if not inode:
                continue
            before = self._seen.get(descriptor)
            if before is not None and inode == (before.inode if isinstance(before, SeenConnection) else before):
                found[descriptor] = before
            else:
                found[descriptor] = self._looked_at(descriptor, inode)
        self._seen = found

    def _looked_at(self, descriptor: int, inode: int) -> SeenConnection | int:
        ends = _ends(descriptor)
        if ends is None or ends[0][1] not in self._ports:
            return inode
        return SeenConnection(descriptor, inode, ends[1], time.monotonic())


def _descriptors() -> list[int]:
    try:
        return [int(entry.name) for entry in _FD_FOLDER.iterdir()]
    except OSError:  # not Linux, or no descriptor left
        return []


def _socket_inode(descriptor: int) -> int:
    """0: no socket, or gone."""
    try:
        status = os.fstat(descriptor)
    except OSError:
        return 0
    return status.st_ino if stat.S_ISSOCK(status.st_mode) else 0


def _ends(descriptor: int) -> tuple[Address, Address] | None:
    """Own and other end of a TCP connection; None: it is none."""
    try:
        with socket.socket(fileno=os.dup(descriptor)) as copy:
            if copy.family not in (socket.AF_INET, socket.AF_INET6) or copy.type != socket.SOCK_STREAM:
                return None
            own, peer = copy.getsockname(), copy.getpeername()
    except OSError:  # listens, or ended meanwhile
        return None
    return address(own[0], own[1]), address(peer[0], peer[1])


def _shut(one: SeenConnection) -> bool:
    """End a connection, if its descriptor is still that one."""
    try:
        copy = os.dup(one.descriptor)
    except OSError:
        return False
    with socket.socket(fileno=copy) as end:
        if os.fstat(copy).st_ino != one.inode:
            return False
        try:
            end.shutdown(socket.SHUT_RDWR)
        except OSError:  # ended already
            return False
    return True


def address(host: str, port: int) -> Address:
    """As it is compared: an IPv4 address within IPv6 is that IPv4 address, and a zone is left out."""
    found = ipaddress.ip_address(host.partition("%")[0])
    mapped = found.ipv4_mapped if isinstance(found, ipaddress.IPv6Address) else None
    return str(mapped or found), port
