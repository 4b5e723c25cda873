"""What the vehicle saw a moment ago as a map: a pose that jumps away from it has jumped, whatever else has changed.

Where nearly all that stands was rebuilt, the base map can be fitted by chance, half a metre off. What was seen half a
second before has not been rebuilt since, so it tells such a chance from a pose that went wrong.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.localise.match_map import MatchMap

_LEAST_POINTS: Final = 6
_MARGIN: Final = 2  # voxels around, so that points beside what was seen are inside the window
_EMPTY: Final = -1


def recent_map(points_map_m: F64, noise_m: float) -> MatchMap:
    """A Gaussian for each 1 m cube of the map frame in which enough points lie; the others are empty.

    Args:
        points_map_m: (N, 3), at least one.
        noise_m: one sigma of a point.
    """
    origin = np.floor(points_map_m.min(axis=0)).astype(np.int64) - _MARGIN
    g = np.floor(points_map_m).astype(np.int64) - origin
    shape = g.max(axis=0) + 1 + _MARGIN
    flat, member, count = np.unique(
        np.ravel_multi_index(tuple(g.T), tuple(shape)), return_inverse=True, return_counts=True
    )
    mean = _sums(points_map_m, member) / count[:, None]
    d = points_map_m - mean[member]
    cov = _sums(d[:, [0, 0, 0, 1, 1, 2]] * d[:, [0, 1, 2, 1, 2, 2]], member) / np.maximum(count - 1, 1)[:, None]
    enough = count >= _LEAST_POINTS
    index = np.full(int(np.prod(shape)), _EMPTY, np.int32)
    index[flat[enough]] = np.arange(int(enough.sum()), dtype=np.int32)
    return MatchMap.of(index.reshape(shape), np.eye(3), -origin.astype(np.float64), mean[enough], cov[enough], noise_m)


def _sums(columns: F64, member: NDArray[np.int64]) -> F64:
    """(M, C) sums of the rows (N, C) by group."""
    return np.stack([np.bincount(member, column) for column in columns.T], axis=1)
