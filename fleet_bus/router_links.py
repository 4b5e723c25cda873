"""Links between routers: a dead one is noticed within seconds, though nobody says anything on it.

A router gives its clients a lease of minutes, since they pay for keep-alives. Zenoh has one lease a session, so that a
link to another router would be believed for as long. The kernel watches these links instead: it probes a silent one,
and ends one whose bytes nobody acknowledges. Zenoh then answers what waits there with "nobody", and connects again.
"""

import contextlib
import logging
import socket
import threading
from collections.abc import Sequence
from typing import Final

import zenoh

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.part import Part
from gnd.fleet_bus.sockets import duplicate_of

LINK_DEAD_MS: Final = 3_000
"""A link to another router on which nothing is acknowledged for so long is ended."""
LINK_OPEN_S: Final = 2.0
"""An attempt to link with another router may take so long: after an interruption the next one finds it."""
_PROBE_S: Final = 1
_LOOK_S: Final = 0.5
_LOG = logging.getLogger(__name__)
_Link = tuple[str, str]


class RouterLinks(Part):
    """Watches the links of a router's session to other routers until closed (Linux; elsewhere zenoh's lease holds).

    Args:
        router: the session.
    """

    def __init__(self, router: Bus) -> None:
        super().__init__()
        self._router = router
        self._watched: frozenset[_Link] = frozenset()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="router links", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(_LOOK_S):
            try:
                self.look()
            except zenoh.ZError:  # the session ends
                return
            except OSError as error:
                _LOG.warning("links to other routers are not watched: %s", error)

    def look(self) -> frozenset[_Link]:
        """Watches links that are new, says which ended; all links to other routers now, as (own, other) locator."""
        now = frozenset((str(link.src), str(link.dst)) for link in links_to_routers(self._router))
        for link in sorted(now - self._watched):
            _watch(*link)
            _LOG.info("linked with the router at %s", link[1])
        for _, other in sorted(self._watched - now):
            _LOG.warning("the link with the router at %s has ended", other)
        self._watched = now
        return now

    def _end(self) -> None:
        self._stop.set()
        self._thread.join()


def links_to_routers(router: Bus) -> Sequence[zenoh.Link]:
    """Its connections over IP to other routers."""
    info = router.connection.session.info
    others = {str(one) for one in info.routers_zid()}
    if not others:
        return ()
    return [link for link in info.links() if str(link.zid) in others and str(link.dst).startswith(("tcp/", "tls/"))]


def _watch(own: str, other: str) -> None:
    """Lets the kernel probe a connection, and end it when nothing is acknowledged."""
    end = duplicate_of(own, other)
    if end is None:  # ended meanwhile
        return
    with end, contextlib.suppress(OSError):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, _PROBE_S)
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, _PROBE_S)
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, LINK_DEAD_MS)
