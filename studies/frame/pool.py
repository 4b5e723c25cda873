"""Jobs in worker processes with progress, ended cleanly by Ctrl-C; one job at a time runs in this process."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import wait as wait_for
from typing import Any, Final

from rich.progress import Progress, TaskID

from studies.frame.errors import FolderError, ReproduceError, Stopped

_ONE_THREAD: Final = ("OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS")
_LOOK_S: Final = 0.2

Tick = Callable[[int, int], None]
"""Told (done, in all); may raise `Stopped`."""


@dataclass(frozen=True, slots=True)
class Job:
    """Work for one process.

    Attributes:
        name: what the progress bar says.
        work: a function of a module, called as work(*arguments, tick) where `ticks`, else work(*arguments).
        arguments: what it gets; must be picklable.
        ticks: whether the work tells how far it is.
    """

    name: str
    work: Callable[..., Any]
    arguments: tuple[Any, ...]
    ticks: bool = False


def run_jobs(jobs: Sequence[Job], processes: int, progress: Progress, title: str) -> list[Any]:
    """Do all jobs and return their results in the order of the jobs.

    Raises:
        KeyboardInterrupt: somebody pressed Ctrl-C; the workers have ended.
        GndError: a job failed.
    """
    if not jobs:
        return []
    whole = progress.add_task(title, total=len(jobs))
    if processes <= 1 or len(jobs) == 1:
        return [_here(job, progress, whole) for job in jobs]
    return _Workers(jobs, processes, progress, whole).run()


def _here(job: Job, progress: Progress, whole: TaskID) -> Any:
    bar = progress.add_task(f"  {job.name}", total=None)
    result = _call(job, lambda done, total: progress.update(bar, completed=done, total=total))
    progress.remove_task(bar)
    progress.advance(whole)
    return result


def _call(job: Job, tick: Tick) -> Any:
    try:
        return job.work(*job.arguments, tick) if job.ticks else job.work(*job.arguments)
    except OSError as error:
        raise FolderError(f"{job.name}: {error}") from error


class _Workers:
    """A pool for one list of jobs; workers write how far they are into shared memory."""

    def __init__(self, jobs: Sequence[Job], processes: int, progress: Progress, whole: TaskID) -> None:
        self._jobs, self._processes, self._progress, self._whole = jobs, processes, progress, whole
        context = multiprocessing.get_context("spawn")
        self._context, self._stop = context, context.Event()
        self._ticks = context.Array("q", 2 * len(jobs), lock=False)
        self._bars: dict[int, TaskID] = {}

    def run(self) -> list[Any]:
        for name in _ONE_THREAD:
            os.environ.setdefault(name, "1")
        arguments = (self._ticks, self._stop)
        with ProcessPoolExecutor(
            min(self._processes, len(self._jobs)), self._context, initializer=_enter, initargs=arguments
        ) as pool:
            futures = {pool.submit(_work, index, job): index for index, job in enumerate(self._jobs)}
            try:
                return self._collect(futures)
            except BrokenProcessPool as error:
                raise ReproduceError(
                    "a worker ended without a word, perhaps for want of memory: start again with fewer --jobs, what is "
                    "done is kept"
                ) from error
            except BaseException:
                self._stop.set()
                pool.shutdown(wait=False, cancel_futures=True)
                raise

    def _collect(self, futures: "dict[Future[Any], int]") -> list[Any]:
        results: dict[int, Any] = {}
        waiting = set(futures)
        while waiting:
            done, waiting = wait(waiting, timeout=_LOOK_S, return_when=FIRST_COMPLETED)
            for future in done:
                index = futures[future]
                results[index] = future.result()
                if index in self._bars:
                    self._progress.remove_task(self._bars.pop(index))
                self._progress.advance(self._whole)
            self._show({futures[future] for future in waiting})
        return [results[index] for index in range(len(self._jobs))]

    def _show(self, waiting: set[int]) -> None:
        for index in waiting:
            done, total = self._ticks[2 * index], self._ticks[2 * index + 1]
            if total and index not in self._bars:
                self._bars[index] = self._progress.add_task(f"  {self._jobs[index].name}", total=total)
            if total:
                self._progress.update(self._bars[index], completed=done)


_shared: dict[str, Any] = {}


def _enter(ticks: Any, stop: Any) -> None:
    """A worker begins: Ctrl-C is the parent's business, and without the parent there is nothing to do."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _shared.update(ticks=ticks, stop=stop)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait_for([parent.sentinel])
        os._exit(1)


def _work(index: int, job: Job) -> Any:
    ticks, stop = _shared["ticks"], _shared["stop"]

    def tick(done: int, total: int) -> None:
        ticks[2 * index], ticks[2 * index + 1] = done, total
        if stop.is_set():
            raise Stopped("the run was asked to end")

    return _call(job, tick)
