"""`gnd map`: the commands of the store, and `build`, which needs the vehicle's segmentation and localisation."""

from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from tile_store import tables
from tile_store.cli import PATH, json_option, layer_option, show, store_to_fill
from tile_store.cli import map_group as store_group
from tile_store.values import DEFAULT_CODEC, MAP_CODECS


@click.command(short_help="Build a map from drives with known poses.")
@click.argument("drives", nargs=-1, required=True, type=PATH)
@click.option("--store", "-o", "path", required=True, type=PATH, help="The store; it is made when missing.")
@click.option(
    "--codec",
    default=DEFAULT_CODEC,
    show_default=True,
    type=click.Choice(MAP_CODECS),
    help="How finely Gaussians are rounded.",
)
@click.option("--keep-movers", is_flag=True, help="What moves, and the vehicle itself, stay in the map.")
@layer_option
@json_option
def build(drives: tuple[Path, ...], path: Path, codec: str, keep_movers: bool, layer: str, as_json: bool) -> None:
    """Build tiles from DRIVES (MCAP, with reference poses) and put them into a store as a new base.

    What moves and the vehicle's own bodywork are left out.
    """
    from vehicle_agent.map_build.build import build_recorded_map  # it loads numba, which the other commands do without
    from vehicle_agent.map_build.result import summary

    with store_to_fill(path) as opened, _bars() as bars:
        built = build_recorded_map(
            drives, opened, layer=layer, codec=codec, keep_movers=keep_movers, progress=_Shown(bars)
        )
    values = summary(built)
    show(values, as_json, lambda console: _print(console, f"{path}, layer {layer}", values))


def _print(console: Console, title: str, values: dict[str, Any]) -> None:
    console.print(tables.fields(title, values))


class _Shown:
    """A progress bar a step and drive."""

    def __init__(self, bars: Progress) -> None:
        self._bars = bars
        self._tasks: dict[str, TaskID] = {}

    def __call__(self, step: str, done: int, total: int) -> None:
        if step not in self._tasks:
            self._tasks[step] = self._bars.add_task(step, total=total)
        self._bars.update(self._tasks[step], completed=done)


def _bars() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True))


map_group = click.Group(
    "map", commands=[build, *store_group.commands.values()], help="Build, inspect, compare, export and roll back maps."
)
