"""A lab: the namespaces and links of one fleet, locked against a second lab of its name, removed at the end.

The lock is the kernel's (flock) and ends with the process that holds it, however it ends. What a killed lab leaves
behind is therefore recognised for certain: its namespaces exist, its lock is free.
"""

import contextlib
import fcntl
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import psutil

from gnd.deploy.errors import LabError, LabRuns
from gnd.deploy.lab.devices import link_commands
from gnd.deploy.lab.groups import PREFIX, Group, LabLink, check_lab_name, links_of, namespace_name
from gnd.deploy.lab.hosts.data import labs_with_data, remove_data
from gnd.deploy.lab.hosts.slow_disk import labs_with_groups, remove_group
from gnd.deploy.lab.namespaces import add_namespace, namespaces, pids_in, remove_namespace, run_all
from gnd.deploy.lab.tools import Offer, check_offer, kernel_offer, needs_carrying

LOCK_FOLDER: Final = Path("/run") / PREFIX
END_WITHIN_S: Final = 10.0
_LOOK_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class Lab:
    """A lab whose namespaces and links are there.

    Attributes:
        name: unique on this machine while it runs.
        groups: who shares a namespace.
        links: one a vehicle, in the order of their numbers.
        relayed: the links that a relay process must carry; the kernel carries the others.
    """

    name: str
    groups: tuple[Group, ...]
    links: tuple[LabLink, ...]
    relayed: tuple[LabLink, ...]

    @property
    def cloud_namespace(self) -> str:
        """Where router, store and mergers run."""
        return namespace_name(self.name, "cloud")

    def links_of(self, group: Group) -> tuple[LabLink, ...]:
        """The links of one group."""
        return tuple(self.links[number] for number in group.vehicles)


@contextmanager
def open_lab(name: str, groups: tuple[Group, ...], *, relay_all: bool = False) -> Iterator[Lab]:
    """Make namespaces and links, and remove them with the block, whatever ends it.

    Args:
        name: of the lab.
        groups: from `parse_groups`.
        relay_all: carry by relay what netem could do.

    Raises:
        LabError: the name is taken, an earlier lab of it left something behind, or the kernel refuses.
    """
    links = links_of(check_lab_name(name), groups)
    with lab_lock(name):
        left = namespaces_of(name)
        if left:
            raise LabError(f"an earlier lab {name!r} left {len(left)} namespaces: remove them with `gnd lab clean`")
        try:
            offer = kernel_offer(namespace_name(name, "probe"))
            check_offer(offer, tuple(group.link for group in groups))
            relayed = relayed_links(links, offer, relay_all=relay_all)
            _build(links, relayed)
            yield Lab(name, groups, links, relayed)
        finally:
            remove_all(name)


def relayed_links(links: tuple[LabLink, ...], offer: Offer, *, relay_all: bool) -> tuple[LabLink, ...]:
    """Return the links that a relay must carry: those with delay or loss, unless the kernel's netem does it."""
    if offer.netem and not relay_all:
        return ()
    return tuple(link for link in links if needs_carrying(link.profile))


def _build(links: tuple[LabLink, ...], relayed: tuple[LabLink, ...]) -> None:
    for namespace in sorted({ns for link in links for ns in (link.cloud_namespace, link.vehicle_namespace)}):
        add_namespace(namespace)
    for link in links:
        run_all(link_commands(link, relayed=link in relayed))


@contextmanager
def lab_lock(name: str) -> Iterator[None]:
    """Hold the name of a lab.

    Raises:
        LabRuns: a process that lives holds it; the message tells which.
    """
    LOCK_FOLDER.mkdir(mode=0o755, parents=True, exist_ok=True)
    file = LOCK_FOLDER / f"{name}.lock"
    descriptor = _locked(file, name)
    try:
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode("ascii"), 0)
        yield
    finally:
        file.unlink(missing_ok=True)
        os.close(descriptor)


def _locked(file: Path, name: str) -> int:
    while True:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(descriptor, 20, 0).decode("ascii", "replace").strip() or "unknown"
            os.close(descriptor)
            raise LabRuns(f"a lab {name!r} runs (process {holder}): end it, or choose another --name") from error
        if file.exists() and os.path.samestat(file.stat(), os.fstat(descriptor)):
            return descriptor
        os.close(descriptor)  # its holder has just removed the file: that lock is worth nothing


def namespaces_of(lab: str) -> tuple[str, ...]:
    """Return the namespaces that a lab of that name has, or has left behind."""
    return tuple(name for name in namespaces() if name.startswith(namespace_name(lab, "")))


def labs() -> tuple[str, ...]:
    """Return the names of all labs that have namespaces, running or left behind."""
    names = (name.split(".") for name in namespaces())
    return tuple(sorted({parts[1] for parts in names if len(parts) == 3 and parts[0] == PREFIX}))


def remove_all(lab: str) -> tuple[str, ...]:
    """End what still runs in a lab's namespaces and remove them with their links; call it under the lab's lock.

    Returns:
        The removed namespaces.
    """
    names = namespaces_of(lab)
    for name in names:
        _end(tuple(pid for pid in pids_in(name) if pid != os.getpid()))
        remove_namespace(name)
    return names


def _end(pids: tuple[int, ...]) -> None:
    """End processes: SIGTERM, a while to obey, then SIGKILL."""
    processes = [process for pid in pids if (process := _process(pid)) is not None]
    for number in (signal.SIGTERM, signal.SIGKILL):
        for process in processes:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.send_signal(number)
        processes = _still_running(processes)


def _still_running(processes: list[psutil.Process]) -> list[psutil.Process]:
    """Wait until processes have ended, and return those that have not in time."""
    deadline_s = time.monotonic() + END_WITHIN_S
    while (running := [process for process in processes if _runs(process)]) and time.monotonic() < deadline_s:
        time.sleep(_LOOK_S)
    return running


def _runs(process: psutil.Process) -> bool:
    """Tell whether a process runs; a dead one that its parent has not yet asked for does not."""
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def _process(pid: int) -> psutil.Process | None:
    try:
        return psutil.Process(pid)
    except psutil.NoSuchProcess:
        return None


def clean() -> dict[str, tuple[str, ...]]:
    """Remove what killed labs have left behind; labs that run are left alone.

    Returns:
        The removed namespaces, the folder of databases and the group of a slow disk, by lab; an empty tuple for a lab
        that runs.
    """
    done: dict[str, tuple[str, ...]] = {}
    for name in sorted({*labs(), *labs_with_data(), *labs_with_groups()}):
        try:
            with lab_lock(name):
                done[name] = (*remove_all(name), *remove_data(name), *remove_group(name))
        except LabRuns:
            done[name] = ()
    return done
