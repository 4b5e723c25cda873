"""How long commands end: Ctrl-C once in order, Ctrl-C twice at once."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from gnd.ending import orderly


@contextmanager
def ending_in_order() -> Iterator[threading.Event]:
    """Give an event that Ctrl-C or SIGTERM sets; the second one raises KeyboardInterrupt."""
    stop = threading.Event()

    def end(_number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with orderly():
            yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
