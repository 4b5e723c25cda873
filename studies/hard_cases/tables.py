"""The hard cases as a table: on a terminal, and as Markdown for a document."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from rich.console import Console
from rich.table import Table

_HEAD: Final = (
    "case", "sensor", "refined cm, °", "wrong called good", "right called bad %", "NEES", "online cm, °",
    "wrong called good", "right called bad %", "NEES", "no submaps cm, °", "CPU s",
)  # fmt: skip


def lines_of(found: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Give the cells of each row, in the order of the head."""
    for case, sensors in found["cases"].items():
        for sensor, row in sensors.items():
            cells = [cell for name in ("refined", "online") for cell in _cells(row[name])]
            yield case, sensor, *cells, _errors(row["without_submaps"]["refined"]), f"{row['cpu_s']:.0f}"


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    wrong, nees = row["wrong_called_good"], row["nees"]
    shown = "" if nees is None else f"{nees['place']:.1f} / {nees['heading']:.1f}"
    return _errors(row), f"{wrong} of {row['poses']}", f"{100 * row['right_called_bad']:.1f}", shown


def _errors(row: Mapping[str, Any]) -> str:
    if row["longitudinal_m"] is None:
        return "no pose"
    along, across, heading = (row[name]["p95"] for name in ("longitudinal_m", "lateral_m", "heading_deg"))
    return f"{100 * along:.1f} / {100 * across:.1f} / {heading:.2f}"


def print_table(found: Mapping[str, Any], console: Console | None = None) -> None:
    """Print the table; rows with a wrong pose called good are bold."""
    seeds = ", ".join(map(str, found["seeds"]))
    table = Table(title=f"Hard cases, seeds {seeds}: 95 % along / across / heading", title_justify="left")
    for index, name in enumerate(_HEAD):
        table.add_column(name, justify="left" if index < 2 else "right")
    for line in lines_of(found):
        lies = not line[3].startswith("0 ") or not line[7].startswith("0 ")
        table.add_row(*line, style="bold" if lies else None)
    (console or Console(width=190)).print(table)


def markdown_of(found: Mapping[str, Any]) -> str:
    """Return the same table as Markdown."""
    rows = [_HEAD, ("---",) * 2 + ("---:",) * (len(_HEAD) - 2), *lines_of(found)]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)
