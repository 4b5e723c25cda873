"""Where a call's time goes: functions and methods are timed while a stopwatch is worn, and are as before after it."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from time import process_time
from typing import Any


class Stopwatch:
    """Sums the processor's time by name. A call within a call that is timed counts for the inner one only."""

    def __init__(self) -> None:
        self.total_s: dict[str, float] = defaultdict(float)
        self._inner_s = [0.0]

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function`, whose time is summed under `name`."""

        def measured(*args: Any, **kwargs: Any) -> Any:
            begin_s = process_time()
            self._inner_s.append(0.0)
            try:
                return function(*args, **kwargs)
            finally:
                spent_s = process_time() - begin_s
                self.total_s[name] += spent_s - self._inner_s.pop()
                self._inner_s[-1] += spent_s

        return measured

    @contextmanager
    def worn(self, parts: Sequence[tuple[str, Any, str]]) -> Iterator[None]:
        """Time the attributes (name, owner, attribute) while this lasts."""
        before = [(owner, attribute, getattr(owner, attribute)) for _, owner, attribute in parts]
        for (name, owner, attribute), (_, _, function) in zip(parts, before, strict=True):
            setattr(owner, attribute, self.timed(name, function))
        try:
            yield
        finally:
            for owner, attribute, function in before:
                setattr(owner, attribute, function)
