"""One write connection for all threads: calls that come while one commits share the next commit (group commit).

Who finds nobody writing writes for all that wait, in its own thread: no thread is woken for a call that comes alone,
which on a busy machine costs more than the call.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import apsw

from gnd.tile_store.errors import StoreClosed, StoreUnavailable
from gnd.tile_store.sqlite_connection import as_store_error

T = TypeVar("T")
_log = logging.getLogger(__name__)


class _Job:
    """A function to run, and what came of it. `wait` returns once it is done, or has to lead."""

    __slots__ = ("_signal", "failed", "is_done", "result", "work")

    def __init__(self, work: Callable[[apsw.Connection], Any]) -> None:
        self.work = work
        self.result: Any = None
        self.failed: Exception | None = None
        self.is_done = False
        self._signal = threading.Lock()
        self._signal.acquire()

    def wait(self) -> None:
        self._signal.acquire()

    def wake(self) -> None:
        self._signal.release()

    def settle(self, result: Any, failed: Exception | None) -> None:
        self.result, self.failed, self.is_done = result, failed, True
        self.wake()


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

    A function that raises is undone alone; the others of its group commit. At any time one of the calling threads
    leads: it commits what waits, until its own call is done, and then gives the lead to whoever waits longest.
    """

    def __init__(self, connection: apsw.Connection, *, group_max: int) -> None:
        self._connection = connection
        self._group_max = group_max
        self._lock = threading.Lock()
        self._idle = threading.Condition(self._lock)
        self._waiting: deque[_Job] = deque()
        self._is_led = False
        self._closed = False

    def run(self, work: Callable[[apsw.Connection], T]) -> T:
        """Run `work` in a transaction and return its result once that is durable."""
        job = _Job(work)
        with self._lock:
            if self._closed:
                raise StoreClosed("the store is closed")
            self._waiting.append(job)
            leads, self._is_led = not self._is_led, True
        if not leads:
            job.wait()
        if not job.is_done:
            self._lead(job)
        if job.failed is not None:
            raise job.failed
        result: T = job.result
        return result

    def close(self) -> None:
        """Commit what is queued, then close the connection."""
        with self._lock:
            self._closed = True
            self._idle.wait_for(lambda: not self._is_led)
        self._connection.close()

    def _lead(self, own: _Job) -> None:
        jobs: list[_Job] = []
        try:
            while not own.is_done:
                with self._lock:
                    jobs = [self._waiting.popleft() for _ in range(min(len(self._waiting), self._group_max))]
                self._commit(jobs)
        finally:
            for job in jobs:
                if not job.is_done:  # the leader was interrupted
                    job.settle(None, StoreUnavailable(f"{self._connection.filename}: interrupted while it was written"))
            with self._lock:
                if self._waiting:
                    self._waiting[0].wake()
                else:
                    self._is_led = False
                    self._idle.notify_all()

    def _commit(self, jobs: list[_Job]) -> None:
        try:
            self._connection.execute("BEGIN IMMEDIATE")
            outcomes = [self._attempt(job) for job in jobs]
            self._connection.execute("COMMIT")
        except Exception as error:
            self._undo()
            failure = as_store_error(error, self._connection.filename)
            for job in jobs:
                job.settle(None, failure)
            return
        except BaseException:
            self._undo()
            raise
        for job, (result, failed) in zip(jobs, outcomes, strict=True):
            job.settle(result, failed)

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
