"""`gnd router` and `gnd traffic`."""

import json
import signal
import threading
from pathlib import Path
from types import FrameType
from typing import Final

import click
from rich.console import Console

from fleet_bus.config import DEFAULT_ENDPOINT
from fleet_bus.ledger_file import read_run
from fleet_bus.links import load_link
from fleet_bus.router import open_router, wait_for_stop
from fleet_bus.traffic import agent_traffic, as_json
from fleet_bus.traffic_table import print_tables

LINKS: Final = ("3g", "4g", "5g")


@click.command()
@click.option("--listen", multiple=True, default=(DEFAULT_ENDPOINT,), show_default=True, help="Endpoint to open.")
@click.option("--connect", multiple=True, help="Endpoint of another router to link with.")
def router(listen: tuple[str, ...], connect: tuple[str, ...]) -> None:
    """Run a Zenoh router until Ctrl-C: the meeting point of vehicles, tile store and mergers."""
    stop = threading.Event()

    def end(_signal: int, _frame: FrameType | None) -> None:
        stop.set()

    with open_router(listen, connect):
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, end)
        click.echo(f"router listens at {', '.join(listen)}; Ctrl-C ends it")
        wait_for_stop(stop)
    click.echo("router ended")


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--json", "as_json_", is_flag=True, help="Print JSON instead of tables.")
@click.option(
    "--link", "links", multiple=True, default=("3g", "4g", "5g"), help="Profile to compare with, or a TOML file."
)
def traffic(run: Path, as_json_: bool, links: tuple[str, ...]) -> None:
    """Show what RUN (a folder, or a name below runs/) sent and received, and what mobile links make of it."""
    profiles = tuple(load_link(link) for link in links)
    agents = tuple(agent_traffic(ledger, profiles) for ledger in read_run(run))
    if as_json_:
        click.echo(json.dumps(as_json(str(run), agents, profiles), indent=1))
    else:
        print_tables(agents, Console(width=110))
