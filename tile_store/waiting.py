"""Programs that are started while the database of their store is away: after a power cut all start at once."""

import logging
import threading
import time
from typing import Final

from gnd.tile_store.errors import StoreAway
from gnd.tile_store.location import StoreLocation, conninfo_of, file_of, shown

WAIT_S: Final = 60.0
RETRY_S: Final = 0.5
_LOG = logging.getLogger(__name__)


def wait_for_store(location: StoreLocation, most_s: float, stop: threading.Event) -> None:
    """Wait until the database server of a store lets in, or `stop` is set; a file is there or it is not.

    What does not pass by itself (a wrong password, no such database, a server that is too old) is told at once.

    Raises:
        StoreAway: it has not answered for so long.
        StoreUnavailable: it does not let in.
    """
    if file_of(location) is not None:
        return
    try:
        from gnd.tile_store.postgres_connection import DatabaseClock, connect
    except ImportError:  # who opens the store says what is missing
        return
    until_s, told = time.monotonic() + most_s, False
    while not stop.is_set():
        try:
            connect(conninfo_of(location), DatabaseClock()).close()
        except StoreAway as error:
            left_s = until_s - time.monotonic()
            if left_s <= 0:
                raise StoreAway(f"{error}; waited for {most_s:g} s") from None
            if not told:
                _LOG.warning("waiting for the database, at most %g s: %s", most_s, error)
            told = True
            stop.wait(min(RETRY_S, left_s))
        else:
            if told:
                _LOG.warning("the database of %s answers", shown(location))
            return
