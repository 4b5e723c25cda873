"""Which scans of a recording go into a drive: one half builds the map, the other half drives on it."""

import re

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.errors import ImportDriveError

CHOICES = "all, even, odd, first-half, second-half or A:B"


def chosen_scans(rule: str, n: int) -> NDArray[np.int64]:
    """Numbers of the scans that `rule` names among n: all, even, odd, first-half, second-half, or A:B (B not included).

    Raises:
        ImportDriveError: an unknown rule, or one that leaves fewer than two scans.
    """
    numbers = np.arange(n, dtype=np.int64)[_slice(rule, n)]
    if len(numbers) < 2:
        raise ImportDriveError(f"--scans {rule} leaves {len(numbers)} of {n} scans; at least 2 are needed")
    return numbers


def _slice(rule: str, n: int) -> slice:
    named = {
        "all": slice(None),
        "even": slice(0, None, 2),
        "odd": slice(1, None, 2),
        "first-half": slice(0, n // 2),
        "second-half": slice(n // 2, None),
    }
    if rule in named:
        return named[rule]
    span = re.fullmatch(r"(\d*):(\d*)", rule)
    if not span:
        raise ImportDriveError(f"--scans {rule!r}: expected {CHOICES}")
    first, last = (int(part) if part else None for part in span.groups())
    return slice(first, last)
