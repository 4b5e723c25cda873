"""Work that comes in bursts is done in parts, so that who does it is not late for the next scan."""

from collections import deque
from collections.abc import Iterator
from typing import Final, TypeVar

T = TypeVar("T")

_PART: Final = 8


def next_few(waiting: deque[T], most: int | None = None) -> Iterator[T]:
    """Take out the oldest of what waits, and an eighth of it beside: none waits for long, however many come at once.

    Args:
        waiting: what waits, the oldest first.
        most: not more than these, for what comes in bursts that are known to be small.
    """
    few = 1 + len(waiting) // _PART
    few = few if most is None else min(few, most)
    while waiting and few > 0:
        yield waiting.popleft()
        few -= 1
