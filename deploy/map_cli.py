"""`gnd map`: the commands of the store, and `build`, which needs the vehicle's segmentation and localisation."""

from functools import partial
from pathlib import Path
from typing import Any, Final

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from gnd.deploy.archive_cli import fetch, publish
from gnd.deploy.erase_cli import erase
from gnd.deploy.map_export.command import diff, export
from gnd.deploy.map_export.serve import serve
from gnd.deploy.sign_cli import sign
from gnd.deploy.tile_memory_cli import memory
from gnd.deploy.vehicle_rollback_cli import rollback
from gnd.deploy.verify_cli import verify
from gnd.fleet_bus.identity.options import identity_option
from gnd.tile_store import tables
from gnd.tile_store.cli import PATH, json_option, layer_option, show, store_to_fill
from gnd.tile_store.cli import map_group as store_group
from gnd.tile_store.location import LOCATION, StoreLocation, file_of, shown
from gnd.tile_store.values import DEFAULT_CODEC, MAP_CODECS
from gnd.vehicle_agent.map_align.command import align

CODEC_HELP: Final = "How finely Gaussians are rounded."
REFINE_HELP: Final = (
    "Close loops and tie poses to GNSS: auto, where passes meet and disagree; always; or never, for surveyed poses."
)
MODES: Final = ("auto", "always", "never")


@click.command(short_help="Build a map from drives with known poses.")
@click.argument("drives", nargs=-1, required=True, type=PATH)
@click.option("--store", "-o", "path", required=True, type=LOCATION, help="The store; it is made when missing.")
@click.option("--codec", default=DEFAULT_CODEC, show_default=True, type=click.Choice(MAP_CODECS), help=CODEC_HELP)
@click.option("--keep-movers", is_flag=True, help="Keep points on moving objects and on the vehicle itself.")
@click.option("--refine-poses", "refine", default="auto", show_default=True, type=click.Choice(MODES), help=REFINE_HELP)
@click.option("--report", type=PATH, help="Write the quality of the map as a page (one HTML file).")
@layer_option
@json_option
@identity_option
def build(
    drives: tuple[Path, ...],
    path: StoreLocation,
    codec: str,
    keep_movers: bool,
    refine: Any,
    report: Path | None,
    layer: str,
    as_json: bool,
) -> None:
    """Build tiles from DRIVES (MCAP, with reference poses) and put them into a store as a new base. Recordings (KITTI,
    bags of ROS 2, ...) are imported first.

    What moves and the vehicle's own bodywork are left out. Where a place is passed twice and the passes disagree, as
    poses from odometry do, loops are closed first; several drives become one map. What is out of bounds is said.
    """
    # loaded here: they load numba, gtsam and matplotlib, which the other commands do without
    from gnd.deploy.html_page import check_writable
    from gnd.deploy.map_page import write_map_page
    from gnd.deploy.next_commands import after_map_build
    from gnd.deploy.recordings import drives_of
    from gnd.vehicle_agent.map_build.build import build_recorded_map
    from gnd.vehicle_agent.map_build.quality import measure
    from gnd.vehicle_agent.map_build.result import summary

    if report is not None:
        check_writable(report)
    file = file_of(path) or Path("map")  # what is made of recordings lies beside the store, or here
    drives = drives_of(drives, file.with_name(f"{file.stem}_drives"), partial(click.echo, err=as_json))
    with store_to_fill(path) as opened, _bars() as bars:
        built = build_recorded_map(
            drives, opened, layer=layer, codec=codec, keep_movers=keep_movers, refine=refine, progress=_Shown(bars)
        )
    quality = measure(built)
    if report is not None:
        write_map_page(report, file.name, built, quality)
    values = summary(built, quality)
    show(values, as_json, lambda console: _print(console, f"{shown(path)}, layer {layer}", values))
    if report is not None and not as_json:
        click.echo(f"page written: {report}")
    if not as_json:
        for line in after_map_build(drives, shown(path)):
            click.echo(line)


def _print(console: Console, title: str, values: dict[str, Any]) -> None:
    """The figures as a table, what was done about the poses, and the warnings."""
    plain = {name: value for name, value in values.items() if not isinstance(value, dict | list)}
    missing = values["scans_without_pose"]
    if missing:
        plain["scans_skipped"] = ", ".join(f"{n} {reason}" for reason, n in missing.items())
    quality, drift = values["quality"], values["poses"]["after"] or values["poses"]["before"]
    plain["doubled walls of 1,000"] = f"{quality['doubled_walls']['per_thousand']:.1f}"
    plain["doubled road of 1,000"] = f"{quality['doubled_road']['per_thousand']:.1f}"
    plain["thickness of planes"] = f"{100 * quality['plane_sd_m']['p50']:.1f} cm (median sd)"
    plain["poses"] = f"{'refined' if values['poses']['refined'] else 'kept'}: {values['poses']['reason']}"
    if drift:
        plain["passes off each other"] = (
            f"{100 * drift['horizontal_m']:.1f} cm, {drift['angle_deg']:.2f} degrees "
            f"(median of {drift['loops']} places)"
        )
    console.print(tables.fields(title, plain))
    for warning in values["warnings"]:
        console.print(f"warning: {warning}", style="yellow", highlight=False)


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


_COMMANDS = {
    **store_group.commands,
    "rollback": rollback,
    "sign": sign,
    "erase": erase,
    "export": export,
    "publish": publish,
    "fetch": fetch,
    "serve": serve,
    "diff": diff,
}
map_group = click.Group(
    "map",
    commands=[build, align, verify, memory, *_COMMANDS.values()],
    help="Build, align, inspect, compare, export, serve, publish, fetch, verify, sign, roll back and erase.",
)
