"""The answers of `gnd map` as tables for people."""

from datetime import UTC, datetime
from typing import Any

from rich.console import Console
from rich.table import Table

from tile_store.compare import MapDiff


def fields(title: str, values: dict[str, Any]) -> Table:
    """One row a value."""
    table = Table(title=title, show_header=False)
    table.add_column()
    table.add_column(justify="right")
    for name, value in values.items():
        table.add_row(name.replace("_", " "), _cell(name, value))
    return table


def info(title: str, values: dict[str, Any]) -> Table:
    """What a store holds: the map, then queue and quarantine."""
    flat = {name: value for name, value in values.items() if name != "store"}
    counts = {f"store {name}": value for name, value in values["store"].items() if name != "tiles"}
    return fields(title, flat | counts)


def history(values: dict[str, Any]) -> Table:
    """One row a version."""
    table = Table(title=f"tile {values['tile']} of layer {values['layer']}")
    for column in ("version", "of", "kind", "created", "merger", "reports", "bytes", "sha"):
        table.add_column(column, justify="right" if column in ("version", "of", "reports", "bytes") else "left")
    for one in values["versions"]:
        numbers = (str(one["n_reports"]), str(one["size_bytes"]))
        table.add_row(
            str(one["version"]), str(one["parent"]), one["kind"], _time(one["created_ns"]), one["merger"], *numbers,
            one["sha"][:12],
        )  # fmt: skip
    return table


def print_diff(console: Console, result: MapDiff) -> None:
    """One row a tile that differs, and the totals in voxels."""
    head, *rows = result.rows()
    table = Table(title=f"layer {result.layer}, region {result.prefix or 'everywhere'}")
    for i, column in enumerate(head):
        table.add_column(column.replace("_", " "), justify="right" if i else "left")
    for row in rows:
        table.add_row(*row)
    if rows:
        console.print(table)
    console.print(
        f"{len(rows)} tiles differ, {result.tiles_same} are the same; voxels: {result.added} added,"
        f" {result.removed} removed, {result.changed} changed, {result.same} the same",
        highlight=False,
    )


def _cell(name: str, value: object) -> str:
    if name.endswith("_ns") and isinstance(value, int):
        return _time(value)
    if isinstance(value, float):
        return f"{value:.6f}"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _time(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S")
