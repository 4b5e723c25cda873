"""`gnd reproduce simulation`: thin over `benchmarks.simulation.run`."""

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
@click.option("--poses", default="noisy:4cm:0.08deg", show_default=True, help="estimated, true, or noisy:<m>:<deg>.")
@click.option("--base", type=click.Choice(["surveyed", "driven"]), default="surveyed", show_default=True)
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
    from rich.console import Console

    from benchmarks.simulation.folder import RunFolder
    from benchmarks.simulation.run import plain_options, plain_worlds, reproduce
    from benchmarks.simulation.summary import summary_of
    from benchmarks.simulation.tables import print_tables
    from deploy.live import progress_bars

    folder = RunFolder.create(out)
    folder.write_mark({"options": plain_options(options)})
    with progress_bars(Console(stderr=True)) as progress:
        outcome = reproduce(options, folder, jobs or os.cpu_count() or 1, progress, keep_drives=keep_drives)
    folder.write_mark({"options": plain_options(options), "worlds": plain_worlds(outcome, folder)})
    found = summary_of(outcome)
    folder.write_json("result.json", found)
    if pictures:
        from benchmarks.simulation.figures import draw_figures

        draw_figures(outcome, found, out)
    if json_file == "-":
        click.echo(json.dumps(found))
        return
    if json_file is not None:
        _write(Path(json_file), found)
    print_tables(found, sorted(options.vehicles))
    click.echo(f"everything else: {out}")


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
    from benchmarks.simulation.method import MethodParameters
    from benchmarks.simulation.options import RunOptions
    from benchmarks.simulation.pose_source import PoseSource
    from fleet_sim.street import StreetOptions

    chosen: dict[str, Any] = {name: given[name] for name in ("parking", "traffic", "mode", "base", "scans", "pcd")}
    chosen["street"] = StreetOptions(given["length_m"], given["site"])
    chosen["poses"] = PoseSource.parse(given["poses"])
    chosen["method"] = MethodParameters.of_mode(given["mode"]).with_changes(given["changes"])
    chosen["vehicles"] = tuple(sorted(set(_numbers("--vehicles", given["vehicles"]))))
    if given["seeds"]:
        chosen["seeds"] = _numbers("--world-seed", ",".join(given["seeds"]))
    if given["sensors"] is not None:
        chosen["sensors"] = _list("--sensors", given["sensors"], str)
    return dataclasses.replace(RunOptions(), **chosen)


def _numbers(option: str, text: str) -> tuple[int, ...]:
    return _list(option, text, int)


def _list(option: str, text: str, of: Callable[[str], T]) -> tuple[T, ...]:
    try:
        return tuple(of(part.strip()) for part in text.split(",") if part.strip())
    except ValueError as error:
        raise click.BadParameter(f"expected numbers with commas between, got {text!r}", param_hint=option) from error
