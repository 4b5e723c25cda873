"""File names that are stamps: seconds, milli-, micro- or nanoseconds since 1970."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.importers.trajectories.clocks import ns_of_number

_STAMP: Final = re.compile(r"(\d{9,10}[._]\d{3,9}|\d{13}|\d{16}|\d{18,19})(?=\.|_|$)")


def stamps_of_names(files: Sequence[Path]) -> NDArray[np.int64] | None:
    """(N,) times of files in this order; None unless every name ends in one and they increase."""
    found = [_STAMP.findall(path.name.split(".pcd")[0].split(".bin")[0].split(".las")[0]) for path in files]
    if not all(found):
        return None
    t_ns = np.array([ns_of_number(stamps[-1].replace("_", ".")) for stamps in found], np.int64)
    return t_ns if len(t_ns) < 2 or (np.diff(t_ns) > 0).all() else None
