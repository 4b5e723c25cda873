"""Who holds a process's memory: libraries by name, and what it has allocated."""

import re
from collections import Counter
from pathlib import Path
from typing import Final

_PART = re.compile(r"^[0-9a-f]+-[0-9a-f]+ \S+ \S+ \S+ \d+ *(.*)$")
_LIBRARIES: Final = {"llvmlite": "LLVM", "gtsam": "gtsam", "scipy/": "scipy", "scipy.libs": "scipy", "numpy": "numpy"}
ALLOCATED: Final = "objects, arrays and machine code made here"
REST: Final = "other libraries and files"


def holders_mb(smaps: str) -> dict[str, float]:
    """Resident memory [MB] by holder.

    Args:
        smaps: the content of /proc/PID/smaps.
    """
    found: Counter[str] = Counter()
    holder = REST
    for line in smaps.splitlines():
        part = _PART.match(line)
        if part is not None:
            holder = _holder(part[1])
        elif line.startswith("Rss:"):
            found[holder] += int(line.split()[1]) * 1024
    return {name: held / 1e6 for name, held in found.most_common()}


def holders_now_mb() -> dict[str, float]:
    """Those of this process; empty where there is no /proc."""
    path = Path("/proc/self/smaps")
    return holders_mb(path.read_text(encoding="utf-8", errors="replace")) if path.exists() else {}


def _holder(name: str) -> str:
    if not name.startswith("/"):
        return ALLOCATED
    return next((library for part, library in _LIBRARIES.items() if part in name), REST)
