"""`gnd import`: a recording into a drive."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from gnd.vehicle_agent.importer import AUTO, FORMATS, import_opened, open_recording
from gnd.vehicle_agent.importers.choices import METRES_OF, Choices, anchor_of_text, fields_of_text, mount_of_text
from gnd.vehicle_agent.importers.fields import ANY_FIELD
from gnd.vehicle_agent.importers.journal import ImportJournal, kept_on_interrupt, kept_scans, key_of
from gnd.vehicle_agent.importers.listing import listed, listing, result_of
from gnd.vehicle_agent.importers.output import check_output
from gnd.vehicle_agent.importers.recording import Recording
from gnd.vehicle_agent.importers.splits import CHOICES
from gnd.vehicle_agent.importers.trajectories.frames import FRAMES


@click.command(name="import")
@click.argument("kind", metavar="FORMAT", type=click.Choice([AUTO, *FORMATS]))
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("-o", "--out", type=click.Path(path_type=Path, dir_okay=False), help="Drive to write; none: only list.")
@click.option("--scans", default="all", show_default=True, help=f"Which scans: {CHOICES}.")
@click.option("--vehicle", default="recorded", show_default=True, help="Pseudonym written into the drive.")
@click.option("--anchor", help="Place: LAT,LON,HEIGHT[,HEADING], degrees, metres above the ellipsoid, from north.")
@click.option("--nowhere", is_flag=True, help="Allow a drive without a place; no shared map takes it.")
@click.option("--poses", help="Track: a file (TUM, KITTI, CSV, INS, GeoJSON, NMEA, .pos) or a topic of the bag.")
@click.option("--poses-frame", default="auto", show_default=True, help=f"Frame of the poses: {FRAMES}.")
@click.option("--poses-of", type=click.Choice(["vehicle", "lidar"]), help="Whose poses; vehicle if a mount is known.")
@click.option("--mount", help="LiDAR on the vehicle: X,Y,Z,ROLL,PITCH,YAW (m, degrees), or a file with a matrix.")
@click.option("--topic", help="Topic of the clouds, for a bag with several.")
@click.option("--sensor", help="Model of the LiDAR, such as VLP-16.")
@click.option("--time-field", help="Field with the time of a point: NAME, NAME:UNIT (s, ms, us, ns), or none.")
@click.option("--units", default="m", show_default=True, type=click.Choice(list(METRES_OF)), help="Of the points.")
@click.option("--stand-ins", is_flag=True, help="Compute fixes and motion from the poses where none were measured.")
@click.option("--strict", is_flag=True, help="End at the first file that cannot be read.")
@click.option("--json", "as_json", is_flag=True, help="Print what is in it and the result as JSON.")
def import_drives(
    kind: str, folder: Path, out: Path | None, scans: str, vehicle: str, as_json: bool, **options: Any
) -> None:
    """Turn a recording into a drive (MCAP): FORMAT is auto or the name of a format, FOLDER holds the recording (or is
    the bag, or the file). What is in it is listed first; without -o that is all.
    """
    choices = _choices(**options)
    if out is not None:
        check_output(out, folder, *choices.files)
    recording = open_recording(kind, folder, choices=choices)
    if not as_json:
        for line in listing(recording):
            click.echo(line)
    if out is None:
        if as_json:
            click.echo(json.dumps(listed(recording), indent=1))
        return
    key = key_of(kind, (folder, *choices.files), choices)
    with _told_on_interrupt(out), kept_on_interrupt(ImportJournal(out, key)) as journal, step_bars() as progress:
        if journal.found:
            _say(f"{out}: resumes at scan {journal.found[-1].number + 1} of {len(recording)} of LiDAR odometry")
        imported = import_opened(
            recording, out, scans=scans, vehicle=vehicle, choices=choices, progress=progress, journal=journal
        )
    if as_json:
        click.echo(json.dumps({**listed(recording), "drive": str(out), **result_of(imported)}, indent=1))
        return
    click.echo(f"{out}: {imported.scans} scans")
    for sentence in (*(imported.quality.lines if imported.quality else ()), *imported.skipped):
        click.echo(f"{out}: {sentence}")
    click.echo(f"next: {next_command(recording, out, choices)}")


def _say(sentence: str) -> None:
    """To people, beside the output."""
    click.echo(sentence, err=True)


@contextmanager
def _told_on_interrupt(out: Path) -> Iterator[None]:
    """Say how to go on when somebody ends the import."""
    try:
        yield
    except KeyboardInterrupt:
        kept = kept_scans(out)
        how = f"goes on after {kept} scans of LiDAR odometry" if kept else "begins anew"
        _say(f"gnd: {out} is not written; the same command {how}")
        raise


def next_command(recording: Recording, out: Path, choices: Choices) -> str:
    """What most people do with such a drive."""
    if not recording.placed:
        return (
            f"gnd import ... --anchor LAT,LON,HEIGHT, for a drive that maps are built from ({out} is marked: no place)"
        )
    if not (choices.stand_ins or (recording.gnss and recording.motion)):
        return f"gnd map build {out} -o map.sqlite (to drive on that map: import with --stand-ins)"
    return f"gnd map build {out} -o map.sqlite, then with another drive: gnd fleet --drives DRIVE --map map.sqlite"


def _choices(anchor: str | None, mount: str | None, time_field: str | None, units: str, **plain: Any) -> Choices:
    return Choices(
        anchor=None if anchor is None else anchor_of_text(anchor),
        mount=None if mount is None else mount_of_text(mount),
        fields=ANY_FIELD if time_field is None else fields_of_text(time_field),
        unit=units,
        **plain,
    )


@contextmanager
def step_bars() -> Iterator[Callable[[str, int, int], None]]:
    """Progress on standard error, one bar a step: to be called with its name, how much is done, and of how much."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    tasks: dict[str, TaskID] = {}
    with Progress(*columns, console=Console(stderr=True)) as bars:

        def show(step: str, done: int, total: int) -> None:
            if step not in tasks:
                tasks[step] = bars.add_task(step, total=total)
            bars.update(tasks[step], completed=done, total=total)

        yield show
