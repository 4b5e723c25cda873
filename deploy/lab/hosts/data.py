"""Where the databases of a laboratory lie: on a disk, in a folder that the server's user can reach."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from gnd.deploy.lab.groups import PREFIX

DATA_ROOT: Final = Path("/var/tmp") / PREFIX  # noqa: S108  (the labs' own folder; names are locked)


@contextmanager
def data_folder(lab: str) -> Iterator[Path]:
    """A folder for the block; call it under the lab's lock."""
    remove_data(lab)
    folder = DATA_ROOT / lab
    folder.mkdir(mode=0o755, parents=True)
    try:
        yield folder
    finally:
        remove_data(lab)


def remove_data(lab: str) -> bool:
    """Remove what a lab's databases have left; whether there was anything. Call it under the lab's lock."""
    folder = DATA_ROOT / lab
    was_there = folder.is_dir() and not folder.is_symlink()
    if was_there:
        shutil.rmtree(folder)
    return was_there


def labs_with_data() -> tuple[str, ...]:
    """Names of labs whose databases lie there."""
    return tuple(sorted(path.name for path in DATA_ROOT.iterdir())) if DATA_ROOT.is_dir() else ()
