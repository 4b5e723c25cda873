"""A scan that waits for its final pose, and the estimate that is made of that: health, cause and covariance."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.localise.estimates import Cause, Health, PoseEstimate
from gnd.vehicle_agent.localise.graph import SmoothedPose
from gnd.vehicle_agent.localise.packed_scan import PackedScan
from gnd.vehicle_agent.localise.scan_odometry import ScanStep
from gnd.vehicle_agent.localise.stretch import log_se3

F64 = NDArray[np.float64]

OVERRULED: Final[tuple[Cause, ...]] = ("wrong_pose", "stale_map", "poor_place", "no_match", "unconfirmed")
"""What single scans hold against a pose and submaps may know better."""
DISPUTED_CHI2 = 21.1  # of heading and place, three degrees of freedom: 99.99 %
DISPUTED_VARIANCE = np.array([np.radians(0.1), 0.02, 0.02]) ** 2  # what online poses are wrong by in changed places
POSE_SHARE = 0.25
"""Of what distortion moves a point by, as far as it moves a pose, which is held by points all around."""
SURE: Final = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class HeldScan:
    """A scan in the lag: what is needed to make it final, and how its match went. `sweep` is the motion during the
    sweep where it is not the one that wheels and gyro tell; `online` the pose as it was when the scan came; `unsure`
    (3,) variance of the sweep's motion forward, left and in yaw.
    """

    scan: PackedScan
    sweep: Trajectory | None
    t_ns: int
    matching_ratio: float
    health: Health
    cause: Cause
    degenerate: tuple[str, ...]
    online: SmoothedPose
    unsure: F64


def end_ns(scan: Scan) -> int:
    """Time of the last point."""
    return scan.t_ns + int(scan.t_offset_ns.max(initial=0))


def reference_ns(scan: Scan) -> int:
    """The middle of the sweep: what the motion is wrong by is shared by both halves."""
    return (scan.t_ns + end_ns(scan)) // 2


def sweep_variance(T_driven: F64, seen: ScanStep | None, share: float) -> F64:
    """(3,) variance, forward, left and in yaw, of a sweep's motion that was taken off its points: what wheels and gyro
    (4, 4) differ from the scans by since the scan before, more than scans are uncertain; a sweep is a `share` of that.
    """
    if seen is None:
        return SURE
    off = log_se3(T_inverse(T_driven) @ seen.T_before_now)
    return np.asarray(np.maximum(off**2 - np.diag(seen.covariance), 0.0)[[3, 4, 2]] * min(share, 1.0) ** 2)


def left_in_sweep(unsure: F64) -> F64:
    """(6, 6) what that does to a pose: points were measured at any time of the sweep, and its middle is right."""
    variance = np.zeros(6)
    variance[[3, 4, 2]] = unsure * POSE_SHARE**2 / 12.0
    return np.diag(variance)


def settled_dispute(refined: SmoothedPose, online: SmoothedPose) -> tuple[SmoothedPose, bool]:
    """The refined pose, or the online one where they lie farther apart than both are uncertain and the stretch has not
    fitted well for long: then what both say is in doubt, and the covariance holds the other one, too.
    """
    off = log_se3(T_inverse(online.T_map_vehicle) @ refined.T_map_vehicle)
    horizontal = off[[2, 3, 4]]
    both = (refined.covariance + online.covariance)[np.ix_([2, 3, 4], [2, 3, 4])] + np.diag(DISPUTED_VARIANCE)
    if float(horizontal @ np.linalg.solve(both, horizontal)) < DISPUTED_CHI2:
        return refined, False
    if refined.certain:
        return refined, True
    return replace(online, covariance=online.covariance + np.outer(off, off), certain=False), True


def sigmas_of(pose: SmoothedPose) -> tuple[float, float]:
    """The larger horizontal one-sigma axis [m], and that of the heading [rad]."""
    R, covariance = pose.T_map_vehicle[:3, :3], pose.covariance
    horizontal = (R @ covariance[3:, 3:] @ R.T)[:2, :2]
    return float(np.sqrt(np.linalg.eigvalsh(horizontal)[1])), float(np.sqrt(covariance[2, 2]))


def estimate_of(pose: SmoothedPose, held: HeldScan) -> PoseEstimate:
    """The estimate of a scan's pose; a certain one is good whatever single scans hold against it (`OVERRULED`)."""
    sigma_m, sigma_rad = sigmas_of(pose)
    overruled = pose.certain and held.health != "good" and held.cause in OVERRULED
    return PoseEstimate(
        t_ns=pose.t_ns,
        T_map_vehicle=pose.T_map_vehicle,
        sigma_m=sigma_m,
        sigma_rad=sigma_rad,
        matching_ratio=held.matching_ratio,
        health="good" if overruled else held.health,
        cause="stale_map" if overruled else held.cause,
        degenerate=held.degenerate,
        covariance=pose.covariance,
    )
