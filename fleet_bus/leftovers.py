"""Closes what a program forgot to close, because an open session would keep the process from ending."""

import logging
import threading
import weakref
from typing import Protocol


class Closable(Protocol):
    """A bus, seen from here."""

    def close(self) -> None:
        """Ends it."""


_LOG = logging.getLogger(__name__)
_open: "weakref.WeakSet[Closable]" = weakref.WeakSet()
_lock = threading.Lock()
_watching = False


def remember(bus: Closable) -> None:
    """Has the bus closed when the main thread ends, unless that was done."""
    global _watching  # noqa: PLW0603 - one watcher a process
    with _lock:
        _open.add(bus)
        if not _watching:
            _watching = True
            threading.Thread(target=_close_at_exit, name="fleet_bus leftovers").start()


def forget(bus: Closable) -> None:
    """The bus was closed."""
    with _lock:
        _open.discard(bus)


def _close_at_exit() -> None:
    # zenoh's callback threads are no daemons: the interpreter would wait for them for ever.
    # Nor is this thread a daemon: it must not be cut off inside zenoh.
    threading.main_thread().join()
    with _lock:
        left = list(_open)
    for bus in left:
        _LOG.warning("a bus was never closed: use it in a `with` block")
        bus.close()
