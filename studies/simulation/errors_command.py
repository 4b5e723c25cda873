"""`gnd reproduce errors`: which voxels of a finished reproduction cost F1, and why."""

import json
from pathlib import Path
from typing import Any, get_args

import click

from gnd.fleet_sim.truth import LEVELS, Level

_PLAIN_WIDTH = 120
PATH = click.Path(path_type=Path)


@click.command()
@click.argument("out", type=PATH, default=Path("runs/reproduce-simulation"))
@click.option("--stage", "stages", multiple=True, help="single, single.<sensor>, or a number of vehicles; repeatable.")
@click.option("--level", "levels", multiple=True, type=click.Choice(get_args(Level)), help="[default: all three]")
@click.option("--causes", default=4, show_default=True, help="Causes shown of each kind of error.")
@click.option("--set", "changes", multiple=True, metavar="merge.FIELD=VALUE", help="Merge with other parameters.")
@click.option("--true-poses", "exact", type=PATH, help="Folder of the same run with --poses true: what poses cost.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def errors(
    out: Path,
    stages: tuple[str, ...],
    levels: tuple[Level, ...],
    causes: int,
    changes: tuple[str, ...],
    exact: Path | None,
    as_json: bool,
) -> None:
    """Show which voxels of the finished run in OUT cost F1, by true class, predicted class and cause."""
    from studies.simulation.analysis import analyse

    found = analyse(out, stages, levels or LEVELS, changes, exact)
    if as_json:
        click.echo(json.dumps(found))
        return
    _print(found, causes)


def _print(found: dict[str, Any], causes: int) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    if not console.is_terminal:
        console = Console(width=_PLAIN_WIDTH)
    for stage, by_level in found.items():
        for level, losses in by_level.items():
            title = f"{stage}, {level.replace('_', ' ')}: what costs F1"
            table = Table(title=title, title_justify="left", box=None, pad_edge=False)
            for column in ("true", "predicted", "voxels", "F1 points", "causes"):
                table.add_column(column, justify="right" if column in ("voxels", "F1 points") else "left")
            for loss in losses:
                table.add_row(
                    loss["true"], loss["predicted"], f"{loss['voxels']:g}", f"{loss['f1']:.2f}", _causes(loss, causes)
                )
            console.print(table, "")


def _causes(loss: dict[str, Any], most: int) -> str:
    parts = [f"{k:g} {cause}" for cause, k in list(loss["by_cause"].items())[:most]]
    return "\n".join(parts)
