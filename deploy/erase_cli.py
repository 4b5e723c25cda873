"""`gnd map erase STORE vehicle:NAME`: what a vehicle has said stays in the map, that it was this vehicle does not."""

from collections import Counter
from dataclasses import asdict
from typing import Any, Final

import click
from rich.console import Console
from rich.table import Table

from gnd.deploy.vehicle_rollback_cli import PREFIX
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import LOCATION, StoreLocation, file_of, shown
from gnd.tile_store.options import bars, existing, json_option, show
from gnd.tile_store.sql_erase import compact

OF_DATABASE: Final = (
    "old forms of its rows are in the database's files until VACUUM FULL; in its log, until that is removed"
)


@click.command(short_help="Make the reports of a vehicle nobody's.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("vehicles", metavar="vehicle:NAME...", nargs=-1, required=True)
@click.option("--dry-run", is_flag=True, help="Only say what there is.")
@json_option
def erase(path: StoreLocation, vehicles: tuple[str, ...], dry_run: bool, as_json: bool) -> None:
    """Remove the name of each vehicle from STORE, and what links its reports; the map and its versions stay.

    Its votes stay under invented names, one a tile; `gnd map verify` computes the same versions as before. Raw
    messages, surveys and accounts of the vehicle are removed, and the file is written anew; a database is not, and
    keeps old forms of rows until VACUUM FULL. No merger may work on the store. A vehicle that still holds reports would
    send them again: shut it out first (`gnd certs revoke`). Backups of the store are not touched.
    """
    names = [one.removeprefix(PREFIX) for one in vehicles if one.startswith(PREFIX)]
    if len(names) != len(vehicles):
        raise StoreError(f"{', '.join(one for one in vehicles if not one.startswith(PREFIX))}: write vehicle:NAME")
    # loaded here: they load scipy and numba, which the other commands do without
    from gnd.cloud_merger.config import ShardConfig
    from gnd.cloud_merger.erase import erase_vehicle

    with existing(path) as store, bars() as tell:
        config = ShardConfig(store_path=path)
        found = [erase_vehicle(store, config, name, tell, dry_run=dry_run) for name in names]
    file = file_of(path)
    if not dry_run and file is not None:
        compact(file)
    told = [
        {"vehicle": one.vehicle, "counts": not one.is_counted_out, "removed": dict(one.removed)}
        | {"tiles": [asdict(tile) | {"tile": tile.tile.path} for tile in one.tiles]}
        for one in found
    ]
    show({"dry_run": dry_run, "vehicles": told}, as_json, lambda console: _print(console, path, told, dry_run))


def _print(console: Console, path: StoreLocation, told: list[dict[str, Any]], dry_run: bool) -> None:
    table = Table("vehicle", "tiles", "reports", "times kept to", "versions that verify", "other rows")
    for one in told:
        times = Counter(tile["times"] for tile in one["tiles"])
        table.add_row(
            one["vehicle"],
            str(len(one["tiles"])),
            str(sum(tile["reports"] for tile in one["tiles"])),
            ", ".join(f"{name} ({n})" for name, n in sorted(times.items())) or "-",
            str(sum(tile["versions"] for tile in one["tiles"])),
            ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in one["removed"].items() if n) or "-",
        )
    verb = "would be made nobody's" if dry_run else "are nobody's now; backups of the store are not touched"
    console.print(f"{shown(path)}: reports {verb}", highlight=False, soft_wrap=True)
    console.print(table)
    if not dry_run and file_of(path) is None:
        console.print(OF_DATABASE, highlight=False, soft_wrap=True)
