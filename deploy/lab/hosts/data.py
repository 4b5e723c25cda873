"""Where the databases of a laboratory lie: on a disk, in a folder that the server's user can reach."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from gnd.deploy.lab.groups import PREFIX, is_lab_name

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


def remove_data(lab: str) -> tuple[str, ...]:
    """Remove what a lab's databases have left; call it under the lab's lock.

    Returns:
        The removed folder; nothing where there was none.
    """
    folder = DATA_ROOT / lab
    if not folder.is_dir() or folder.is_symlink():
        return ()
    shutil.rmtree(folder)
    return (str(folder),)


def labs_with_data() -> tuple[str, ...]:
    """Names of labs whose databases lie there."""
    found = sorted(path.name for path in DATA_ROOT.iterdir()) if DATA_ROOT.is_dir() else ()
    return tuple(name for name in found if is_lab_name(name))
