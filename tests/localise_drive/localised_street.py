"""What the command makes of a drive along a short street that has changed, and drives that something is wrong with."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from gnd.deploy.cli import gnd
from gnd.gnd_map.errors import GndError
from gnd.schemas.drive import DriveItem, GnssFix
from gnd.schemas.drive_mcap import DriveWriter, read_drive, read_header


@dataclass(frozen=True)
class Ran:
    """A street and what the command wrote."""

    drive: Path
    store: Path
    out: Path
    stdout: str
    summary: dict[str, Any]


def changed(source: Path, target: Path, change: Callable[[DriveItem], DriveItem | None]) -> Path:
    """A copy of a drive, each item changed, or left out where `change` gives None."""
    with DriveWriter(target, read_header(source)) as writer:
        for item in read_drive(source):
            kept = change(item)
            if kept is not None:
                writer.add(kept)
    return target


def moved_north(item: DriveItem) -> DriveItem:
    """GNSS fixes 0.01 rad, some 64 km, farther north."""
    return replace(item, lat_rad=item.lat_rad + 0.01) if isinstance(item, GnssFix) else item


def localise(drive: Path, store: Path, *more: str) -> Result:
    """Run the command in this process."""
    return CliRunner().invoke(gnd, ["localise", str(drive), "--map", str(store), *more])


def refusal(drive: Path, store: Path, *more: str) -> str:
    """The error that the command ends with, which the root prints as one line."""
    ran = localise(drive, store, *more)
    assert isinstance(ran.exception, GndError), ran.output
    assert "\n" not in str(ran.exception)
    return str(ran.exception)
