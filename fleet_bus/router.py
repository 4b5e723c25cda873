"""A zenoh router inside a Python process: no other binary is needed.

It forwards and stores nothing: plugins do not exist in the wheel and are silently ignored. Storage is the tile
server's.
"""

import logging
import threading
from collections.abc import Sequence

from fleet_bus.bus import Bus, open_bus
from fleet_bus.config import DEFAULT_ENDPOINT, BusConfig

_LOG = logging.getLogger(__name__)


def open_router(listen: Sequence[str] = (DEFAULT_ENDPOINT,), connect: Sequence[str] = ()) -> Bus:
    """A running router; close it to end it.

    Args:
        listen: endpoints to open, "tcp/host:port".
        connect: endpoints of other routers to link with.

    Raises:
        PortInUse: another process listens there.
        BusConfigError: malformed endpoint.
    """
    config = BusConfig(mode="router", listen=tuple(listen), connect=tuple(connect))
    return open_bus(config, name="router")


def run_router(
    listen: Sequence[str] = (DEFAULT_ENDPOINT,), *, stop: threading.Event, connect: Sequence[str] = ()
) -> None:
    """Runs a router until the event is set; errors as `open_router`."""
    with open_router(listen, connect):
        _LOG.info("router listens at %s", ", ".join(listen))
        stop.wait()
    _LOG.info("router ended")
