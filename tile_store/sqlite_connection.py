"""Opening SQLite so that several processes may share the file and nothing acknowledged is lost."""

import random
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import apsw

from tile_store.errors import StoreBusy, StoreClosed, StoreError, StoreUnavailable
from tile_store.sql import statements

SCHEMA_VERSION: Final = 1
APPLICATION_ID: Final = 0x474E4453
"""ASCII "GNDS" in the file's header: this database is a GND store."""
SQL: Final = statements("sqlite")

OLDEST_SQLITE: Final = (3, 51, 3)
"""Older ones can corrupt a WAL that several connections write and checkpoint."""


Row = tuple[Any, ...]
Bindings = Mapping[str, Any]


def fetch(connection: apsw.Connection, statement: str, bindings: Bindings = MappingProxyType({})) -> list[Row]:
    """All rows of a named statement."""
    return list(connection.execute(SQL[statement], bindings))


def change(connection: apsw.Connection, statement: str, bindings: Bindings) -> int:
    """Run a named statement; the number of rows that it changed."""
    connection.execute(SQL[statement], bindings)
    return connection.changes()


def as_store_error(error: Exception, path: str | Path) -> Exception:
    """SQLite's errors as ours, in one line; any other exception as it is."""
    if isinstance(error, (apsw.BusyError, apsw.LockedError)):
        return StoreBusy(f"{path}: another process has held the write lock for too long; try again or stop it")
    if isinstance(error, apsw.NotADBError):
        return StoreUnavailable(f"{path}: not a tile store (not an SQLite database); choose another path")
    if isinstance(error, (apsw.CantOpenError, apsw.ReadOnlyError, apsw.PermissionsError)):
        return StoreUnavailable(f"{path}: cannot be opened for writing; its folder must exist and be writable")
    if isinstance(error, apsw.FullError):
        return StoreUnavailable(f"{path}: disk full; free space and try again, nothing was changed")
    if isinstance(error, apsw.CorruptError):
        return StoreUnavailable(f"{path}: damaged ({error}); restore the newest backup")
    if isinstance(error, apsw.Error):
        return StoreError(f"{path}: {type(error).__name__}: {error}")
    return error


def open_writer(path: Path, *, create: bool, busy_timeout_s: float) -> apsw.Connection:
    """A connection for writing: WAL, every commit synced to disk, schema checked (and made when the file is new)."""
    if tuple(map(int, apsw.sqlite_lib_version().split("."))) < OLDEST_SQLITE:
        raise StoreUnavailable(f"SQLite {apsw.sqlite_lib_version()} can corrupt a shared WAL; install apsw >= 3.52")
    if not create and not path.is_file():
        raise StoreUnavailable(f"{path}: no such store; `gnd map build` makes one")
    flags = apsw.SQLITE_OPEN_READWRITE | (apsw.SQLITE_OPEN_CREATE if create else 0)
    try:
        connection = apsw.Connection(str(path), flags=flags)
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


def _prepare(connection: apsw.Connection, path: Path, busy_timeout_s: float) -> None:
    connection.set_busy_handler(_Patience(busy_timeout_s))
    _retry_busy(lambda: _check_header(connection, path), busy_timeout_s)
    _retry_busy(lambda: connection.pragma("journal_mode", "wal"), busy_timeout_s)
    connection.pragma("synchronous", "full")
    connection.pragma("trusted_schema", False)
    if connection.pragma("application_id") == 0:
        _create_schema(connection)
        _check_header(connection, path)
    if connection.readonly("main"):
        raise StoreUnavailable(f"{path}: read-only; a store must be writable")
    if not fetch(connection, "has_schema_of_confirmation"):
        _in_one(connection, lambda: connection.execute(SQL["schema_of_confirmation"]))
    if not fetch(connection, "has_schema_of_surveys"):
        _in_one(connection, lambda: connection.execute(SQL["schema_of_surveys"]))
    if not fetch(connection, "has_schema_of_parts"):
        _in_one(connection, lambda: _add_parts(connection))
    if not fetch(connection, "has_schema_of_journal"):
        _in_one(connection, lambda: _add_journal(connection))
    if not fetch(connection, "has_schema_of_uploads"):
        _in_one(connection, lambda: connection.execute(SQL["schema_of_uploads"]))


def _add_parts(connection: apsw.Connection) -> None:
    if not fetch(connection, "has_schema_of_parts"):  # another process may have added them since we looked
        connection.execute(SQL["schema_of_parts"])


def _add_journal(connection: apsw.Connection) -> None:
    if not fetch(connection, "has_schema_of_journal"):
        connection.execute(SQL["schema_of_journal"])


def _check_header(connection: apsw.Connection, path: Path) -> None:
    connection.execute("BEGIN")  # all at one instant: another process may be making the schema
    try:
        application_id = connection.pragma("application_id")
        version = connection.pragma("user_version")
        empty = not connection.execute("SELECT COUNT(*) FROM sqlite_schema").get
    finally:
        _undo(connection)
    if application_id != APPLICATION_ID and not (empty and application_id == 0):
        raise StoreUnavailable(f"{path}: an SQLite database of another program, not a tile store; choose another path")
    if version > SCHEMA_VERSION:
        raise StoreUnavailable(
            f"{path}: store schema {version}, this release reads up to {SCHEMA_VERSION}; use the gnd that wrote it"
        )


def _create_schema(connection: apsw.Connection) -> None:
    def create() -> None:
        # Another process may have made it since we looked.
        if connection.pragma("application_id") == 0:
            connection.execute(SQL["schema"])
            connection.pragma("user_version", SCHEMA_VERSION)
            connection.pragma("application_id", APPLICATION_ID)

    _in_one(connection, create)


def _in_one(connection: apsw.Connection, work: Callable[[], object]) -> None:
    """Run `work` in one write transaction."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        work()
        connection.execute("COMMIT")
    except BaseException:
        _undo(connection)
        raise


def _undo(connection: apsw.Connection) -> None:
    if connection.in_transaction:  # after some errors SQLite has ended it itself
        connection.execute("ROLLBACK")


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


def _retry_busy(step: Callable[[], object], timeout_s: float) -> None:
    # Changing the journal mode does not call the busy handler.
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            step()
            return
        except (apsw.BusyError, apsw.LockedError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.005)


class ReaderPool:
    """Read-only connections, one for each thread that reads at the same time."""

    def __init__(self, path: Path, *, busy_timeout_s: float) -> None:
        self._path = path
        self._busy_timeout_s = busy_timeout_s
        self._idle: list[apsw.Connection] = []
        self._lock = threading.Lock()
        self._closed = False

    @contextmanager
    def snapshot(self) -> Iterator[apsw.Connection]:
        """A connection on which everything is read at one instant."""
        with self.connection() as connection:
            connection.execute("BEGIN")
            yield connection
            connection.execute("COMMIT")

    @contextmanager
    def connection(self) -> Iterator[apsw.Connection]:
        """A connection outside any transaction; it is not used again after an error."""
        connection = self._take()
        try:
            yield connection
        except apsw.Error as error:
            connection.close()
            raise as_store_error(error, self._path) from None
        except BaseException:
            connection.close()
            raise
        self._give_back(connection)

    def close(self) -> None:
        """Close the idle connections; those in use close when they come back."""
        with self._lock:
            self._closed = True
            idle, self._idle = self._idle, []
        for connection in idle:
            connection.close()

    def _take(self) -> apsw.Connection:
        with self._lock:
            if self._closed:
                raise StoreClosed(f"{self._path}: the store is closed")
            if self._idle:
                return self._idle.pop()
        try:
            connection = apsw.Connection(str(self._path), flags=apsw.SQLITE_OPEN_READONLY)
        except apsw.Error as error:
            raise as_store_error(error, self._path) from None
        connection.set_busy_handler(_Patience(self._busy_timeout_s))
        return connection

    def _give_back(self, connection: apsw.Connection) -> None:
        with self._lock:
            if not self._closed:
                self._idle.append(connection)
                return
        connection.close()
