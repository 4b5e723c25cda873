"""How a study of a feature layer is started and what it writes; the same for both commands."""

import json
import os
from pathlib import Path
from typing import Any, Final

import click

from studies.simulation.errors import OptionError

PATH: Final = click.Path(path_type=Path)


def check_seeds(seeds: tuple[int, ...]) -> None:
    """Check seeds of routes.

    Raises:
        OptionError: none, one twice, or a negative one.
    """
    if not seeds or len(set(seeds)) != len(seeds) or min(seeds) < 0:
        raise OptionError(f"--seeds must be different integers >= 0, got {', '.join(map(str, seeds)) or 'none'}")


def workers(processes: int | None) -> int:
    """Return the number of worker processes, one a core where none is given.

    Raises:
        OptionError: fewer than one.
    """
    if processes is not None and processes < 1:
        raise OptionError(f"--processes must be at least 1, got {processes}")
    return processes or os.cpu_count() or 1


def write_result(found: dict[str, Any], json_file: str | None) -> bool:
    """Write a result as JSON where one is asked for; whether it was printed instead.

    Raises:
        click.BadParameter: the file cannot be written.
    """
    if json_file == "-":
        click.echo(json.dumps(found))
        return True
    if json_file is not None:
        try:
            Path(json_file).write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            raise click.BadParameter(f"cannot write {json_file}: {error.strerror}", param_hint="--json") from error
    return False


def picture_folder(pictures: Path | None, out: Path) -> Path:
    """Return the folder for pictures, made if need be: the study's own where none is given.

    Raises:
        click.BadParameter: it cannot be made.
    """
    folder = pictures or out
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise click.BadParameter(f"cannot write to {folder}: {error.strerror}", param_hint="--pictures") from error
    return folder
