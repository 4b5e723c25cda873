"""`gnd reproduce new-feature-layer`: thin over `studies.new_layer_study.study`."""

from pathlib import Path
from typing import Any

import click

from studies.feature_study.output import PATH, picture_folder, workers, write_result

DEFAULT_OUT = Path("runs/reproduce-new-layer")


@click.command("new-feature-layer")
@click.option("--seeds", default="11", show_default=True, help="Seeds of routes, with commas between: 1,2,3.")
@click.option("--drives", default=6, show_default=True, help="Drives on the test track.")
@click.option("--motorway-drives", default=11, show_default=True, help="Drives on the motorway; one more localises.")
@click.option("--levels", default="0.5,1,2", show_default=True, help="Noise levels of Figure 8; none: no sweep.")
@click.option("--sweep-seeds", default=1, show_default=True, help="The sweep runs on so many of the seeds.")
@click.option("--lap", "lap_m", default=0.0, help="Way driven on the test track, metres.  [default: one lap]")
@click.option("--km", default=4.0, show_default=True, help="Length of the motorway.")
@click.option("--gnss-bias", "gnss_bias_m", default=0.0, help="Constant error of each motorway drive's GNSS, metres.")
@click.option("--straight-seeds", default=1, show_default=True, help="The straight motorway, on so many of the seeds.")
@click.option("--out", type=PATH, default=DEFAULT_OUT, show_default=True, help="Folder that keeps everything.")
@click.option("--json", "json_file", help="Write the result as JSON; `-` prints it and nothing else.")
@click.option("--pictures", type=PATH, help="Folder for the figures.  [default: the one that keeps everything]")
@click.option("--processes", type=int, help="Worker processes.  [default: one a core]")
def new_feature_layer(
    json_file: str | None, out: Path, pictures: Path | None, processes: int | None, **given: Any
) -> None:
    """A layer of beacons or streetlights that many cars map while driving, and localisation with it: Figures 6 to 8, 10
    to 12 and Tables 2 and 3 of the paper on new feature layers.

    A second start with the same options and folder continues where the first ended.
    """
    options, processes = options_of(given), workers(processes)
    # The heavy imports wait until the options have been found good.
    from rich.console import Console

    from gnd.deploy.live import progress_bars
    from studies.feature_study.targets import print_tables
    from studies.new_layer_study.figures import draw_figures
    from studies.new_layer_study.study import study
    from studies.new_layer_study.summary import summary_of
    from studies.new_layer_study.tables import tables_of
    from studies.simulation.folder import RunFolder

    folder, drawn = RunFolder.create(out, "new-feature-layer"), picture_folder(pictures, out)
    folder.write_mark({"seeds": list(options.seeds)})
    with progress_bars(Console(stderr=True)) as progress:
        outcome = study(options, folder, processes, progress)
    found = summary_of(outcome)
    folder.write_json("result.json", found)
    draw_figures(outcome, found, drawn)
    if not write_result(found, json_file):
        print_tables(tables_of(found))
        click.echo(f"everything else: {out}")


def options_of(given: dict[str, Any]) -> Any:
    """Return `NewLayerOptions` of the command line's values.

    Raises:
        click.BadParameter: a value that cannot be read.
        OptionError: a value that cannot work.
    """
    from studies.new_layer_study.options import NewLayerOptions
    from studies.simulation.command import list_of

    seeds = list_of("--seeds", given["seeds"], int)
    levels = () if given["levels"] == "none" else list_of("--levels", given["levels"], float)
    same = ("drives", "motorway_drives", "lap_m", "sweep_seeds", "gnss_bias_m", "km", "straight_seeds")
    return NewLayerOptions(seeds=seeds, levels=levels, **{name: given[name] for name in same})
