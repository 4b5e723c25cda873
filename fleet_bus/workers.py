"""Threads of ours that handle what zenoh delivers, so that zenoh's own threads never wait for us."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, Generic, TypeVar

_T = TypeVar("_T")
_LOG = logging.getLogger(__name__)
_JOIN_S: Final = 5.0


class Workers(Generic[_T]):
    """A bounded mailbox and the threads that empty it.

    Args:
        name: of the threads.
        handle: called with each item; what it raises is logged, and the thread goes on.
        count: number of threads; one keeps the order.
        limit: how many items may wait.
    """

    def __init__(self, name: str, handle: Callable[[_T], None], count: int, limit: int) -> None:
        self._handle, self.limit = handle, limit
        self._items: deque[_T] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._threads = [threading.Thread(target=self._run, name=f"{name}-{i}", daemon=True) for i in range(count)]
        for thread in self._threads:
            thread.start()

    def offer(self, item: _T) -> bool:
        """Hands an item over without ever blocking; False when the mailbox is full or closed."""
        with self._changed:
            if self._closed or len(self._items) >= self.limit:
                return False
            self._items.append(item)
            self._changed.notify()
            return True

    def offer_newest(self, item: _T) -> bool:
        """Hands an item over without ever blocking; drops the oldest of a full mailbox and then gives False."""
        with self._changed:
            full = len(self._items) >= self.limit
            if full:
                self._items.popleft()
            self._items.append(item)
            self._changed.notify()
            return not full

    def close(self) -> None:
        """Forgets what waits and ends the threads; handlers that do not return are left behind after 5 s."""
        with self._changed:
            self._closed = True
            self._items.clear()
            self._changed.notify_all()
        deadline_s = time.monotonic() + _JOIN_S
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline_s - time.monotonic()))
                if thread.is_alive():
                    _LOG.warning("%s is still busy %.0f s after it was told to end", thread.name, _JOIN_S)

    def _run(self) -> None:
        while (item := self._next()) is not None:
            try:
                self._handle(item[0])
            except Exception:
                _LOG.exception("%s: handler failed", threading.current_thread().name)
            del item  # a query is finalised when its last reference goes

    def _next(self) -> tuple[_T] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._items)
            return None if self._closed else (self._items.popleft(),)
