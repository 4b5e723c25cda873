"""Our numbers beside the paper's and what we set out to reach."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from rich.console import Console
from rich.table import Table

from studies.traffic_study.targets import Target

_PLAIN_WIDTH: Final = 150


def judged(found: Mapping[str, Any], targets: Sequence[Target]) -> dict[str, dict[str, Any]]:
    """Return each target that a result can judge: our value, the paper's, must and aim, and which of them are met."""
    rows = {}
    for target in targets:
        value = at_path(found, target.path)
        if value is not None:
            rows[target.name] = {
                "value": round(value, 4),
                "unit": target.unit,
                "paper": target.paper,
                "must": target.must,
                "aim": target.aim,
                "larger_is_better": target.larger,
                "met": target.is_met(value, target.must),
                "aim_met": target.is_met(value, target.aim),
            }
    return rows


def at_path(values: Mapping[str, Any], path: str) -> float | None:
    """Return the number at a path with dots between; None where there is none."""
    found: Any = values
    for name in path.split("."):
        found = found.get(name) if isinstance(found, Mapping) else None
    return None if found is None else float(found)


def targets_table(rows: Mapping[str, Mapping[str, Any]], title: str) -> Table:
    """Return the targets as a table for the terminal."""
    table = plain_table(title, "", "ours", "paper", "must", "aim", "met")
    for name, row in rows.items():
        sign = "≥" if row["larger_is_better"] else "≤"
        met = "aim" if row["aim_met"] else "yes" if row["met"] else "NO"
        ours, limits = f"{row['value']:.3f} {row['unit']}", (f"{sign} {row[limit]:g}" for limit in ("must", "aim"))
        table.add_row(name, ours, row["paper"], *limits, met, style="" if row["met"] else "red")
    return table


def print_tables(tables: Sequence[Table]) -> None:
    """Print tables on standard output."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=_PLAIN_WIDTH)
    for table in tables:
        console.print(table)


def plain_table(title: str, *columns: str) -> Table:
    """Return an empty table: its first column to the left, numbers to the right."""
    table = Table(title=title, title_justify="left")
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right")
    return table
