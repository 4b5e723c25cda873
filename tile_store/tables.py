"""The answers of `gnd map` as tables for people."""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from rich.console import Console
from rich.table import Table

from gnd.tile_store.compare import MapDiff


def fields(title: str, values: dict[str, Any]) -> Table:
    """One row a value."""
    table = Table(title=title, show_header=False)
    for name, value in values.items():
        table.add_row(name.replace("_", " "), str(value))
    return table


def info(title: str, told: dict[str, Any]) -> Table:
    """What a store holds: the map of a region, then the store's inbox, queue and quarantine."""
    store = told["store"]
    heights = {}
    if "lowest_m" in told:
        heights["heights"] = f"{told['lowest_m']} m to {told['highest_m']} m above the ellipsoid"
    return fields(
        title,
        {
            "layer": _layer(told),
            "region": told["prefix"] or "everywhere",
            "tiles": f"{told['tiles']} in {told['districts']} districts",
            **_content(told),
            "versions": f"{told['lowest_version']} to {told['highest_version']}",
            "updated": f"{_time(told['updated_ns'])} UTC",
            "south-west": f"{told['south_deg']:.6f}, {told['west_deg']:.6f}",
            "north-east": f"{told['north_deg']:.6f}, {told['east_deg']:.6f}",
            **heights,
            "reports": f"{store['reports']} over {store['report_rows']} tiles, {store['waiting']} to merge",
            "tiles to merge": store["dirty"],
            "tiles set aside": store["set_aside"],
            "in quarantine": store["quarantined"],
        },
    )


def _layer(told: dict[str, Any]) -> str:
    others = [name for name in told["layers"] if name != told["layer"]]
    return f"{told['layer']} (others: {', '.join(others)})" if others else str(told["layer"])


def _content(told: dict[str, Any]) -> dict[str, Any]:
    if "features" in told:
        return _features(told)
    if "gaussians" in told:
        return _gaussians(told)
    return {"size": f"{told['body_bytes'] / 1e6:.3f} MB", "codecs": _listed(told["codecs"], " tiles")}


def _gaussians(told: dict[str, Any]) -> dict[str, Any]:
    return {
        "Gaussians": f"{told['gaussians']} of {told['points']} points",
        "size": f"{told['body_bytes'] / 1e6:.3f} MB, {told['bytes_a_voxel']:.2f} bytes a Gaussian",
        "codecs": _listed(told["codecs"], " tiles"),
    }


def _features(told: dict[str, Any]) -> dict[str, Any]:
    return {
        "features": f"{told['features']} in {told['pieces']} pieces with {told['points']} points",
        "kinds": _listed(told["kinds"]),
        "existence": _listed(told["states"]),
        "size": f"{told['body_bytes'] / 1e6:.3f} MB, {told['bytes_a_piece']:.2f} bytes a piece",
    }


def _listed(counts: dict[str, int], unit: str = "") -> str:
    return ", ".join(f"{name} ({n}{unit})" for name, n in counts.items())


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
    """One row a tile that differs, and the totals in voxels or features."""
    head, *rows = result.rows()
    table = Table(title=f"layer {result.layer}, region {result.prefix or 'everywhere'}")
    for i, column in enumerate(head):
        table.add_column(column.replace("_", " "), justify="right" if i else "left")
    for row in rows:
        table.add_row(*row)
    if rows:
        console.print(table)
    console.print(
        f"{len(rows)} tiles differ, {result.tiles_same} are the same; {result.noun}: {result.new} new,"
        f" {result.deleted} deleted, {result.modified} modified, {result.same} the same",
        highlight=False,
    )


def quarantine(rows: list[dict[str, Any]]) -> Table:
    """One row a refused message."""
    table = Table("last received", "times", "bytes", "source", "reason", title=f"{len(rows)} messages in quarantine")
    for row in rows:
        table.add_row(_time(row["received_ns"]), str(row["times"]), str(row["bytes"]), row["source"], row["reason"])
    return table


def _time(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S")


def checked(title: str, told: dict[str, Any]) -> Table:
    """One row a thing that is not whole."""
    table = Table("what", "which", "why", title=f"{title}: {len(told['damages'])} damages")
    for one in told["damages"]:
        table.add_row(one["kind"], one["name"], one["why"])
    return table


def rollback(steps: list[dict[str, Any]], meaning: Mapping[Any, str]) -> Table:
    """One row a tile."""
    table = Table("tile", "version", "content of", "it")
    for one in steps:
        content = str(one["to_version"]) if one["to_version"] else "nothing"
        table.add_row(one["tile"], str(one["from_version"]), content, meaning[one["action"]])
    return table
