"""`gnd reproduce slamcu`: thin over `studies.slamcu_study.study`."""

from pathlib import Path
from typing import Any

import click

from studies.feature_study.output import PATH, picture_folder, workers, write_result

DEFAULT_OUT = Path("runs/reproduce-slamcu")


@click.command()
@click.option("--seeds", default="11", show_default=True, help="Seeds of routes: 1,2,3 or 1000-1049.")
@click.option("--drives", default=10, show_default=True, help="Vehicles whose reports are merged.")
@click.option("--km", default=20.0, show_default=True, help="Length of the motorway; signs in proportion.")
@click.option("--ablations/--no-ablations", default=True, show_default=True, help="The first drive in all variants.")
@click.option(
    "--faults", default="", help="What the vehicle knows nothing of, put into every drive: camera, gnss, signs."
)
@click.option("--out", type=PATH, default=DEFAULT_OUT, show_default=True, help="Folder that keeps everything.")
@click.option("--json", "json_file", help="Write the result as JSON; `-` prints it and nothing else.")
@click.option("--pictures", type=PATH, help="Folder for the figures.  [default: the one that keeps everything]")
@click.option("--processes", default=1, show_default=True, help="Worker processes.")
def slamcu(json_file: str | None, out: Path, pictures: Path | None, processes: int, **given: Any) -> None:
    """Signs that have gone or are new, found by single cars on a motorway: Figures 8 and 9 and Table 1 of the SLAMCU
    paper, and what ten cars make of it.

    A second start with the same options and folder continues where the first ended.
    """
    options, processes = options_of(given), workers(processes)
    # The heavy imports wait until the options have been found good.
    from rich.console import Console

    from gnd.deploy.live import progress_bars
    from studies.feature_study.targets import print_tables
    from studies.simulation.folder import RunFolder
    from studies.slamcu_study.figures import draw_figures
    from studies.slamcu_study.study import study
    from studies.slamcu_study.summary import summary_of
    from studies.slamcu_study.tables import tables_of

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
    from studies.slamcu_study.options import SlamcuOptions

    return SlamcuOptions(
        seeds_of(given["seeds"]), given["drives"], given["km"], given["ablations"], faults_of(given["faults"])
    )


def faults_of(text: str) -> tuple[str, ...]:
    """Return faults written as names with commas, each once, sorted."""
    return tuple(sorted({name for part in text.split(",") if (name := part.strip())}))


def seeds_of(text: str) -> tuple[int, ...]:
    """Return seeds written as numbers and ranges, such as 7,1000-1049.

    Raises:
        click.BadParameter: one cannot be read, or a range runs backwards.
    """
    from studies.simulation.command import list_of

    return tuple(seed for span in list_of("--seeds", text, _span) for seed in span)


def _span(text: str) -> range:
    first, dash, last = text.partition("-") if not text.startswith("-") else (text, "", "")
    span = range(int(first), int(last if dash else first) + 1)
    if not span:
        raise ValueError(f"{text} runs backwards")
    return span
