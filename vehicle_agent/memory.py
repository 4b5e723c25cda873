"""Keeps a vehicle's process small: what is freed goes back to the system.

glibc raises its threshold for separate mappings with every large array that is freed, up to 32 MB, and from then on
keeps map windows and scans in heaps that fragment: 330 MB where 170 MB are in use (measured, 32-layer drive). A fixed
threshold sends windows back at once; arrays of scans are smaller (mapping each of them would cost a third more time),
so the heap is trimmed now and then.
"""

import ctypes
import sys
from functools import cache

_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # malloc.h
MMAP_BYTES = 4 * 1024 * 1024
ARENAS = 2
TRIM_EVERY = 20  # scans; two seconds of driving


@cache
def _glibc() -> ctypes.CDLL | None:
    """The C library, where it is glibc."""
    library = ctypes.CDLL(None) if sys.platform.startswith("linux") else None
    return library if library is not None and hasattr(library, "mallopt") else None


def keep_small() -> bool:
    """Fix glibc's settings for this process; False where the C library is another one (nothing changes then)."""
    library = _glibc()
    if library is None:
        return False
    settings = ((_M_MMAP_THRESHOLD, MMAP_BYTES), (_M_ARENA_MAX, ARENAS))
    return all(library.mallopt(name, value) == 1 for name, value in settings)


def trim(scans: int) -> None:
    """Give back what the heap does not use, once in `TRIM_EVERY` scans."""
    library = _glibc()
    if library is not None and scans % TRIM_EVERY == 0:
        library.malloc_trim(0)
