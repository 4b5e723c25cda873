"""Work that comes in bursts is done in parts, so that who does it is not late for the next scan."""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, TypeVar

T = TypeVar("T")

_PART: Final = 8
MOST_WAITING: Final = 4


@dataclass(slots=True)
class ScanRoom:
    """How much of the work that can wait may still be done with the newest scan.

    What work takes is estimated from how much there is to do, never measured: results must not depend on how fast a
    machine is.

    Attributes:
        left_ms: of a core that drives an HDL-64E at a half more than real time.
    """

    left_ms: float = math.inf

    def takes(self, ms: float, *, must: bool = False) -> bool:
        """Whether work that takes so long is to be done now; the room shrinks by it then.

        Args:
            ms: how long.
            must: it has waited long enough.
        """
        if ms > self.left_ms and not must:
            return False
        self.left_ms -= ms
        return True


@dataclass(slots=True)
class Patient:
    """Work that waits until there is room for it, but not for more than `MOST_WAITING` scans.

    Attributes:
        waited: for so many by now.
    """

    waited: int = 0

    def may(self, ms: float, room: ScanRoom) -> bool:
        """Whether it is to be done now; takes so long of the room then."""
        may = room.takes(ms, must=self.waited >= MOST_WAITING)
        self.waited = 0 if may else self.waited + 1
        return may


def few_of(waiting: deque[T]) -> int:
    """How many to take out of what waits: one, and an eighth of it, so that none waits for long, however many come at
    once.
    """
    return 1 + len(waiting) // _PART


def next_few(waiting: deque[T]) -> Iterator[T]:
    """Take out the oldest of what waits, `few_of` it."""
    few = few_of(waiting)
    while waiting and few > 0:
        yield waiting.popleft()
        few -= 1
