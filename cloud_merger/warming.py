"""A worker of a shard says that it gets its kernels ready: nothing is merged until then, and compiling takes long."""

import logging
import threading
import time
from contextlib import ExitStack
from typing import Final

from prometheus_client import CollectorRegistry

from gnd.cloud_merger.warm import warm_up
from gnd.fleet_bus.health import Check, HealthServer
from gnd.gnd_map.jit import kernels_ready, tell_compiling

TYPICAL: Final = (
    "some seconds where their machine code is on the disk, one to three minutes where it has to be compiled"
)
TOLD_EVERY_S: Final = 30.0
"""While kernels are compiled, how far that is goes to the log so often."""
_LOG = logging.getLogger(__name__)


class _Compiling:
    """Counts the kernels that are compiled, and tells now and then."""

    def __init__(self, shard: str) -> None:
        self.count, self.is_over = 0, False
        self._shard, self._told_s, self._lock = shard, -TOLD_EVERY_S, threading.Lock()

    def tell(self, name: str) -> None:
        """A kernel is about to be compiled."""
        with self._lock:
            self.count += 1
            if self.is_over or time.monotonic() - self._told_s < TOLD_EVERY_S:
                return
            self._told_s = time.monotonic()
        ready, known = kernels_ready()
        _LOG.info("merger %s: compiles kernels, %s now; %d of %d are ready", self._shard, name, ready, known)


def warmed_up(shard: str, metrics_at: tuple[str, int] | None = None) -> None:
    """Get the kernels ready. The log says so before and after, and /healthz says "warming" meanwhile.

    Args:
        shard: its name, for the log.
        metrics_at: host and port of the pages; they are free again afterwards. None: there are none.

    Raises:
        PortInUse: the port is taken.
    """
    began_s, compiling = time.monotonic(), _Compiling(shard)
    tell_compiling(compiling.tell)
    with ExitStack() as stack:
        if metrics_at is not None:
            host, port = metrics_at
            stack.enter_context(HealthServer(port, CollectorRegistry(), {"kernels": _warming(began_s)}, host=host))
        _LOG.info("merger %s: gets its kernels ready, merges nothing until then: %s", shard, TYPICAL)
        warm_up()
    compiling.is_over = True
    took_s, count = time.monotonic() - began_s, compiling.count
    _LOG.info("merger %s: kernels are ready after %.1f s, %d compiled; merges from now on", shard, took_s, count)


def _warming(began_s: float) -> Check:
    return lambda: f"warming: kernels are made ready for {time.monotonic() - began_s:.0f} s now"
