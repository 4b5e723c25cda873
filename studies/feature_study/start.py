"""Where a simulated drive begins, as the vehicle itself finds out."""

import numpy as np

from gnd.fleet_sim.roads.drive import RoadDrive
from gnd.vehicle_agent.features.slamcu.first_pose import AFTER_S, FirstPose, first_pose_of


def start_of(drive: RoadDrive, after_s: float = AFTER_S) -> FirstPose:
    """Return the pose some seconds after the start, of nothing but wheel speed, yaw rate and GNSS until then.

    Raises:
        BadPose: too little was driven or too few fixes came to tell a heading.
    """
    motion, gnss = drive.motion, drive.gnss
    end_ns = int(motion.t_ns[0]) + round(after_s * 1e9)
    n, k = int(np.searchsorted(motion.t_ns, end_ns, "right")), int(np.searchsorted(gnss.t_ns, end_ns, "right"))
    return first_pose_of(
        motion.t_ns[:n], motion.speed_mps[:n], motion.yaw_rate_radps[:n], gnss.t_ns[:k], gnss.xy_m[:k], gnss.sigma_m
    )
