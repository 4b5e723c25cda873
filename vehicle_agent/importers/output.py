"""Where a drive may be written: never over what it is made of, and never over a file that is something else."""

import os
from collections.abc import Iterator
from pathlib import Path

from gnd.schemas.drive_mcap import is_drive
from gnd.schemas.errors import DriveError
from gnd.vehicle_agent.errors import ImportDriveError


def check_output(out: Path, *inputs: Path) -> None:
    """Refuse an output that is one of the inputs, or lies where a file that is no drive does.

    Files are compared as the system knows them, so links, other spellings and relative paths are seen through.

    Raises:
        ImportDriveError: with what to do.
    """
    if not out.parent.is_dir():
        raise ImportDriveError(f"{out}: no folder {out.parent} to write into")
    if not out.exists() and not out.is_symlink():
        return
    if out.is_dir():
        raise ImportDriveError(f"{out}: is a folder; name the file of the drive")
    for path in input_files(inputs):
        if out.exists() and path.exists() and out.samefile(path):
            raise ImportDriveError(f"{out}: is the input {path}; an import never writes over its input: name another")
    if not _is_drive(out):
        raise ImportDriveError(f"{out}: exists and is no drive; only an older drive is replaced: name another file")


def input_files(inputs: tuple[Path, ...]) -> Iterator[Path]:
    """Every file of these files and folders."""
    for place in inputs:
        if place.is_dir():
            yield from (Path(folder, name) for folder, _, names in os.walk(place, followlinks=True) for name in names)
        elif place.exists():
            yield place


def _is_drive(path: Path) -> bool:
    try:
        return is_drive(path)
    except DriveError:
        return False
