"""`gnd reproduce traffic`: thin over `studies.traffic_study.study`."""

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import click

PATH = click.Path(path_type=Path)
DEFAULT_OUT = Path("runs/reproduce-traffic")


@click.command()
@click.option("--world-seed", "seed", default=201, show_default=True, help="Seed of the world.")
@click.option("--street", "kind", default="usual", show_default=True, help="How much has changed: usual or rebuilt.")
@click.option("--length", "length_m", type=float, help="Length of the street, metres.  [default: the street's]")
@click.option("--edits", "edit_share", type=float, help="Share of the street's edits made.  [default: the street's]")
@click.option("--parking", type=float, help="Share of parking slots that are taken.  [default: the street's]")
@click.option("--drives", default=38, show_default=True, help="How many vehicles drive, as in the paper.")
@click.option("--at-once", default=4, show_default=True, help="So many are on the street at a time.")
@click.option("--sensor", default="vlp16", show_default=True, help="The sensor of all vehicles, as in the paper.")
@click.option("--traffic/--no-traffic", default=True, show_default=True, help="Moving cars and pedestrians.")
@click.option("--poses", default="noisy:4cm:0.08deg", show_default=True, help="estimated, true, or noisy:<m>:<deg>.")
@click.option("--base", type=click.Choice(["driven", "surveyed"]), default="driven", show_default=True)
@click.option("--pcd-drives", default=4, show_default=True, help="The point-cloud baseline runs beside so many drives.")
@click.option("--f1-drives", default=4, show_default=True, help="F1 after so many drives, also in floats; 0: not.")
@click.option("--set", "changes", multiple=True, metavar="GROUP.FIELD=VALUE", help="Replace a parameter, repeatable.")
@click.option("--scans", type=int, help="At most so many scans a drive, for a quick look.")
@click.option("--out", type=PATH, default=DEFAULT_OUT, show_default=True, help="Folder that keeps everything.")
@click.option("--json", "json_file", help="Write the result as JSON; `-` prints it and nothing else.")
@click.option("--jobs", type=int, help="Worker processes.  [default: one a core]")
@click.option("--pictures/--no-pictures", default=True, show_default=True, help="Draw the figures.")
def traffic(json_file: str | None, out: Path, jobs: int | None, pictures: bool, **given: Any) -> None:
    """What a map and its changes weigh on the way: Figure 23 of the GND paper, with our codecs.

    A second start with the same options and folder continues where the first ended.
    """
    if jobs is not None and jobs < 1:
        raise click.BadParameter(f"at least one process is needed, got {jobs}", param_hint="--jobs")
    options = options_of(given)
    # The heavy imports wait until the options have been found good.
    from rich.console import Console

    from gnd.deploy.live import progress_bars
    from studies.simulation.folder import RunFolder
    from studies.traffic_study.study import study
    from studies.traffic_study.summary import summary_of
    from studies.traffic_study.tables import print_tables, tables_of

    folder = RunFolder.create(out, "traffic")
    folder.write_mark({"seed": options.seed})
    with progress_bars(Console(stderr=True)) as progress:
        found = summary_of(study(options, folder, jobs or os.cpu_count() or 1, progress))
    folder.write_json("result.json", found)
    if pictures:
        from studies.traffic_study.figures import draw_figures

        draw_figures(found, out)
    if json_file == "-":
        click.echo(json.dumps(found))
        return
    if json_file is not None:
        _write(Path(json_file), found)
    print_tables(tables_of(found))
    click.echo(f"everything else: {out}")


def _write(path: Path, found: dict[str, Any]) -> None:
    try:
        path.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise click.BadParameter(f"cannot write {path}: {error.strerror}", param_hint="--json") from error


def options_of(given: dict[str, Any]) -> Any:
    """Return `TrafficOptions` of the command line's values.

    Raises:
        GndError: a value that cannot work.
    """
    from studies.simulation.method import MethodParameters
    from studies.simulation.pose_source import PoseSource
    from studies.traffic_study.options import TrafficOptions, street_kind, street_options

    kind, street = street_kind(given["kind"]), street_options(given["kind"], given["length_m"])
    if given["edit_share"] is not None:
        street = dataclasses.replace(street, edit_share=given["edit_share"])
    same = ("seed", "drives", "at_once", "sensor", "traffic", "base", "pcd_drives", "f1_drives", "scans")
    return TrafficOptions(
        **{name: given[name] for name in same},
        street=street,
        parking=kind.parking if given["parking"] is None else given["parking"],
        poses=PoseSource.parse(given["poses"]),
        method=MethodParameters().with_changes(given["changes"]),
    )
