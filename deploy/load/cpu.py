"""CPU that processes have used, read from /proc."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

_TICK_S: Final = 1.0 / os.sysconf("SC_CLK_TCK")
_UTIME, _CUTIME = 11, 13  # fields of /proc/PID/stat behind the name, from 0


def cpu_s(pid: int) -> float:
    """CPU seconds of a process with its children, those that have ended included; 0.0 where there is none."""
    return sum((_own_s(pid), *(cpu_s(child) for child in children(pid))))


def busy_s() -> float:
    """CPU seconds that all programs of the machine have used since it was started."""
    line = Path("/proc/stat").read_text(encoding="ascii").partition("\n")[0].split()[1:]
    user, nice, system, _idle, _iowait, irq, softirq, *_ = map(int, line)
    return _TICK_S * (user + nice + system + irq + softirq)


def children(pid: int) -> list[int]:
    """The processes that a process has started and that run."""
    found: set[int] = set()
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found |= {int(word) for word in task.read_text(encoding="ascii").split()}
        except OSError:  # it has ended meanwhile
            continue
    return sorted(found)


def by_part(pids: Mapping[str, int]) -> dict[str, float]:
    """CPU seconds of the cloud's parts so far: router, store, shards (they receive) and their workers (they compute).

    Args:
        pids: of the processes by name, as the supervisor knows them.
    """
    shards = [pid for name, pid in pids.items() if name.startswith("merger-")]
    workers = [child for pid in shards for child in children(pid)]
    return {
        "router": _sum_s(pid for name, pid in pids.items() if name == "router"),
        "store": _sum_s(pid for name, pid in pids.items() if name == "store"),
        "shards": sum(_own_s(pid) for pid in shards),  # a worker that has died is counted here
        "workers": _sum_s(workers),
    }


def _sum_s(pids: Iterable[int]) -> float:
    return sum(map(cpu_s, pids))


def _own_s(pid: int) -> float:
    """CPU of the process, and of its children that have ended."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except OSError:
        return 0.0
    fields = text.rpartition(")")[2].split()
    return _TICK_S * sum(map(int, fields[_UTIME : _CUTIME + 2]))
