"""CPU that processes have used."""

from collections.abc import Mapping
from typing import Final

import psutil

from gnd.tile_store.location import StoreLocation, conninfo_of, file_of

DATABASE: Final = "database"
"""Name of the part that is a database server's."""
_NAMES: Final = {
    "router": ("router", "hub"),
    "store": ("store", "tiles-"),
    "shards": ("merger-", "shard-"),
    DATABASE: (DATABASE,),
}
"""How the names of its processes begin, on one machine or on several hosts."""
_HERE: Final = ("/", "localhost", "127.0.0.1", "::1")
"""How hosts begin that are this machine; a path is a socket."""


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
    """CPU seconds of the cloud's parts so far: routers, tile servers, shards (they receive), their workers (they
    compute), and database servers, if there are any.

    Args:
        pids: of the processes by name, as the supervisor knows them; `DATABASE` beside them.
    """
    of = {part: [pid for name, pid in pids.items() if name.startswith(words)] for part, words in _NAMES.items()}
    shards = of.pop("shards")
    return {
        **{part: sum(map(cpu_s, own)) for part, own in of.items() if own or part != DATABASE},
        "shards": sum(map(_own_s, shards)),  # a worker that has died is counted here
        "workers": sum(cpu_s(child) for pid in shards for child in children(pid)),
    }


def server_of(location: StoreLocation) -> int | None:
    """The first process of the database server of a store; None: the store is a file, or its server is elsewhere."""
    if file_of(location) is not None:
        return None
    import psycopg

    with psycopg.connect(conninfo_of(location)) as connection:
        if not connection.info.host.startswith(_HERE):
            return None
        try:
            return int(psutil.Process(connection.info.backend_pid).ppid())
        except psutil.NoSuchProcess:  # it is in a container of its own
            return None


def _own_s(pid: int) -> float:
    """CPU of the process, and of its children that have ended."""
    try:
        times = psutil.Process(pid).cpu_times()
    except psutil.NoSuchProcess:
        return 0.0
    return float(times.user + times.system + times.children_user + times.children_system)
