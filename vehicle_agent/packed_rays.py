"""The rays of a scan: as they were placed, or, while it waits, in a quarter to a third of their memory, points to 10 µm
and starts to 0.1 mm.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.jit import kernel

F32 = NDArray[np.float32]
I16 = NDArray[np.int16]
_LEVELS: Final = 32767
_LEAST_STEP_M: Final = 1e-4


class PlacedRays(NamedTuple):
    """N rays in the map frame: `ends_m` and `starts_m`, (N, 3) float64 each, in firing order."""

    ends_m: F64
    starts_m: F64

    def restore(self) -> tuple[F64, F64]:
        """Ends and starts."""
        return self.ends_m, self.starts_m

    def packed(self) -> "PackedRays":
        """For waiting."""
        return PackedRays.of(self.ends_m, self.starts_m)


@dataclass(frozen=True, slots=True, eq=False)
class PackedRays:
    """N rays about a centre, the mean of their starts.

    Attributes:
        centre_m: (3,) float64, map frame.
        points_m: (N, 3) float32, their ends from the centre.
        starts: (R, 3) int16, in steps of `step_m` from the centre: R runs of rays that start at one place.
        until: (R,) int32, how many rays have come when a run ends.
        step_m: of the starts.
    """

    centre_m: F64
    points_m: F32
    starts: I16
    until: I32
    step_m: float

    def restore(self) -> tuple[F64, F64]:
        """Ends and starts (N, 3), float64, map frame."""
        return _restored(self.points_m, self.starts, self.until, self.step_m, self.centre_m)

    def __len__(self) -> int:
        """How many rays."""
        return len(self.points_m)

    def packed(self) -> "PackedRays":
        """Themselves."""
        return self

    def points_at(self, rows: I64) -> F32:
        """(K, 3) float32 the ends of some of them, from the centre."""
        return self.points_m[rows]

    def from_centre(self) -> tuple[F32, F32]:
        """Ends and starts (N, 3), float32, from the centre."""
        step_m = np.float32(self.step_m)
        starts = np.repeat(self.starts.astype(np.float32) * step_m, np.diff(self.until, prepend=0), axis=0)
        return self.points_m, starts

    @classmethod
    def of(cls, points_m: F64, starts_m: F64) -> "PackedRays":
        """Pack ends and starts (N, 3), map frame."""
        points, starts = np.ascontiguousarray(points_m, np.float64), np.ascontiguousarray(starts_m, np.float64)
        centre, near_points, near_starts, farthest_m = _centred(points, starts)
        step_m = max(float(farthest_m) / _LEVELS, _LEAST_STEP_M)
        return cls(centre, near_points, *_runs(near_starts, step_m), step_m)


@kernel
def _centred(points: F64, starts: F64) -> tuple[F64, F32, F32, np.float32]:
    """Mean of the starts, both from there in float32, and the largest coordinate of a start."""
    centre, n = np.zeros(3), points.shape[0]
    for i in range(n):
        for axis in range(3):
            centre[axis] += starts[i, axis]
    for axis in range(3):
        centre[axis] /= max(n, 1)
    near_points, near_starts, farthest = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32), np.float32(0.0)
    for i in range(n):
        for axis in range(3):
            near_points[i, axis] = np.float32(points[i, axis] - centre[axis])
            near_starts[i, axis] = np.float32(starts[i, axis] - centre[axis])
            farthest = max(farthest, abs(near_starts[i, axis]))
    return centre, near_points, near_starts, farthest


@kernel
def _runs(starts: F32, step_m: float) -> tuple[I16, I32]:
    """Starts (N, 3) as multiples of a step, equal neighbours once: (R, 3), and where each run ends, (R,)."""
    packed, until, runs = np.empty(starts.shape, np.int16), np.empty(starts.shape[0], np.int32), 0
    for i in range(starts.shape[0]):
        x, y, z = np.rint(starts[i, 0] / step_m), np.rint(starts[i, 1] / step_m), np.rint(starts[i, 2] / step_m)
        at = runs - 1
        if runs == 0 or packed[at, 0] != x or packed[at, 1] != y or packed[at, 2] != z:
            packed[runs, 0], packed[runs, 1], packed[runs, 2] = np.int16(x), np.int16(y), np.int16(z)
            runs += 1
        until[runs - 1] = i + 1
    return packed[:runs].copy(), until[:runs].copy()


@kernel
def _restored(points: F32, starts: I16, until: I32, step_m: float, centre: F64) -> tuple[F64, F64]:
    ends_m, starts_m, begun = np.empty(points.shape), np.empty(points.shape), 0
    for run in range(starts.shape[0]):
        for i in range(begun, until[run]):
            for axis in range(3):
                ends_m[i, axis] = points[i, axis] + centre[axis]
                starts_m[i, axis] = starts[run, axis] * step_m + centre[axis]
        begun = until[run]
    return ends_m, starts_m
