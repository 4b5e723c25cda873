"""`gnd localise`: a thin command over the library."""

import json
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gnd.ending import ENDING_SIGNALS, exit_code, orderly
from gnd.extras import need_vehicle
from gnd.tile_store.arguments import parse_time_ns
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import DEFAULT_LAYER
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.localise_drive.account import print_account, summary
from gnd.vehicle_agent.localise_drive.outputs import FORMATS, make_folder, write_outputs
from gnd.vehicle_agent.localise_drive.run import LocalisedDrive, check_is_drive, localise_drive
from gnd.vehicle_agent.localise_drive.stretches import stretches_of
from gnd.vehicle_agent.localise_drive.tiles import StoreMap


@click.command(name="localise")
@click.argument("drive", type=click.Path(path_type=Path))
@click.option("--map", "store", metavar="STORE", required=True, type=click.Path(path_type=Path), help="Tile store.")
@click.option("--layer", default=DEFAULT_LAYER, show_default=True, help="Layer of the map.")
@click.option("--at", help="The map as it was then: 2026-01-31T12:00:00Z.  [default: now]")
@click.option("--out", type=click.Path(path_type=Path), help="Folder to write to.  [default: runs/localise-DRIVE]")
@click.option("--format", "formats", default=",".join(FORMATS), show_default=True, help="Which files of poses.")
@click.option("--without-submaps", is_flag=True, help="Refined poses from single scans alone.")
@click.option("--no-plots", is_flag=True, help="Draw no pictures.")
@click.option("--json", "json_to", metavar="FILE", help="Write the summary to this file, too; - prints it instead.")
def localise(
    drive: Path, store: Path, layer: str, at: str | None, out: Path | None, formats: str,
    without_submaps: bool, no_plots: bool, json_to: str | None,
) -> None:  # fmt: skip
    """Localise DRIVE (MCAP, see `gnd import`) on the map of a tile store (see `gnd map build`).

    Writes the refined and the online poses (TUM, KITTI, MCAP, GeoJSON and CSV), the health timeline and pictures;
    prints what came of it, with errors where the drive has a reference. Ctrl-C ends it and keeps what is there.
    """
    need_vehicle()
    chosen, folder = chosen_formats(formats), out or Path("runs") / f"localise-{drive.stem}"
    check_is_drive(drive)
    make_folder(folder)
    with SqliteStore(store, create=False) as opened, ended_by_ctrl_c() as stop:
        tiles = StoreMap(opened, layer, None if at is None else parse_time_ns(at))
        with progress_bar(drive.name) as progress:
            found = localise_drive(drive, tiles, _parameters(without_submaps), progress=progress, stop=stop)
        values = {"map": str(store), "layer": layer, "at": at, "submaps": not without_submaps} | summary(found)
        written = write_outputs(found, values, folder, chosen)
        if not no_plots:
            from gnd.vehicle_agent.localise_drive.map_picture import draw_pictures  # it loads matplotlib

            written += draw_pictures(found, tiles, folder)
        interrupted = stop.is_set()
    _tell(found, values, json_to)
    click.echo(f"{folder}: {', '.join(path.name for path in written)}", err=json_to == "-")
    _end(found, folder, interrupted=interrupted)


def _parameters(without_submaps: bool) -> LocaliserParameters:
    """The defaults, with or without the hierarchical part."""
    parameters = LocaliserParameters()
    return replace(parameters, refine=replace(parameters.refine, enabled=not without_submaps))


def chosen_formats(text: str) -> tuple[str, ...]:
    """The formats of a list such as "tum,kitti", each once; LocaliseError for one that is not known."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    unknown = [name for name in names if name not in FORMATS]
    if unknown:
        raise LocaliseError(f"--format: {unknown[0]!r} is not known; known are {', '.join(FORMATS)}")
    return names


@contextmanager
def progress_bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on standard error, there from the first call: to be called with the scans done and the scans in all."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("scans"))
    bars = Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True))
    task = bars.add_task(name, total=None)

    def show(done: int, total: int) -> None:
        bars.start()
        bars.update(task, completed=done, total=total)

    try:
        yield show
    finally:
        if bars.live.is_started:
            bars.stop()


@contextmanager
def ended_by_ctrl_c() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C or SIGTERM sets; the second ends the program as always."""
    stop = threading.Event()
    before = {number: signal.getsignal(number) for number in ENDING_SIGNALS}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def end(_number: int, _frame: FrameType | None) -> None:
        stop.set()
        restore()

    for number in ENDING_SIGNALS:
        signal.signal(number, end)
    try:
        with orderly():
            yield stop
    finally:
        restore()


def _tell(found: LocalisedDrive, values: dict[str, Any], json_to: str | None) -> None:
    if json_to == "-":
        click.echo(json.dumps(values, indent=1))
        return
    if json_to is not None:
        _write_json(Path(json_to), values)
    print_account(Console(width=120), values, stretches_of(found.moments))


def _write_json(path: Path, values: dict[str, Any]) -> None:
    try:
        path.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise LocaliseError(f"{path}: cannot write: {error.strerror or error}") from None


def _end(found: LocalisedDrive, folder: Path, *, interrupted: bool) -> None:
    """Say it when it was not the whole drive."""
    if found.counts.damage:
        raise LocaliseError(f"{found.counts.damage}; {folder} holds what came before ({found.counts.scans} scans)")
    if interrupted:
        click.echo(f"gnd: interrupted; {folder} holds the first {found.counts.scans} scans", err=True)
        sys.exit(exit_code())
