"""A mailbox that serves its senders in turn: who sends much waits for itself, not others for it.

Deficit round robin over the turns (a vehicle, a district) by their bytes, within two groups: turns that have been seen
for a while, and newcomers. A name costs nothing to invent; so all newcomers together have a share of their own, however
many they are, and only a name that comes again after `KNOWN_AFTER_S` leaves them. While known ones come, newcomers have
a part of the threads only, so that a known one finds a thread that is free.
"""

import logging
import math
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

_T = TypeVar("_T")
_LOG = logging.getLogger(__name__)
_JOIN_S: Final = 5.0
KNOWN_AFTER_S: Final = 30.0
"""A turn seen again after so long is known."""
REMEMBERED_TURNS: Final = 65_536
"""Of each group; the oldest are forgotten."""
LONGEST_TURN: Final = 128
"""Characters of a turn that tell it from others: a key may have 65,535, and turns are remembered."""
KNOWN_SHARE: Final = 3
"""So many times as much is served of the known as of newcomers, where both wait."""
OF_ONE_TURN: Final = 4
"""One turn may fill a quarter of the mailbox."""
NEWCOMERS_THREADS: Final = 4
"""Newcomers have a quarter of the threads ..."""
KNOWN_COME_S: Final = 60.0
"""... while a known one has come within so long."""
_QUANTUM_BYTES: Final = 64 * 1024
_HEAD_BYTES: Final = 1024  # what any message costs, as bytes


@dataclass(slots=True)
class _Group(Generic[_T]):
    """Turns that have something waiting, in the order in which they are served."""

    waiting: OrderedDict[str, deque[tuple[int, _T]]] = field(default_factory=OrderedDict)
    credit: dict[str, int] = field(default_factory=dict)
    served: float = 0.0

    def put(self, turn: str, cost: int, item: _T) -> None:
        self.waiting.setdefault(turn, deque()).append((cost, item))

    def take(self) -> tuple[int, _T]:
        """The next item by deficit round robin; there is one."""
        while True:
            turn, items = next(iter(self.waiting.items()))
            credit = self.credit.get(turn, _QUANTUM_BYTES)
            cost, item = items[0]
            if cost > credit:
                self.credit[turn] = credit + _QUANTUM_BYTES
                self.waiting.move_to_end(turn)
                continue
            items.popleft()
            self.credit[turn] = credit - cost
            if items:
                if self.credit[turn] <= 0:
                    self.waiting.move_to_end(turn)
            else:
                del self.waiting[turn]
                self.credit.pop(turn, None)
            return cost, item


class KnownTurns:
    """Which turns are known, within bounds: inventing names forgets newcomers only. Not safe in several threads."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._known: OrderedDict[str, None] = OrderedDict()
        self._new: OrderedDict[str, float] = OrderedDict()

    def is_known(self, turn: str) -> bool:
        """Whether a turn is known; it has now been seen."""
        if turn in self._known:
            self._known.move_to_end(turn)
            return True
        now_s = self._clock_s()
        since_s = self._new.setdefault(turn, now_s)
        if turn and now_s - since_s >= KNOWN_AFTER_S:
            del self._new[turn]
            self._known[turn] = None
            _shorten(self._known)
            return True
        _shorten(self._new)
        return False


def _shorten(kept: "OrderedDict[str, None] | OrderedDict[str, float]") -> None:
    if len(kept) > REMEMBERED_TURNS:
        kept.popitem(last=False)


class InTurn(Generic[_T]):
    """A bounded mailbox of senders in turn, and the threads that empty it.

    Args:
        name: of the threads.
        handle: called with each item; what it raises is logged, and the thread goes on.
        count: number of threads.
        limit: how many items may wait; a quarter of them of one turn.
        clock_s: a clock that does not step, s.
    """

    def __init__(
        self,
        name: str,
        handle: Callable[[_T], None],
        count: int,
        limit: int,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._handle, self.limit, self._clock_s = handle, limit, clock_s
        self._known, self._new = _Group[_T](), _Group[_T]()
        self._turns = KnownTurns(clock_s)
        self._count = self._new_in_hand = 0
        self._most_new = max(1, count // NEWCOMERS_THREADS)
        self._known_s = -math.inf
        self._changed = threading.Condition()
        self._closed = False
        self._threads = [threading.Thread(target=self._run, name=f"{name}-{i}", daemon=True) for i in range(count)]
        for thread in self._threads:
            thread.start()

    def offer(self, turn: str, size_bytes: int, item: _T) -> Iterable[_T]:
        """Hands an item over without ever blocking.

        Args:
            turn: whose it is; "" where nobody knows.
            size_bytes: of the message.
            item: what is handed over.

        Returns:
            The items that have no room now: the one offered where its turn has too many waiting, else where the mailbox
            is full the newest one of the turn with the most.
        """
        with self._changed:
            if self._closed:
                return (item,)
            turn = turn[:LONGEST_TURN]
            is_known = self._turns.is_known(turn)
            self._known_s = self._clock_s() if is_known else self._known_s
            group = self._known if is_known else self._new
            if len(group.waiting.get(turn, ())) >= max(1, self.limit // OF_ONE_TURN):
                return (item,)
            group.put(turn, size_bytes + _HEAD_BYTES, item)
            self._count += 1
            dropped = (self._drop_of_longest(),) if self._count > self.limit else ()
            self._changed.notify()
            return dropped

    def _drop_of_longest(self) -> _T:
        """Newcomers make room before the known do."""
        group = self._new if self._new.waiting else self._known
        turn, items = max(group.waiting.items(), key=lambda one: len(one[1]))
        _, item = items.pop()
        if not items:
            del group.waiting[turn]
            group.credit.pop(turn, None)
        self._count -= 1
        return item

    def close(self) -> None:
        """Forgets what waits and ends the threads; handlers that do not return are left behind after 5 s."""
        with self._changed:
            self._closed = True
            self._known, self._new, self._count = _Group[_T](), _Group[_T](), 0
            self._changed.notify_all()
        deadline_s = time.monotonic() + _JOIN_S
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline_s - time.monotonic()))
                if thread.is_alive():
                    _LOG.warning("%s is still busy %.0f s after it was told to end", thread.name, _JOIN_S)

    def _run(self) -> None:
        while (taken := self._next()) is not None:
            item, is_new = taken
            try:
                self._handle(item)
            except Exception:
                _LOG.exception("%s: handler failed", threading.current_thread().name)
            del item, taken  # a query is finalised when its last reference goes
            if is_new:
                with self._changed:
                    self._new_in_hand -= 1
                    self._changed.notify()

    def _next(self) -> tuple[_T, bool] | None:
        """The next item and whether it is a newcomer's; None: closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._known.waiting or self._may_take_new())
            if self._closed:
                return None
            self._count -= 1
            item, is_new = self._take()
            self._new_in_hand += is_new
            return item, is_new

    def _may_take_new(self) -> bool:
        if not self._new.waiting:
            return False
        return self._new_in_hand < self._most_new or self._clock_s() - self._known_s > KNOWN_COME_S

    def _take(self) -> tuple[_T, bool]:
        """Of the group that has had less of its share; one that was idle does not save up."""
        known, new = self._known, self._new
        if not (known.waiting and self._may_take_new()):
            known.served = new.served = 0.0
            is_new = not known.waiting
            return (new if is_new else known).take()[1], is_new
        is_new = known.served > new.served
        group, share = (new, 1) if is_new else (known, KNOWN_SHARE)
        cost, item = group.take()
        group.served += cost / share
        return item, is_new
