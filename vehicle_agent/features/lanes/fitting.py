"""Lines of paint beside a stretch of the way: found together, since markings run parallel, then fitted one by one.

A window is a stretch of 16 m in a straight frame (s ahead, d to the left). Its lines share a direction and a curvature:
those under which the points pile up highest across the way (a Hough transform of two parameters). About each pile a
line is fitted by iterated least squares with a gate. Its variance is that of the means of scans: points of one scan err
together.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64

HALF_WINDOW_M: Final = 8.0
_BIN_M: Final = 0.05
_BESIDE_M: Final = 12.0
_SLOPES: Final = np.linspace(-0.08, 0.08, 17)
_BENDS: Final = np.linspace(-0.006, 0.006, 7)
_APART_M: Final = 0.25
"""Two lines are no nearer; a double line is one of twice the width."""
_GATES_M: Final = (0.18, 0.12, 0.10)
_FLANKS_M: Final = np.array([0.2, 0.3, 0.4, 0.5, 0.6])
_LEAST_CONTRAST: Final = 3.0
_SIGMA_POINT_M: Final = 0.03
_SIGMA_SLOPE: Final = 0.01
"""A line's direction may differ from that of the others by this."""
_LEAST_SIGMA_M: Final = 0.01
LEAST_POINTS: Final = 10
LEAST_LOOKS: Final = 4
BIN_ALONG_M: Final = 0.5
LEAST_PAINTED: Final = 4
"""Half metres: less paint than two metres is no line."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedLine:
    """A line d = a + b s + c s² in the frame of its window.

    Attributes:
        a_m, b, c_per_m: of it.
        variance_m2: of a, of what was measured alone: neither the pose's nor the mount's.
        points: rows of the points that it rests on.
        looks: how many scans (looks) saw it.
        painted: (B,) half metres of the window, from -8 m on, with paint.
    """

    a_m: float
    b: float
    c_per_m: float
    variance_m2: float
    points: I64
    looks: int
    painted: NDArray[np.bool_]

    def away(self, a_m: float) -> float:
        """How far from another place beside the window's middle."""
        return abs(a_m - self.a_m)

    def d_m(self, s_m: F64) -> F64:
        """(N,) how far left the line is at places along the window."""
        return np.asarray(self.a_m + s_m * (self.b + self.c_per_m * s_m))


def fitted_lines(s_m: F64, d_m: F64, look: I64) -> list[FittedLine]:
    """The lines of a window, from right to left.

    Args:
        s_m: (N,) along the window, -8 … 8 m.
        d_m: (N,) to the left.
        look: (N,) number of the scan or look that each point is from.
    """
    if len(s_m) < LEAST_POINTS:
        return []
    slope, bend = _direction(s_m, d_m)
    beside = d_m - s_m * (slope + bend * s_m)
    found = (_fitted(s_m, d_m, look, place, slope, bend) for place in _piles(beside))
    lines = sorted((line for line in found if line is not None), key=lambda line: line.a_m)
    return _apart(lines)


def _direction(s_m: F64, d_m: F64) -> tuple[float, float]:
    """Slope and bend under which the points pile up highest."""
    best, chosen = -1.0, (0.0, 0.0)
    for bend in _BENDS:
        for slope in _SLOPES:
            number = _numbers(d_m - s_m * (slope + bend * s_m))
            height = np.bincount(number, minlength=_bins()).astype(np.float64)
            score = float((np.convolve(height, (0.5, 1.0, 0.5), "same") ** 2).sum())
            if score > best:
                best, chosen = score, (float(slope), float(bend))
    return chosen


def _bins() -> int:
    return int(2 * _BESIDE_M / _BIN_M)


def _numbers(beside_m: F64) -> I64:
    return np.clip((beside_m + _BESIDE_M) / _BIN_M, 0, _bins() - 1).astype(np.int64)


def _piles(beside_m: F64) -> list[float]:
    """Where points pile up across the way, the highest first; the outermost bins hold what lies beyond."""
    height = np.bincount(_numbers(beside_m), minlength=_bins()).astype(np.float64)
    height[[0, -1]] = 0.0
    height = np.convolve(height, (0.5, 1.0, 1.0, 1.0, 0.5), "same")
    reach = round(_APART_M / _BIN_M)
    found = []
    while height.max() >= LEAST_POINTS / 2:
        top = int(height.argmax())
        found.append((top + 0.5) * _BIN_M - _BESIDE_M)
        height[max(top - reach, 0) : top + reach + 1] = 0.0
    return found


def _fitted(s_m: F64, d_m: F64, look: I64, place: float, slope: float, bend: float) -> FittedLine | None:
    """The line about a pile; None where too little speaks for it."""
    state = np.array([place, slope])
    for gate in _GATES_M:
        rows = np.flatnonzero(np.abs(d_m - bend * s_m**2 - state[0] - state[1] * s_m) < gate)
        if len(rows) < LEAST_POINTS:
            return None
        A = np.column_stack([np.ones(len(rows)), s_m[rows]])
        information = A.T @ A / _SIGMA_POINT_M**2 + np.diag([0.0, _SIGMA_SLOPE**-2])
        right = A.T @ (d_m[rows] - bend * s_m[rows] ** 2) / _SIGMA_POINT_M**2 + [0.0, slope / _SIGMA_SLOPE**2]
        state = np.linalg.solve(information, right)
    off = d_m[rows] - bend * s_m[rows] ** 2 - state[0] - state[1] * s_m[rows]
    if not _stands_alone(d_m - bend * s_m**2 - state[0] - state[1] * s_m):
        return None
    looks = np.unique(look[rows])
    painted = np.zeros(round(2 * HALF_WINDOW_M / BIN_ALONG_M), np.bool_)
    painted[np.clip((s_m[rows] + HALF_WINDOW_M) / BIN_ALONG_M, 0, len(painted) - 1).astype(np.int64)] = True
    if len(looks) < LEAST_LOOKS or painted.sum() < LEAST_PAINTED:
        return None
    variance = (
        _variance_of_mean(off, look[rows]) * float(np.linalg.inv(information)[0, 0] * len(rows)) / _SIGMA_POINT_M**2
    )
    return FittedLine(
        float(state[0]), float(state[1]), bend, max(variance, _LEAST_SIGMA_M**2), rows, len(looks), painted
    )


def _stands_alone(off_m: F64) -> bool:
    """Whether points lie on a line rather than on a bright or rough surface: the strips beside it are dark.

    Of the eight strips the third brightest is taken, for another line may lie there.
    """
    edges = np.concatenate([-_FLANKS_M[::-1], _FLANKS_M])
    strips = np.delete(np.histogram(off_m, edges)[0], len(_FLANKS_M) - 1)
    inside = float((np.abs(off_m) < _GATES_M[-1]).sum())
    usual = float(np.sort(strips)[-3]) * 2.0 * _GATES_M[-1] / float(_FLANKS_M[1] - _FLANKS_M[0])
    return inside >= _LEAST_CONTRAST * usual


def _variance_of_mean(off_m: F64, look: I64) -> float:
    """Of the mean of all points, whose errors are common to a look in part: by the scatter of the looks' means."""
    _, number, count = np.unique(look, return_inverse=True, return_counts=True)
    means = np.bincount(number, off_m) / count
    weight = count / count.sum()
    effective = 1.0 / float((weight**2).sum())
    scatter = float((weight * (means - (weight * means).sum()) ** 2).sum())
    return scatter / max(effective - 1.0, 0.5)


def _apart(lines: list[FittedLine]) -> list[FittedLine]:
    """Without those that lie so near to one of more points that they are the same."""
    kept: list[FittedLine] = []
    for line in sorted(lines, key=lambda one: -len(one.points)):
        if all(abs(line.a_m - other.a_m) >= _APART_M for other in kept):
            kept.append(line)
    return sorted(kept, key=lambda line: line.a_m)
