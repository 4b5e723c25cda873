"""Worlds, drives and maps that are made once for all processes of a run of the suite, and only looked at."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from tempfile import mkdtemp

import pytest

Prepared = Callable[[str, Callable[[Path], None]], Path]


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    """Gives the folder of a name, filled by `make` when a test of this run first asks for it.

    Tests must not write there: they copy what they change. Fixtures that take it may be used in several processes,
    so they tie no modules to each other (`suite_groups`).
    """
    base = tmp_path_factory.getbasetemp()
    common = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base  # of this run; each worker has one below it
    return lambda name, make: made_once(common / "prepared", name, make)


def made_once(home: Path, name: str, make: Callable[[Path], None]) -> Path:
    """The folder `home/name`; who comes first fills it, the others wait. A folder that was left half made is not used.

    Raises:
        Whatever `make` raises; the next who asks tries again.
    """
    home.mkdir(exist_ok=True)
    whole = home / name
    with (home / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # until the file is closed, also by the end of the process
        if not whole.is_dir():
            partial = Path(mkdtemp(prefix=f"{name}.", dir=home))
            make(partial)
            partial.rename(whole)
    return whole
