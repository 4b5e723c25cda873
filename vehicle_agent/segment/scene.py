"""One scan as segmentation sees it: ground, voxels of objects, and its range image for votes on other scans."""

from dataclasses import dataclass
from math import ceil, radians, tan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, F64, I32, I64
from gnd.vehicle_agent.segment.ground_kernels import GroundGrid, ground_heights, lowest_heights, remember_ground
from gnd.vehicle_agent.segment.image_kernels import Optics, RangeJudge, draw_image, elevation_span, layer_gap, vote
from gnd.vehicle_agent.segment.parameters import RANGE_MIN_M, SegmentParameters
from gnd.vehicle_agent.segment.voxel_kernels import MOST_REACH, find_objects

I16 = NDArray[np.int16]
U8 = NDArray[np.uint8]

WEIGHTS: Final = 4
"""Weight of a full vote for "static"; others have less."""
_SETTLED_S: Final = 1.0
"""A return at the same place counts the less the nearer in time below this: what moves still covers its place."""
_COLUMN_DEG: Final = 0.3
"""Width of the range images' columns, at least the spacing of the sensor's shots."""
_ROW_DEG: Final = 0.4
"""Height of their rows at the horizon; rows are even in the tangent of the elevation."""
_REACH_ACROSS_M: Final = 0.15
"""How far from a point a ray may pass at its side and still be evidence about it."""
_REACH_UP_M: Final = 0.3
"""The same above and below: layers are far apart."""
_MARGIN_M: Final = 0.45
"""A ray passes a point where it ends farther behind it than this …"""
_MARGIN_SHARE: Final = 0.01
"""… plus this share of the range."""
_GROUND_CELL_M: Final = 1.0
_GROUND_SLOPE: Final = 0.15
"""The ground rises no steeper than this."""
_ROAD_SLOPE: Final = 0.02
"""It rises no steeper than this over the plane of the road under the vehicle."""
_GROUND_M: Final = 0.25
"""What lies lower than this over the ground is no object by itself; it goes with what stands above it."""
_FEET_M: Final = 0.1
"""What lies lower than this over the ground is the ground."""
SEGMENT_VOXEL_M: Final = 0.3
"""Points this near to each other are judged together, and objects farther apart are two."""

U16 = NDArray[np.uint16]

GAP_SHARE = 0.8  # of layers that are at most so far apart
NS = 1_000_000_000
ENOUGH = 3  # full votes for "static", none against them
VISIBLE = 0.8  # of the distance at which the lowest ray meets a level road
STEP_M = 0.15  # what rises more from one scan to the next is not the ground
SPREAD_M = 0.5  # farther apart than this within two degrees: start and end of a sweep meet there


@dataclass(frozen=True, slots=True, eq=False)
class RangeImage:
    """What the rays of one scan saw.

    t_ns: its time. centre_m: (3,) mean place of the sensor, map frame. R: (3, 3) map axes to the vehicle's. optics:
    scale. ranges: (columns, rows) uint16 cm. places: (bins, 3) float32, the sensor by azimuth, relative to the centre.
    """

    t_ns: int
    centre_m: F64
    R: F64
    optics: Optics
    ranges: U16
    places: F32

    @property
    def gap_tan(self) -> float:
        """Usual distance of layers, as tangent."""
        return layer_gap(self.ranges, GAP_SHARE) * self.optics.tan_step

    def vote(self, t_ns: int, objects: "Objects", centre_m: F64, judge: RangeJudge) -> None:
        """Vote on the objects of the scan at `t_ns`, whose points are relative to `centre_m`.

        What moves may still cover its own place for a while: a return there counts the more the longer after.
        """
        share = min(1.0, abs(t_ns - self.t_ns) / (_SETTLED_S * NS))
        weight = max(1, round(share * WEIGHTS))
        vote(
            objects.points, centre_m - self.centre_m, self.ranges, self.places, self.R, self.optics, judge, weight,
            objects.passed, objects.met,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Objects:
    """The voxels of what stands on the ground.

    points: (V, 3) float32 one measured point of each, relative to the scan's centre. index: (V, 3) int32. passed, met:
    (V,) uint8 votes so far. reach: (V,) uint8, voxels from one layer to the next there. voxel_of:
    (N,) int32, the voxel of each point of the scan, or what else it is; int16 while it waits, where that is enough.
    """

    points: F32
    index: I32
    passed: U8
    met: U8
    reach: U8
    voxel_of: I32 | I16


def hash_table(n: int) -> tuple[I64, I32]:
    """An empty table for up to `n` keys."""
    size = 1 << max(4, ceil(2 * n - 1).bit_length())
    return np.full(size, -1, np.int64), np.empty(size, np.int32)


def judge_of(gap_tan: float) -> RangeJudge:
    """What a vote needs: parameters, and the distance of the sensor's layers."""
    return RangeJudge(_REACH_ACROSS_M, _REACH_UP_M, _MARGIN_M, _MARGIN_SHARE, 1.2 * gap_tan, ENOUGH * WEIGHTS)


class GroundMap:
    """The ground around the vehicle, remembered from scan to scan in squares that lie still in the map frame."""

    def __init__(self, p: SegmentParameters) -> None:
        self._cell_m, self._slope, self._road_slope = _GROUND_CELL_M, _GROUND_SLOPE, _ROAD_SLOPE
        self._half = ceil(p.range_max_m / _GROUND_CELL_M) + 1
        self._memory = np.full((2 * self._half, 2 * self._half), np.inf, np.float32)
        self._corner = np.zeros(2, np.int64)

    def around(self, points: F32, centre_m: F64, T_map_vehicle: F64, tan_low: float) -> tuple[F32, GroundGrid]:
        """Heights of the ground relative to `centre_m`, and their grid, with points (N, 3) relative to it just seen.

        `tan_low`: tangent of the lowest elevation, from which follows where the sensor begins to see the ground.
        """
        self._move(np.floor(centre_m[:2] / self._cell_m).astype(np.int64) - self._half)
        x0, y0 = self._corner * self._cell_m - centre_m[:2]
        grid = GroundGrid(float(x0), float(y0), self._cell_m, *self._memory.shape)
        height = np.float32(centre_m[2])
        mount_m = float(T_map_vehicle[:3, 2] @ (centre_m - T_map_vehicle[:3, 3]))
        near_m = VISIBLE * max(mount_m, 0.0) / max(-tan_low, 1e-3)
        remember_ground(self._memory, lowest_heights(points, grid, near_m) + height, STEP_M)
        road = np.concatenate([T_map_vehicle[:3, 3] - centre_m, T_map_vehicle[:3, 2]])
        return ground_heights(self._memory - height, grid, self._slope, road, self._road_slope, near_m), grid

    def _move(self, corner: NDArray[np.int64]) -> None:
        """Forget what lies outside the new place of the grid."""
        before, self._corner = self._corner, corner
        dx, dy = np.clip(corner - before, -2 * self._half, 2 * self._half)
        if dx or dy:
            n = 2 * self._half
            memory = np.full((n, n), np.inf, np.float32)
            memory[max(0, -dx) : n - max(0, dx), max(0, -dy) : n - max(0, dy)] = self._memory[
                max(0, dx) : n - max(0, -dx), max(0, dy) : n - max(0, -dy)
            ]
            self._memory = memory


def find_all_objects(
    points: F32, origins: F32, ground: tuple[F32, GroundGrid], gap_tan: float, p: SegmentParameters
) -> Objects:
    """Voxels of a scan's points (N, 3), relative to its centre; `gap_tan`: distance of its layers."""
    voxel_of, first, index = find_objects(
        points, origins, *ground, _GROUND_M, _FEET_M, SEGMENT_VOXEL_M, RANGE_MIN_M, p.range_max_m,
        *hash_table(len(points)),
    )  # fmt: skip
    votes = np.zeros((2, len(first)), np.uint8)
    reach = np.ceil(np.hypot(points[first, 0], points[first, 1]) * (1.2 * gap_tan / SEGMENT_VOXEL_M))
    return Objects(points[first], index, votes[0], votes[1], np.clip(reach, 1, MOST_REACH).astype(np.uint8), voxel_of)


def image_of(t_ns: int, centre_m: F64, R: F64, points: F32, origins: F32, voxel_of: I32) -> RangeImage:
    """The range image of a scan."""
    low, high = elevation_span(points, origins, R)
    step = tan(radians(_ROW_DEG))
    rows = int((high - low) / step) + 1 if high >= low else 1
    optics = Optics(round(360.0 / _COLUMN_DEG), rows, float(low), step)
    return RangeImage(t_ns, centre_m, R, optics, *draw_image(points, origins, voxel_of, R, optics, SPREAD_M))


def belief(passed: U8, met: U8, mass_moving: float, mass_static: float) -> tuple[F64, F64]:
    """Return the masses of "moving" and of "static", float64 (V,) each.

    Votes are combined by Dempster's rule in closed form: `passed` votes for "moving", votes of `met` weights together
    for "static".

    A vote of weight w has the mass 1 - (1 - mass_static)^(w / WEIGHTS). Every vote is a simple support function; equal
    ones combine to 1 - (1 - m)^n, and Dempster's rule joins the two (Shafer 1976, chapter 4). The rest is "not known".
    """
    doubt_moving = (1.0 - mass_moving) ** passed.astype(np.float64)
    doubt_static = (1.0 - mass_static) ** (met / WEIGHTS)
    agreed = doubt_moving + doubt_static - doubt_moving * doubt_static  # 1 - conflict, which would lose its digits
    moving = (1.0 - doubt_moving) * doubt_static / agreed
    static = (1.0 - doubt_static) * doubt_moving / agreed
    return moving, static
