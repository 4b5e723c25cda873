"""The scans of a drive with known poses, as localisation would give them; and why a scan has none."""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from gnd.gnd_map.motion import TOLERANCE_NS, Trajectory, deskew
from gnd.gnd_map.se3 import transform
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import read_drive
from gnd.tile_store.build import MapSource
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.packed_rays import PlacedRays

NoPose = Literal["before the first pose", "after the last pose", "without a point in range"]


def middle_ns(scan: Scan) -> int:
    """The middle of the sweep."""
    return scan.t_ns + int(scan.t_offset_ns.max(initial=0)) // 2


def drive_scans(source: MapSource) -> Iterator[Scan]:
    """The scans of a drive, in time order."""
    return (item for item in read_drive(source.path) if isinstance(item, Scan))


def why_no_pose(scan: Scan, poses: Trajectory) -> NoPose | None:
    """Why the poses do not cover a scan, or None where they do."""
    if scan.t_ns < poses.t_ns[0] - TOLERANCE_NS:
        return "before the first pose"
    # a sweep is deskewed on poses up to a millisecond after its last point
    if scan.t_ns + int(scan.t_offset_ns.max(initial=0)) + 2_000_000 > poses.t_ns[-1] + TOLERANCE_NS:
        return "after the last pose"
    return None


def placed(scan: Scan, poses: Trajectory, T_vehicle_lidar: np.ndarray, range_m: tuple[float, float]) -> RefinedScan:
    """A scan at its known pose, with the points between two ranges; its sweep motion is removed.

    Args:
        scan: one that `why_no_pose` has nothing against.
        poses: of the vehicle in the map frame.
        T_vehicle_lidar: (4, 4) the mount.
        range_m: least and greatest distance from the LiDAR.
    """
    squared = np.einsum("ij,ij->i", scan.points_m, scan.points_m)
    kept = (squared >= range_m[0] ** 2) & (squared <= range_m[1] ** 2)
    points_m, offset_ns, t_ns = scan.points_m[kept], scan.t_offset_ns[kept], middle_ns(scan)
    T = poses.at(t_ns)
    ends, starts = (
        transform(T, deskew(p, offset_ns, scan.t_ns, poses, T_vehicle_lidar, t_ns))
        for p in (points_m, np.zeros_like(points_m))
    )
    return RefinedScan(t_ns, PlacedRays(ends, starts), PoseEstimate(t_ns, T, 0.0, 0.0, 1.0, "good"))
