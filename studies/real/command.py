"""`gnd reproduce real`: thin over `studies.real.run`."""

import json
from pathlib import Path
from typing import Any

import click

PATH = click.Path(path_type=Path)


@click.command()
@click.option("--scans", required=True, type=PATH, help="Folder of KITTI .bin, PCD or RADIATE scans, or MCAP file.")
@click.option("--format", "kind", default="auto", show_default=True, help="kitti, pcd, mcap, radiate or auto.")
@click.option("--topic", help="Topic of the clouds, for an MCAP file with several.")
@click.option("--map-scans", default="even", show_default=True, help="Scans that make the map.")
@click.option("--drive-scans", default="odd", show_default=True, help="Scans that are driven.")
@click.option("--rounds", default=4, show_default=True, help="Ways to lay the recording on the grid, with new objects.")
@click.option("--objects", default=8, show_default=True, help="Objects a round, half of them into either half.")
@click.option("--seed", default=0, show_default=True, help="Of the ways on the grid and the places of objects.")
@click.option("--first", "at_most", default=200, show_default=True, help="At most so many scans are read.")
@click.option("--poses", type=click.Choice(["reference", "estimated"]), default="reference", show_default=True)
@click.option("--segment/--no-segment", default=True, show_default=True, help="Motion segmentation.")
@click.option("--segment-map/--no-segment-map", default=True, show_default=True, help="Of the map's scans, too.")
@click.option("--mode", type=click.Choice(["default", "paper"]), default="default", show_default=True)
@click.option("--set", "changes", multiple=True, metavar="FIELD=VALUE", help="Replace a parameter of detection.")
@click.option("--out", type=PATH, default=Path("runs/reproduce-real"), show_default=True, help="Pictures and result.")
@click.option("--json", "json_file", help="Write the result as JSON; `-` prints it and nothing else.")
@click.option("--pictures/--no-pictures", default=True, show_default=True, help="Draw the first round.")
def real(out: Path, json_file: str | None, pictures: bool, **given: Any) -> None:
    """Change detection on a real recording: part of the scans makes the map, the vehicle drives the others.

    Objects are inserted ray-accurately into the map's scans (they are gone, then) and into the vehicle's (they are
    new); the untouched scans tell how much is reported although nothing changed.
    """
    from gnd.vehicle_agent.importer_cli import step_bars
    from studies.real.options import RealOptions
    from studies.real.run import reproduce_real
    from studies.real.tables import print_tables

    options = RealOptions(**given)
    with step_bars() as progress:
        found = reproduce_real(options, out if pictures else None, progress)
    if json_file == "-":
        click.echo(json.dumps(found))
        return
    _write(Path(json_file) if json_file else out / f"{found['recording']}.json", found)
    print_tables(found)
    if pictures:
        click.echo(f"pictures: {', '.join(str(out / name) for name in found['pictures'])}")


def _write(path: Path, found: dict[str, Any]) -> None:
    from studies.real.errors import RealDataError

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise RealDataError(f"{path}: cannot be written: {error.strerror or error}") from error
