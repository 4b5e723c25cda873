"""`gnd watch`: follow the tile updates of a region."""

import signal
import threading

import click

from gnd.deploy.watch import TileWatch
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.identity.following import follow_revoked
from gnd.fleet_bus.identity.options import identity_option
from gnd.gnd_map.region import parse_region


@click.command()
@identity_option
@click.argument("region")
@click.option("--connect", default="tcp/127.0.0.1:7447", show_default=True, help="Router to connect to.")
@click.option("--layer", "layers", multiple=True, default=("ndt",), show_default=True, help="Map layer; repeatable.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object a line.")
def watch(region: str, connect: str, layers: tuple[str, ...], as_json: bool) -> None:
    """Print each tile update of REGION as it is published; Ctrl-C ends.

    REGION is a wildcard (13033/03021/** or ** for the world), a tile id (497353963154), a tile path, or a circle
    lat,lon,radius in degrees and metres. Layers are of Gaussians (ndt) or of features (signs, streetlights, ...).
    """
    chosen = parse_region(region)
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    signal.signal(signal.SIGINT, lambda *_: stop.set())
    with open_bus(BusConfig(connect=(connect,)), name="watch") as bus:
        follow_revoked(bus)
        click.echo(f"watching {chosen.prefix or 'the world'} on {connect}, Ctrl-C ends", err=True)
        TileWatch(bus, chosen, lambda event: click.echo(event.json() if as_json else event.line()), layers).run(stop)
