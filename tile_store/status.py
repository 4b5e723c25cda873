"""`gnd map status`: what a map is waiting for."""

import json
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import click
from rich.console import Console
from rich.table import Table

from tile_store.sqlite_store import SqliteStore
from tile_store.store import Store
from tile_store.values import WaitingReason

WORDS: Final[dict[WaitingReason, str]] = {
    "share": "more of the tile than one vehicle is believed",
    "poses": "its poses were known poorly",
    "doubtful": "the vehicle doubts it itself",
    "named": "its reports are shifted again and again",
}


@click.command(short_help="What the map waits for: confirmation, merging, people.")
@click.argument("path", metavar="STORE", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of tables.")
def status(path: Path, as_json: bool) -> None:
    """What STORE waits for: changes that only one vehicle claims, tiles to merge, refused messages."""
    with SqliteStore(path, create=False) as store:
        values = status_of(store)
    if as_json:
        click.echo(json.dumps(values, indent=1))
    else:
        print_status(Console(width=120), str(path), values)


def status_of(store: Store) -> dict[str, Any]:
    """All that waits, in plain values: `waiting_for_confirmation`, `to_merge`, `quarantined`."""
    claims = [asdict(one) | {"tile": one.tile.path} for one in store.waiting_changes()]
    return {
        "waiting_for_confirmation": waiting_totals(store) | {"claims": claims},
        "to_merge": [asdict(one) | {"tile": one.tile.path} for one in store.dirty_tiles()],
        "quarantined": store.counts().quarantined,
    }


def waiting_totals(store: Store) -> dict[str, int]:
    """How many tiles and voxels wait for a second witness; a voxel counts once for each vehicle that claims it."""
    waiting = store.waiting_changes()
    tiles = {(one.layer, one.tile) for one in waiting}
    return {"tiles": len(tiles), "voxels": sum(one.voxels for one in waiting)}


def print_status(console: Console, title: str, values: dict[str, Any]) -> None:
    """One table for each thing that waits, and one line where nothing does."""
    waiting, to_merge = values["waiting_for_confirmation"], values["to_merge"]
    if waiting["claims"]:
        console.print(_waiting_table(waiting))
    if to_merge:
        console.print(_merge_table(to_merge))
    if values["quarantined"]:
        line = f"{values['quarantined']} messages in quarantine: see `gnd map quarantine`"
        console.print(line, highlight=False)
    if not (waiting["claims"] or to_merge or values["quarantined"]):
        console.print(f"{title}: all reports merged, nothing waits for confirmation, none refused", highlight=False)


def _waiting_table(waiting: dict[str, Any]) -> Table:
    title = (
        f"waiting for confirmation by a second vehicle or drive: {waiting['voxels']} voxels in {waiting['tiles']} tiles"
    )
    table = Table("layer", "tile", "vehicle", "voxels", "of seen", "since (UTC)", "because", title=title)
    for one in waiting["claims"]:
        numbers = (str(one["voxels"]), str(one["seen"]), _time(one["since_ns"]))
        table.add_row(one["layer"], one["tile"], one["vehicle"], *numbers, WORDS.get(one["reason"], one["reason"]))
    return table


def _merge_table(to_merge: list[dict[str, Any]]) -> Table:
    table = Table("layer", "tile", "reports", "attempts", "", title=f"{len(to_merge)} tiles to merge")
    for one in to_merge:
        numbers = (str(one["reports"]), str(one["attempts"]))
        table.add_row(one["layer"], one["tile"], *numbers, "at work" if one["is_leased"] else "")
    return table


def _time(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S")
