"""Work that comes in bursts is done in parts, so that who does it is not late for the next scan."""

from collections import deque
from collections.abc import Iterator
from typing import Final, TypeVar

T = TypeVar("T")

_PART: Final = 8


def next_few(waiting: deque[T]) -> Iterator[T]:
    """Take out the oldest of what waits, and an eighth of it beside: none waits for long, however many come at once."""
    few = 1 + len(waiting) // _PART
    while waiting and few > 0:
        yield waiting.popleft()
        few -= 1
