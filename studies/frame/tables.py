"""Tables: declared once, shown on a terminal and written as Markdown."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

_PLAIN_WIDTH: Final = 190
Row = Mapping[str, Any]


@dataclass(slots=True)
class Sheet:
    """A table: its title, columns, rows of cells with a style ("bold", "dim", "red" or none), lines below it, and
    which columns beside the first are texts, not numbers.
    """

    title: str
    columns: Sequence[str] = ()
    rows: list[tuple[tuple[str, ...], str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    texts: Sequence[str] = ()

    def add(self, *cells: object, style: str = "") -> None:
        """Add a row; cells that are missing stay empty."""
        shown = tuple(map(str, cells))
        self.rows.append((shown + ("",) * (len(self.columns) - len(shown)), style))

    def rich(self) -> Table:
        """The table for a terminal: its first column to the left, the others to the right."""
        table = Table(box=None, pad_edge=False)
        for number, column in enumerate(self.columns):
            table.add_column(column, justify="right" if number and column not in self.texts else "left")
        for cells, style in self.rows:
            table.add_row(*map(_coloured, cells), style=style)
        return table

    def markdown(self) -> str:
        """The table as Markdown."""
        lines = [f"**{self.title}**", ""]
        if self.columns:
            lines += [_row(self.columns), _row(["---", *["---:"] * (len(self.columns) - 1)])]
        marks = {"dim": "*", "bold": "**"}
        lines += [_row([f"{mark}{c}{mark}" if c else "" for c in cells])
                  for cells, mark in ((cells, marks.get(style, "")) for cells, style in self.rows)]  # fmt: skip
        return "\n".join([*lines, "", *(f"{note}\n" for note in self.notes)])


def sheet(title: str, *columns: str) -> Sheet:
    """An empty table."""
    return Sheet(title, columns)


def sheet_of(title: str, columns: Mapping[str, str], rows: Mapping[str, Row] | Iterable[Row], first: str = "") -> Sheet:
    """A table from one declaration of its columns.

    Args:
        title: of the table.
        columns: by their head what stands in a cell, such as "{error.p95:.2f} / {error.max:.2f}"; what is missing or
            None is a dash.
        rows: nested plain values; by the name of the row, which then stands first, or without names.
        first: head of the rows' names.
    """
    named = isinstance(rows, Mapping)
    table = Sheet(title, ((first,) if named else ()) + tuple(columns))
    for name, row in rows.items() if isinstance(rows, Mapping) else (("", row) for row in rows):
        table.add(*((name,) if named else ()), *(shown(cell, row) for cell in columns.values()))
    return table


def shown(cell: str, row: Row) -> str:
    """What stands in a cell: `str.format` over nested plain values."""
    return cell.format_map(_Values({key: _Value(value) for key, value in row.items()}))


class _Value:
    """A plain value for `str.format`: tables by attribute, None as a dash."""

    def __init__(self, value: Any) -> None:
        self._value = value

    def __getattr__(self, name: str) -> "_Value":
        return _Value(None if self._value is None else self._value.get(name))

    def __format__(self, spec: str) -> str:
        return "–" if self._value is None else format(self._value, spec)


class _Values(dict[str, _Value]):
    def __missing__(self, key: str) -> _Value:
        return _Value(None)


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _coloured(cell: str) -> Text:
    """Green where all limits are met, red where one is not."""
    return Text(cell, style="red" if "FAIL" in cell else "green" if cell.startswith("pass") else "")


def print_sheets(sheets: Sequence[Sheet], console: Console | None = None) -> None:
    """Print tables on standard output."""
    console = console or Console()
    if not console.is_terminal:
        console = Console(width=_PLAIN_WIDTH, file=console.file)
    for one in sheets:
        console.print(Text(one.title, style="bold"))
        if one.columns:
            console.print(one.rich())
        for note in one.notes:
            console.print(Text(note))
        console.print()


def markdown_of(sheets: Sequence[Sheet], command: str) -> str:
    """Tables as Markdown, below the command that makes them."""
    return "\n".join([f"`{command}`\n", *(one.markdown() for one in sheets)])


def fixed(value: Any, digits: int = 2, unit: str = "") -> str:
    """A number with so many digits behind the point; a dash for None."""
    return "–" if value is None else f"{value:,.{digits}f}{unit}"


def several(values: Iterable[Any], digits: int = 2) -> str:
    """Numbers with slashes between."""
    return " / ".join(fixed(value, digits) for value in values)


def seeds_named(seeds: Sequence[Any]) -> str:
    """Seeds for a title: `seed 3`, `seeds 1, 2`, `50 seeds, 1000 … 1049`."""
    if len(seeds) > 8:
        return f"{len(seeds)} seeds, {seeds[0]} … {seeds[-1]}"
    return f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
