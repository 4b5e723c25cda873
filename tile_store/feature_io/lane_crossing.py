"""Whether two lines of a lane cross: borders of a lane never do."""

import numpy as np

from gnd.gnd_map.arrays import F64

_INSIDE = 1e-9
"""Lines that only share an end do not cross: lanes begin and end in a point."""

_BLOCK = 256
"""Segments of one line that are held against those of the other around them at once."""


def crossing_of(a: F64, b: F64) -> tuple[int, int] | None:
    """The numbers of the first two segments of lines (N, 2) and (M, 2) that cross in their insides, or None."""
    low, high = np.minimum(b[:-1], b[1:]), np.maximum(b[:-1], b[1:])
    for first in range(0, len(a) - 1, _BLOCK):
        block = a[first : first + _BLOCK + 1]
        near = np.flatnonzero(((low <= block.max(axis=0)) & (high >= block.min(axis=0))).all(axis=1))
        met = _crossing_in_block(block, b[near], b[near + 1])
        if met is not None:
            return first + met[0], int(near[met[1]])
    return None


def _crossing_in_block(a: F64, start: F64, end: F64) -> tuple[int, int] | None:
    p, r = a[:-1, None], np.diff(a, axis=0)[:, None]
    q, s = start[None], (end - start)[None]
    across = _cross(r, s)
    with np.errstate(divide="ignore", invalid="ignore"):
        t, u = _cross(q - p, s) / across, _cross(q - p, r) / across
        inside = (t > _INSIDE) & (t < 1 - _INSIDE) & (u > _INSIDE) & (u < 1 - _INSIDE)
    if not inside.any():
        return None
    i, j = np.argwhere(inside)[0]
    return int(i), int(j)


def _cross(a: F64, b: F64) -> F64:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
