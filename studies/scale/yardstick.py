"""Work without any cloud in as many processes as there are shards, bounded as these: what the machine itself takes more
CPU for when more processes share it.

    python -m studies.scale.yardstick UNITS     prints the CPU of a unit of work, ms
"""

import subprocess
import sys
import time
from statistics import median
from typing import Final

import numpy as np

from studies.scale.room import Room

UNITS: Final = 60
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
    before_s, units = time.process_time(), int(sys.argv[1])
    for _ in range(units):
        _unit(rows)
    print(1e3 * (time.process_time() - before_s) / units)


if __name__ == "__main__":
    main()
