"""One write connection in one thread: calls that come while it commits share the next commit (group commit)."""

import logging
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import apsw

from gnd.tile_store.errors import StoreClosed, StoreUnavailable
from gnd.tile_store.sqlite_connection import as_store_error

T = TypeVar("T")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Job:
    work: Callable[[apsw.Connection], Any]
    future: "Future[Any]" = field(default_factory=Future)


class NoWriter:
    """Stands where a store is only read: whatever would write is refused."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def run(self, _work: Callable[[apsw.Connection], T]) -> T:
        """Always StoreUnavailable."""
        raise StoreUnavailable(f"{self._path}: opened for reading only")

    def close(self) -> None:
        """Nothing to close."""


class GroupWriter:
    """Runs functions inside write transactions, many in one commit, each in its own savepoint.

    A function that raises is undone alone; the others of its group commit.
    """

    def __init__(self, connection: apsw.Connection, *, group_max: int) -> None:
        self._connection = connection
        self._group_max = group_max
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._closed = False
        self._thread = threading.Thread(target=self._loop, name="store-writer", daemon=True)
        self._thread.start()

    def run(self, work: Callable[[apsw.Connection], T]) -> T:
        """Run `work` in a transaction and return its result once that is durable."""
        job = _Job(work)
        with self._lock:
            if self._closed:
                raise StoreClosed("the store is closed")
            self._jobs.put(job)
        result: T = job.future.result()
        return result

    def close(self) -> None:
        """Commit what is queued, then close the connection."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self._jobs.put(None)
        self._thread.join()

    def _loop(self) -> None:
        closing = False
        while not closing:
            jobs, closing = self._next_group()
            if jobs:
                self._commit(jobs)
        self._connection.close()

    def _next_group(self) -> tuple[list[_Job], bool]:
        job = self._jobs.get()
        jobs: list[_Job] = []
        while job is not None:
            jobs.append(job)
            if len(jobs) == self._group_max:
                return jobs, False
            try:
                job = self._jobs.get_nowait()
            except queue.Empty:
                return jobs, False
        return jobs, True

    def _commit(self, jobs: list[_Job]) -> None:
        try:
            self._connection.execute("BEGIN IMMEDIATE")
            outcomes = [self._attempt(job) for job in jobs]
            self._connection.execute("COMMIT")
        except Exception as error:
            self._undo()
            failure = as_store_error(error, self._connection.filename)
            for job in jobs:
                job.future.set_exception(failure)
            return
        for job, (result, failed) in zip(jobs, outcomes, strict=True):
            if failed is None:
                job.future.set_result(result)
            else:
                job.future.set_exception(failed)

    def _attempt(self, job: _Job) -> tuple[Any, Exception | None]:
        self._connection.execute("SAVEPOINT job")
        try:
            result = job.work(self._connection)
        except Exception as error:
            if not self._connection.in_transaction:
                raise  # SQLite itself has undone everything (disk full, I/O error): the whole group has failed
            self._connection.execute("ROLLBACK TO job; RELEASE job")
            return None, as_store_error(error, self._connection.filename)
        self._connection.execute("RELEASE job")
        return result, None

    def _undo(self) -> None:
        try:
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
        except apsw.Error as error:
            _log.error("rollback failed: %s", error)
