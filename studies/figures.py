"""What a benchmark measures, and how it is printed."""

import json
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

from rich.console import Console
from rich.table import Table


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


def median_s(work: Callable[[], object], runs: int = 5) -> float:
    """Return the median wall time, s, of a call after one call that is not counted."""
    work()
    times_s = []
    for _ in range(runs):
        start_s = time.perf_counter()
        work()
        times_s.append(time.perf_counter() - start_s)
    return statistics.median(times_s)


def machine() -> str:
    """Return a line about the machine, so that nobody compares across machines unknowingly."""
    return f"{platform.machine()}, Python {platform.python_version()}, {platform.system()} {platform.release()}"


def print_figures(title: str, command: str, figures: Sequence[Figure], *, as_json: bool) -> None:
    """Print figures as a table, or as one JSON object."""
    if as_json:
        print(json.dumps({"benchmark": title, "command": command, "figures": [asdict(f) for f in figures]}))
        return
    table = Table(title=f"{title}  [dim]{command}[/dim]", title_justify="left", box=None, pad_edge=False)
    for column in ("figure", "value", "unit", "detail"):
        table.add_column(column, justify="right" if column == "value" else "left")
    for figure in figures:
        table.add_row(figure.name, f"{figure.value:,.3g}" if figure.value < 1000 else f"{figure.value:,.0f}",
                      figure.unit, figure.detail)  # fmt: skip
    Console().print(table)
