"""A zenoh router inside a Python process: no other binary is needed.

It forwards and stores nothing: plugins do not exist in the wheel and are silently ignored. Storage is the tile
server's.
"""

import logging
import os
import resource
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import DEFAULT_ENDPOINT, BusConfig
from gnd.fleet_bus.guard import USUAL_LIMITS, Address, ConnectionGuard, GuardLimits, address
from gnd.fleet_bus.identity.names import identity_of_environment
from gnd.fleet_bus.part import Part
from gnd.fleet_bus.router_links import LINK_OPEN_S, RouterLinks

if TYPE_CHECKING:  # a router without an identity loads nothing of it
    from gnd.fleet_bus.gate import SecureRouter

_LOG = logging.getLogger(__name__)
_LOOK_UP_S: Final = 0.25
# A thread that receives waits while it forwards to a full queue; zenoh's two would soon all wait.
_RECEIVING_THREADS: Final = 16


def open_router(
    listen: Sequence[str] = (DEFAULT_ENDPOINT,), connect: Sequence[str] = (), limits: GuardLimits | None = None
) -> Bus:
    """A running router; close it to end it.

    Args:
        listen: endpoints to open, "tcp/host:port".
        connect: endpoints of other routers to link with.
        limits: of connections; by default `USUAL_LIMITS`.

    Raises:
        PortInUse: another process listens there.
        BusConfigError: malformed endpoint.
    """
    _prepare()
    config = BusConfig(mode="router", listen=tuple(listen), connect=tuple(connect), open_timeout_s=LINK_OPEN_S)
    bus = open_bus(config, name="router")
    bus.keep(_Guarding(bus, limits or USUAL_LIMITS))
    bus.keep(RouterLinks(bus))
    return bus


class _Guarding(Part):
    """The guard of a router's connections, closed with its session."""

    def __init__(self, router: Bus, limits: GuardLimits) -> None:
        super().__init__()
        ports = {port for _, port in map(_address, router.config.listen)}

        def sessions() -> set[Address]:
            return {_address(link.dst) for link in router.connection.session.info.links()}

        self._guard = ConnectionGuard(ports, sessions, limits)

    def _end(self) -> None:
        self._guard.close()


def _address(locator: str) -> Address:
    """Host and port of "tcp/[::1]:7447#options"; of a name as it is."""
    host, _, port = locator.partition("/")[2].partition("#")[0].partition("?")[0].rpartition(":")
    try:
        return address(host.strip("[]"), int(port))
    except ValueError:  # a name: of an endpoint to listen at, whose port alone is looked at
        return host, int(port)


def start_router(
    listen: Sequence[str] = (DEFAULT_ENDPOINT,), connect: Sequence[str] = (), identity: Path | None = None
) -> "Bus | SecureRouter":
    """A running router: with an identity one that gives rights; errors as `open_router` and `gate.SecureRouter`."""
    if identity is None:
        return open_router(listen, connect)
    from gnd.fleet_bus.gate import SecureRouter

    _prepare()
    return SecureRouter(listen, connect, identity)


def run_router(
    listen: Sequence[str] = (DEFAULT_ENDPOINT,), *, stop: threading.Event, connect: Sequence[str] = ()
) -> None:
    """Runs a router until the event is set, with the identity of the environment; errors as `start_router`."""
    with start_router(listen, connect, identity_of_environment()):
        _LOG.info("router listens at %s", ", ".join(listen))
        wait_for_stop(stop)
    _LOG.info("router ended")


def wait_for_stop(stop: threading.Event) -> None:
    """Waits in the main thread for an event that a signal handler sets.

    A signal that arrives just before a wait without timeout is seen only after it, that is never: look up now and then.
    """
    while not stop.wait(_LOOK_UP_S):
        pass


def _prepare() -> None:
    _raise_file_limit()
    os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {_RECEIVING_THREADS}))")  # read at first use


def _raise_file_limit() -> None:
    """A session is a descriptor: take all that the system allows (often 1024 unless asked for)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
