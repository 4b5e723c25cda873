"""Keeps a vehicle's process small: what is freed goes back to the system.

glibc raises its threshold for separate mappings with every large array that is freed, up to 32 MB, and from then on
keeps map windows and scans in heaps that fragment: 330 MB where 170 MB are in use (measured, 32-layer drive). A fixed
threshold sends windows back at once; arrays of scans are smaller (mapping each of them would cost a third more time),
so the heap is trimmed now and then.
"""

import ctypes
import os
import sys
from functools import cache

import psutil

_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # malloc.h
MMAP_BYTES = 4 * 1024 * 1024
ARENAS = 2
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
TRIM_EVERY = 3  # scans; segmentation leaves 20 MB of free pieces a second behind


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


def trim() -> None:
    """Give back to the system what the heap does not use."""
    library = _glibc()
    if library is not None:
        library.malloc_trim(0)


class MemoryMeter:
    """Trims the heap every few scans, and remembers the most memory that was in use just before."""

    def __init__(self) -> None:
        self.peak_rss_mb = 0.0
        self._scans = 0

    def count_scan(self) -> None:
        """One more scan was worked on."""
        self._scans += 1
        if self._scans % TRIM_EVERY == 0:
            self.peak_rss_mb = max(self.peak_rss_mb, resident_mb())
            trim()

    def read(self) -> dict[str, float]:
        """Proportional (PSS), resident (RSS) and private (USS) memory of this process now, the highest RSS so far, and
        the PSS then if as much was shared as now; MB.
        """
        info = psutil.Process(os.getpid()).memory_full_info()
        now = {name: round(getattr(info, name, 0) / 1e6, 1) for name in ("pss", "rss", "uss")}
        self.peak_rss_mb = max(self.peak_rss_mb, now["rss"])
        peak = self.peak_rss_mb
        return now | {"rss_peak": round(peak, 1), "pss_peak": round(now["pss"] + peak - now["rss"], 1)}


def resident_mb() -> float:
    """Memory of this process that is resident now, MB. By /proc/self/statm where there is one: /proc/self/smaps, which
    also knows what is shared, takes milliseconds.
    """
    try:
        with open("/proc/self/statm", "rb", buffering=0) as statm:  # noqa: PTH123 - a hundredth of the time of a Path
            return int(statm.read().split()[1]) * _PAGE_BYTES / 1e6
    except OSError:
        return float(psutil.Process(os.getpid()).memory_info().rss) / 1e6
