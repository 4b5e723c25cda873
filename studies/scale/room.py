"""Room on a shared machine: cores that processes have before everybody else, and bounds for some of them (control
groups, version 1, as root).

    python -m studies.scale.room [--with PID] -- COMMAND …
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import click
import psutil

from studies.frame.errors import OptionError

WEIGHT: Final = 64 * 1024
PERIOD_US: Final = 20_000
"""A bounded group gets its share anew so often."""
GROUPS: Final = Path("/sys/fs/cgroup/cpu")


@dataclass(frozen=True, slots=True)
class Room:
    """Cores on which the processes that enter go before all others.

    Attributes:
        group: the control group.
        cores: their numbers.
    """

    group: Path
    cores: frozenset[int]

    def enter(self, pid: int) -> None:
        """A process, and what it starts afterwards."""
        self._move(pid, self.group)

    def bound(self, name: str, share: float, pid: int) -> None:
        """A process with all that it has started, and what it starts afterwards, together use at most a share of one
        core; those under one name share it.
        """
        group = self.group / name
        if not group.exists():
            group.mkdir()
            (group / "cpu.cfs_period_us").write_text(str(PERIOD_US), encoding="ascii")
            (group / "cpu.cfs_quota_us").write_text(str(round(share * PERIOD_US)), encoding="ascii")
        with suppress(psutil.NoSuchProcess):
            for process in (psutil.Process(pid), *psutil.Process(pid).children(recursive=True)):
                self._move(process.pid, group)

    def unbound(self) -> None:
        """Remove the bounds; what was bound has ended, or is free now."""
        for group in [one for one in self.group.iterdir() if one.is_dir()]:
            _emptied(group, self.group)

    def _move(self, pid: int, group: Path) -> None:
        with suppress(ProcessLookupError, psutil.NoSuchProcess):  # it has ended
            (group / "cgroup.procs").write_text(str(pid), encoding="ascii")
            for thread in psutil.Process(pid).threads():
                os.sched_setaffinity(thread.id, self.cores)


@contextmanager
def room(cores: int = 1) -> Iterator[Room]:
    """This process and what it starts run on the last cores, before all others.

    Raises:
        OptionError: control groups cannot be made here.
    """
    before = os.sched_getaffinity(0)
    made = Room(GROUPS / f"gnd-scale-{os.getpid()}", frozenset(sorted(before)[-cores:]))
    try:
        made.group.mkdir()
    except OSError as error:
        raise OptionError(f"no control group can be made: {error}; it takes root and {GROUPS}") from error
    try:
        (made.group / "cpu.shares").write_text(str(WEIGHT), encoding="ascii")
        made.enter(os.getpid())
        yield made
    finally:
        made.unbound()
        _emptied(made.group, GROUPS)
        os.sched_setaffinity(0, before)


def _emptied(group: Path, into: Path) -> None:
    for pid in (group / "cgroup.procs").read_text(encoding="ascii").split():
        with suppress(ProcessLookupError):
            (into / "cgroup.procs").write_text(pid, encoding="ascii")
    group.rmdir()


@click.command(help="Run a command on the last core before everybody else, as root: its clock means something then.")
@click.option("--with", "pids", multiple=True, type=int, help="A process that comes along, with those it has started.")
@click.argument("command", nargs=-1, required=True)
def main(pids: tuple[int, ...], command: tuple[str, ...]) -> None:
    """Run it, and end as it does."""
    with room() as made:
        for pid in pids:
            made.enter(pid)
            for child in psutil.Process(pid).children(recursive=True):
                made.enter(child.pid)
        sys.exit(subprocess.run(command, check=False).returncode)  # noqa: S603  what the user has typed


if __name__ == "__main__":
    main(prog_name="python -m studies.scale.room")
