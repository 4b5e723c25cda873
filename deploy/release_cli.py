"""`gnd release`: versions on trial with a share of the fleet; how far they are, and who steers them."""

import getpass
import json
import socket
from collections.abc import Callable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any, TypeVar

import click
from rich.console import Console
from rich.table import Table

from gnd.fleet_bus.identity.options import identity_option
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import releasing
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.arguments import parse_tile
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import LOCATION, StoreLocation, shown
from gnd.tile_store.options import existing, json_option, layer_option, show, to_publish, to_read
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.trials import VersionTrial

_F = TypeVar("_F", bound=Callable[..., Any])
Steer = Callable[[SqlStore, VersionTrial, str, str], bool]


@click.group()
def release() -> None:
    """See and steer versions on trial: those that a share of the fleet gets first (docs/release.md)."""


def _steering(command: _F) -> _F:
    """Adds STORE, TILE, --why, --layer, --identity and --json."""
    for decorate in (
        identity_option,
        json_option,
        layer_option,
        click.option("--why", required=True, help="Why, for who looks later; it is kept in the store."),
        click.argument("tile"),
        click.argument("path", metavar="STORE", type=LOCATION),
    ):
        command = decorate(command)
    return command


@release.command("list", short_help="The versions on trial, and those settled lately.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.option("--settled", default=10, show_default=True, type=click.IntRange(0, 10_000), help="How many of them.")
@json_option
def list_trials(path: StoreLocation, settled: int, as_json: bool) -> None:
    """The versions on trial, and the newest that were released or withdrawn."""
    with to_read(path) as store:
        found = [*store.look(trials.all_open), *store.look(lambda c: trials.settled(c, settled))]
    rows = [_told(one) for one in found]
    show({"trials": rows}, as_json, lambda console: console.print(_table(rows)))


@release.command("show", short_help="A tile's trials, what vehicles told, whose reports are doubted, who steered.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("tile")
@layer_option
@json_option
def show_tile(path: StoreLocation, tile: str, layer: str, as_json: bool) -> None:
    """All about the trials of TILE (path, number, or lat,lon in degrees), and what was decided about its changes."""
    tile_id = parse_tile(tile)
    with to_read(path) as store:
        known = store.look(lambda c: trials.of_tile(c, layer, tile_id))
        steered = store.look(lambda c: trials.steered(c, layer, tile_id))
        if not known and not steered:
            raise StoreError(f"no version of tile {tile_id.path} of layer {layer} was ever on trial in {shown(path)}")
        open_trial = store.trials(layer, tile_id.path).get(tile_id)
        said = [] if open_trial is None else store.look(lambda c: trials.health(c, open_trial))
        values = {
            "trials": [_told(one) for one in known],
            "vehicles": [asdict(one) for one in said],
            "doubted": [asdict(one) for one in store.look(lambda c: trials.doubted_reports(c, layer, tile_id))],
            "steered": [asdict(one) for one in steered],
        }
    show(values, as_json, lambda console: _print_tile(console, values))


@release.command(short_help="Decide nothing about a version on trial until somebody does.")
@_steering
def pause(path: StoreLocation, tile: str, why: str, layer: str, as_json: bool) -> None:
    """Leave the version of TILE that is on trial where it is: no automatic release, no withdrawal."""
    _steer(path, tile, layer, as_json, why, lambda *of: releasing.hold(*of, paused=True))


@release.command(short_help="Let vehicles decide again about a paused version.")
@_steering
def resume(path: StoreLocation, tile: str, why: str, layer: str, as_json: bool) -> None:
    """Take up the trial of TILE again after a pause."""
    _steer(path, tile, layer, as_json, why, lambda *of: releasing.hold(*of, paused=False))


@release.command(short_help="Give a version on trial to everybody now.")
@_steering
def advance(path: StoreLocation, tile: str, why: str, layer: str, as_json: bool) -> None:
    """Release the version of TILE that is on trial, whatever vehicles have told so far."""
    _steer(path, tile, layer, as_json, why, releasing.release)


@release.command(short_help="Take a version on trial back.")
@_steering
def withdraw(path: StoreLocation, tile: str, why: str, layer: str, as_json: bool) -> None:
    """Publish the content before the trial as the next version of TILE, and doubt the reports behind the trial."""
    _steer(path, tile, layer, as_json, why, releasing.withdraw)


@release.command(short_help="Believe doubted reports again.")
@_steering
def clear(path: StoreLocation, tile: str, why: str, layer: str, as_json: bool) -> None:
    """Believe the reports behind a withdrawn version of TILE again: they are merged as if they came now."""
    # loaded here: it loads numpy and numba, which the other commands do without
    from gnd.cloud_merger.release.doubts import clear_and_reenter

    tile_id = parse_tile(tile)
    with existing(path) as store:
        cleared = clear_and_reenter(store, (layer, tile_id), _who(), why)
    values = {"tile": tile_id.path, "layer": layer, "cleared": cleared}
    show(values, as_json, lambda console: console.print(f"{cleared} reports about {tile_id.path} are believed again"))


def _steer(path: StoreLocation, tile: str, layer: str, as_json: bool, why: str, work: Steer) -> None:
    tile_id = parse_tile(tile)
    with to_publish(path) as store:
        trial = _open_trial(store, layer, tile_id)
        if not work(store, trial, _who(), why):
            raise StoreError(f"version {trial.version} of tile {tile_id.path} was settled meanwhile; nothing was done")
        (now,) = (
            one for one in store.look(lambda c: trials.of_tile(c, layer, tile_id)) if one.version == trial.version
        )
    values = _told(now)
    show(values, as_json, lambda console: console.print(f"{tile_id.path} version {now.version}: {now.state}"))


def _open_trial(store: SqlStore, layer: str, tile: TileId) -> VersionTrial:
    found = store.trials(layer, tile.path).get(tile)
    if found is None:
        raise StoreError(f"no version of tile {tile.path} of layer {layer} is on trial; `gnd release list` shows them")
    return found


def _who() -> str:
    """Who steers, as the machine knows them."""
    try:
        name = getpass.getuser()
    except (KeyError, OSError):
        name = "somebody"
    return f"{name}@{socket.gethostname()}"


def _told(trial: VersionTrial) -> dict[str, Any]:
    verdict = json.loads(trial.verdict) if trial.verdict else None
    return {
        "layer": trial.layer,
        "tile": trial.tile.path,
        "version": trial.version,
        "base_version": trial.base_version,
        "state": trial.state,
        "share": trial.share,
        "since_ns": trial.since_ns,
        "settled_ns": trial.settled_ns,
        "verdict": verdict,
    }


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="Versions on trial")
    for name in ("layer", "tile", "version", "state", "share", "since (UTC)", "on it", "before it", "why"):
        table.add_column(name, overflow="fold")
    for row in rows:
        verdict = row["verdict"] or {}
        table.add_row(
            row["layer"],
            row["tile"],
            f"{row['base_version']} → {row['version']}",
            row["state"],
            f"{100 * row['share']:g} %",
            _time(row["since_ns"]),
            _arm(verdict.get("new")),
            _arm(verdict.get("old")),
            verdict.get("why", ""),
        )
    return table


def _arm(figures: Mapping[str, Any] | None) -> str:
    if not figures:
        return "–"
    ratio = "–" if figures["matched"] is None else f"{100 * figures['matched']:.0f} %"
    score = "–" if figures["score"] is None else f"{figures['score']:+.3f}"
    silent = f", {figures['silent']} silent" if figures["silent"] else ""
    return f"{figures['told']} vehicles, {ratio}, {score}{silent}"


def _print_tile(console: Console, values: Mapping[str, Any]) -> None:
    console.print(_table(values["trials"]))
    for name, columns in (
        ("vehicles", ("vehicle", "arm", "scans", "matched", "fit", "elsewhere", "inside", "gated", "not_good")),
        ("doubted", ("version", "report_id", "vehicle", "cleared_by")),
        ("steered", ("at_ns", "who", "action", "version", "why")),
    ):
        if not values[name]:
            continue
        table = Table(title=name)
        for column in columns:
            table.add_column(column.replace("_", " "), overflow="fold")
        for row in values[name]:
            table.add_row(*(_time(row[c]) if c == "at_ns" else str(row[c]) for c in columns))
        console.print(table)


def _time(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S")
