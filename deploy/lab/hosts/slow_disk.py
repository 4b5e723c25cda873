"""A slow disk: what runs on a host may write to the disk only so often a second, by a control group of the kernel.

What a process writes and waits for (a commit of PostgreSQL) is held back; what the kernel writes later is not. With
control groups of version 1 it is `blkio.throttle.write_iops_device`, with version 2 `io.max`.
"""

import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gnd.deploy.errors import LabError
from gnd.deploy.lab.groups import PREFIX, is_lab_name

ROOT: Final = Path("/sys/fs/cgroup")
_PROCS: Final = "cgroup.procs"


@dataclass(frozen=True, slots=True)
class GroupsOfDisks:
    """Where control groups of disks are made.

    Attributes:
        root: the group of all.
        bound: file that holds the bound.
        before: goes before the number of writes in it.
    """

    root: Path
    bound: str
    before: str

    def group_of(self, lab: str) -> Path:
        """The group of a laboratory."""
        return self.root / f"{PREFIX}-{lab}"


def groups_of_disks(root: Path = ROOT) -> GroupsOfDisks:
    """What this machine has.

    Raises:
        LabError: nothing.
    """
    if (root / "blkio" / "blkio.throttle.write_iops_device").exists():
        return GroupsOfDisks(root / "blkio", "blkio.throttle.write_iops_device", "")
    controllers = root / "cgroup.controllers"
    if controllers.exists() and "io" in controllers.read_text(encoding="ascii").split():
        return GroupsOfDisks(root, "io.max", "wiops=")
    raise LabError(f"no control groups of disks under {root}: a slow disk needs blkio (version 1) or io (version 2)")


def disk_of(path: Path) -> str:
    """The disk on which a path lies, as "MAJOR:MINOR"; a partition's disk, not the partition.

    Raises:
        LabError: it lies on none that the kernel could slow.
    """
    number = path.stat().st_dev
    device = Path(f"/sys/dev/block/{os.major(number)}:{os.minor(number)}")
    if not device.exists():
        raise LabError(f"{path} does not lie on a disk of its own (device {os.major(number)}:{os.minor(number)})")
    if (device / "partition").exists():
        device = device.resolve().parent
    return (device / "dev").read_text(encoding="ascii").strip()


def slow_disk(lab: str, disk: str, pids: Iterable[int], writes_per_s: int) -> Callable[[], None]:
    """Let processes, and what they start, write to a disk only so often a second.

    Args:
        lab: name of the laboratory; one disk at a time is slow.
        disk: of `disk_of`.
        pids: the processes.
        writes_per_s: at most so many requests a second, of all of them together.

    Returns:
        What ends it.

    Raises:
        LabError: the kernel refuses.
    """
    groups = groups_of_disks()
    group = groups.group_of(lab)
    try:
        if groups.bound == "io.max":
            (groups.root / "cgroup.subtree_control").write_text("+io", encoding="ascii")
        group.mkdir()
        (group / groups.bound).write_text(f"{disk} {groups.before}{writes_per_s}\n", encoding="ascii")
        for pid in pids:
            _move(pid, group)
    except OSError as error:
        remove_group(lab)
        raise LabError(f"the disk {disk} cannot be slowed: {error}") from error
    return lambda: _undo(lab)


def _undo(lab: str) -> None:
    remove_group(lab)


def remove_group(lab: str) -> tuple[str, ...]:
    """Free what is in the group of a laboratory, and remove it; call it under the lab's lock.

    Returns:
        The removed group; nothing where there was none.
    """
    with suppress(LabError):
        groups = groups_of_disks()
        group = groups.group_of(lab)
        if group.is_dir():
            while pids := (group / _PROCS).read_text(encoding="ascii").split():
                for pid in pids:
                    _move(int(pid), groups.root)
            group.rmdir()
            return (str(group),)
    return ()


def labs_with_groups() -> tuple[str, ...]:
    """Names of labs that have one."""
    with suppress(LabError):
        names = (path.name.partition("-")[2] for path in groups_of_disks().root.glob(f"{PREFIX}-*") if path.is_dir())
        return tuple(sorted(filter(is_lab_name, names)))
    return ()


def _move(pid: int, group: Path) -> None:
    with suppress(ProcessLookupError):  # it has ended
        (group / _PROCS).write_text(str(pid), encoding="ascii")
