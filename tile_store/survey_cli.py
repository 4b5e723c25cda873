"""`gnd map survey`: roads that vehicles have surveyed, tile by tile, with their quality and their age."""

from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from gnd.tile_store import clocks, sql_roads
from gnd.tile_store.location import LOCATION, StoreLocation, shown
from gnd.tile_store.options import json_option, layer_option, show, to_read
from gnd.tile_store.sqlite_store import SqlStore

_DAY_NS = 86_400 * 10**9


@click.command(short_help="New roads that vehicles have surveyed: drafts, what waits, what is published.")
@click.argument("path", metavar="STORE", type=LOCATION)
@layer_option
@json_option
def survey(path: StoreLocation, layer: str, as_json: bool) -> None:
    """The tiles of STORE that vehicles have surveyed where the map had no road.

    A tile is a draft until two vehicles have driven there, waits while they disagree or its place is not known well
    enough, and is published then. Sigma is that of the places of its submaps, apart is how far vehicles lie from each
    other in the voxels that they share.
    """
    with to_read(path) as store:
        values = survey_of_store(store, layer, clocks.day_ns())
    show(values, as_json, lambda console: print_survey(console, shown(path), values))


def survey_of_store(store: SqlStore, layer: str, now_ns: int) -> dict[str, Any]:
    """What surveys have made of a layer, in plain values."""
    tiles = store.look(lambda c: sql_roads.tiles(c, layer))
    rows = [
        {name: value for name, value in asdict(one).items() if name not in ("codec_id", "body", "layer")}
        | {"tile": one.tile.path, "bytes": len(one.body), "age_days": round((now_ns - one.last_ns) / _DAY_NS, 2)}
        for one in tiles
    ]
    counts = {state: sum(one.state == state for one in tiles) for state in ("draft", "waiting", "published")}
    open_parts = sum(one.parts for one in store.look(sql_roads.open_roads) if one.layer == layer)
    return {"layer": layer, **counts, "parts_not_mapped": open_parts, "tiles": rows}


def print_survey(console: Console, title: str, values: dict[str, Any]) -> None:
    """One row a tile."""
    table = Table(title=f"{title}: layer {values['layer']}")
    for column in ("tile", "state", "vehicles", "drives", "sigma m", "apart m", "voxels", "alone", "last seen", "why"):
        table.add_column(column, justify="right" if column[-1] == "m" or column in ("drives", "voxels") else "left")
    for one in values["tiles"]:
        apart = "–" if one["apart_m"] is None else f"{one['apart_m']:.3f}"
        seen = datetime.fromtimestamp(one["last_ns"] / 1e9, UTC).strftime("%Y-%m-%d %H:%M")
        numbers = (f"{one['sigma_m']:.3f}", apart, str(one["voxels"]), str(one["alone"]))
        table.add_row(one["tile"], one["state"], str(len(one["vehicles"])), str(one["drives"]), *numbers, seen,
                      one["reason"])  # fmt: skip
    if values["tiles"]:
        console.print(table)
    console.print(
        f"{values['draft']} tiles are drafts, {values['waiting']} wait, {values['published']} are published;"
        f" {values['parts_not_mapped']} parts of surveys are not mapped yet",
        highlight=False,
    )
