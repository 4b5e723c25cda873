"""`gnd reproduce steady-vehicle`: thin over `studies.traffic_study.steady`."""

import json
from pathlib import Path
from typing import Any

import click

PATH = click.Path(path_type=Path)
DEFAULT_OUT = Path("runs/reproduce-steady")


@click.command()
@click.option("--world-seed", "seed", default=201, show_default=True, help="Seed of the world.")
@click.option("--length", "length_m", default=1000.0, show_default=True, help="Length of the street, metres.")
@click.option(
    "--parking", default=0.0, show_default=True, help="Share of parking slots that are taken; on the map none."
)
@click.option("--speed", "speed_kmh", default=40.0, show_default=True, help="Of the vehicle, km/h.")
@click.option("--sensor", default="vlp16", show_default=True, help="Of the vehicle.")
@click.option("--link", default="4g", show_default=True, help="Profile of its link.")
@click.option("--pace", default=1.0, show_default=True, help="Times real time.")
@click.option(
    "--out", type=PATH, default=DEFAULT_OUT, show_default=True, help="Folder that keeps street, map and drive."
)
@click.option("--json", "json_file", help="Write the result as JSON; `-` prints it and nothing else.")
def steady_vehicle(json_file: str | None, out: Path, **given: Any) -> None:
    """All bytes of a vehicle that knows its street, up and down, over the real bus.

    Nothing has changed since the street was mapped, and the vehicle's cache holds the map. Counted is what the kernel
    counted on its connection (TCP_INFO): reports, telemetry, keep-alives, acknowledgements, handshakes, everything.
    """
    # The heavy imports wait until the options have been found good.
    from studies.simulation.folder import RunFolder
    from studies.traffic_study.steady import SteadyOptions, lines_of, steady

    options = SteadyOptions(**given)
    folder = RunFolder.create(out, "steady-vehicle")
    folder.write_mark({"seed": options.seed})
    found = steady(options, out)
    if json_file == "-":
        click.echo(json.dumps(found))
        return
    if json_file is not None:
        Path(json_file).write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    click.echo("\n".join(lines_of(found)))
