"""`gnd reproduce localisation`: thin over `studies.localisation_study.run`."""

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import click

PATH = click.Path(path_type=Path)
DEFAULT_OUT = Path("runs/reproduce-localisation")


@click.command()
@click.option("--world-seed", "seeds", multiple=True, help="Seed of the world, or several: 1,2,3.  [default: 201]")
@click.option("--sensors", default="vlp16,hdl64e,scala", show_default=True, help="Each drives once.")
@click.option("--length", "length_m", default=300.0, show_default=True, help="Length of the street, metres.")
@click.option("--site", default="wangsimni", show_default=True, help="Where it lies: wangsimni, border or north49.")
@click.option("--fleet", default=5, show_default=True, help="Vehicles whose reports update the map.")
@click.option("--poses", default="estimated", show_default=True, help="The fleet's: estimated, true, noisy:<m>:<deg>.")
@click.option("--variants", help="Sensors that also run with added errors, none for none.  [default: the first]")
@click.option("--trials", default=20, show_default=True, help="Starts without a pose, for each sensor.")
@click.option("--parking", default=0.2, show_default=True, help="Share of parking slots that are taken.")
@click.option("--base", type=click.Choice(["driven", "surveyed"]), default="driven", show_default=True)
@click.option("--set", "changes", multiple=True, metavar="GROUP.FIELD=VALUE", help="Replace a parameter, repeatable.")
@click.option("--scans", type=int, help="At most so many scans a drive, for a quick look.")
@click.option("--out", type=PATH, default=DEFAULT_OUT, show_default=True, help="Folder that keeps everything.")
@click.option("--json", "json_file", help="Write the result as JSON; `-` prints it and nothing else.")
@click.option("--markdown", "markdown_file", help="Write the tables as Markdown; `-` prints them and nothing else.")
@click.option("--jobs", type=int, help="Worker processes.  [default: one a core]")
@click.option("--pictures/--no-pictures", default=True, show_default=True, help="Draw the figures.")
@click.option("--keep-drives", is_flag=True, help="Keep every drive as MCAP, too.")
def localisation(
    json_file: str | None,
    markdown_file: str | None,
    out: Path,
    jobs: int | None,
    keep_drives: bool,
    pictures: bool,
    **given: Any,
) -> None:
    """Localisation in a changed world: with and without submaps, before and after the map update, with added errors.

    Errors stand beside the GND paper's and Ford's limits. A second start with the same options and folder continues
    where the first ended.
    """
    if jobs is not None and jobs < 1:
        raise click.BadParameter(f"at least one process is needed, got {jobs}", param_hint="--jobs")
    if json_file == "-" and markdown_file == "-":
        raise click.BadParameter("only one of --json and --markdown can be printed", param_hint="--markdown")
    options = options_of(given)
    # The heavy imports wait until the options have been found good.
    from rich.console import Console

    from gnd.deploy.live import progress_bars
    from studies.localisation_study.run import study
    from studies.localisation_study.summary import summary_of
    from studies.localisation_study.tables import markdown_of, print_tables
    from studies.simulation.folder import RunFolder

    folder = RunFolder.create(out, "localisation")
    folder.write_mark({"seeds": list(options.seeds)})
    with progress_bars(Console(stderr=True)) as progress:
        outcome = study(options, folder, jobs or os.cpu_count() or 1, progress, keep_drives=keep_drives)
    found = summary_of(outcome)
    folder.write_json("result.json", found)
    if pictures:
        from studies.localisation_study.figures import draw_figures
        from studies.localisation_study.overview import draw_overview

        draw_figures(outcome, out)
        draw_overview(found, out / "overview.png")
    text, markdown = json.dumps(found, indent=2) + "\n", markdown_of(found, _command_of(given))
    printed = [written(json_file, text, "--json"), written(markdown_file, markdown, "--markdown")]
    if not any(printed):
        print_tables(found)
        click.echo(f"everything else: {out}")


def written(file: str | None, text: str, option: str) -> bool:
    """Write or print a text; whether it was printed."""
    if file == "-":
        click.echo(text, nl=False)
        return True
    if file is not None:
        try:
            Path(file).write_text(text, encoding="utf-8")
        except OSError as error:
            raise click.BadParameter(f"cannot write {file}: {error.strerror}", param_hint=option) from error
    return False


def options_of(given: dict[str, Any]) -> Any:
    """Return `StudyOptions` of the command line's values.

    Raises:
        click.BadParameter: a value that cannot be read.
        GndError: a value that cannot work.
    """
    from gnd.fleet_sim.street import StreetOptions
    from studies.localisation_study.options import StudyOptions
    from studies.simulation.command import list_of
    from studies.simulation.method import MethodParameters
    from studies.simulation.pose_source import PoseSource

    chosen: dict[str, Any] = {name: given[name] for name in ("fleet", "trials", "parking", "scans", "base")}
    chosen["street"] = StreetOptions(given["length_m"], given["site"])
    chosen["poses"] = PoseSource.parse(given["poses"])
    chosen["method"] = MethodParameters().with_changes(given["changes"])
    chosen["sensors"] = list_of("--sensors", given["sensors"], str)
    if given["variants"] is not None:
        named = list_of("--variants", given["variants"], str)
        chosen["variant_sensors"] = () if named == ("none",) else named
    if given["seeds"]:
        chosen["seeds"] = list_of("--world-seed", ",".join(given["seeds"]), int)
    return dataclasses.replace(StudyOptions(), **chosen)


def _command_of(given: dict[str, Any]) -> str:
    """The command line that makes the same numbers."""
    context, words = click.get_current_context(), ["gnd reproduce localisation"]
    named = {"seeds": "--world-seed", "length_m": "--length", "changes": "--set"}
    for name, value in given.items():
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            option = named.get(name, f"--{name}")
            words += [f"{option} {one}" for one in (value if isinstance(value, tuple) else (value,))]
    return " ".join(words)
