"""The threads in which a shard looks at uploads; they outlive every failure."""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from gnd.tile_store.errors import StoreClosed

_PAUSE_S: Final = 1.0
_LOG = logging.getLogger(__name__)


@contextmanager
def working(work: Callable[[], int], wake: threading.Event, count: int, poll_s: float) -> Iterator[None]:
    """Call `work` again and again in `count` threads while the block runs.

    Args:
        work: how many things it has done; after none a thread sleeps until `wake` is set or `poll_s` is over.
        wake: set when there is something to do.
        count: number of threads.
        poll_s: how long to sleep at most.
    """
    stop = threading.Event()

    def loop() -> None:
        while not stop.is_set():
            try:
                done = work()
            except StoreClosed:
                return
            except Exception:
                _LOG.exception("looking at uploads failed; it goes on in %g s", _PAUSE_S)
                stop.wait(_PAUSE_S)
                continue
            if not done:
                wake.wait(poll_s)
                wake.clear()

    threads = [threading.Thread(target=loop, name=f"expander-{k}", daemon=True) for k in range(count)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        wake.set()
        for thread in threads:
            thread.join()
