"""`gnd map rollback STORE vehicle:NAME`: remove the reports of one vehicle; other targets are the store's own."""

from dataclasses import asdict
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from gnd.fleet_bus.identity.options import identity_option
from gnd.gnd_map.features import is_feature_layer
from gnd.tile_store.arguments import parse_time_ns
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import LOCATION, StoreLocation, shown
from gnd.tile_store.options import json_option, layer_option, show, to_publish, to_read
from gnd.tile_store.upkeep_cli import rollback as store_rollback
from gnd.tile_store.values import DEFAULT_CODEC, MAP_CODECS

PREFIX = "vehicle:"
_OLD = "Of the shards, where the store does not say: it was merged by an older release."


@click.command(short_help="Restore an older state of tiles, or remove the reports of a vehicle.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("place", metavar="TILE|REGION|vehicle:NAME")
@click.argument("version", type=int, required=False)
@click.option("--to", help="A version of the tile (3), or a time (2026-01-31T12:00:00Z).")
@click.option("--dry-run", is_flag=True, help="Only list what would change.")
@click.option("--codec", default=DEFAULT_CODEC, show_default=True, type=click.Choice(MAP_CODECS), help=_OLD)
@layer_option
@json_option
@identity_option
@click.pass_context
def rollback(
    context: click.Context,
    path: StoreLocation,
    place: str,
    version: int | None,
    to: str | None,
    dry_run: bool,
    codec: str,
    layer: str,
    as_json: bool,
) -> None:
    """Publish older content of a TILE as its next version; merged reports count no more.

    TILE is a path, a number, or lat,lon. REGION is the leading part of tile paths with a slash at its end, such as
    13033/ or 13033/03021/, and / is everywhere: its tiles go back to a time, all or none. Tiles that were not there yet
    become empty.

    vehicle:NAME computes every tile that a vehicle spoke of anew from what the others said, without its reports (all,
    or those received since --to TIME), and publishes what differs. Running mergers announce it to the vehicles.
    """
    if not place.startswith(PREFIX):
        context.invoke(
            store_rollback,
            path=path, place=place, version=version, to=to, dry_run=dry_run, layer=layer, as_json=as_json,
        )  # fmt: skip
        return
    if version is not None:
        raise StoreError("rollback vehicle:NAME goes back to a time, not to a version")
    # loaded here: they load scipy and numba, which the other commands do without
    from gnd.cloud_merger.config import ShardConfig
    from gnd.cloud_merger.expel import without_vehicle

    since_ns = 0 if to is None else parse_time_ns(to)
    with to_read(path) if dry_run else to_publish(path) as store:
        config = ShardConfig(store_path=path, codec=codec)
        found = list(without_vehicle(store, config, layer, place.removeprefix(PREFIX), since_ns))
        changed = [tile for _, tile in found if tile is not None]
        if changed and not dry_run:
            store.put_tiles(changed, "rollback", layer)
    if not found:
        raise StoreError(
            f"{shown(path)}: {place.removeprefix(PREFIX)} has reported nothing about layer {layer} since then"
        )
    rows = [asdict(one) | {"tile": one.tile.path} for one, _ in found]
    verb = "would change" if dry_run else "have changed"
    title = f"{shown(path)}, layer {layer}: {len(changed)} of {len(rows)} tiles {verb}"
    values = {"layer": layer, "vehicle": place.removeprefix(PREFIX), "dry_run": dry_run, "tiles": rows}
    show(values, as_json, lambda console: _print(console, title, layer, rows))


def _print(console: Console, title: str, layer: str, rows: list[dict[str, Any]]) -> None:
    console.print(title, highlight=False, soft_wrap=True)
    table = Table("tile", "its reports", "features" if is_feature_layer(layer) else "voxels", "")
    for one in rows:
        table.add_row(one["tile"], str(one["reports"]), str(one["voxels"]), one["reason"] or one["status"])
    console.print(table)
