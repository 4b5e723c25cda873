"""`gnd reproduce real-localisation`: thin over `studies.real_localisation.run`."""

import json
from pathlib import Path
from typing import Any

import click

PATH = click.Path(path_type=Path)


@click.command(name="real-localisation")
@click.option("--scans", required=True, help="Folders of recordings, with commas between them.")
@click.option("--first", "at_most", default=200, show_default=True, help="At most so many scans of each are read.")
@click.option("--seed", default=0, show_default=True, help="Of the offsets from which registration starts.")
@click.option(
    "--out", type=PATH, default=Path("runs/real-localisation"), show_default=True, help="Pictures and result."
)
@click.option("--json", "json_file", help="Write the result as JSON; `-` prints it and nothing else.")
@click.option("--pictures/--no-pictures", default=True, show_default=True)
def real_localisation(scans: str, at_most: int, seed: int, out: Path, json_file: str | None, pictures: bool) -> None:
    """Odometry, localisation, registration and georeferencing on real recordings, beside KISS-ICP and small_gicp.

    A folder of scans (KITTI, RADIATE, PCD, MCAP) is halved: one half is the map, the other is localised on it. Two
    scans of Apollo are localised on each other and on Apollo's own map. Tracks with GNSS are put on the Earth.
    """
    from gnd.vehicle_agent.importer_cli import step_bars
    from studies.real_localisation.options import RealLocalisationOptions
    from studies.real_localisation.run import reproduce_real_localisation
    from studies.real_localisation.tables import print_tables

    options = RealLocalisationOptions.of(scans, at_most, seed)
    with step_bars() as progress:
        found = reproduce_real_localisation(options, out if pictures else None, progress)
    if json_file == "-":
        click.echo(json.dumps(found))
        return
    _write(Path(json_file) if json_file else out / "real-localisation.json", found)
    print_tables(found)


def _write(path: Path, found: dict[str, Any]) -> None:
    from studies.real_localisation.errors import RealLocalisationError

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise RealLocalisationError(f"{path}: cannot be written: {error.strerror or error}") from error
