"""The machine: cores, memory, disk, descriptors, ports, clock."""

import os
import resource
import shutil
import socket
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from gnd.deploy.doctor.finding import Finding, graded
from gnd.fleet_bus.config import DEFAULT_ENDPOINT, check_endpoint
from gnd.fleet_bus.errors import BusConfigError

_CORES: Final = (2, 1)
_MEMORY_GB: Final = (2.0, 0.5)
_DISK_GB: Final = (5.0, 0.5)
_DESCRIPTORS: Final = (4096, 256)
_CLOCK_S: Final = 0.2
_LOOKS: Final = 2000
_STEP_S: Final = 0.05
_OLDEST: Final = 1_750_000_000
"""2025-06-15: a clock before that has not been set; certificates and reports would be of the past."""
_GB: Final = 1e9
_CGROUP: Final = Path("/sys/fs/cgroup")
_LISTEN_S: Final = 1.0


def machine(folder: Path, listen: Sequence[str]) -> list[Finding]:
    """All that is looked at of the machine.

    Args:
        folder: where runs and stores are to be written.
        listen: endpoints that are to be opened; empty: that of a router by default.
    """
    return [cores(), memory(), disk(folder), descriptors(), *ports(listen), *clock()]


def cores() -> Finding:
    """How many processors this process may use."""
    count = float(len(os.sched_getaffinity(0)))
    quota = _cgroup_words("cpu.max")
    if len(quota) == 2 and quota[0].isdecimal():
        count = min(count, int(quota[0]) / int(quota[1]))
    return graded(
        "cores", count, _CORES, f"{count:g} for this process", "give it at least 2: a vehicle and a shard need one each"
    )


def memory() -> Finding:
    """How much memory is left for this process."""
    free_gb = _available_kb() * 1024 / _GB
    limit, used = _cgroup_words("memory.max"), _cgroup_words("memory.current")
    if limit and limit[0].isdecimal() and used:
        free_gb = min(free_gb, (int(limit[0]) - int(used[0])) / _GB)
    do = "end other programs, or run fewer vehicles: one takes some 0.3 GB, compiling kernels 1 GB"
    return graded("memory", free_gb, _MEMORY_GB, f"{free_gb:.1f} GB free", do)


def _available_kb() -> int:
    for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1])
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 1024


def _cgroup_words(name: str) -> list[str]:
    """Words of a file of the control group; none where there is none."""
    try:
        return (_CGROUP / name).read_text(encoding="ascii").split()
    except OSError:
        return []


def disk(folder: Path) -> Finding:
    """Room where runs and stores go, and whether they may be written there."""
    there = next((one for one in (folder, *folder.absolute().parents) if one.is_dir()), Path("/"))
    if not os.access(there, os.W_OK):
        return Finding("disk", "fault", f"{there} cannot be written to", "choose another folder, or change its rights")
    free_gb = shutil.disk_usage(there).free / _GB
    do = "free space, or choose another folder: a run with simulated drives takes some 0.5 GB"
    return graded("disk", free_gb, _DISK_GB, f"{free_gb:.1f} GB free in {there}", do)


def descriptors() -> Finding:
    """How many files and connections a process may have open."""
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    count = float("inf") if most == resource.RLIM_INFINITY else most
    says = f"at most {count:.0f} files and connections a process"
    return graded("descriptors", count, _DESCRIPTORS, says, "raise the limit (ulimit -n): a router needs one a vehicle")


def ports(listen: Sequence[str]) -> list[Finding]:
    """Whether endpoints can be opened; that of a router by default may be taken by one that runs."""
    if listen:
        return [_port(endpoint, is_wanted=True) for endpoint in listen]
    return [_port(DEFAULT_ENDPOINT, is_wanted=False)]


def _port(endpoint: str, *, is_wanted: bool) -> Finding:
    what = f"port {endpoint}"
    try:
        check_endpoint(endpoint)
    except BusConfigError as error:
        return Finding(what, "fault", str(error), "name it like tcp/127.0.0.1:7447")
    host, _, port = endpoint.partition("/")[2].partition("#")[0].rpartition(":")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        says = f"cannot be opened: {error.strerror or error}"
        if is_wanted:
            return Finding(what, "fault", says, "end who listens there (ss -ltnp), or choose another with --listen")
        return Finding(what, "warning", says, "good if that is your router; else start yours with --listen elsewhere")
    return Finding(what, "ok", "is free")


def clock() -> list[Finding]:
    """Whether the clocks of this machine run evenly, and the wall clock has been set."""
    began_wall_s, began_s = time.time(), time.monotonic()
    steps, last_s = [], began_s
    for _ in range(_LOOKS):
        time.sleep(_CLOCK_S / _LOOKS)
        now_s = time.monotonic()
        steps.append(now_s - last_s)
        last_s = now_s
    apart_s = (time.time() - began_wall_s) - (last_s - began_s)
    found = [_monotonic(min(steps), max(steps))]
    if began_wall_s < _OLDEST:
        says = f"says {time.strftime('%Y-%m-%d %H:%M:%S', time.gmtime(began_wall_s))} UTC, which is long past"
        return [
            *found,
            Finding("clock", "fault", says, "set it, best by NTP (chrony): certificates count as not valid"),
        ]
    if abs(apart_s) > _STEP_S:
        says = f"jumped by {apart_s:+.3f} s against the monotonic clock within {last_s - began_s:.1f} s"
        return [*found, Finding("clock", "warning", says, "let NTP slew it (chrony makestep only at boot)")]
    return [*found, Finding("clock", "ok", f"even to {abs(apart_s) * 1000:.2f} ms over {last_s - began_s:.1f} s")]


def _monotonic(least_s: float, most_s: float) -> Finding:
    if least_s < 0:
        says = f"went back by {-least_s * 1000:.3f} ms"
        return Finding("monotonic clock", "fault", says, "a broken time source of this machine: see `dmesg`")
    return Finding("monotonic clock", "ok", f"never back; longest step {most_s * 1000:.1f} ms")
