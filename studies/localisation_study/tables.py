"""A study as tables: for people on a terminal, and as Markdown for a document. Both show the same rows."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from studies.localisation_study import reference
from studies.localisation_study.reference import PAPER, PAPER_OF_ROW, QUANTITIES, Limit
from studies.localisation_study.summary import ROWS
from studies.localisation_study.targets import sensors_of, within
from studies.localisation_study.trials import WITHIN_S
from studies.localisation_study.variants import LABELS

_PLAIN_WIDTH: Final = 150
ROW_LABELS: Final[Mapping[str, str]] = {
    "without_submap": "without submap",
    "with_submap": "with submap",
    "online": "online, outdated map",
    "after_update": "online, updated map",
    "after_update_with_submap": "with submap, updated map",
    "fresh": "online, fresh map",
    "fresh_with_submap": "with submap, fresh map",
}
HEAD: Final = (
    "",
    "longitudinal m",
    "lateral m",
    "heading °",
    "coverage",
    "paper's limits",
    "Ford, local street",
    "good, but wrong",
)


@dataclass(frozen=True, slots=True)
class Line:
    """One row of a table: its cells, and whether it is the paper's."""

    cells: tuple[str, ...]
    paper: bool = False


def lines_of(rows: Mapping[str, Any]) -> Iterator[Line]:
    """Give the lines of one sensor: each of our rows, the paper's below it, then the runs with added errors."""
    for name in ROWS:
        yield _line(ROW_LABELS[name], rows[name])
        for paper in PAPER_OF_ROW.get(name, ()):
            yield _paper_line(paper)
    for name, row in rows.get("variants", {}).items():
        yield _line(LABELS[name], row)


def _line(label: str, row: Mapping[str, Any]) -> Line:
    errors = [_pair(row[quantity]) for quantity in QUANTITIES]
    limits = [_met(row, limit) for limit in (reference.PAPER_LIMITS, reference.FORD_LOCAL)]
    return Line((label, *errors, f"{100 * row['coverage']:.1f} %", *limits, str(row["wrong_called_good"])))


def _paper_line(name: str) -> Line:
    limit = PAPER[name]
    row = limit.plain()
    errors = [_pair(row[quantity]) for quantity in QUANTITIES]
    return Line((f"paper, {_paper_name(name)}", *errors, "", *(_met(row, one) for one in _limits()), ""), paper=True)


def _limits() -> tuple[Limit, Limit]:
    return reference.PAPER_LIMITS, reference.FORD_LOCAL


def _paper_name(name: str) -> str:
    table, _, what = name.partition("_")
    return f"{table.replace('table', 'Table ')}, {what.replace('_', ' ')}"


def _pair(error: Mapping[str, float] | None) -> str:
    return "no pose" if error is None else f"{error['p95']:.4f} / {error['max']:.4f}"


def _met(row: Mapping[str, Any], limit: Limit) -> str:
    """Whether the 95 % and the largest error meet a limit."""
    return " / ".join("pass" if within(row, limit, statistic) else "FAIL" for statistic in ("p95", "max"))


def starts_line(rows: Mapping[str, Any]) -> str:
    """Return a sentence about the starts without a pose; empty where there were none."""
    row = rows.get("reinitialisation")
    if not row:
        return ""
    after = row["good_after_s"]
    seconds = "" if after["p50"] is None else f"; good after {after['p50']:.1f} s (half), {after['p95']:.1f} s (95 %)"
    return (
        f"{row['trials']} starts 2.5 m off, any heading: {row['right']} right within {WITHIN_S:g} s"
        f" ({100 * row['right_share']:.1f} %), {row['never_good']} never good,"
        f" {row['wrong_called_good']} ever good while wrong{seconds}"
    )


def update_line(rows: Mapping[str, Any]) -> str:
    """Return a sentence on the updated map against a fresh one."""
    ratio = rows["update_ratio"]
    if ratio is None:
        return "updated map against a fresh one: no poses"
    shown = " / ".join(f"{ratio[quantity]:.2f}" for quantity in QUANTITIES)
    return f"95 % online, updated map over fresh map: {shown} (at most {reference.MUST_UPDATE_RATIO})"


def world_line(world: Mapping[str, Any]) -> str:
    """Return a sentence on a world."""
    edits = sum(n for edit, n in world["edits"].items() if edit != "kept")
    return f"{world['length_m']:g} m, {edits} edits, {100 * world['changed_share']:.1f} % of the Gaussians changed"


def worlds_of(found: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Return the facts of each world by seed."""
    return {seed: one["world"] for seed, one in found["seeds"].items()}


def print_tables(found: Mapping[str, Any]) -> None:
    """Print the tables on standard output."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=_PLAIN_WIDTH)
    console.print(_tables(found))


def _tables(found: Mapping[str, Any]) -> Group:
    worlds = worlds_of(found)
    parts: list[Any] = [Text(f"world {seed}: {world_line(world)}") for seed, world in worlds.items()]
    if len(worlds) > 1:
        parts.append(Text("Of every number the worst of the worlds."))
    for sensor in sensors_of(found):
        parts += [Text(), _table(sensor, found[sensor])]
        parts += [Text(line) for line in (update_line(found[sensor]), starts_line(found[sensor])) if line]
    return Group(*parts)


def _table(sensor: str, rows: Mapping[str, Any]) -> Table:
    table = Table(title=f"{sensor}: 95 % / maximum", title_justify="left", box=None, pad_edge=False)
    for number, column in enumerate(HEAD):
        table.add_column(column, justify="right" if number else "left")
    for line in lines_of(rows):
        table.add_row(*map(_coloured, line.cells), style="dim" if line.paper else "")
    return table


def _coloured(cell: str) -> Text:
    """Green where both limits are met, red where one is not."""
    style = "red" if "FAIL" in cell else "green" if cell.startswith("pass") else ""
    return Text(cell, style=style)


def markdown_of(found: Mapping[str, Any], command: str) -> str:
    """Return the tables as Markdown.

    Args:
        found: the result.
        command: what makes these numbers.
    """
    worlds = worlds_of(found)
    lines = [f"`{command}`", ""]
    lines += [f"- world {seed}: {world_line(world)}" for seed, world in worlds.items()]
    worst = "; of every number the worst of the worlds" if len(worlds) > 1 else ""
    for sensor in sensors_of(found):
        rows = found[sensor]
        lines += ["", f"**{sensor}**, 95 % / maximum{worst}:", "", *_markdown_table(rows), ""]
        lines += [f"{line}." for line in (update_line(rows), starts_line(rows)) if line]
    return "\n".join(lines) + "\n"


def _markdown_table(rows: Mapping[str, Any]) -> Iterator[str]:
    yield f"| {' | '.join(HEAD)} |"
    yield "|---" * len(HEAD) + "|"
    for line in lines_of(rows):
        cells = [f"*{cell}*" if line.paper and cell else cell for cell in line.cells]
        yield f"| {' | '.join(cells)} |"
