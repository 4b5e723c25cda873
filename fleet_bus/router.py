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
from gnd.fleet_bus.identity.names import identity_of_environment

if TYPE_CHECKING:  # a router without an identity loads nothing of it
    from gnd.fleet_bus.gate import SecureRouter

_LOG = logging.getLogger(__name__)
_LOOK_UP_S: Final = 0.25
# A thread that receives waits while it forwards to a full queue; zenoh's two would soon all wait.
_RECEIVING_THREADS: Final = 16


def open_router(listen: Sequence[str] = (DEFAULT_ENDPOINT,), connect: Sequence[str] = ()) -> Bus:
    """A running router; close it to end it.

    Args:
        listen: endpoints to open, "tcp/host:port".
        connect: endpoints of other routers to link with.

    Raises:
        PortInUse: another process listens there.
        BusConfigError: malformed endpoint.
    """
    _prepare()
    config = BusConfig(mode="router", listen=tuple(listen), connect=tuple(connect))
    return open_bus(config, name="router")


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
