"""`gnd router`."""

import json
import signal
import threading
from contextlib import ExitStack
from types import FrameType

import click

from gnd.fleet_bus.config import DEFAULT_ENDPOINT
from gnd.fleet_bus.errors import IdentityError
from gnd.fleet_bus.health_options import metrics_options
from gnd.fleet_bus.identity.names import identity_of_environment
from gnd.fleet_bus.identity.options import identity_option
from gnd.fleet_bus.router import start_router, wait_for_stop
from gnd.fleet_bus.router_metrics import watch_router


@click.command()
@click.option("--listen", multiple=True, help=f"Endpoint to open; repeatable.  [default: {DEFAULT_ENDPOINT}]")
@click.option("--connect", multiple=True, help="Endpoint of another router to link with.")
@click.option("--acl", is_flag=True, help="Print the rights that it gives (zenoh's access_control), and end.")
@identity_option
@metrics_options
def router(
    listen: tuple[str, ...], connect: tuple[str, ...], acl: bool, metrics_port: int | None, metrics_host: str
) -> None:
    """Run a Zenoh router until Ctrl-C: the meeting point of vehicles, tile store and mergers.

    With an identity it speaks TLS alone, lets in the members of its authority, and gives each the rights of its role.
    """
    identity = identity_of_environment()
    if acl:
        click.echo(_rights_text())
        return
    stop = threading.Event()

    def end(_signal: int, _frame: FrameType | None) -> None:
        stop.set()

    listen = listen or (DEFAULT_ENDPOINT if identity is None else DEFAULT_ENDPOINT.replace("tcp/", "tls/"),)
    with start_router(listen, connect, identity) as bus, ExitStack() as stack:
        if metrics_port is not None:
            stack.enter_context(watch_router(bus, metrics_port, metrics_host))
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, end)
        click.echo(f"router listens at {', '.join(listen)}; Ctrl-C ends it")
        wait_for_stop(stop)
    click.echo("router ended")


def _rights_text() -> str:
    folder = identity_of_environment()
    if folder is None:
        raise IdentityError("without an identity a router gives every right to everybody: --identity FOLDER")
    from gnd.fleet_bus.gate import read_members
    from gnd.fleet_bus.identity.folder import load_identity
    from gnd.fleet_bus.rights import access_control

    return json.dumps(access_control(read_members(load_identity(folder)).members), indent=1)
