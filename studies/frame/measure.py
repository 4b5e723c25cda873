"""What a benchmark measures, how it is timed, and how it is printed."""

import json
import platform
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from time import perf_counter, process_time
from typing import Any

from studies.frame.tables import Sheet, print_sheets


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure.

    Attributes:
        name: what was measured.
        value: the number (a median where several runs were made).
        unit: its unit.
        detail: the size of the work, the accuracy beside it, the peer in the same run.
    """

    name: str
    value: float
    unit: str
    detail: str = ""


def times_s(work: Callable[[], object], runs: int, clock: Callable[[], float] = process_time) -> list[float]:
    """Return the time, s, of each of some calls after one call that is not counted."""
    work()
    found = []
    for _ in range(runs):
        begin_s = clock()
        work()
        found.append(clock() - begin_s)
    return found


def median_s(work: Callable[[], object], runs: int = 5) -> float:
    """Return the median wall time, s, of a call."""
    return statistics.median(times_s(work, runs, perf_counter))


def core_s(work: Callable[[], object], runs: int = 15) -> float:
    """Return the median time of the processor, s, of a call."""
    return statistics.median(times_s(work, runs))


def least_s(work: Callable[[], object], runs: int = 3) -> float:
    """Return the least time of the processor, s, of a call."""
    return min(times_s(work, runs))


def spent_s(work: Callable[[], object]) -> float:
    """Return the time of the processor, s, of one call, the first."""
    begin_s = process_time()
    work()
    return process_time() - begin_s


def machine() -> str:
    """Return a line about the machine, so that nobody compares across machines unknowingly."""
    return f"{platform.machine()}, Python {platform.python_version()}, {platform.system()} {platform.release()}"


def print_figures(title: str, command: str, figures: Sequence[Figure], *, as_json: bool) -> None:
    """Print figures as a table, or as one JSON object."""
    if as_json:
        print(json.dumps({"benchmark": title, "command": command, "figures": [asdict(f) for f in figures]}))
        return
    table = Sheet(f"{title}  {command}", ("figure", "value", "unit", "detail"))
    table.texts = ("unit", "detail")
    for one in figures:
        table.add(one.name, f"{one.value:,.3g}" if one.value < 1000 else f"{one.value:,.0f}", one.unit, one.detail)
    print_sheets([table])


class Stopwatch:
    """Sums the processor's time by name, where functions and methods are timed while it is worn.

    A call within a call that is timed counts for the inner one only.
    """

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
