"""The process of a shard in which everything is computed, so that no ack waits for the interpreter.

Its standard input is the line to the process that receives: first the configuration, then a byte for each time that
something has come, and its end when that process has ended, however it did. Its standard output is the line back: whom
to tell how far his report has come. The process that receives tells it, for it has agreed on keys with the vehicles.
"""

from gnd.ending import ctrl_c_withheld, run_program  # isort: skip  # registers its end before others do

import contextlib
import io
import logging
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from gnd.importing import without_garbage

with without_garbage():
    from gnd.cloud_merger.config import ShardConfig
    from gnd.schemas.report_states import ReportState

ENDS_IN_S: Final = 5.0
NICER: Final = 5
"""Acks and queries go first where the cores do not suffice for all."""
_RESTART_S: Final = 1.0
Address = tuple[str, int]
"""Host and port."""
Tell = Callable[[str, ReportState], None]
"""Called with a vehicle and how far its report has come."""
_LOG = logging.getLogger(__name__)


class WorkerProcess:
    """The worker of a shard; one that has ended is started again. Use it by `worker_process`."""

    def __init__(self, config: ShardConfig, tell: Tell, metrics_at: Address | None = None) -> None:
        self._config, self._tell = pickle.dumps((config, metrics_at)), tell
        self._started_s = 0.0
        self._process = self._start()

    def _start(self) -> "subprocess.Popen[bytes]":
        self._started_s = time.monotonic()
        command = [sys.executable, "-m", __name__]
        with ctrl_c_withheld():  # the line to it is its end
            process = subprocess.Popen(  # noqa: S603 - nothing in it is given
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
            )
        threading.Thread(target=self._hear, args=(process,), name="line back", daemon=True).start()
        if process.stdin is not None:
            process.stdin.write(len(self._config).to_bytes(8, "little") + self._config)
            os.set_blocking(process.stdin.fileno(), False)
        return process

    def _hear(self, process: "subprocess.Popen[bytes]") -> None:
        """Tell what the worker says, until it ends."""
        assert isinstance(process.stdout, io.RawIOBase)
        with io.BufferedReader(process.stdout) as line:
            while True:
                try:
                    vehicle, state = pickle.load(line)  # noqa: S301 - written by the process that was started here
                except (EOFError, OSError, pickle.UnpicklingError):
                    return
                try:
                    self._tell(vehicle, state)
                except Exception:  # who is not told asks
                    _LOG.exception("%s is not told how far its report is", vehicle)

    def wake(self) -> None:
        """Something has come. Never blocks: a worker that has not read its line yet is awake already."""
        with contextlib.suppress(OSError, ValueError):
            if self._process.stdin is not None:
                self._process.stdin.write(b"\n")

    def has_ended(self) -> bool:
        """Whether it is to be started again: it has ended, and was not started just now."""
        return self._process.poll() is not None and time.monotonic() - self._started_s > _RESTART_S

    def restart(self) -> None:
        """Start a worker in place of one that has ended."""
        _LOG.error("the worker has ended with status %s; it is started again", self._process.returncode)
        self._process = self._start()

    def give_up(self) -> None:
        """End the worker at once: its store refuses all that it could still write."""
        self._process.kill()

    def close(self) -> None:
        """End the worker: in order, or by force where that takes too long."""
        with contextlib.suppress(OSError):
            if self._process.stdin is not None:
                self._process.stdin.close()
        try:
            self._process.wait(ENDS_IN_S + 1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@contextmanager
def worker_process(config: ShardConfig, tell: Tell, metrics_at: Address | None = None) -> Iterator[WorkerProcess]:
    """The worker of a shard, running while the block runs.

    Args:
        config: of the shard.
        tell: called in a thread with a vehicle and how far its report has come.
        metrics_at: where it shows its metrics; None: nowhere.
    """
    worker = WorkerProcess(config, tell, metrics_at)
    try:
        yield worker
    finally:
        worker.close()


def _listen(stop: threading.Event, arrived: threading.Event) -> None:
    while os.read(0, 65536):
        arrived.set()
    stop.set()
    arrived.set()
    time.sleep(ENDS_IN_S)
    os._exit(1)  # whatever still computes has no shard any more; what it has claimed is fenced


def main() -> None:
    """Read the configuration, then work until the line ends."""
    with without_garbage():
        from gnd.cloud_merger.merger import run_worker

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    with contextlib.suppress(PermissionError):  # a container or unit may forbid it: the work is done all the same
        os.nice(NICER)
    size = int.from_bytes(_exactly(8), "little")
    config, metrics_at = pickle.loads(_exactly(size))  # noqa: S301 - written by the process that has started this one
    stop, arrived = threading.Event(), threading.Event()
    threading.Thread(target=_listen, args=(stop, arrived), name="line", daemon=True).start()
    run_worker(config, stop, arrived, _LineBack().tell, metrics_at)


class _LineBack:
    """The standard output, kept for what vehicles are to be told: whatever else is printed goes to the log."""

    def __init__(self) -> None:
        self._lock, self._descriptor = threading.Lock(), os.dup(1)
        os.dup2(2, 1)

    def tell(self, vehicle: str, state: ReportState) -> None:
        """Pass on how far a report has come; a word that is lost is asked for."""
        data = pickle.dumps((vehicle, state))
        with self._lock, contextlib.suppress(OSError):
            while data:
                data = data[os.write(self._descriptor, data) :]


def _exactly(count: int) -> bytes:
    data = b""
    while len(data) < count:
        more = os.read(0, count - len(data))
        if not more:
            sys.exit(0)
        data += more
    return data


if __name__ == "__main__":
    run_program(main)
