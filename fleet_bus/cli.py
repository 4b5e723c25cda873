"""`gnd router`."""

import signal
import threading
from types import FrameType

import click

from fleet_bus.config import DEFAULT_ENDPOINT
from fleet_bus.router import open_router, wait_for_stop


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
