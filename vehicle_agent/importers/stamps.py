"""Stamps of scans: in file names (seconds, milli-, micro- or nanoseconds since 1970), and in order."""

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.importers.trajectories.clocks import ns_of_number

_STAMP: Final = re.compile(r"(\d{9,10}[._]\d{3,9}|\d{13}|\d{16}|\d{18,19})(?=\.|_|$)")


class HasStamp(Protocol):
    """Where a cloud lies, and when it was stamped."""

    @property
    def stamp_ns(self) -> int:
        """UTC."""


At = TypeVar("At", bound=HasStamp)


def in_time_order(clouds: list[At]) -> tuple[list[At], tuple[str, ...]]:
    """Clouds by their stamps, each stamp once; and what had to be done for that."""
    notes, kept = [], sorted(clouds, key=lambda at: at.stamp_ns)
    if (late := sum(a.stamp_ns > b.stamp_ns for a, b in pairwise(clouds))) > 0:
        notes.append(f"{late} clouds were not in the order of their stamps: sorted")
    once = [at for i, at in enumerate(kept) if i == 0 or at.stamp_ns != kept[i - 1].stamp_ns]
    if len(once) < len(kept):
        notes.append(f"{len(kept) - len(once)} clouds have the stamp of another: left out")
    return once, tuple(notes)


def stamps_of_names(files: Sequence[Path]) -> NDArray[np.int64] | None:
    """(N,) times of files in this order; None unless every name ends in one and they increase."""
    found = [_STAMP.findall(path.name.split(".pcd")[0].split(".bin")[0].split(".las")[0]) for path in files]
    if not all(found):
        return None
    t_ns = np.array([ns_of_number(stamps[-1].replace("_", ".")) for stamps in found], np.int64)
    return t_ns if len(t_ns) < 2 or (np.diff(t_ns) > 0).all() else None
