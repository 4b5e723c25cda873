"""`gnd map backup`, `restore`, `check`, `gc`, `retry` and `rollback`: what an operator does with a store."""

from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import click
from rich.console import Console

from gnd.fleet_bus.identity.options import identity_option
from gnd.tile_store import tables
from gnd.tile_store.arguments import parse_place, parse_tile, parse_time_ns
from gnd.tile_store.backup import copy_store
from gnd.tile_store.check import check_rows, check_store
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import LOCATION, StoreLocation, file_of, required_file, shown
from gnd.tile_store.options import PATH, bars, existing, json_option, layer_option, show, to_publish, to_read
from gnd.tile_store.retention import retain
from gnd.tile_store.rollback import MEANING, RollbackStep, RollbackTarget, plan, roll_back

STORE: Final = click.argument("path", metavar="STORE", type=LOCATION)


@click.command(short_help="Copy a map that is in use.")
@STORE
@click.argument("target", metavar="FILE", type=PATH)
@json_option
def backup(path: StoreLocation, target: Path, as_json: bool) -> None:
    """Copy STORE to FILE as it is at one instant, and compare every tile of the copy with its hash.

    The cloud may be running. FILE must not exist; it is one file, which `gnd map restore` makes a store again.
    """
    _copied(required_file(path, "gnd map backup"), target, "backed up", as_json)


@click.command(short_help="Make a store of a backup.")
@click.argument("source", metavar="BACKUP", type=PATH)
@click.argument("target", metavar="STORE", type=PATH)
@json_option
def restore(source: Path, target: Path, as_json: bool) -> None:
    """Copy BACKUP to STORE, which must not exist, and compare every tile with its hash.

    Stop the cloud and move the damaged store (with its -wal and -shm files) away first. Vehicles whose tiles are newer
    than the backup send what they know of anew.
    """
    _copied(source, target, "restored", as_json)


def _copied(source: Path, target: Path, done: str, as_json: bool) -> None:
    with bars() as progress:
        checked = copy_store(source, target, progress)
    values = {"path": str(target), "size_bytes": target.stat().st_size, "versions": checked.tiles}
    values |= {"report_parts": checked.reports, "schema": checked.schema}
    line = (
        f"{source} {done} to {target}: {checked.tiles} tile versions and {checked.reports} report parts, all whole,"
        f" {target.stat().st_size / 1e6:.2f} MB"
    )
    show(values, as_json, lambda console: console.print(line, highlight=False, soft_wrap=True))


@click.command(short_help="Whether a map is whole.")
@STORE
@click.option("--all-versions", is_flag=True, help="Older versions, too.")
@json_option
@click.pass_context
def check(context: click.Context, path: StoreLocation, all_versions: bool, as_json: bool) -> None:
    """Read every page, tile and report of STORE, and compare tiles with their hashes; exit code 1 if one is damaged."""
    with bars() as progress:
        file = file_of(path)
        if file is None:
            with to_read(path) as opened:
                checked = opened.look(lambda c: check_rows(c, path, all_versions=all_versions, progress=progress))
        else:
            checked = check_store(file, all_versions=all_versions, progress=progress)
    values = checked.as_dict()
    line = f"{shown(path)}: whole; {checked.tiles} tiles and {checked.reports} report parts read"
    line += f", schema {checked.schema}"
    if checked.damages:
        show(values, as_json, lambda console: console.print(tables.checked(shown(path), values)))
        context.exit(1)
    show(values, as_json, lambda console: console.print(line, highlight=False, soft_wrap=True))


@click.command(short_help="Remove what counts no more.")
@STORE
@click.option("--keep-versions", "--keep", type=click.IntRange(1), help="So many newest versions of each tile stay.")
@click.option(
    "--keep-days", type=click.FloatRange(0.0), help="So long reports that count no more and refused ones stay."
)
@click.option("--folded", is_flag=True, help="With --keep-days: old reports, too, that are folded into the map.")
@click.option("--quarantine-mb", type=click.FloatRange(0.0), help="So much of the newest refused messages stays.")
@json_option
def gc(
    path: StoreLocation,
    keep_versions: int | None,
    keep_days: float | None,
    folded: bool,
    quarantine_mb: float | None,
    as_json: bool,
) -> None:
    """Remove old versions, old reports and old refused messages.

    Epochs, reports that count and what they cite stay. The file does not shrink: the room is used again.
    """
    if folded and keep_days is None:
        raise StoreError("gc: --folded needs --keep-days D; nothing was removed")
    if (keep_versions, keep_days, quarantine_mb) == (None, None, None):
        raise StoreError("gc: give --keep-versions N, --keep-days D or --quarantine-mb N; nothing was removed")
    with existing(path) as opened:
        removed = retain(opened, keep_versions, keep_days, quarantine_mb, folded=folded)
    line = (
        f"{shown(path)}: {removed.versions} versions removed, {removed.version_bytes / 1e6:.2f} MB; {removed.reports}"
        f" report parts, {removed.report_bytes / 1e6:.2f} MB; {removed.quarantined} refused messages,"
        f" {removed.quarantined_bytes / 1e6:.2f} MB; {removed.uploads} settled uploads"
    )
    show(asdict(removed), as_json, lambda console: console.print(line, highlight=False, soft_wrap=True))


@click.command(short_help="Merge tiles again that were set aside.")
@STORE
@click.argument("tiles", metavar="[TILE]...", nargs=-1)
@layer_option
@json_option
def retry(path: StoreLocation, tiles: tuple[str, ...], layer: str, as_json: bool) -> None:
    """Have the tiles merged again that were set aside, or only each TILE of a layer (see `gnd map status`)."""
    wanted = [(layer, parse_tile(text)) for text in tiles]
    with existing(path) as opened:
        aside = {(one.layer, one.tile) for one in opened.tiles_set_aside()}
        for _, tile in (one for one in wanted if one not in aside):
            raise StoreError(
                f"tile {tile.path} of layer {layer} is not set aside; `gnd map status` lists those that are"
            )
        n = opened.take_up_again(wanted or sorted(aside, key=lambda one: (one[0], one[1].morton)))
    line = f"{shown(path)}: {n} tiles wait to be merged again" if n else f"{shown(path)}: no tile is set aside"
    show({"tiles": n}, as_json, lambda console: console.print(line, highlight=False, soft_wrap=True))


@click.command(short_help="Bring tiles back to an older state.")
@STORE
@click.argument("place", metavar="TILE|REGION")
@click.argument("version", type=int, required=False)
@click.option("--to", help="A version of the tile (3), or a time (2026-01-31T12:00:00Z).")
@click.option("--dry-run", is_flag=True, help="Only say what would change.")
@layer_option
@json_option
@identity_option
def rollback(
    path: StoreLocation, place: str, version: int | None, to: str | None, dry_run: bool, layer: str, as_json: bool
) -> None:
    """Publish older content of a TILE as its next version; merged reports count no more.

    TILE is a path, a number, or lat,lon. REGION is the leading part of tile paths with a slash at its end, such as
    13033/ or 13033/03021/, and / is everywhere: its tiles go back to a time, all or none. Tiles that were not there yet
    become empty. Running mergers announce it to the vehicles.
    """
    if (version is None) == (to is None):
        raise StoreError("rollback: give --to VERSION or --to TIME")
    region, target = parse_place(place), _target(str(version) if to is None else to)
    with to_read(path) if dry_run else to_publish(path) as opened:
        steps = (plan if dry_run else roll_back)(opened, layer, region, target)
        after = {head.tile: head.version for head in opened.heads(layer)}
    rows = [_step(one, after[one.tile]) for one in steps]
    n = sum(one.action in ("rollback", "empty") for one in steps)
    verb = "would change" if dry_run else "have changed"
    title = f"{shown(path)}, layer {layer}: {n} of {len(steps)} tiles {verb}"
    values = {"layer": layer, "dry_run": dry_run, "tiles": rows}

    def print_it(console: Console) -> None:
        console.print(title, highlight=False, soft_wrap=True)
        console.print(tables.rollback(rows, MEANING))

    show(values, as_json, print_it)


def _target(text: str) -> RollbackTarget:
    return RollbackTarget(version=int(text)) if text.isdecimal() else RollbackTarget(at_ns=parse_time_ns(text))


def _step(step: RollbackStep, version: int) -> dict[str, Any]:
    return asdict(step) | {"tile": step.tile.path, "version": version}


COMMANDS: Final = (backup, restore, check, gc, retry, rollback)
