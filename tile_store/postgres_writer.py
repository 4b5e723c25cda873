"""Writing to PostgreSQL: groups of calls in one commit, beside those of other processes.

Where SQLite has one writer at a time, here a group locks what its calls are about (`store_lock`), before anything else
and always in one order, so that groups cannot wait for each other in a circle: a share of the store and those parts of
it that its tiles and reports fall into, or the whole store where a call does not say what it is about.
"""

import logging
from collections.abc import Callable, Iterable, Sequence
from typing import Final
from zlib import crc32

import psycopg
from psycopg import errors as pg

from gnd.tile_store.connection import Bindings, Lock
from gnd.tile_store.errors import StoreClosed, StoreUnavailable
from gnd.tile_store.postgres_connection import PostgresConnection, as_store_error, is_loss, patiently
from gnd.tile_store.postgres_wire import IntegerArray
from gnd.tile_store.writer import GroupWriter, Outcome, WriteJob

LOCKS: Final = 0x474E4453
"""ASCII "GNDS": tells our advisory locks from those of other programs in the same database."""
PARTS: Final = 256
"""Tiles and reports share so many locks: a server has room for some thousand in all."""
RETRIES: Final = 5
_log = logging.getLogger(__name__)


def parts_of(locks: Iterable[Lock]) -> list[int]:
    """The numbers of the parts of the store that locks fall into, sorted, from 1."""
    return sorted({1 + crc32(repr(lock).encode()) % PARTS for lock in locks})


class PostgresWriter(GroupWriter):
    """Commits groups over one connection, which is opened anew when the server has gone.

    A group that fails is run again with each function in its own savepoint, so that the one to blame is undone alone;
    one that the server gives up (deadlock, loss of the connection before the commit) is run again as it was.
    """

    def __init__(self, location: str, open_one: Callable[[], PostgresConnection], *, group_max: int) -> None:
        super().__init__(location, group_max=group_max)
        self._open = open_one
        self._connection: PostgresConnection | None = open_one()
        self._is_freed = False

    def _free(self) -> None:
        self._is_freed = True
        if self._connection is not None:
            self._connection.close()

    def _outcomes(self, jobs: list[WriteJob]) -> list[Outcome]:
        apart = False
        for attempt in range(RETRIES + 1):
            try:
                return self._attempt(jobs, apart=apart)
            except _CommitUnknownError as unknown:
                self._undo()
                raise StoreUnavailable(
                    f"{self.location}: the server went while it committed: what was written may be there or not"
                ) from unknown.__cause__
            except Exception as error:
                self._undo()
                is_again = isinstance(error, (pg.DeadlockDetected, pg.SerializationFailure)) or is_loss(error)
                if attempt == RETRIES or (apart and not is_again):
                    raise
                if is_again:
                    _log.warning("%s: written again: %s", self.location, " ".join(str(error).split()))
                apart = apart or not is_again
        raise AssertionError("the last attempt has raised")

    def _attempt(self, jobs: list[WriteJob], *, apart: bool) -> list[Outcome]:
        connection = self._ready()
        connection.post_command("BEGIN")
        self._lock_parts(connection, jobs)
        single = [job.statement for job in jobs if job.statement is not None]
        if not apart and len(single) == len(jobs):
            return self._single(connection, single)
        outcomes = [self._saved(connection, job) if apart else (job.work(connection), None) for job in jobs]
        try:
            connection.run("COMMIT")
        except psycopg.Error as error:
            if is_loss(error):
                raise _CommitUnknownError from error
            raise
        return outcomes

    def _single(self, connection: PostgresConnection, single: Sequence[tuple[str, Bindings]]) -> list[Outcome]:
        """A group of single statements goes to the server with its commit."""
        try:
            if {statement for statement, _ in single} == {"insert_upload"}:
                return [(n, None) for n in connection.insert_all("insert_uploads", "sha", [b for _, b in single])]
            return [(n, None) for n in connection.changes(single, "COMMIT")]
        except psycopg.Error as error:
            if is_loss(error):
                raise _CommitUnknownError from error
            raise

    def _ready(self) -> PostgresConnection:
        connection = self._connection
        if connection is None or connection.is_lost:
            if self._is_freed:
                raise StoreClosed(f"{self.location}: the store is closed")
            if connection is not None:
                connection.close()
            connection = self._connection = patiently(self._open)
        connection.clock.read_with(connection.raw)
        return connection

    def _lock_parts(self, connection: PostgresConnection, jobs: list[WriteJob]) -> None:
        abouts = [job.about for job in jobs]
        known = [about for about in abouts if about is not None]
        alone = len(known) < len(abouts)
        parts = [] if alone else parts_of(lock for about in known for lock in about)
        connection.post("store_lock", {"store": LOCKS, "alone": alone, "parts": IntegerArray(parts)})

    def _saved(self, connection: PostgresConnection, job: WriteJob) -> Outcome:
        connection.run("SAVEPOINT job")
        try:
            result = job.work(connection)
            connection.run("RELEASE SAVEPOINT job")
        except Exception as error:
            if is_loss(error) or isinstance(error, (pg.DeadlockDetected, pg.SerializationFailure)):
                raise
            connection.forget_posted()
            connection.run("ROLLBACK TO SAVEPOINT job")
            return None, self._as_store_error(error)
        return result, None

    def _as_store_error(self, error: Exception) -> Exception:
        return as_store_error(error, self.location)

    def _undo(self) -> None:
        connection = self._connection
        if connection is None:
            return
        try:
            if not connection.is_lost:
                connection.forget_posted()
                connection.run("ROLLBACK")
                return
        except psycopg.Error as error:
            _log.warning("%s: rollback failed: %s", self.location, " ".join(str(error).split()))
        connection.close()
        self._connection = None


class _CommitUnknownError(Exception):
    """The connection went after COMMIT was sent and before its answer came."""
