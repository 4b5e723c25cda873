"""What a benchmark measures, how it is timed, and how it is printed."""

import json
import platform
import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from time import process_time

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


def core_s(work: Callable[[], object], runs: int = 15) -> float:
    """Return the median time of the processor, s, of a call."""
    return statistics.median(times_s(work, runs))


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
