"""Programs that follow a store which moves (`gnd store copy`), instead of failing until somebody starts them anew."""

import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from gnd.tile_store.connection import change, fetch
from gnd.tile_store.errors import StoreError, StoreMoved
from gnd.tile_store.location import StoreLocation, open_store, shown
from gnd.tile_store.sqlite_store import SqlStore

LOOK_S: Final = 0.2
"""It is looked so often whether the store has moved, and whether the other one can be used."""
_LOG = logging.getLogger(__name__)
Run = Callable[[StoreLocation, threading.Event], None]
"""Works on a store until the event is set."""


def run_following(location: StoreLocation, run: Run, stop: threading.Event) -> None:
    """Run on a store until `stop` is set; when it moves, on the store to which it has moved, as soon as that is whole.

    A store that has moved before is followed, too: who is started with the old one again goes to the new one.

    Raises:
        StoreError: there is no store at the beginning, or what `run` raises.
    """
    while not stop.is_set():
        with open_store(location, create=False) as store:
            watch = _Watch(store, stop)
            try:
                if watch.target is None:
                    run(location, watch.ended)
            except StoreMoved as moved:  # what it wanted to write at its end
                watch.target = moved.target
            finally:
                watch.close()
        if watch.target is None:
            return
        location = _where_to_go_on(location, watch.target, stop)


class _Watch:
    """Looks whether a store has moved; `ended` is set when it has, and when `stop` is."""

    def __init__(self, store: SqlStore, stop: threading.Event) -> None:
        self.ended, self.target = threading.Event(), moved_to(store)
        self._store, self._stop = store, stop
        self._thread = threading.Thread(target=self._run, name="moves", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while self.target is None and not self.ended.is_set() and not self._stop.wait(LOOK_S):
            try:
                self.target = moved_to(self._store)
            except StoreError as error:  # a database that restarts: who works on it says so, too
                _LOG.debug("cannot see whether %s has moved: %s", self._store.location, error)
        self.ended.set()

    def close(self) -> None:
        """Look no more."""
        self.ended.set()
        self._thread.join()


def moved_to(store: SqlStore) -> str | None:
    """Where a store has moved; None: it is here."""
    if not store.look(lambda c: fetch(c, "is_fenced")):
        return None
    try:  # who refuses says where
        store.transact(lambda c, _now: change(c, "touch", {}))
    except StoreMoved as moved:
        return moved.target
    return None


def _where_to_go_on(old: StoreLocation, new: StoreLocation, stop: threading.Event) -> StoreLocation:
    """Waits until the new store is whole, as it cannot be opened before; the old one where the move was abandoned."""
    told = ""
    while not stop.is_set():
        try:
            open_store(new, create=False).close()
        except StoreError as error:
            if str(error) != told:
                told = str(error)
                _LOG.warning("waiting for the store: %s", error)
        else:
            _LOG.warning("%s has moved to %s: going on there", shown(old), shown(new))
            return new
        with suppress(StoreError), open_store(old, create=False) as store:
            if moved_to(store) is None:
                _LOG.warning("%s is used again: going on there", shown(old))
                return old
        stop.wait(LOOK_S / 4)
    return old
