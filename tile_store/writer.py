"""One write connection for all threads: calls that come while one commits share the next commit (group commit).

Who finds nobody writing writes for all that wait, in its own thread: no thread is woken for a call that comes alone,
which on a busy machine costs more than the call.
"""

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

from gnd.tile_store.connection import Bindings, Lock, SqlConnection
from gnd.tile_store.errors import StoreClosed, StoreUnavailable

T = TypeVar("T")
Outcome = tuple[Any, Exception | None]
"""What a function has returned, or why it was undone."""


class WriteJob:
    """A function to run, and what came of it. `wait` returns once it is done, or has to lead; False: not in time."""

    __slots__ = ("_signal", "about", "failed", "is_done", "result", "statement", "work")

    def __init__(
        self,
        work: Callable[[SqlConnection], Any],
        about: tuple[Lock, ...] | None,
        statement: tuple[str, Bindings] | None = None,
    ) -> None:
        self.work, self.about, self.statement = work, about, statement
        self.result: Any = None
        self.failed: Exception | None = None
        self.is_done = False
        self._signal = threading.Lock()
        self._signal.acquire()

    def wait(self, at_most_s: float = -1.0) -> bool:
        """Return once it is done, or has to lead; False: neither within so many seconds."""
        return self._signal.acquire(timeout=at_most_s)

    def wake(self) -> None:
        """Let it go on."""
        self._signal.release()

    def settle(self, result: Any, failed: Exception | None) -> None:
        """It is done."""
        self.result, self.failed, self.is_done = result, failed, True
        self.wake()


class NoWriter:
    """Stands where a store is only read: whatever would write is refused."""

    def __init__(self, path: Path | str) -> None:
        self._path = path

    def run(
        self,
        work: Callable[[SqlConnection], T],  # noqa: ARG002
        about: Iterable[Lock] | None = None,  # noqa: ARG002
        patient_s: float = 0.0,  # noqa: ARG002
    ) -> T:
        """Always StoreUnavailable."""
        raise StoreUnavailable(f"{self._path}: opened for reading only")

    def change(self, statement: str, bindings: Bindings, about: Iterable[Lock], patient_s: float = 0.0) -> int:
        """The same."""
        return self.run(lambda c: c.change(statement, bindings), about, patient_s)

    def close(self) -> None:
        """Nothing to close."""


class GroupWriter(ABC):
    """Runs functions inside write transactions, many in one commit.

    A function that raises is undone alone; the others of its group commit. At any time one of the calling threads
    leads: it commits what waits, until its own call is done, and then gives the lead to whoever waits longest. A call
    that is patient leads nobody for a while: the next commit of another takes it along, so that however many are
    patient, they cause few commits of their own.
    """

    def __init__(self, location: str, *, group_max: int) -> None:
        self.location = location
        self._group_max = group_max
        self._lock = threading.Lock()
        self._idle = threading.Condition(self._lock)
        self._waiting: deque[WriteJob] = deque()
        self._patient: deque[WriteJob] = deque()
        self._is_led = False
        self._closed = False

    def run(self, work: Callable[[SqlConnection], T], about: Iterable[Lock] | None = None, patient_s: float = 0.0) -> T:
        """Run `work` in a transaction and return its result once that is durable.

        Args:
            work: what is to be done.
            about: what it changes; None: nobody else writes meanwhile.
            patient_s: for so long it waits for a commit of others, s.
        """
        result: T = self._done(WriteJob(work, None if about is None else tuple(about)), patient_s)
        return result

    def change(self, statement: str, bindings: Bindings, about: Iterable[Lock], patient_s: float = 0.0) -> int:
        """Run one named statement; the number of rows that it changed, once that is durable."""
        job = WriteJob(lambda c: c.change(statement, bindings), tuple(about), (statement, bindings))
        return int(self._done(job, patient_s))

    def _done(self, job: WriteJob, patient_s: float) -> Any:
        leads = False
        with self._lock:
            if self._closed:
                raise StoreClosed("the store is closed")
            if patient_s > 0:
                self._patient.append(job)
            else:
                leads = self._joins(job)
        if patient_s > 0 and not job.wait(patient_s):
            leads = self._insists(job)
        if not (job.is_done or leads):
            job.wait()
        if not job.is_done:
            self._lead(job)
        if job.failed is not None:
            raise job.failed
        return job.result

    def _joins(self, job: WriteJob) -> bool:
        """Wait for the next commit, with the lock held; whether the caller has to lead."""
        self._waiting.append(job)
        leads, self._is_led = not self._is_led, True
        return leads

    def _insists(self, job: WriteJob) -> bool:
        """Be patient no longer, unless a commit has the job in hand; whether the caller has to lead."""
        with self._lock:
            if job not in self._patient:
                return False
            self._patient.remove(job)
            return self._joins(job)

    def close(self) -> None:
        """Commit what is queued, then close the connection."""
        with self._lock:
            self._closed = True
            self._idle.wait_for(lambda: not (self._is_led or self._patient))
        self._free()

    def commit(self, jobs: list[WriteJob]) -> None:
        """Run the jobs in one transaction and settle each."""
        try:
            outcomes = self._outcomes(jobs)
        except Exception as error:
            self._undo()
            failure = self._as_store_error(error)
            for job in jobs:
                job.settle(None, failure)
            return
        except BaseException:
            self._undo()
            raise
        for job, (result, failed) in zip(jobs, outcomes, strict=True):
            job.settle(result, failed)

    @abstractmethod
    def _outcomes(self, jobs: list[WriteJob]) -> list[Outcome]:
        """Run the jobs in one transaction; what came of each, once that is durable. It raises when the group failed."""

    @abstractmethod
    def _undo(self) -> None:
        """Undo what a group has left, if anything; raises nothing."""

    @abstractmethod
    def _as_store_error(self, error: Exception) -> Exception:
        """An error of the database as one of the store's."""

    @abstractmethod
    def _free(self) -> None:
        """Close the connection."""

    def _lead(self, own: WriteJob) -> None:
        jobs: list[WriteJob] = []
        try:
            while not own.is_done:
                with self._lock:
                    jobs = [self._waiting.popleft() for _ in range(min(len(self._waiting), self._group_max))]
                    while self._patient and len(jobs) < self._group_max:
                        jobs.append(self._patient.popleft())
                self.commit(jobs)
        finally:
            for job in jobs:
                if not job.is_done:  # the leader was interrupted
                    job.settle(None, StoreUnavailable(f"{self.location}: interrupted while it was written"))
            with self._lock:
                if self._waiting:
                    self._waiting[0].wake()
                else:
                    self._is_led = False
                    self._idle.notify_all()
