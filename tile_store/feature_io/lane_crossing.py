"""Whether two lines of a lane cross: borders of a lane never do."""

import numpy as np

from gnd_map.arrays import F64

_INSIDE = 1e-9
"""Lines that only share an end do not cross: lanes begin and end in a point."""


_BLOCK = 2048
"""Segments of one line that are held against all of the other at once."""


def crossing_of(a: F64, b: F64) -> tuple[int, int] | None:
    """The numbers of the first two segments of lines (N, 2) and (M, 2) that cross in their insides, or None."""
    for first in range(0, len(a) - 1, _BLOCK):
        met = _crossing_in_block(a[first : first + _BLOCK + 1], b)
        if met is not None:
            return first + met[0], met[1]
    return None


def _crossing_in_block(a: F64, b: F64) -> tuple[int, int] | None:
    p, r = a[:-1, None], np.diff(a, axis=0)[:, None]
    q, s = b[None, :-1], np.diff(b, axis=0)[None]
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
