"""The result for people."""

from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from studies.real.causes import CAUSES


def print_tables(found: dict[str, Any], console: Console | None = None) -> None:
    """Print false changes, their causes, and what became of the inserted objects."""
    console = console or Console()
    untouched, inserted = found["untouched"], found["inserted"]
    console.print(
        f"{found['recording']}: {found['scans']} scans, {found['scans_driven']} driven in"
        f" {found['options']['rounds']} rounds, {found['runtime_s']} s"
    )
    for sentence in found["left_out"]:
        console.print(f"  {sentence}")
    console.print(_false_changes(untouched))
    seen = found["untouched_seen"]
    console.print(
        f"  Where the map's half had looked: {sum(seen['false'].values()):,} of {seen['observed']:,} observed,"
        f" {_number(seen['false_per_1000'])} of 1,000\n"
    )
    console.print(_causes(untouched["causes"]))
    console.print(_inserted(inserted))


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left")
    return table


def _false_changes(untouched: dict[str, Any]) -> Table:
    table = _table("Nothing changed: reported nevertheless", "", "voxels", "a 1,000 observed", "a 1,000 Gaussians")
    gaussians = max(untouched["observed_gaussian"], 1)
    for name, n in untouched["false"].items():
        table.add_row(
            name, f"{n:,}", _number(untouched["false_per_1000_by_class"][name]), f"{1000 * n / gaussians:.2f}"
        )
    total = sum(untouched["false"].values())
    rates = _number(untouched["false_per_1000"]), _number(untouched["false_per_1000_gaussian"])
    table.add_row("all", f"{total:,}", *rates, style="bold")
    table.add_row("observed", f"{untouched['observed']:,}", f"{untouched['observed_gaussian']:,} Gaussians", "")
    return table


def _causes(causes: dict[str, dict[str, int]]) -> Table:
    table = _table("Why", "first that holds", *causes)
    for cause, meaning in CAUSES.items():
        numbers = [counts[cause] for counts in causes.values()]
        if any(numbers):
            table.add_row(f"{cause}: {meaning}" if meaning else cause, *map(str, numbers))
    return table


def _inserted(inserted: dict[str, Any]) -> Table:
    table = _table(
        "Objects inserted", "", "objects", "voxels", "recall", "precision", "precision within 3 m of objects"
    )
    for name in ("new", "deleted"):
        one = inserted[name]
        shares = (_percent(one[key]) for key in ("recall", "precision", "precision_near_objects"))
        table.add_row(name, str(inserted["objects"][name]), str(one["true"]), *shares)
    return table


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"
