"""CPU time by stage: calls of the vehicle's own parts are timed where they stand, each without what it calls."""

import time
from collections import defaultdict
from collections.abc import Iterator
from functools import wraps
from typing import Any, Final

from gnd.deploy.errors import DeployError

REST: Final = "the rest"
"""What no stage takes: the loop between them."""


class Stopwatch:
    """Sums the CPU time [s] of the calling thread by stage, scan by scan.

    A stage that calls another is not charged for it. What a generator does is timed while it is asked.
    """

    def __init__(self) -> None:
        self.scans: list[dict[str, float]] = []
        self._stack = [REST]
        self._now: dict[str, float] = defaultdict(float)
        self._since_s = time.thread_time()

    def watch(self, owner: type, method: str, stage: str) -> None:
        """Time a method of a class, for all its objects, until the process ends.

        Raises:
            DeployError: the class has no such method.
        """
        plain = owner.__dict__.get(method)
        if not callable(plain):
            raise DeployError(f"{owner.__name__} has no method {method} to time")

        @wraps(plain)
        def watched(*arguments: Any, **named: Any) -> Any:
            self._enter(stage)
            try:
                given = plain(*arguments, **named)
            finally:
                self._leave()
            return self.timed(given, stage) if isinstance(given, Iterator) else given

        setattr(owner, method, watched)

    def lap(self) -> None:
        """A scan is done with: what was measured since the last counts for it."""
        self._charge()
        self.scans.append(dict(self._now))
        self._now.clear()

    def timed(self, items: Iterator[Any], stage: str) -> Iterator[Any]:
        """The same items; the time to get each counts for a stage."""
        while True:
            self._enter(stage)
            try:
                item = next(items, _END)
            finally:
                self._leave()
            if item is _END:
                return
            yield item

    def _enter(self, stage: str) -> None:
        self._charge()
        self._stack.append(stage)

    def _leave(self) -> None:
        self._charge()
        self._stack.pop()

    def _charge(self) -> None:
        now_s = time.thread_time()
        self._now[self._stack[-1]] += now_s - self._since_s
        self._since_s = now_s


_END: Final = object()
