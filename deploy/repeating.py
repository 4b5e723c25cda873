"""Periodic work in a thread beside a block."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def repeated(work: Callable[[int], object], every_s: float, name: str = "repeated") -> Iterator[None]:
    """Call `work` with 0, 1, 2 … every `every_s` from a thread of its own, of that name, while the block runs."""
    stop = threading.Event()

    def run() -> None:
        number = 0
        while not stop.wait(every_s):
            work(number)
            number += 1

    thread = threading.Thread(target=run, name=name)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
