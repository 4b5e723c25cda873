"""One scan as segmentation sees it: ground, voxels of objects, and its range image for votes on other scans."""

from dataclasses import dataclass
from math import ceil, radians, tan

import numpy as np
from numpy.typing import NDArray

from gnd_map.arrays import F32, F64, I32
from vehicle_agent.segment.kernels import (
    Grid,
    Judge,
    Optics,
    draw_image,
    elevation_span,
    find_objects,
    ground_heights,
    vote,
)
from vehicle_agent.segment.parameters import SegmentParameters

U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
I64 = NDArray[np.int64]

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

    def vote(self, points: F32, centre_m: F64, judge: Judge, passed: U8, met: U8) -> None:
        """Vote on points (V, 3) relative to `centre_m`; the counts go up."""
        vote(
            points, centre_m - self.centre_m, self.ranges, self.places, self.R, self.optics, judge, passed, met
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Objects:
    """The voxels of what stands on the ground.

    points: (V, 3) float32 one measured point of each, relative to the scan's centre. index: (V, 3) int32. passed, met:
    (V,) uint8 votes so far. voxel_of: (N,) int32, the voxel of each point of the scan, or what else it is.
    """

    points: F32
    index: I32
    passed: U8
    met: U8
    voxel_of: I32


def hash_table(n: int) -> tuple[I64, I32]:
    """An empty table for up to `n` keys."""
    size = 1 << max(4, ceil(2 * n - 1).bit_length())
    return np.full(size, -1, np.int64), np.empty(size, np.int32)


def judge_of(p: SegmentParameters) -> Judge:
    """The parameters that a vote needs."""
    return Judge(p.reach_across_m, p.reach_up_m, p.margin_m, p.margin_share)


def find_all_objects(points: F32, origins: F32, p: SegmentParameters) -> Objects:
    """Ground and voxels of a scan's points (N, 3), relative to its centre."""
    half = p.range_max_m + p.ground_cell_m
    n = ceil(2 * half / p.ground_cell_m)
    grid = Grid(-half, -half, p.ground_cell_m, n, n)
    ground = ground_heights(points, grid, p.ground_slope)
    voxel_of, first, index = find_objects(
        points, origins, ground, grid, p.ground_m, p.feet_m, p.voxel_m, p.range_min_m, p.range_max_m,
        *hash_table(len(points)),
    )  # fmt: skip
    votes = np.zeros((2, len(first)), np.uint8)
    return Objects(points[first], index, votes[0], votes[1], voxel_of)


def image_of(
    t_ns: int, centre_m: F64, R: F64, points: F32, origins: F32, voxel_of: I32, p: SegmentParameters
) -> RangeImage:
    """The range image of a scan."""
    low, high = elevation_span(points, origins, R)
    step = tan(radians(p.row_deg))
    rows = int((high - low) / step) + 1 if high >= low else 1
    optics = Optics(round(360.0 / p.column_deg), rows, float(low), step)
    return RangeImage(t_ns, centre_m, R, optics, *draw_image(points, origins, voxel_of, R, optics, SPREAD_M))
