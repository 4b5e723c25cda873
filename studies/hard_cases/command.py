"""`gnd reproduce hard-cases`: thin over `studies.hard_cases.study`."""

import json
import os
from pathlib import Path

import click

from studies.localisation_study.command import PATH, written

DEFAULT_OUT = Path("runs/hard-cases")


@click.command("hard-cases")
@click.option("--seeds", default="11", show_default=True, help="Of places and drives, several: 11,12,13.")
@click.option("--sensors", default="vlp16,scala", show_default=True, help="Each drives every case.")
@click.option("--cases", help="Only these, with commas between.  [default: all]")
@click.option("--set", "changes", multiple=True, metavar="GROUP.FIELD=VALUE", help="Replace a parameter, repeatable.")
@click.option("--shorter", default=1.0, show_default=True, help="Share of the places' length, for a quick look.")
@click.option("--out", type=PATH, default=DEFAULT_OUT, show_default=True, help="Folder that keeps everything.")
@click.option("--json", "json_file", help="Write the result as JSON; `-` prints it and nothing else.")
@click.option("--markdown", "markdown_file", help="Write the table as Markdown; `-` prints it and nothing else.")
@click.option("--keep-drives", is_flag=True, help="Keep every drive as MCAP, too.")
@click.option("--jobs", type=int, help="Worker processes.  [default: one a core]")
def hard_cases(
    seeds: str,
    sensors: str,
    cases: str | None,
    changes: tuple[str, ...],
    shorter: float,
    out: Path,
    json_file: str | None,
    markdown_file: str | None,
    keep_drives: bool,
    jobs: int | None,
) -> None:
    """Localisation where it is hard: errors, wrong poses called good, honesty of the covariance, case by case.

    A second start with the same folder continues where the first ended, and drives again only what has changed.
    """
    if jobs is not None and jobs < 1:
        raise click.BadParameter(f"at least one process is needed, got {jobs}", param_hint="--jobs")
    if json_file == "-" and markdown_file == "-":
        raise click.BadParameter("only one of --json and --markdown can be printed", param_hint="--markdown")
    # The heavy imports wait until the options have been found good.
    from rich.console import Console

    from gnd.deploy.live import progress_bars
    from studies.hard_cases.cases import CASES
    from studies.hard_cases.study import HardOptions, study
    from studies.hard_cases.tables import markdown_of, print_table
    from studies.simulation.command import list_of
    from studies.simulation.folder import RunFolder
    from studies.simulation.method import MethodParameters

    options = HardOptions(
        seeds=list_of("--seeds", seeds, int),
        sensors=list_of("--sensors", sensors, str),
        cases=tuple(CASES) if cases is None else list_of("--cases", cases, str),
        localise=MethodParameters().with_changes(changes).localise,
        shorter=shorter,
    )
    folder = RunFolder.create(out, "hard-cases")
    folder.write_mark({"seeds": list(options.seeds)})
    with progress_bars(Console(stderr=True)) as progress:
        found = study(options, out, jobs or os.cpu_count() or 1, progress, keep_drives=keep_drives)
    folder.write_json("result.json", found)
    printed = [
        written(json_file, json.dumps(found, indent=2) + "\n", "--json"),
        written(markdown_file, markdown_of(found), "--markdown"),
    ]
    if not any(printed):
        print_table(found)
        click.echo(f"everything else: {out}")
