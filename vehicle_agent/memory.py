"""Keeps a vehicle's process small: what is freed goes back to the system.

glibc raises its threshold for separate mappings with every large array that is freed, up to 32 MB, and from then on
keeps map windows and scans in heaps that fragment: 330 MB where 170 MB are in use (measured, 32-layer drive). A fixed
threshold sends windows back at once; arrays of scans are smaller (mapping each of them would cost a third more time),
so the heap is trimmed now and then.

Libraries are read into memory where their code runs, and stay: most of gtsam and all of LLVM run once, when they
register their classes or compile. `give_back_code` lets such pages go; they are as they are in their files.
"""

import ctypes
import gc
import os
import re
import sys
from functools import cache
from pathlib import Path

_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # malloc.h
_MADV_DONTNEED = 4  # mman.h
MMAP_BYTES = 4 * 1024 * 1024
ARENAS = 2
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
TRIM_EVERY = 3  # scans; segmentation leaves 20 MB of free pieces a second behind
CODE_EVERY = 100  # scans; looking for the pages takes some milliseconds
_FIRST_CODE = 10  # scan, by which most has run that runs once
# addresses, then, of a part that is not writable, the library's name
_LIBRARY_PART = re.compile(r"^([0-9a-f]+)-([0-9a-f]+) (?:r-[x-]p [0-9a-f]+ \S+ \d+ +(/\S.*\.so[\d.]*)$)?")


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


def keep_what_is_loaded() -> None:
    """Let the garbage collector no more look at the objects that there are now. Those of the imports stay to the end,
    and a look at all of them takes tens of milliseconds, while a scan waits.
    """
    gc.freeze()


def trim() -> None:
    """Give back to the system what the heap does not use."""
    library = _glibc()
    if library is not None:
        library.malloc_trim(0)


def give_back_code() -> int:
    """Give back to the system the pages of libraries that nobody has written to: what runs again is mapped again from
    the page cache, 16 pages at a time. Bytes whose pages were given back, used or not; 0 where there is no /proc.
    """
    library, done = _glibc(), 0
    if library is None:
        return 0
    for first, end in _unwritten(Path("/proc/self/smaps")):
        if library.madvise(ctypes.c_void_p(first), ctypes.c_size_t(end - first), _MADV_DONTNEED) == 0:
            done += end - first
    return done


def _unwritten(smaps: Path) -> list[tuple[int, int]]:
    """First and end addresses of the libraries' read-only parts without a page of this process's own (relocations make
    such pages, which must stay).
    """
    found, at = [], None
    try:
        lines = smaps.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []
    for line in lines:
        head = _LIBRARY_PART.match(line)
        if head is not None:
            at = (int(head[1], 16), int(head[2], 16)) if head[3] else None
        elif at is not None and line.startswith("Anonymous:"):
            if line.split()[1] == "0":
                found.append(at)
            at = None
    return found


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
        if self._scans in (1, _FIRST_CODE) or self._scans % CODE_EVERY == 0:
            give_back_code()

    def read(self) -> dict[str, float]:
        """Proportional (PSS), resident (RSS) and private (USS) memory of this process now, the highest RSS so far, and
        the PSS then if as much was shared as now; MB.
        """
        import psutil  # once, at the end of a drive: 1.4 MB

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
        import psutil

        return float(psutil.Process(os.getpid()).memory_info().rss) / 1e6
