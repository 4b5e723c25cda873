"""Recordings where drives are asked for: each is imported in passing, as `gnd import auto` does it."""

from collections.abc import Callable, Sequence
from pathlib import Path

from gnd.schemas.drive_mcap import is_drive
from gnd.schemas.errors import DriveError
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import AUTO, DEFAULTS, Imported, import_opened, open_recording
from gnd.vehicle_agent.importer_cli import step_bars
from gnd.vehicle_agent.importers.listing import listing
from gnd.vehicle_agent.importers.output import check_output

_METADATA_OF_BAG = "metadata.yaml"


def drives_of(paths: Sequence[Path], folder: Path, say: Callable[[str], None]) -> tuple[Path, ...]:
    """The drives among paths as they are, and of each recording the drive that it becomes.

    Args:
        paths: drives, folders of drives, recordings (folders, bags, files); in this order they come back.
        folder: where drives of recordings are written; it is made when one is needed.
        say: takes a line for people: what is in a recording, and what became of it.

    Raises:
        ImportDriveError: something is no recording either, or cannot be imported without being told more: with the
            command that takes it.
    """
    found, names = list[Path](), set[str]()
    for path in paths:
        if not _is_recording(path):
            found += sorted(path.glob("*.mcap")) if path.is_dir() else [path]
            continue
        names.add(name := _free_name(path, names))
        found.append(_imported(path, folder / name, say))
    return tuple(found)


def _is_recording(path: Path) -> bool:
    """Whether it has to be imported. What is missing or damaged is left to those who read drives: they say it best."""
    if not path.exists():
        return False
    if path.is_file():
        return path.suffix != ".mcap" or not _is_drive(path)
    drives = sorted(path.glob("*.mcap"))
    return (path / _METADATA_OF_BAG).is_file() or not any(map(_is_drive, drives))


def _is_drive(path: Path) -> bool:
    try:
        return is_drive(path)
    except DriveError:
        return True


def _free_name(path: Path, taken: set[str]) -> str:
    """The name of its drive: two days may have folders of the same name."""
    stem = path.resolve().name.removesuffix(path.suffix if path.is_file() else "")
    names = (f"{stem}{'' if number == 1 else f'-{number}'}.mcap" for number in range(1, len(taken) + 2))
    return next(name for name in names if name not in taken)


def _imported(recording: Path, drive: Path, say: Callable[[str], None]) -> Path:
    try:
        opened = open_recording(AUTO, recording, choices=DEFAULTS)
        for line in listing(opened):
            say(line)
        drive.parent.mkdir(parents=True, exist_ok=True)
        check_output(drive, recording)
        with step_bars() as progress:
            imported = import_opened(opened, drive, choices=DEFAULTS, progress=progress)
    except ImportDriveError as error:
        raise ImportDriveError(
            f"{error}; options are taken by the import alone: gnd import auto {recording} -o drive.mcap ..., and give"
            " drive.mcap here"
        ) from error
    for line in _lines(drive, imported):
        say(line)
    return drive


def _lines(drive: Path, imported: Imported) -> list[str]:
    sentences = (*(imported.quality.lines if imported.quality else ()), *imported.skipped)
    return [f"{drive}: {imported.scans} scans", *(f"{drive}: {sentence}" for sentence in sentences)]
