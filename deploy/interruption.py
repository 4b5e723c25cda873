"""How long commands end: Ctrl-C once in order, Ctrl-C twice at once."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from gnd.ending import ORDERLY_S, orderly


class EndEvent(threading.Event):
    """Is set by Ctrl-C or SIGTERM.

    Attributes:
        is_awaited: whether somebody looks at it; else the first signal, too, raises KeyboardInterrupt.
    """

    is_awaited = True


@contextmanager
def ending_in_order(*, is_awaited: bool = True, within_s: float = ORDERLY_S) -> Iterator[EndEvent]:
    """Give an event that Ctrl-C or SIGTERM sets; the second one raises KeyboardInterrupt.

    Args:
        is_awaited: whether the event is looked at from the first; who looks at it only later says so by its attribute.
        within_s: so long after the first signal the program is killed.
    """
    stop = EndEvent()
    stop.is_awaited = is_awaited

    def end(_number: int, _frame: FrameType | None) -> None:
        was_set = stop.is_set()
        stop.set()
        if was_set or not stop.is_awaited:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with orderly(within_s):
            yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
