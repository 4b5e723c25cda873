"""Measurements of several live sensors in the order of their stamps, held back for as short as that allows."""

import heapq
import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Final, Generic, TypeVar

T = TypeVar("T")

HOLD_S: Final = 0.3
"""Nothing waits longer for a sensor that may yet deliver something older: a scan's stamp is its start, and the driver
sends it a sweep later, than 100 ms after a gyro's sample of the same time."""


class StampOrder(Generic[T]):
    """Merges streams, each of which is in order, by stamp; of equal stamps by the rank of their streams.

    An item is given out when every stream has come to its stamp, or when it, or a younger one, has waited `HOLD_S`. As
    long as no stream is later than that, the order is the one of a recording that is sorted by stamps, however the
    messages interleave on their way.

    Args:
        streams: their names; the first has the lowest rank. All are waited for.

    Attributes:
        late: items by stream that came after a younger one had been given out; they are given out at once.
    """

    def __init__(self, streams: Sequence[str]) -> None:
        self.late: Counter[str] = Counter()
        self._ranks = {stream: rank for rank, stream in enumerate(streams)}
        self._newest_ns = dict.fromkeys(streams, -1)
        self._waiting: list[tuple[int, int, int, float, T]] = []
        self._numbers = itertools.count()
        self._given_ns = -1

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, stream: str, t_ns: int, item: T, now_s: float) -> None:
        """Take an item with its stamp; `now_s` by a clock that never goes back."""
        self._newest_ns[stream] = max(t_ns, self._newest_ns[stream])
        self.late[stream] += t_ns < self._given_ns
        heapq.heappush(self._waiting, (t_ns, self._ranks[stream], next(self._numbers), now_s, item))

    def take(self, now_s: float) -> list[T]:
        """What need not wait any longer, in order."""
        overdue_ns = (t_ns for t_ns, _, _, at_s, _ in self._waiting if now_s - at_s >= HOLD_S)
        until_ns = max(min(self._newest_ns.values()), max(overdue_ns, default=-1))
        ripe = []
        while self._waiting and self._waiting[0][0] <= until_ns:
            t_ns, *_, item = heapq.heappop(self._waiting)
            self._given_ns = max(self._given_ns, t_ns)
            ripe.append(item)
        return ripe
