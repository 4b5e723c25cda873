"""Connections to PostgreSQL: named statements with binary parameters, prepared once, and the database's clock."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from types import MappingProxyType
from typing import Any, Final
from urllib.parse import quote

import psycopg
from psycopg import errors as pg
from psycopg.conninfo import conninfo_to_dict
from psycopg.pq.abc import PGresult

from gnd.tile_store.connection import NOTHING, Bindings, Row
from gnd.tile_store.errors import (
    DistrictElsewhere,
    StoreAway,
    StoreBusy,
    StoreDamaged,
    StoreError,
    StoreMoved,
    StoreUnavailable,
)
from gnd.tile_store.idle import IdleConnections
from gnd.tile_store.postgres_race import first_connection, hosts_of
from gnd.tile_store.postgres_wire import BoundStatement, PostgresWire, columns_of
from gnd.tile_store.sql import statements

NS_PER_S: Final = 1_000_000_000
OLDEST_SERVER: Final = 150_000
"""PostgreSQL 15, as libpq counts."""
CONNECT_TIMEOUT_S: Final = 5
RECONNECT_S: Final = 5.0
"""A server that restarts, or whose standby takes over, is waited for so long."""
MOST_READERS: Final = 16
READER_PATIENCE_S: Final = 30.0
CLOCK_READ_EVERY_S: Final = 10.0
MOVED_STATE: Final = "GND01"
"""The code of PostgreSQL's error for a store that has moved."""
ELSEWHERE_STATE: Final = "GND02"
"""The same for a district of another store."""
STEP_NS: Final = 2_000_000_000
"""A clock that goes back by more was set; less is how exactly it is read on a busy machine."""
CLOCK_NAME: Final = "database"
_SETTINGS: Final = (
    "SET client_min_messages = warning; SET jit = off; SET lock_timeout = '30s'; SET DateStyle = ISO; "
    "SET plan_cache_mode = force_generic_plan; "
    "SELECT set_config('synchronous_commit', CASE current_setting('synchronous_commit') WHEN 'off' THEN 'on' "
    "ELSE current_setting('synchronous_commit') END, false)"
)
"""Plans are made once and not compiled; who waits for a lock is told; what is committed is on disk."""
_SAYS: Final = (
    ("password", "the password was not accepted (PGPASSWORD, or a line of ~/.pgpass)"),
    ("no pg_hba.conf entry", "the server lets nobody in from here under this name (its pg_hba.conf)"),
    ('role "', "the server does not know the user"),
    ('database "', "the server has no such database; createdb makes one"),
    ("too many", "the server has no connection left (its max_connections)"),
    ("certificate", "the server's certificate was not accepted"),
    ("SSL", "no TLS as it was asked for"),
    ("definition of service", "pg_service.conf has no such service"),
)
"""What libpq says, by a part of its line, and what to do: of connections that fail it gives no code."""


_NOT_YET: Final = ("starting up", "shutting down", "in recovery mode", "not yet accepting connections")


class ServerNotReady(StoreAway):
    """The server is there, and starts or stops."""


SQL: Final = MappingProxyType({name: BoundStatement.of(sql) for name, sql in statements("postgresql").items()})


class DatabaseClock:
    """The database's clock, read now and then, between that the machine's own: one for shards of all hosts.

    A date that is set on the database's host, or a standby that takes over with another, moves the ends of leases by as
    much. A lease that ends early costs work twice, never a report: what counts is its token, and the head that is
    compared (decision 0011). One that would end late would hold up work for as long, so who sees the clock go back
    frees all (`stepped_back`).
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ahead_ns = 0
        self._read_s = float("-inf")
        self._stepped_back = False

    @property
    def name(self) -> str:
        """One for all: times by it mean the same everywhere."""
        return CLOCK_NAME

    def steady_ns(self) -> int:
        """Now, ns."""
        return time.monotonic_ns() + self._ahead_ns

    def read_with(self, raw: psycopg.Connection[Any]) -> None:
        """Ask the database, if that was long ago."""
        with self._lock:
            if time.monotonic() - self._read_s < CLOCK_READ_EVERY_S:
                return
            before = time.monotonic_ns()
            row = raw.execute(SQL["now"].sql, binary=True).fetchone()
            assert row is not None
            ahead_ns = int(row[0]) - (before + time.monotonic_ns()) // 2
            self._stepped_back |= self._ahead_ns - ahead_ns > STEP_NS and self._read_s > 0.0
            self._ahead_ns, self._read_s = ahead_ns, time.monotonic()

    def stepped_back(self) -> bool:
        """Whether it has gone back since this was asked last."""
        with self._lock:
            told, self._stepped_back = self._stepped_back, False
            return told


class _Question:
    """What will be answered by a statement that is on its way."""

    __slots__ = ("result",)

    def __init__(self) -> None:
        self.result: PGresult | None = None


class PostgresConnection:
    """`SqlConnection` to PostgreSQL."""

    def __init__(self, raw: psycopg.Connection[Any], clock: DatabaseClock) -> None:
        self.raw = raw
        self._clock = clock
        self._wire = PostgresWire(raw)
        self._posted: list[tuple[BoundStatement, Bindings, _Question | None]] = []

    @property
    def clock(self) -> DatabaseClock:
        """The database's."""
        return self._clock

    def fetch(self, statement: str, bindings: Bindings = NOTHING) -> list[Row]:
        """All rows of a named statement."""
        return self._wire.rows(self._run([(SQL[statement], bindings)])[-1])

    def change(self, statement: str, bindings: Bindings = NOTHING) -> int:
        """Run a named statement; the number of rows that it changed."""
        return self._run([(SQL[statement], bindings)])[-1].command_tuples or 0

    def post(self, statement: str, bindings: Bindings = NOTHING) -> None:
        """Run a named statement with the next one: one way to the server and back for both."""
        self._posted.append((SQL[statement], bindings, None))

    def post_command(self, command: str) -> None:
        """The same of a command without parameters, such as BEGIN."""
        self._posted.append((_command(command), NOTHING, None))

    def run(self, command: str) -> None:
        """Run a command without parameters, such as COMMIT."""
        self._run([(_command(command), NOTHING)])

    def run_script(self, script: str) -> None:
        """Run several commands."""
        self.raw.execute(script, prepare=False)

    def fetch_each(self, statement: str, each: Sequence[Bindings], shared: Bindings = NOTHING) -> list[list[Row]]:
        """All rows of a named statement, for each of several bindings: one statement over arrays."""
        return self.ask_each(statement, each, shared)()

    def ask_each(
        self, statement: str, each: Sequence[Bindings], shared: Bindings = NOTHING
    ) -> Callable[[], list[list[Row]]]:
        """The same, asked with the next statement, or when the answer is wanted."""
        question = _Question()
        if each:
            self._posted.append((*_over_arrays(statement, each, shared), question))

        def answer() -> list[list[Row]]:
            found: list[list[Row]] = [[] for _ in each]
            if each and question.result is None:
                self._run([])
            if question.result is not None:
                for number, *row in self._wire.rows(question.result):
                    found[number - 1].append(tuple(row))
            return found

        return answer

    def post_each(self, statement: str, each: Sequence[Bindings], shared: Bindings = NOTHING) -> None:
        """Run a named statement for each of several bindings: one statement over arrays, with the next one."""
        if each:
            self._posted.append((*_over_arrays(statement, each, shared), None))

    def changes(self, told: Sequence[tuple[str, Bindings]], end: str) -> list[int]:
        """Run named statements, then a command such as COMMIT, all in one way to the server and back.

        Returns:
            The number of rows that each statement changed.
        """
        ran = self._run([*((SQL[name], bindings) for name, bindings in told), (_command(end), NOTHING)])
        return [result.command_tuples or 0 for result in ran[-1 - len(told) : -1]]

    def insert_all(self, statement: str, key: str, rows: Sequence[Bindings]) -> list[int]:
        """Insert rows by a statement over arrays that returns the keys of the new ones, and commit.

        Returns:
            For each row whether it is new, 1 or 0; of several with one key the first.
        """
        ran = self._run([(SQL[statement], columns_of(rows, rows[0])), (_command("COMMIT"), NOTHING)])
        new = {found for (found,) in self._wire.rows(ran[-2])}
        told = []
        for row in rows:
            told.append(int(row[key] in new))
            new.discard(row[key])
        return told

    def forget_posted(self) -> None:
        """What was posted and is not sent is not wanted any more."""
        self._posted.clear()

    def _run(self, commands: list[tuple[BoundStatement, Bindings]]) -> list[PGresult]:
        posted, self._posted = self._posted, []
        results = self._wire.run([*((statement, bindings) for statement, bindings, _ in posted), *commands])
        for (_, _, question), result in zip(posted, results, strict=False):
            if question is not None:
                question.result = result
        return results

    @property
    def is_lost(self) -> bool:
        """Whether nothing can be asked of it any more. A server that has something to say unasked says farewell."""
        return self.raw.closed or self.raw.broken or self._wire.has_farewell()

    def close(self) -> None:
        """Free it."""
        self.raw.close()


@cache
def _command(command: str) -> BoundStatement:
    return BoundStatement(command)


def _over_arrays(statement: str, each: Sequence[Bindings], shared: Bindings) -> tuple[BoundStatement, Bindings]:
    found = SQL[f"{statement}_each"]
    return found, {**columns_of(each, found.names), **shared}


def shown(conninfo: str) -> str:
    """A connection string without its password, for messages."""
    try:
        told = conninfo_to_dict(conninfo)
    except psycopg.Error:
        return "postgresql:…"
    if "service" in told:
        return f"postgresql:service={told['service']}"
    user, host, port = (str(told.get(name) or "") for name in ("user", "host", "port"))
    at = f"{quote(user)}@" if user else ""
    where = _where(host, port) if not host.startswith("/") else f":{port}" if port else ""
    rest = f"?host={host}" if host.startswith("/") else ""
    return f"postgresql://{at}{where}/{told.get('dbname') or ''}{rest}"


def _where(hosts: str, ports: str) -> str:
    """Hosts with their ports, as a URL has them; libpq tells them as two lists, of which one port stands for all."""
    names, numbers = hosts.split(","), ports.split(",")
    each = numbers if len(numbers) == len(names) else numbers[:1] * len(names)
    return ",".join(f"{name}:{number}" if number else name for name, number in zip(names, each, strict=True))


def connect(conninfo: str, clock: DatabaseClock) -> PostgresConnection:
    """A connection outside any transaction.

    Raises:
        StoreUnavailable: what stands against it, in one line: not reachable, not let in, no such database, too old.
    """
    try:
        told = conninfo_to_dict(conninfo)
        told.setdefault("connect_timeout", CONNECT_TIMEOUT_S)
        told.setdefault("application_name", "gnd")
        raw = first_connection(hosts_of(told))
    except psycopg.Error as error:
        raise _not_let_in(error, conninfo) from None
    try:
        _require_new_enough(raw.info.server_version, shown(conninfo))
        raw.execute(_SETTINGS)
        clock.read_with(raw)
    except psycopg.Error as error:
        raw.close()
        raise as_store_error(error, shown(conninfo)) from None
    except BaseException:
        raw.close()
        raise
    return PostgresConnection(raw, clock)


def _require_new_enough(version: int, location: str) -> None:
    if version < OLDEST_SERVER:
        raise StoreUnavailable(
            f"{location}: PostgreSQL {version // 10_000} is too old; {OLDEST_SERVER // 10_000} or newer is needed"
        )


def _not_let_in(error: psycopg.Error, conninfo: str) -> StoreUnavailable:
    line = " ".join(str(error).split())[:300]
    if any(part in line for part in _NOT_YET):
        return ServerNotReady(f"{shown(conninfo)}: the server starts or stops; try again ({line})")
    known = next((meaning for part, meaning in _SAYS if part in line), None)
    if known is None and "FATAL" not in line:
        return StoreAway(f"{shown(conninfo)}: no server answers there ({line})")
    return StoreUnavailable(f"{shown(conninfo)}: {known or 'cannot be opened'} ({line})")


def as_store_error(error: Exception, location: str) -> Exception:
    """PostgreSQL's errors as ours, in one line; any other exception as it is."""
    if not isinstance(error, psycopg.Error):
        return error
    line = " ".join(str(error).split())[:300]
    if error.diag.sqlstate in (MOVED_STATE, ELSEWHERE_STATE):
        moved = error.diag.sqlstate == MOVED_STATE
        return StoreMoved(location, line) if moved else DistrictElsewhere(location)
    if isinstance(error, (pg.LockNotAvailable, pg.DeadlockDetected, pg.SerializationFailure, pg.QueryCanceled)):
        return StoreBusy(f"{location}: other writers have held a lock for too long; try again ({line})")
    if isinstance(error, pg.InsufficientPrivilege):
        return StoreUnavailable(f"{location}: the user has no right to this ({line}); it needs to own the tables")
    if isinstance(error, pg.ReadOnlySqlTransaction):
        return StoreUnavailable(f"{location}: read-only; a standby cannot be written to")
    if isinstance(error, pg.DiskFull):
        return StoreUnavailable(f"{location}: disk full; free space and try again, nothing was changed")
    if isinstance(error, (pg.DataCorrupted, pg.IndexCorrupted)):
        return StoreDamaged(f"{location}: damaged ({line}); `gnd map check` names what is")
    if isinstance(error, pg.UndefinedTable):
        return StoreUnavailable(f"{location}: not a tile store ({line})")
    if isinstance(error, (psycopg.OperationalError, psycopg.InterfaceError)):
        return StoreUnavailable(f"{location}: the server is gone ({line})")
    return StoreError(f"{location}: {type(error).__name__}: {line}")


def is_loss(error: BaseException) -> bool:
    """Whether an error says that the connection is gone, and nothing of the store."""
    return isinstance(error, (psycopg.InterfaceError, psycopg.OperationalError)) and not isinstance(
        error, (pg.LockNotAvailable, pg.DiskFull, pg.OutOfMemory, pg.QueryCanceled, pg.TransactionRollback)
    )


def patiently(
    open_one: Callable[[], PostgresConnection], waits_for: type[StoreUnavailable] = StoreUnavailable
) -> PostgresConnection:
    """A connection to a server that may be restarting; other failures than `waits_for` are told at once."""
    until = time.monotonic() + RECONNECT_S
    while True:
        try:
            return open_one()
        except waits_for:
            if time.monotonic() > until:
                raise
            time.sleep(0.05)


class PostgresReaders:
    """Connections that read at one instant; at most `MOST_READERS` at a time."""

    def __init__(self, conninfo: str, clock: DatabaseClock) -> None:
        self._conninfo, self._clock = conninfo, clock
        self._location = shown(conninfo)
        self._idle = IdleConnections[PostgresConnection](
            self._location, psycopg.Error, lambda error: as_store_error(error, self._location)
        )
        self._free = threading.Semaphore(MOST_READERS)

    @contextmanager
    def snapshot(self) -> Iterator[PostgresConnection]:
        """A connection on which everything is read at one instant."""
        with self.single() as connection:
            connection.post_command("BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY")
            yield connection
            connection.run("COMMIT")

    @contextmanager
    def single(self) -> Iterator[PostgresConnection]:
        """A connection on which each statement reads at its own instant: for those that ask once."""
        if not self._free.acquire(timeout=READER_PATIENCE_S):
            raise StoreBusy(f"{self._location}: {MOST_READERS} readers of this process for {READER_PATIENCE_S:.0f} s")
        try:
            with self._idle.lent(self._ready()) as connection:
                connection.clock.read_with(connection.raw)
                yield connection
        finally:
            self._free.release()

    def close(self) -> None:
        """Close the idle connections; those in use close when they come back."""
        self._idle.close()

    def _ready(self) -> PostgresConnection:
        """A connection outside any transaction; one that the server has closed meanwhile is not used."""
        while (connection := self._idle.take()) is not None and connection.is_lost:
            connection.close()
        if connection is None:
            connection = patiently(lambda: connect(self._conninfo, self._clock))
        return connection
