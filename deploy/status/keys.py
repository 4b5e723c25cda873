"""Keys of a terminal while a view runs."""

import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

_LOOK_S: Final = 0.2
QUIT: Final = frozenset(b"qQ\x1b\x04")
"""q, Escape, Ctrl-D."""


@contextmanager
def quitting_by_key(stop: threading.Event) -> Iterator[bool]:
    """Set the event when a key to quit is pressed; gives whether keys are heard: not where the input is no terminal, or
    the program runs in the background. The terminal is left as it was.
    """
    try:
        number = sys.stdin.fileno()
        is_heard = os.isatty(number) and os.tcgetpgrp(number) == os.getpgrp()
    except (OSError, ValueError):
        is_heard = False
    if not is_heard:
        yield False
        return
    before, ended = termios.tcgetattr(number), threading.Event()
    thread = threading.Thread(target=_listen, args=(number, stop, ended), name="keys", daemon=True)
    try:
        tty.setcbreak(number)  # keys come one by one; Ctrl-C stays a signal
        thread.start()
        yield True
    finally:
        ended.set()
        if thread.is_alive():
            thread.join()
        termios.tcsetattr(number, termios.TCSADRAIN, before)


def _listen(number: int, stop: threading.Event, ended: threading.Event) -> None:
    while not (ended.is_set() or stop.is_set()):
        if select.select([number], [], [], _LOOK_S)[0]:
            pressed = os.read(number, 64)
            if not pressed or QUIT & set(pressed):
                stop.set()
