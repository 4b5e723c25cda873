"""The clocks of the cloud: `steady_ns` of the queue (leases, and when a tile is ready to merge), `day_ns` of receipts.

The first never steps, whatever the time of day does. A store lies on one machine, and all processes of a machine see
the same monotonic clock. It begins anew at each boot; so the store remembers in which boot its queue was used: whoever
held a lease in another one is dead. The time of day may step, and a test may have it step.
"""

import mmap
import os
import struct
import time
from functools import cache
from pathlib import Path
from typing import Final

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")

steady_ns = time.monotonic_ns


@cache
def boot_id() -> str:
    """What tells this boot of this machine from any other; where the system does not say so, its name stands for it."""
    try:
        return _BOOT_ID.read_text(encoding="utf-8").strip()
    except OSError:
        return "unknown"


class MachineClock:
    """The clock of the queue of a store that the processes of one machine share."""

    @property
    def name(self) -> str:
        """This boot of this machine."""
        return boot_id()

    def steady_ns(self) -> int:
        """Now, ns; it never steps."""
        return steady_ns()


MACHINE: Final = MachineClock()

OFFSET_FILE: Final = "GND_CLOCK_OFFSET_FILE"
"""Environment: a file of 8 bytes, int64 little-endian ns, by which the time of day is wrong (`gnd chaos` steps it)."""


def day_ns() -> int:
    """The time of day, int ns UTC."""
    return time.time_ns() + _offset_ns()


def _offset_ns() -> int:
    path = os.environ.get(OFFSET_FILE)
    return int(struct.unpack("<q", _offset_file(path)[:8])[0]) if path else 0


@cache
def _offset_file(path: str) -> mmap.mmap:
    with Path(path).open("rb") as file:
        return mmap.mmap(file.fileno(), 8, access=mmap.ACCESS_READ)
