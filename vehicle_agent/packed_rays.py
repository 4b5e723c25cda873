"""The rays of a scan that waits, in a third of their memory: points to 10 µm, starts to 0.1 mm."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.jit import kernel

F32 = NDArray[np.float32]
I16 = NDArray[np.int16]
_LEVELS: Final = 32767
_LEAST_STEP_M: Final = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class PackedRays:
    """N rays about a centre, the mean of their starts.

    Attributes:
        centre_m: (3,) float64, map frame.
        points_m: (N, 3) float32, their ends from the centre.
        starts: (N, 3) int16, in steps of `step_m` from the centre.
        step_m: of the starts.
    """

    centre_m: F64
    points_m: F32
    starts: I16
    step_m: float

    def restore(self) -> tuple[F64, F64]:
        """Ends and starts (N, 3), float64, map frame."""
        return _restored(self.points_m, self.starts, self.step_m, self.centre_m)

    @classmethod
    def of(cls, points_m: F64, starts_m: F64) -> tuple["PackedRays", F32]:
        """Pack ends and starts (N, 3), map frame; gives the starts from the centre, too, (N, 3) float32 [m]."""
        points, starts = np.ascontiguousarray(points_m, np.float64), np.ascontiguousarray(starts_m, np.float64)
        centre, near_points, near_starts, farthest_m = _centred(points, starts)
        step_m = max(float(farthest_m) / _LEVELS, _LEAST_STEP_M)
        return cls(centre, near_points, _stepped(near_starts, step_m), step_m), near_starts


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
def _stepped(starts: F32, step_m: float) -> I16:
    """Starts (N, 3) as multiples of a step."""
    packed = np.empty(starts.shape, np.int16)
    for i in range(starts.shape[0]):
        for axis in range(3):
            packed[i, axis] = np.int16(np.rint(starts[i, axis] / step_m))
    return packed


@kernel
def _restored(points: F32, starts: I16, step_m: float, centre: F64) -> tuple[F64, F64]:
    ends_m, starts_m = np.empty(points.shape), np.empty(points.shape)
    for i in range(points.shape[0]):
        for axis in range(3):
            ends_m[i, axis] = points[i, axis] + centre[axis]
            starts_m[i, axis] = starts[i, axis] * step_m + centre[axis]
    return ends_m, starts_m
