"""A scan that waits for its final pose, in 8 bytes a point instead of 16.

Points are kept as multiples of a step that the scan's farthest coordinate sets, times as multiples of 2 µs or more. At
120 m the step is 3.7 mm, so a coordinate moves by at most 1.8 mm: less than a tenth of what range noise does. A scan
that reaches beyond MAX_REACH_M is kept as it is. Points that are not finite are left out.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, F64, I64
from gnd.gnd_map.jit import bare
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import Scan

Points = NDArray[np.int16] | NDArray[np.float32]
Ticks = NDArray[np.uint16] | NDArray[np.uint32]

LEVELS, TICKS = 32767, 65535
MAX_REACH_M = 131.0  # steps of 4 mm
MIN_TICK_NS = 2000
KNOT_NS = 1_000_000  # as in `gnd.gnd_map.motion`: at 1 rad/s, blending rotations over 1 ms is off by 1.3e-7 rad


@dataclass(frozen=True, slots=True, eq=False)
class PackedScan:
    """points: (N, 3) int16 in `step_m`, or float32 metres with `step_m` 1; ticks: (N,) uint16 in `tick_ns`, or uint32
    nanoseconds with `tick_ns` 1; both in firing order, LiDAR frame. t_ns: start of the sweep; end_ns: its last point.
    """

    t_ns: int
    end_ns: int
    points: Points
    ticks: Ticks
    step_m: float
    tick_ns: int

    def __len__(self) -> int:
        """Points that are kept."""
        return len(self.points)

    @property
    def nbytes(self) -> int:
        """Bytes of the columns."""
        return self.points.nbytes + self.ticks.nbytes

    def placed(self, sweep: Trajectory, T_vehicle_lidar: F64, reference_ns: int, T_map_vehicle: F64) -> "SweptRays":
        """Its rays in the map frame, sweep motion removed.

        Args:
            sweep: the vehicle's motion during the sweep, in any frame.
            T_vehicle_lidar: (4, 4) mount pose.
            reference_ns: the time at which the vehicle was at T_map_vehicle.
            T_map_vehicle: (4, 4).
        """
        knots_ns = self.t_ns + KNOT_NS * np.arange((self.end_ns - self.t_ns) // KNOT_NS + 3)  # ticks may round up
        T_map_dst = T_map_vehicle @ T_inverse(sweep.at(reference_ns))
        T_map_lidar = T_map_dst @ sweep.at(knots_ns) @ T_vehicle_lidar
        knots = np.ascontiguousarray(T_map_lidar[:, :3, :])
        return SweptRays(self.points, self.ticks, self.step_m, self.tick_ns, knots)


@dataclass(frozen=True, slots=True, eq=False)
class SweptRays:
    """Rays of a packed scan and where its LiDAR was. They are placed each time they are asked for: that takes less than
    to hold them placed.

    Attributes:
        points, ticks, step_m, tick_ns: as of the `PackedScan`, whose memory it is.
        knots: (K, 3, 4) float64 pose of the LiDAR in the map frame every `KNOT_NS` from the start of the sweep.
    """

    points: Points
    ticks: Ticks
    step_m: float
    tick_ns: int
    knots: F64

    def __len__(self) -> int:
        """How many rays."""
        return len(self.points)

    @property
    def centre_m(self) -> F64:
        """(3,) float64, map frame: the LiDAR in the middle of the sweep."""
        return self.knots[len(self.knots) // 2, :, 3].copy()

    @property
    def points_m(self) -> F32:
        """(N, 3) float32 their ends from the centre."""
        ends: F32 = self._placed(np.float32, self.centre_m, 0)[0]
        return ends

    def points_at(self, rows: I64) -> F32:
        """(K, 3) float32 the ends of some of them, from the centre."""
        return replace(self, points=self.points[rows], ticks=self.ticks[rows]).points_m

    def from_centre(self) -> tuple[F32, F32]:
        """Ends and starts (N, 3), float32, from the centre."""
        return self._placed(np.float32, self.centre_m, len(self))

    def restore(self) -> tuple[F64, F64]:
        """Ends and starts (N, 3), float64, map frame."""
        return self._placed(np.float64, np.zeros(3), len(self))

    def packed(self) -> "SweptRays":
        """Themselves."""
        return self

    def _placed(self, dtype: Any, centre_m: F64, n_starts: int) -> tuple[Any, Any]:
        ends, starts = np.empty((len(self), 3), dtype), np.empty((n_starts, 3), dtype)
        place_rays(
            self.points, self.ticks, self.step_m, self.tick_ns, KNOT_NS, self.knots, centre_m, np.empty((3, 4)), ends,
            starts,
        )  # fmt: skip
        return ends, starts


def pack(scan: Scan) -> PackedScan:
    """The scan without what is not finite, in as few bytes as its reach allows."""
    raw = np.ascontiguousarray(scan.points_m)
    kept, reach_m = survey(raw)
    last_ns = int(scan.t_offset_ns.max(initial=0))
    end_ns = scan.t_ns + last_ns
    if reach_m > MAX_REACH_M:
        finite = np.flatnonzero(np.isfinite(raw).all(axis=1))
        return PackedScan(scan.t_ns, end_ns, raw[finite], scan.t_offset_ns[finite], 1.0, 1)
    step_m, tick_ns = max(reach_m, 1.0) / LEVELS, max(MIN_TICK_NS, last_ns // TICKS + 1)
    points, ticks = np.empty((kept, 3), np.int16), np.empty(kept, np.uint16)
    squeeze(raw, scan.t_offset_ns, 1.0 / step_m, tick_ns, points, ticks)
    return PackedScan(scan.t_ns, end_ns, points, ticks, step_m, tick_ns)


@bare
def survey(points: NDArray[np.float32]) -> tuple[int, float]:
    """How many points (N, 3) are finite, and their largest coordinate."""
    kept, reach = 0, 0.0
    for n in range(points.shape[0]):
        largest = max(abs(points[n, 0]), abs(points[n, 1]), abs(points[n, 2]))
        if np.isfinite(points[n, 0] + points[n, 1] + points[n, 2]):
            kept += 1
            reach = max(reach, np.float64(largest))
    return kept, reach


@bare
def squeeze(
    raw: NDArray[np.float32], offset_ns: NDArray[np.uint32], per_m: float, tick_ns: int,
    points: NDArray[np.int16], ticks: NDArray[np.uint16],
) -> None:  # fmt: skip
    """Fill `points` (K, 3) and `ticks` (K,) with the K finite points, rounded to the nearest step and tick."""
    k = 0
    for n in range(raw.shape[0]):
        if not np.isfinite(raw[n, 0] + raw[n, 1] + raw[n, 2]):
            continue
        for axis in range(3):
            points[k, axis] = np.int16(np.rint(raw[n, axis] * per_m))
        ticks[k] = np.uint16((np.int64(offset_ns[n]) + tick_ns // 2) // tick_ns)
        k += 1


@bare
def place_rays(
    points: Points, ticks: Ticks, step_m: float, tick_ns: int, knot_ns: int, knots: F64, centre_m: F64, T: F64,
    ends: F32 | F64, starts: F32 | F64,
) -> None:  # fmt: skip
    """Fill ends and starts (N, 3) of the rays, from a centre (3,), under the LiDAR's pose blended between the two knots
    (K, 3, 4) around each point's time; starts (0, 3) are left out. `T` (3, 4) is room for that pose: it serves all
    points of one time.
    """
    tick = np.int64(-1)
    for n in range(points.shape[0]):
        if np.int64(ticks[n]) != tick:
            tick = np.int64(ticks[n])
            t = tick * tick_ns
            k = t // knot_ns
            after = (t - k * knot_ns) / knot_ns
            before = 1.0 - after
            for row in range(3):
                for column in range(4):
                    T[row, column] = before * knots[k, row, column] + after * knots[k + 1, row, column]
        x, y, z = points[n, 0] * step_m, points[n, 1] * step_m, points[n, 2] * step_m
        for row in range(3):
            ends[n, row] = T[row, 3] + T[row, 0] * x + T[row, 1] * y + T[row, 2] * z - centre_m[row]
        if starts.shape[0] != 0:
            for row in range(3):
                starts[n, row] = T[row, 3] - centre_m[row]
