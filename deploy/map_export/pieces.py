"""Cuts clusters of voxels that are too large for one look: along a street neighbouring changes touch."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.grid import VOXEL_M

LONGEST_M: Final = 14.0
"""Centres of voxels of one piece lie at most so far apart: what is as long as a lorry is seen in one picture."""
_WAYS: Final = 16
_ANGLE: Final = np.pi * np.arange(_WAYS) / _WAYS
_AXES: Final = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)])


def pieces(at_m: F64) -> Iterator[I64]:
    """The rows of each piece of a cluster, none longer than `LONGEST_M` in any of sixteen directions.

    What is longer is cut across its longest direction, in its middle half where fewest voxels lie, so that a gap or a
    narrow place parts it rather than a wall's middle. The pieces depend on the set of voxels alone, not on their order.

    Args:
        at_m: (N, 2) centres of voxels, east and north.
    """
    waiting = [np.arange(len(at_m))]
    while waiting:
        rows = waiting.pop()
        along_m = np.round(at_m[rows] @ _AXES, 3)
        long_m = np.ptp(along_m, axis=0)
        way = int(long_m.argmax())
        if long_m[way] <= LONGEST_M:
            yield rows
        else:
            is_left = _is_left(along_m[:, way])
            waiting += [rows[~is_left], rows[is_left]]


def _is_left(along_m: F64) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """(N,) which side of the cut each voxel lies on; neither is empty."""
    step = ((along_m - along_m.min()) / VOXEL_M).astype(np.int64)
    count = np.bincount(step)
    n = len(count)
    inner = np.arange(n // 4 + 1, n - n // 4)
    fewest = inner[count[inner] == count[inner].min()]
    cut = int(fewest[np.abs(fewest - n / 2).argmin()])
    is_left: np.ndarray[tuple[int], np.dtype[np.bool_]] = step < cut
    return is_left
