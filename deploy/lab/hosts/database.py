"""A database host: its server, and who watches over the pair of them.

One side takes writes, and commits wait until the other has them on its disk. A side that misses the other for
`MISSED_S` asks the witness; who is told yes goes on alone, and the other begins anew as its copy. For a fleet of your
own take a tool that does this for a living, such as Patroni.
"""

import logging
import socket
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import psycopg

from gnd.deploy.errors import LabError
from gnd.deploy.lab.hosts.plan import DATABASE_PORT, DATABASES
from gnd.deploy.lab.hosts.postgres import LabServer, end_server
from gnd.deploy.lab.hosts.witness import WitnessClient, WitnessState

LOOK_S: Final = 0.1
MISSED_S: Final = 0.6
"""A side that is missed for so long is asked about."""
KNOCK_S: Final = 0.3
SETTLED_S: Final = 0.5
"""Every backend has read new settings after so long."""
READY_S: Final = 60.0
RETRY_S: Final = 0.5
_LOG: Final = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class DatabaseSide:
    """One of the two database hosts.

    Attributes:
        name: "database-a" or "database-b".
        address: of its host.
        other: address of the other's host.
        folder: of its data; what lies there is lost where it begins as a copy.
        witness: its address; None: there is none, and each side stays what it was first.
    """

    name: str
    address: str
    other: str
    folder: Path
    witness: tuple[str, int] | None

    @property
    def other_name(self) -> str:
        """Of the other one."""
        return DATABASES[1 - DATABASES.index(self.name)]


def database(side: DatabaseSide, *, stop: threading.Event) -> None:
    """Run one of the two database hosts until `stop` is set; the role of a process.

    Raises:
        LabError: the server has ended, or the other one has taken over: begun again, this side is its copy.
    """
    client = WitnessClient(side.witness, side.name)
    LabServer(side.name, side.address, side.folder).end_left()
    state = _remembered(client, stop)
    watch: _Primary | _Standby = _Primary(side, client) if state.primary == side.name else _Standby(side, client)
    try:
        if not watch.begin(state, stop):
            return
        while not stop.wait(LOOK_S):
            watch = watch.look()
    finally:
        watch.end()


def _remembered(client: WitnessClient, stop: threading.Event) -> WitnessState:
    """What the witness remembers; it is waited for. Without one the first side takes writes."""
    while client.address is not None and not stop.is_set():
        if (state := client.who()) is not None:
            return state
        stop.wait(RETRY_S)
    return WitnessState(DATABASES[0])


class _WatchedSide:
    """What both have: a server, a connection to it, and since when the other is missed."""

    def __init__(self, side: DatabaseSide, client: WitnessClient) -> None:
        self._side, self._client = side, client
        self._server = LabServer(side.name, side.address, side.folder)
        self._process: Any = None
        self._connection: psycopg.Connection[Any] | None = None
        self._seen_s = time.monotonic()

    def _start(self, stop: threading.Event) -> bool:
        """Start the server and wait until it answers; False: it does not, or was stopped meanwhile."""
        self._process = self._server.start()
        until_s = time.monotonic() + READY_S
        while time.monotonic() < until_s and not stop.is_set():
            self._must_run()
            try:
                self._connection = self._server.connect()
            except psycopg.Error:
                time.sleep(LOOK_S)
                continue
            self._seen_s = time.monotonic()
            return True
        return False

    def _must_run(self) -> None:
        if self._process.poll() is not None:
            raise LabError(f"the server of {self._side.name} has ended with code {self._process.returncode}")

    def _asked(self, sql: str) -> list[tuple[Any, ...]]:
        """Rows; nothing where the server does not answer now."""
        self._must_run()
        try:
            if self._connection is None or self._connection.closed:
                self._connection = self._server.connect()
            return self._connection.execute(sql).fetchall()
        except psycopg.Error as error:
            _LOG.warning("%s: %s", self._side.name, " ".join(str(error).split()))
            if self._connection is not None:
                self._connection.close()
            return []

    def _is_missed(self, *, is_there: bool) -> bool:
        now_s = time.monotonic()
        if is_there:
            self._seen_s = now_s
        return now_s - self._seen_s > MISSED_S

    def end(self) -> None:
        """Stop the server."""
        if self._connection is not None:
            self._connection.close()
        if self._process is not None:
            end_server(self._process)


class _Primary(_WatchedSide):
    """Takes writes."""

    _waits = False  # commits wait for the other
    _is_paired = False  # and the witness knows
    _waits_since_s = 0.0

    @classmethod
    def promoted(cls, standby: "_Standby") -> "_Primary":
        """A standby that has taken over: the same server, alone."""
        found = cls(standby._side, standby._client)
        found._process, found._connection = standby._process, standby._connection
        return found

    def begin(self, state: WitnessState, stop: threading.Event) -> bool:
        """Make the cluster where there is none, and start; False: it was stopped meanwhile."""
        if not (self._server.data / "PG_VERSION").exists():
            self._server.make()
        self._waits = self._is_paired = not state.is_alone
        self._server.configure(waits_for=self._side.other_name if self._waits else "")
        return self._start(stop)

    def look(self) -> "_Primary":
        """Pair, or go on alone where the witness says so.

        Raises:
            LabError: the other one has taken over.
        """
        is_there, has_all = self._other()
        if self._is_missed(is_there=is_there):
            self._missed()
        elif is_there and not self._waits:
            self._wait_for_other(self._side.other_name)
        elif has_all and not self._is_paired and time.monotonic() - self._waits_since_s > SETTLED_S:
            self._is_paired = self._client.address is None or self._client.grants("paired")
        return self

    def _other(self) -> tuple[bool, bool]:
        """Whether the other follows, and whether it has on its disk all that there is."""
        followers = self._asked(
            "SELECT application_name, flush_lsn >= pg_current_wal_flush_lsn(), sync_state = 'sync'"
            " FROM pg_stat_replication WHERE state = 'streaming'"
        )
        others = [has_all and is_sync for name, has_all, is_sync in followers if name == self._side.other_name]
        return bool(others), any(others)

    def _missed(self) -> None:
        if self._client.grants("alone"):
            if self._waits:
                _LOG.warning("%s goes on alone", self._side.name)
                self._is_paired = False
                self._wait_for_other("")
        elif (state := self._client.who()) is not None and state.primary != self._side.name:
            end_server(self._process, at_once=True)
            raise LabError(f"{state.primary} has taken over from {self._side.name}")

    def _wait_for_other(self, name: str) -> None:
        self._server.configure(waits_for=name)
        self._asked("SELECT pg_reload_conf()")
        self._waits, self._waits_since_s = bool(name), time.monotonic()


class _Standby(_WatchedSide):
    """Follows the other, and takes over where the witness says so."""

    def begin(self, _state: WitnessState, stop: threading.Event) -> bool:
        """Copy the other as soon as it can be copied, and start; False: it was stopped meanwhile."""
        while not stop.is_set():
            try:
                self._server.copy_of(self._side.other)
                return self._start(stop)
            except LabError as error:
                _LOG.warning("%s: %s", self._side.name, error)
                stop.wait(RETRY_S)
        return False

    def look(self) -> "_Primary | _Standby":
        """Take over where the other is gone; what runs from now on.

        Raises:
            LabError: the server has ended.
        """
        self._must_run()
        if not self._is_missed(is_there=self._is_other_there()) or not self._client.grants("promote"):
            return self
        _LOG.warning("%s takes over", self._side.name)
        self._server.configure()
        if self._asked("SELECT pg_promote(true, 30)") != [(True,)]:
            raise LabError(f"{self._side.name} could not take over")
        return _Primary.promoted(self)

    def _is_other_there(self) -> bool:
        try:
            socket.create_connection((self._side.other, DATABASE_PORT), KNOCK_S).close()
        except OSError:
            return False
        return True
