"""A scan that waits for its final pose, and the estimate that is made of it: health, cause and covariance."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.vehicle_agent.localise.estimates import Cause, Health, PoseEstimate
from gnd.vehicle_agent.localise.graph import SmoothedPose
from gnd.vehicle_agent.localise.packed_scan import PackedScan
from gnd.vehicle_agent.localise.stretch import log_se3

OVERRULED: Final[tuple[Cause, ...]] = ("wrong_pose", "stale_map", "poor_place", "no_match", "unconfirmed")
"""Causes found by single scans that a pose which submaps make certain overrules."""
DISPUTED_CHI2 = 21.1  # of heading and place, three degrees of freedom: 99.99 %
DISPUTED_VARIANCE = np.array([np.radians(0.1), 0.02, 0.02]) ** 2  # what online poses are wrong by in changed places


@dataclass(frozen=True, slots=True, eq=False)
class HeldScan:
    """A scan in the lag: what is needed to make it final, and how its match went.

    Attributes:
        scan: the scan, packed.
        sweep: the motion during the sweep, where it is not that of wheels and gyro.
        t_ns: reference time.
        matching_ratio: of its match; 0 without one.
        health, cause: of the pose when the scan came.
        degenerate: directions that were not constrained then.
        online: the pose when the scan came.
        unsure: (3,) variance of the sweep's motion forward, left and in yaw.
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


def settled_dispute(refined: SmoothedPose, online: SmoothedPose) -> tuple[SmoothedPose, bool]:
    """Return the final pose, and whether the refined and the online pose disagree: lie farther apart than their sigmas.

    Where they do, the refined one counts only if the stretch has fitted well for long; else the online one, with a
    covariance that holds the other too.
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
