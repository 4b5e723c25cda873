"""Several hosts of a database, of which one takes writes: all are asked at once, and a silent one holds up nobody."""

import queue
import threading
from collections.abc import Sequence
from itertools import cycle, islice
from typing import Any, Final

import psycopg

AGAIN_S: Final = 0.05
"""A host that refuses is asked again after so long, while others have not answered: it may just take over."""
Words = dict[str, Any]
"""What libpq is told, by keyword."""


def hosts_of(told: Words) -> list[Words]:
    """The same for each host, where exactly one of several can be meant: that which takes writes. Else libpq goes
    through them in order.
    """
    names = str(told.get("host") or "").split(",")
    ports = str(told.get("port") or "").split(",")
    is_one_meant = told.get("target_session_attrs") in ("read-write", "primary")
    if not is_one_meant or len(names) < 2 or "hostaddr" in told or len(ports) not in (1, len(names)):
        return [told]
    each = zip(names, islice(cycle(ports), len(names)), strict=True)
    return [told | {"host": name} | ({"port": port} if port else {}) for name, port in each]


def first_connection(hosts: Sequence[Words]) -> "psycopg.Connection[Any]":
    """A connection to the host that lets us in first.

    Raises:
        psycopg.Error: none does; of several hosts with what each has said.
    """
    if len(hosts) == 1:
        return psycopg.connect(**hosts[0], autocommit=True)
    race = _Race()
    for number, told in enumerate(hosts):
        threading.Thread(target=race.run, args=(number, told), name=f"connect-{number}", daemon=True).start()
    return race.won(len(hosts))


class _Race:
    """Attempts at the same time, each in a thread; connections that come too late are closed."""

    def __init__(self) -> None:
        self._lock, self._over = threading.Lock(), threading.Event()
        self._told: queue.SimpleQueue[tuple[int, psycopg.Connection[Any] | psycopg.Error]] = queue.SimpleQueue()

    def run(self, number: int, told: Words) -> None:
        """Try one host until it lets us in or the race is over."""
        while not self._over.is_set():
            try:
                found: psycopg.Connection[Any] | psycopg.Error = psycopg.connect(**told, autocommit=True)
            except psycopg.Error as error:
                found = error
            with self._lock:
                is_late = self._over.is_set()
                if isinstance(found, psycopg.Connection) and not is_late:
                    self._over.set()
            if not is_late:
                self._told.put((number, found))
            elif isinstance(found, psycopg.Connection):
                found.close()
            self._over.wait(AGAIN_S)

    def won(self, hosts: int) -> "psycopg.Connection[Any]":
        """The first connection; psycopg.Error: each of the hosts has failed."""
        failed = dict[int, psycopg.Error]()
        while len(failed) < hosts:
            number, found = self._told.get()
            if isinstance(found, psycopg.Connection):
                return found
            failed[number] = found
        with self._lock:
            self._over.set()
        while not self._told.empty():
            _, found = self._told.get()
            if isinstance(found, psycopg.Connection):  # it came with the last failure
                return found
        raise psycopg.OperationalError("; ".join(str(failed[number]) for number in sorted(failed)))
