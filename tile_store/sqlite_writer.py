"""The one write connection of a process to an SQLite file."""

import logging

import apsw

from gnd.tile_store.sqlite_connection import SqliteConnection, as_store_error
from gnd.tile_store.writer import GroupWriter, Outcome, WriteJob

_log = logging.getLogger(__name__)


class SqliteWriter(GroupWriter):
    """Commits groups, each function in its own savepoint. SQLite lets one write at a time: nothing else is to lock."""

    def __init__(self, connection: SqliteConnection, *, group_max: int) -> None:
        super().__init__(connection.filename, group_max=group_max)
        self._connection = connection

    def _free(self) -> None:
        self._connection.close()

    def _outcomes(self, jobs: list[WriteJob]) -> list[Outcome]:
        self._connection.execute("BEGIN IMMEDIATE")
        outcomes = [self._attempt(job) for job in jobs]
        self._connection.execute("COMMIT")
        return outcomes

    def _attempt(self, job: WriteJob) -> Outcome:
        self._connection.execute("SAVEPOINT job")
        try:
            result = job.work(self._connection)
        except Exception as error:
            if not self._connection.in_transaction:
                raise  # SQLite itself has undone everything (disk full, I/O error): the whole group has failed
            self._connection.execute("ROLLBACK TO job; RELEASE job")
            return None, self._as_store_error(error)
        self._connection.execute("RELEASE job")
        return result, None

    def _undo(self) -> None:
        try:
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
        except apsw.Error as error:
            _log.error("rollback failed: %s", error)

    def _as_store_error(self, error: Exception) -> Exception:
        return as_store_error(error, self._connection.filename)
