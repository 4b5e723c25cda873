"""CPU that processes have used."""

from collections.abc import Mapping

import psutil


def cpu_s(pid: int) -> float:
    """CPU seconds of a process with its children, those that have ended included; 0.0 where there is none."""
    return sum((_own_s(pid), *(cpu_s(child) for child in children(pid))))


def busy_s() -> float:
    """CPU seconds that all programs of the machine have used since it was started."""
    times = psutil.cpu_times()
    return float(times.user + times.nice + times.system + times.irq + times.softirq)


def children(pid: int) -> list[int]:
    """The processes that a process has started and that run."""
    try:
        return sorted(child.pid for child in psutil.Process(pid).children())
    except psutil.NoSuchProcess:
        return []


def by_part(pids: Mapping[str, int]) -> dict[str, float]:
    """CPU seconds of the cloud's parts so far: router, store, shards (they receive) and their workers (they compute).

    Args:
        pids: of the processes by name, as the supervisor knows them.
    """
    shards = [pid for name, pid in pids.items() if name.startswith("merger-")]
    return {
        **{part: sum(cpu_s(pid) for name, pid in pids.items() if name == part) for part in ("router", "store")},
        "shards": sum(map(_own_s, shards)),  # a worker that has died is counted here
        "workers": sum(cpu_s(child) for pid in shards for child in children(pid)),
    }


def _own_s(pid: int) -> float:
    """CPU of the process, and of its children that have ended."""
    try:
        times = psutil.Process(pid).cpu_times()
    except psutil.NoSuchProcess:
        return 0.0
    return float(times.user + times.system + times.children_user + times.children_system)
