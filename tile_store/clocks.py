"""The clock of the queue: leases, and when a tile is ready to merge. It never steps, whatever the time of day does.

A store lies on one machine, and all processes of a machine see the same monotonic clock. It begins anew at each boot;
so the store remembers in which boot its queue was used: whoever held a lease in another one is dead.
"""

import time
from functools import cache
from pathlib import Path

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")

steady_ns = time.monotonic_ns


@cache
def boot_id() -> str:
    """What tells this boot of this machine from any other; where the system does not say so, its name stands for it."""
    try:
        return _BOOT_ID.read_text(encoding="utf-8").strip()
    except OSError:
        return "unknown"
