"""Opening SQLite so that several processes may share the file and nothing acknowledged is lost."""

import os
import random
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Final, Literal, TypeVar
from urllib.parse import quote

import apsw

from gnd.tile_store import clocks
from gnd.tile_store.connection import NOTHING, Bindings, Row
from gnd.tile_store.errors import (
    DISTRICT_REFUSED,
    DistrictElsewhere,
    StoreBusy,
    StoreDamaged,
    StoreError,
    StoreMoved,
    StoreUnavailable,
)
from gnd.tile_store.idle import IdleConnections
from gnd.tile_store.migrations import SCHEMA_VERSION, migrate, schema_of
from gnd.tile_store.sql import statements

SQL: Final = statements("sqlite")

READER_PATIENCE_S: Final = 30.0
OLDEST_SQLITE: Final = (3, 51, 3)
"""Older ones can corrupt a WAL that several connections write and checkpoint."""


T = TypeVar("T")


class SqliteConnection(apsw.Connection):
    """`SqlConnection` to an SQLite file."""

    @property
    def clock(self) -> clocks.MachineClock:
        """The machine's: all processes that share a file see the same."""
        return clocks.MACHINE

    def fetch(self, statement: str, bindings: Bindings = NOTHING) -> list[Row]:
        """All rows of a named statement."""
        try:
            return list(self.execute(SQL[statement], bindings))
        except UnicodeDecodeError as error:  # a text of a damaged store
            raise StoreDamaged(f"{self.filename}: damaged (a text that is no UTF-8: {error})") from None

    def change(self, statement: str, bindings: Bindings = NOTHING) -> int:
        """Run a named statement; the number of rows that it changed."""
        self.execute(SQL[statement], bindings)
        return self.changes()

    def post(self, statement: str, bindings: Bindings = NOTHING) -> None:
        """Run a named statement."""
        self.execute(SQL[statement], bindings)

    def fetch_each(self, statement: str, each: Sequence[Bindings], shared: Bindings = NOTHING) -> list[list[Row]]:
        """All rows of a named statement, for each of several bindings."""
        return [self.fetch(statement, {**shared, **one}) for one in each]

    def ask_each(
        self, statement: str, each: Sequence[Bindings], shared: Bindings = NOTHING
    ) -> Callable[[], list[list[Row]]]:
        """All rows of a named statement, for each of several bindings."""
        found = self.fetch_each(statement, each, shared)
        return lambda: found

    def post_each(self, statement: str, each: Sequence[Bindings], shared: Bindings = NOTHING) -> None:
        """Run a named statement for each of several bindings."""
        for one in each:
            self.execute(SQL[statement], {**shared, **one})


def as_store_error(error: Exception, path: str | Path, *, to_write: bool = True) -> Exception:
    """SQLite's errors as ours, in one line; any other exception as it is."""
    if isinstance(error, (apsw.CantOpenError, apsw.PermissionsError, PermissionError)) and not to_write:
        return StoreUnavailable(f"{path}: cannot be read; check its permissions and those of its folder")
    if isinstance(error, (apsw.BusyError, apsw.LockedError)):
        return StoreBusy(f"{path}: another process has held the write lock for too long; try again or stop it")
    if isinstance(error, apsw.NotADBError):
        return StoreUnavailable(f"{path}: not a tile store (not an SQLite database); choose another path")
    if isinstance(error, (apsw.CantOpenError, apsw.ReadOnlyError, apsw.PermissionsError)):
        return StoreUnavailable(f"{path}: cannot be opened for writing; its folder must exist and be writable")
    if isinstance(error, apsw.ConstraintError) and DISTRICT_REFUSED in str(error):
        return DistrictElsewhere(str(path))
    if isinstance(error, apsw.ConstraintError) and "moved to " in str(error):
        return StoreMoved(str(path), str(error))
    if isinstance(error, apsw.FullError):
        return StoreUnavailable(f"{path}: disk full; free space and try again, nothing was changed")
    if isinstance(error, apsw.CorruptError):
        return StoreDamaged(
            f"{path}: damaged ({error}); `gnd map check` names what is, `gnd map restore` puts a backup back"
        )
    if isinstance(error, apsw.Error):
        return StoreError(f"{path}: {type(error).__name__}: {error}")
    return error


def open_writer(path: Path, *, create: bool, busy_timeout_s: float) -> SqliteConnection:
    """A connection for writing: WAL, every commit synced to disk, schema checked (and made when the file is new)."""
    if tuple(map(int, apsw.sqlite_lib_version().split("."))) < OLDEST_SQLITE:
        raise StoreUnavailable(f"SQLite {apsw.sqlite_lib_version()} can corrupt a shared WAL; install apsw >= 3.52")
    if not create and not path.is_file():
        raise StoreUnavailable(f"{path}: no such store; `gnd map build` makes one")
    flags = apsw.SQLITE_OPEN_READWRITE | (apsw.SQLITE_OPEN_CREATE if create else 0)
    try:
        connection = SqliteConnection(str(path), flags=flags)
    except apsw.Error as error:
        raise as_store_error(error, path) from None
    try:
        _prepare(connection, path, busy_timeout_s)
    except apsw.Error as error:
        connection.close()
        raise as_store_error(error, path) from None
    except BaseException:
        connection.close()
        raise
    return connection


def open_reader(path: Path) -> SqliteConnection:
    """A connection that changes nothing, also where nothing can be written: in a folder or on a disk that is read-only.

    There a store can be read that was closed cleanly, or whose log is in use by a process that may write.

    Raises:
        StoreUnavailable: no such store, not a store, or a log that cannot be read without writing.
    """
    if not path.is_file():
        raise StoreUnavailable(f"{path}: no such store; `gnd map build` makes one")
    try:
        try:
            return _opened_reader(str(path), path, 0)
        except (apsw.CantOpenError, apsw.ReadOnlyError, apsw.PermissionsError):
            if os.access(path.parent, os.W_OK):
                raise
            log = path.with_name(path.name + "-wal")
            if log.exists() and log.stat().st_size:
                raise StoreUnavailable(
                    f"{path}: its log {log.name} is not yet part of it and its folder is read-only; copy both to a"
                    " folder that can be written to"
                ) from None
            # A store in WAL mode wants to make files beside itself, unless it is told that nobody will change it.
            return _opened_reader(f"file:{quote(str(path.resolve()))}?immutable=1", path, apsw.SQLITE_OPEN_URI)
    except (apsw.Error, OSError) as error:
        raise as_store_error(error, path, to_write=False) from None


def require_current(path: Path) -> None:
    """StoreUnavailable unless the store has the schema of this release, which cannot be given to it without writing."""
    connection = open_reader(path)
    try:
        found = schema_of(connection, path)
    finally:
        connection.close()
    if found < SCHEMA_VERSION:
        raise StoreUnavailable(
            f"{path}: store schema {found}, this release reads {SCHEMA_VERSION} and may not write here; copy the store"
            " to a folder that can be written to, opening it there brings it up to date"
        )


def _opened_reader(name: str, path: Path, flags: int) -> SqliteConnection:
    connection = SqliteConnection(name, flags=apsw.SQLITE_OPEN_READONLY | flags)
    try:
        connection.set_busy_handler(_Patience(READER_PATIENCE_S))
        connection.pragma("trusted_schema", False)
        schema_of(connection, path)
    except BaseException:
        connection.close()
        raise
    return connection


def _prepare(connection: apsw.Connection, path: Path, busy_timeout_s: float) -> None:
    connection.set_busy_handler(_Patience(busy_timeout_s))
    found = _retry_busy(lambda: schema_of(connection, path), busy_timeout_s)
    log_ahead(connection, "full", busy_timeout_s)
    connection.pragma("trusted_schema", False)
    if connection.readonly("main"):
        raise StoreUnavailable(f"{path}: read-only; a store must be writable")
    if found < SCHEMA_VERSION:
        migrate(connection, path)


def log_ahead(connection: apsw.Connection, synchronous: Literal["full", "normal"], busy_timeout_s: float) -> None:
    """Have a connection write through a log (WAL), wait for other writers, and sync each commit ("full") or not."""
    connection.set_busy_handler(_Patience(busy_timeout_s))
    _retry_busy(lambda: connection.pragma("journal_mode", "wal"), busy_timeout_s)
    connection.pragma("synchronous", synchronous)


class _Patience:
    """Busy handler: waits 0.2 to 2 ms at random, so that no process starves as under SQLite's ever longer steps."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._deadline = 0.0

    def __call__(self, attempts: int) -> bool:
        now = time.monotonic()
        if attempts == 0:
            self._deadline = now + self._timeout_s
        time.sleep(random.uniform(0.0002, 0.002))
        return now < self._deadline


def _retry_busy(step: Callable[[], T], timeout_s: float) -> T:
    # Changing the journal mode does not call the busy handler.
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            return step()
        except (apsw.BusyError, apsw.LockedError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.005)


class ReaderPool:
    """Read-only connections, one for each thread that reads at the same time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._idle = IdleConnections[SqliteConnection](str(path), apsw.Error, lambda error: as_store_error(error, path))

    @contextmanager
    def snapshot(self) -> Iterator[SqliteConnection]:
        """A connection on which everything is read at one instant."""
        with self.connection() as connection:
            connection.execute("BEGIN")
            yield connection
            connection.execute("COMMIT")

    def single(self) -> AbstractContextManager[SqliteConnection]:
        """The same."""
        return self.snapshot()

    @contextmanager
    def connection(self) -> Iterator[SqliteConnection]:
        """A connection outside any transaction; it is not used again after an error."""
        idle = self._idle.take()
        with self._idle.lent(open_reader(self._path) if idle is None else idle) as connection:
            yield connection

    def close(self) -> None:
        """Close the idle connections; those in use close when they come back."""
        self._idle.close()
