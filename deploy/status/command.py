"""`gnd status`: the operator's room in the terminal, and a check for cron and monitoring."""

import json
from pathlib import Path
from typing import Final

import click
from rich.console import Console

from gnd.deploy.interruption import ending_in_order
from gnd.deploy.map_export.scene import store_of
from gnd.deploy.run_folder import RunFolder
from gnd.deploy.status.raised import exit_code
from gnd.deploy.status.screen import one_line, screen
from gnd.deploy.status.thresholds import load_thresholds
from gnd.deploy.status.watching import OperatorRoom, endpoint_of, told, watch_room
from gnd.fleet_bus.identity.names import identity_of_environment
from gnd.fleet_bus.identity.options import identity_option
from gnd.tile_store.location import LOCATION, StoreLocation
from gnd.tile_store.options import json_option

PATH: Final = click.Path(path_type=Path)


@click.command(short_help="How the cloud and its vehicles stand; live, or as a check for monitoring.")
@click.argument("source", metavar="RUN|STORE", type=LOCATION)
@click.option("--watch", is_flag=True, help="Look again and again until q or Ctrl-C.")
@click.option("--check", "checks", is_flag=True, help="Print a line; exit code 0: well, 1: warning, 2: critical.")
@click.option("--alerts", "file", type=PATH, help="Thresholds (TOML).  [default: those of `gnd config alerts`]")
@click.option("--connect", help="Router where vehicles are heard.  [default: that of RUN while it is going]")
@click.option(
    "--every",
    "every_s",
    type=click.FloatRange(0.1, 3600.0),
    default=1.0,
    show_default=True,
    help="Seconds between looks.",
)
@json_option
@identity_option
@click.pass_context
def status(
    context: click.Context,
    source: StoreLocation,
    watch: bool,
    checks: bool,
    file: Path | None,
    connect: str | None,
    every_s: float,
    as_json: bool,
) -> None:
    """How the cloud over STORE, or of RUN (the folder of a run), stands: alerts with what to do, shards, queue, reports
    acknowledged, quarantine, what waits for confirmation, releases, disk, vehicles.

    Nothing is changed by it. `gnd map status STORE` lists what waits tile by tile.
    """
    if watch and checks:
        raise click.UsageError("--watch looks again and again, --check once: give one of them")
    run = RunFolder(source) if isinstance(source, Path) and source.is_dir() else None
    endpoint = connect or (endpoint_of(run) if watch else None)
    room = OperatorRoom(store_of(source), load_thresholds(file), identity_of_environment(), run, endpoint)
    console = Console(width=None if Console().is_terminal else 120)
    if watch:
        room.look()  # what is wrong from the beginning is an error
        with ending_in_order() as stop:
            watch_room(room, every_s, stop, console, as_json=as_json)
        return
    with room.listening() as fleet:
        view = room.look()
        room.close()
        if fleet is not None:
            fleet.ledgers.refresh(now=True)
        if as_json:
            click.echo(json.dumps(told(view, fleet), indent=1))
        elif checks:
            click.echo(one_line(view, fleet))
        else:
            console.print(screen(view, fleet))
    if checks:
        context.exit(exit_code(list(view.raised)))
