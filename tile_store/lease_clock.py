"""The clock of leases: it never steps, and all processes of one machine read the same.

A lease is a time of this clock together with the boot that it counts from. One of another boot has ended: whoever held
it is gone. Setting the machine's date neither ends a lease nor keeps it.
"""

from typing import Final

from tile_store import clocks

LONGEST_LEASE_NS: Final = 3_600_000_000_000
"""A lease that ends later than this from now was not written by this clock: it counts as ended."""


def boot() -> str:
    """Which run of the machine `now_ns` counts from; the same in all its processes."""
    return clocks.boot_id()


def now_ns() -> int:
    """Time since the machine started, int ns."""
    return clocks.steady_ns()
