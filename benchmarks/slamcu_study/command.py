"""`gnd reproduce slamcu`: thin over `benchmarks.slamcu_study.study`."""

from pathlib import Path
from typing import Any

import click

from benchmarks.feature_study.output import PATH, picture_folder, workers, write_result

DEFAULT_OUT = Path("runs/reproduce-slamcu")


@click.command()
@click.option("--seeds", default="11", show_default=True, help="Seeds of routes, with commas between: 1,2,3.")
@click.option("--drives", default=10, show_default=True, help="Vehicles whose reports are merged.")
@click.option("--km", default=20.0, show_default=True, help="Length of the motorway; signs in proportion.")
@click.option("--ablations/--no-ablations", default=True, show_default=True, help="The first drive in all variants.")
@click.option("--out", type=PATH, default=DEFAULT_OUT, show_default=True, help="Folder that keeps everything.")
@click.option("--json", "json_file", help="Write the result as JSON; `-` prints it and nothing else.")
@click.option("--pictures", type=PATH, help="Folder for the figures.  [default: the one that keeps everything]")
@click.option("--processes", type=int, help="Worker processes.  [default: one a core]")
def slamcu(json_file: str | None, out: Path, pictures: Path | None, processes: int | None, **given: Any) -> None:
    """Signs that have gone or are new, found by single cars on a motorway: Figures 8 and 9 and Table 1 of the SLAMCU
    paper, and what ten cars make of it.

    A second start with the same options and folder continues where the first ended.
    """
    options, processes = options_of(given), workers(processes)
    # The heavy imports wait until the options have been found good.
    from rich.console import Console

    from benchmarks.feature_study.targets import print_tables
    from benchmarks.simulation.folder import RunFolder
    from benchmarks.slamcu_study.figures import draw_figures
    from benchmarks.slamcu_study.study import study
    from benchmarks.slamcu_study.summary import summary_of
    from benchmarks.slamcu_study.tables import tables_of
    from deploy.live import progress_bars

    folder, drawn = RunFolder.create(out, "slamcu"), picture_folder(pictures, out)
    folder.write_mark({"seeds": list(options.seeds)})
    with progress_bars(Console(stderr=True)) as progress:
        outcome = study(options, folder, processes, progress)
    found = summary_of(outcome)
    folder.write_json("result.json", found)
    draw_figures(outcome, drawn)
    if not write_result(found, json_file):
        print_tables(tables_of(found))
        click.echo(f"everything else: {out}")


def options_of(given: dict[str, Any]) -> Any:
    """Return `SlamcuOptions` of the command line's values.

    Raises:
        click.BadParameter: a value that cannot be read.
        OptionError: a value that cannot work.
    """
    from benchmarks.simulation.command import list_of
    from benchmarks.slamcu_study.options import SlamcuOptions

    seeds = list_of("--seeds", given["seeds"], int)
    return SlamcuOptions(seeds, given["drives"], given["km"], given["ablations"])
