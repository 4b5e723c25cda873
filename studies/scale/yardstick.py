"""Work without any cloud: what the machine itself takes more CPU for when more processes share it.

python -m studies.scale.yardstick UNITS     prints the CPU of a unit of work, ms
python -m studies.scale.yardstick beside    does a unit now and then until its input ends, and prints what each took
"""

import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from statistics import mean, median
from typing import Final

import numpy as np

from studies.frame.errors import OptionError
from studies.scale.room import Room

UNITS: Final = 60
PAUSE_S: Final = 0.5
_ROWS: Final = 40_000
"""Of some 50 B each: about what a worker touches for a report."""
_CALLS: Final = 20_000


def unit_ms(count: int, share: float, made: Room) -> float:
    """CPU of a unit of work, ms: the median of `count` processes side by side, each with its share of a core."""
    command = [sys.executable, "-m", __spec__.name, str(UNITS)]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(count)]  # noqa: S603
    for number, process in enumerate(running):
        made.bound(f"yardstick-{number}", share, process.pid)
    found = [float(process.communicate()[0]) for process in running]
    made.unbound()
    return median(found)


class UnitsBeside:
    """Units of work that are done beside something, on the same core, with their times."""

    def __init__(self) -> None:
        self._done: list[tuple[float, float]] = []

    def note(self, line: str) -> None:
        """A line that the process beside has printed: when (`time.monotonic`), and the CPU, ms."""
        at_s, took_ms = map(float, line.split())
        self._done.append((at_s, took_ms))

    def read(self, lines: Iterable[str]) -> None:
        """All that it prints."""
        for line in lines:
            self.note(line)

    def mean_ms(self, begin_s: float = 0.0, end_s: float = float("inf")) -> float:
        """CPU of a unit while that went on, the mean, ms.

        Raises:
            OptionError: none was done in that time.
        """
        found = [took_ms for at_s, took_ms in self._done if begin_s <= at_s <= end_s]
        if not found:
            raise OptionError(f"no unit of work was done beside it in {end_s - begin_s:.1f} s")
        return mean(found)


@contextmanager
def units_beside(made: Room) -> Iterator[UnitsBeside]:
    """Do a unit of work every `PAUSE_S` in the room while the block runs: what its core is worth in that time."""
    units, command = UnitsBeside(), [sys.executable, "-m", __spec__.name, "beside"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603
        made.enter(process.pid)
        assert process.stdin is not None
        assert process.stdout is not None
        units.note(process.stdout.readline())  # it has begun
        reader = threading.Thread(target=units.read, args=(process.stdout,))
        reader.start()
        try:
            yield units
        finally:
            process.stdin.close()
            reader.join()


def _unit(rows: np.ndarray) -> int:
    """Sort, sum and look up: half numpy over some MB, half Python."""
    order = np.argsort(rows["key"], kind="stable")
    sums = np.add.reduceat(rows["value"][order], np.arange(0, len(rows), 8), axis=0)
    known = {number: number for number in range(_CALLS)}
    return int(sums.sum()) + sum(known[number] for number in range(0, _CALLS, 2))


def main() -> None:
    """Do the work, and print what a unit of it has cost."""
    rng = np.random.default_rng(1)
    rows = np.zeros(_ROWS, [("key", np.int64), ("value", np.float64, 5)])
    rows["key"], rows["value"] = rng.integers(0, 1 << 40, _ROWS), rng.random((_ROWS, 5))
    _unit(rows)
    if sys.argv[1] == "beside":
        _beside(rows)
        return
    before_s, units = time.process_time(), int(sys.argv[1])
    for _ in range(units):
        _unit(rows)
    print(1e3 * (time.process_time() - before_s) / units)


def _beside(rows: np.ndarray) -> None:
    ended = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait, daemon=True).start()
    while True:
        before_s = time.thread_time()
        _unit(rows)
        print(time.monotonic(), 1e3 * (time.thread_time() - before_s), flush=True)
        if ended.wait(PAUSE_S):
            return


if __name__ == "__main__":
    main()
