"""`gnd reproduce simulation`: thin over `studies.simulation.run`."""

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

PATH = click.Path(path_type=Path)
DEFAULT_OUT = Path("runs/reproduce-simulation")
T = TypeVar("T")


@click.command()
@click.option("--world-seed", "seeds", multiple=True, help="Seed of the world, or several: 1,2,3.  [default: 201]")
@click.option("--length", "length_m", default=400.0, show_default=True, help="Length of the street, metres.")
@click.option("--site", default="wangsimni", show_default=True, help="Where it lies: wangsimni, border or north49.")
@click.option("--vehicles", default="1,5,9,20", show_default=True, help="Sizes of the fleet that are reported.")
@click.option("--sensors", help="Sensors that the fleet cycles through, such as vlp16,hdl32e.  [default: all]")
@click.option("--parking", default=0.2, show_default=True, help="Share of parking slots that are taken.")
@click.option("--traffic/--no-traffic", default=True, show_default=True, help="Moving cars and pedestrians.")
@click.option("--mode", type=click.Choice(["default", "paper"]), default="default", show_default=True)
@click.option(
    "--poses",
    default="noisy:4cm:0.08deg",
    show_default=True,
    help="estimated, true, or noisy:<m>:<deg>; true,estimated compares.",
)
@click.option("--base", type=click.Choice(["surveyed", "driven"]), default="surveyed", show_default=True)
@click.option(
    "--upload",
    type=click.Choice(["float", "full", "packed"]),
    default="full",
    show_default=True,
    help="Whole reports with Gaussians as measured, or on their lattice; or in short, flags first.",
)
@click.option("--set", "changes", multiple=True, metavar="GROUP.FIELD=VALUE", help="Replace a parameter, repeatable.")
@click.option("--pcd/--no-pcd", default=True, show_default=True, help="Run the point-cloud baseline beside.")
@click.option("--scans", type=int, help="At most so many scans a drive, for a quick look.")
@click.option("--out", type=PATH, default=DEFAULT_OUT, show_default=True, help="Folder that keeps everything.")
@click.option("--json", "json_file", help="Write the result as JSON; `-` prints it and nothing else.")
@click.option("--jobs", type=int, help="Worker processes.  [default: one a core]")
@click.option("--pictures/--no-pictures", default=True, show_default=True, help="Draw the figures.")
@click.option("--keep-drives", is_flag=True, help="Write every drive as MCAP, too.")
def simulation(
    json_file: str | None, out: Path, jobs: int | None, keep_drives: bool, pictures: bool, **given: Any
) -> None:
    """Reproduce the simulation of the GND paper: worlds with known truth, single drives, fleets, and their scores.

    A second start with the same options and folder continues where the first ended.
    """
    options = options_of(given)
    if jobs is not None and jobs < 1:
        raise click.BadParameter(f"at least one process is needed, got {jobs}", param_hint="--jobs")
    # The heavy imports wait until the options have been found good.
    from studies.simulation.comparison import pose_sources
    from studies.simulation.tables import comparison_tables, print_tables, tables_of

    processes, sources = jobs or os.cpu_count() or 1, pose_sources(given["poses"])
    if len(sources) == 1:
        found = _run(options, out, processes, keep_drives=keep_drives, pictures=pictures)
        tables = tables_of(found, sorted(options.vehicles))
    else:
        runs = [dataclasses.replace(options, poses=source) for source in sources]
        found = _compare(runs, out, processes, keep_drives=keep_drives, pictures=pictures)
        tables = comparison_tables(found, sorted(options.vehicles))
    if json_file == "-":
        click.echo(json.dumps(found))
        return
    if json_file is not None:
        _write(Path(json_file), found)
    print_tables(tables)
    click.echo(f"everything else: {out}")


def _run(options: Any, out: Path, processes: int, *, keep_drives: bool, pictures: bool) -> dict[str, Any]:
    """Run everything, write result and figures into the folder, and return the result."""
    from rich.console import Console

    from gnd.deploy.live import progress_bars
    from studies.simulation.folder import RunFolder
    from studies.simulation.run import plain_options, plain_worlds, reproduce
    from studies.simulation.summary import summary_of

    folder = RunFolder.create(out)
    folder.write_mark({"options": plain_options(options)})
    with progress_bars(Console(stderr=True)) as progress:
        outcome = reproduce(options, folder, processes, progress, keep_drives=keep_drives)
    folder.write_mark({"options": plain_options(options), "worlds": plain_worlds(outcome, folder)})
    found = summary_of(outcome)
    folder.write_json("result.json", found)
    if pictures:
        from studies.simulation.figures import draw_figures

        draw_figures(outcome, found, out)
    return found


def _compare(runs: list[Any], out: Path, processes: int, **how: bool) -> dict[str, Any]:
    """Run the same with poses of each source, in a folder each; the worlds are made once."""
    from studies.simulation.comparison import comparison_of, folder_of, share_worlds
    from studies.simulation.folder import RunFolder
    from studies.simulation.run import plain_options

    folder = RunFolder.create(out)
    folder.write_mark({"compared": {str(run.poses): plain_options(run) for run in runs}})
    found: dict[str, Any] = {}
    for run in runs:
        home = folder_of(out, run.poses)
        if found:
            share_worlds(folder_of(out, runs[0].poses), home)
        found[str(run.poses)] = _run(run, home, processes, **how)
    compared = comparison_of(found)
    folder.write_json("result.json", compared)
    return compared


def _write(path: Path, found: dict[str, Any]) -> None:
    try:
        path.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise click.BadParameter(f"cannot write {path}: {error.strerror}", param_hint="--json") from error


def options_of(given: dict[str, Any]) -> Any:
    """Return `RunOptions` of the command line's values.

    Raises:
        click.BadParameter: a value that cannot be read.
        GndError: a value that cannot work.
    """
    from gnd.fleet_sim.street import StreetOptions
    from studies.simulation.comparison import pose_sources
    from studies.simulation.method import MethodParameters
    from studies.simulation.options import RunOptions

    chosen: dict[str, Any] = {
        name: given[name] for name in ("parking", "traffic", "mode", "base", "scans", "pcd", "upload")
    }
    chosen["street"] = StreetOptions(given["length_m"], given["site"])
    chosen["poses"] = pose_sources(given["poses"])[0]
    chosen["method"] = MethodParameters.of_mode(given["mode"]).with_changes(given["changes"])
    chosen["vehicles"] = tuple(sorted(set(_numbers("--vehicles", given["vehicles"]))))
    if given["seeds"]:
        chosen["seeds"] = _numbers("--world-seed", ",".join(given["seeds"]))
    if given["sensors"] is not None:
        chosen["sensors"] = list_of("--sensors", given["sensors"], str)
    return dataclasses.replace(RunOptions(), **chosen)


def _numbers(option: str, text: str) -> tuple[int, ...]:
    return list_of(option, text, int)


def list_of(option: str, text: str, of: Callable[[str], T]) -> tuple[T, ...]:
    """Return the values of an option that takes several, with commas between.

    Raises:
        click.BadParameter: one cannot be read.
    """
    try:
        return tuple(of(part.strip()) for part in text.split(",") if part.strip())
    except ValueError as error:
        raise click.BadParameter(f"expected numbers with commas between, got {text!r}", param_hint=option) from error
