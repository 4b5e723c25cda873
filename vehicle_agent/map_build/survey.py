"""A first look over a drive before it becomes a map: its bodywork, where the road is, and samples to find loops by."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F32, F64, I64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.schemas.drive import Scan
from gnd.tile_store.build import POINT_RANGE_M, MapSource
from gnd.vehicle_agent.localise.parameters import SamplingParameters
from gnd.vehicle_agent.localise.sampling import sample_scan
from gnd.vehicle_agent.map_build.bodywork import EVERY_M, Bodywork, BodyworkSurvey
from gnd.vehicle_agent.map_build.placed_scans import drive_scans, middle_ns, placed, why_no_pose
from gnd.vehicle_agent.map_build.road import road_below

Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it is, and of how much."""

SAMPLED: Final = SamplingParameters(n_points=1500, max_range_m=50.0)


@dataclass(frozen=True, slots=True, eq=False)
class DriveSurvey:
    """What a first look over a drive found; S scans, each about a metre of way after the one before.

    t_ns: (S,) middle of each scan. way_m: (S,) odometer there. road_z_m: (S,) height of the road under the LiDAR in the
    vehicle frame, NaN where too little ground is seen. samples: S arrays (K, 3) float32 of points in the vehicle frame,
    without sweep motion and bodywork.
    """

    t_ns: I64
    way_m: F64
    road_z_m: F64
    bodywork: Bodywork
    samples: tuple[F32, ...]

    @property
    def road_m(self) -> float:
        """Median height of the road in the vehicle frame; 0, where it should be, when it was never seen."""
        return _median_or_zero(self.road_z_m)


def way_of(poses: Trajectory) -> F64:
    """(N,) horizontal way driven until each pose."""
    step_m = np.linalg.norm(np.diff(poses.T_dst_vehicle[:, :2, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(step_m)])


def look_over(source: MapSource, progress: Progress) -> DriveSurvey:
    """Look over a drive with the poses that it has.

    Raises:
        DriveError: the drive cannot be read.
    """
    way_m, seen = way_of(source.poses), BodyworkSurvey()
    found: list[tuple[int, float, float, F32]] = []
    for done, scan in enumerate(drive_scans(source)):
        progress(f"{source.path.name}: looking over", done + 1, source.scans)
        t_ns = middle_ns(scan)
        at_m = float(np.interp(t_ns, source.poses.t_ns, way_m))
        if (found and at_m - found[-1][1] < EVERY_M) or why_no_pose(scan, source.poses):
            continue
        points = _vehicle_points(source, scan)
        seen.add(points)
        road_z = road_below(points, source.header.T_vehicle_lidar[:3, 3])
        chosen = points[sample_scan(points - source.header.T_vehicle_lidar[:3, 3], SAMPLED)]
        found.append((t_ns, at_m, np.nan if road_z is None else road_z, chosen.astype(np.float32)))
    road = np.array([one[2] for one in found], np.float64)
    bodywork = seen.bodywork(_median_or_zero(road))
    return DriveSurvey(
        np.array([one[0] for one in found], np.int64),
        np.array([one[1] for one in found], np.float64),
        road,
        bodywork,
        tuple(one[3][~bodywork.of(one[3].astype(np.float64))] for one in found),
    )


def _vehicle_points(source: MapSource, scan: Scan) -> F64:
    one = placed(scan, source.poses, source.header.T_vehicle_lidar, POINT_RANGE_M)
    return transform(T_inverse(one.estimate.T_map_vehicle), one.points_map_m)


def _median_or_zero(values: F64) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0
