"""`gnd import`: a recording into a drive."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import AUTO, FORMATS, import_recording
from gnd.vehicle_agent.importers.recording import RecordingAnchor
from gnd.vehicle_agent.importers.splits import CHOICES


@click.command(name="import")
@click.argument("kind", metavar="FORMAT", type=click.Choice([AUTO, *FORMATS]))
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("-o", "--out", required=True, type=click.Path(path_type=Path, dir_okay=False), help="Drive to write.")
@click.option("--scans", default="all", show_default=True, help=f"Which scans: {CHOICES}.")
@click.option("--anchor", help="Place on the Earth: LAT,LON,HEIGHT in degrees and metres above the ellipsoid.")
@click.option("--vehicle", default="recorded", show_default=True, help="Pseudonym written into the drive.")
@click.option("--topic", help="Topic of the clouds, for an MCAP file with several.")
def import_drives(
    kind: str, folder: Path, out: Path, scans: str, anchor: str | None, vehicle: str, topic: str | None
) -> None:
    """Turn a recording into a drive (MCAP): FORMAT is kitti, radiate, pcd, mcap (ROS 2 PointCloud2, Foxglove clouds),
    planes (millimetres with an INS), apollo or auto, FOLDER holds the recording (or is the .mcap file).
    """
    with step_bars() as progress:
        imported = import_recording(
            kind, folder, out, scans=scans, anchor=_anchor(anchor), vehicle=vehicle, topic=topic, progress=progress
        )
    click.echo(f"{out}: {imported.scans} scans")
    for sentence in imported.skipped:
        click.echo(f"{out}: {sentence}")


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


def _anchor(text: str | None) -> RecordingAnchor | None:
    """LAT,LON,HEIGHT; ImportDriveError when it is something else."""
    if text is None:
        return None
    try:
        lat, lon, height = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ImportDriveError(f"--anchor {text!r}: expected LAT,LON,HEIGHT, such as 37.56,127.03,30") from error
    return RecordingAnchor(lat, lon, height)
