"""`gnd router`."""

import signal
import threading
from contextlib import ExitStack
from types import FrameType

import click

from gnd.fleet_bus.config import DEFAULT_ENDPOINT
from gnd.fleet_bus.health_options import metrics_options
from gnd.fleet_bus.router import open_router, wait_for_stop
from gnd.fleet_bus.router_metrics import watch_router


@click.command()
@click.option("--listen", multiple=True, default=(DEFAULT_ENDPOINT,), show_default=True, help="Endpoint to open.")
@click.option("--connect", multiple=True, help="Endpoint of another router to link with.")
@metrics_options
def router(listen: tuple[str, ...], connect: tuple[str, ...], metrics_port: int | None, metrics_host: str) -> None:
    """Run a Zenoh router until Ctrl-C: the meeting point of vehicles, tile store and mergers."""
    stop = threading.Event()

    def end(_signal: int, _frame: FrameType | None) -> None:
        stop.set()

    with open_router(listen, connect) as bus, ExitStack() as stack:
        if metrics_port is not None:
            stack.enter_context(watch_router(bus, metrics_port, metrics_host))
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, end)
        click.echo(f"router listens at {', '.join(listen)}; Ctrl-C ends it")
        wait_for_stop(stop)
    click.echo("router ended")
