"""The process of a shard in which everything is computed, so that no ack waits for the interpreter.

Its standard input is the line to the process that receives: first the configuration, then a byte for each time that
something has come, and its end when that process has ended, however it did.
"""

import contextlib
import logging
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from gnd.cloud_merger.config import ShardConfig

ENDS_IN_S: Final = 5.0
NICER: Final = 5
"""Acks and queries go first where the cores do not suffice for all."""
_RESTART_S: Final = 1.0
Address = tuple[str, int]
"""Host and port."""
_LOG = logging.getLogger(__name__)


class WorkerProcess:
    """The worker of a shard; one that has ended is started again. Use it by `worker_process`."""

    def __init__(self, config: ShardConfig, metrics_at: Address | None = None) -> None:
        self._config = pickle.dumps((config, metrics_at))
        self._started_s = 0.0
        self._process = self._start()

    def _start(self) -> "subprocess.Popen[bytes]":
        self._started_s = time.monotonic()
        command = [sys.executable, "-m", __name__]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, bufsize=0)  # noqa: S603 - nothing in it is given
        if process.stdin is not None:
            process.stdin.write(len(self._config).to_bytes(8, "little") + self._config)
            os.set_blocking(process.stdin.fileno(), False)
        return process

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
def worker_process(config: ShardConfig, metrics_at: Address | None = None) -> Iterator[WorkerProcess]:
    """The worker of a shard, running while the block runs; `metrics_at`: where it shows its metrics."""
    worker = WorkerProcess(config, metrics_at)
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
    from gnd.cloud_merger.merger import run_worker

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    with contextlib.suppress(PermissionError):  # a container or unit may forbid it: the work is done all the same
        os.nice(NICER)
    size = int.from_bytes(_exactly(8), "little")
    config, metrics_at = pickle.loads(_exactly(size))  # noqa: S301 - written by the process that has started this one
    stop, arrived = threading.Event(), threading.Event()
    threading.Thread(target=_listen, args=(stop, arrived), name="line", daemon=True).start()
    run_worker(config, stop, arrived, metrics_at)


def _exactly(count: int) -> bytes:
    data = b""
    while len(data) < count:
        more = os.read(0, count - len(data))
        if not more:
            sys.exit(0)
        data += more
    return data


if __name__ == "__main__":
    main()
