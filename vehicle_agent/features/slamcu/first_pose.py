"""Where a drive begins, as the vehicle itself finds out: its first motion laid onto its first GNSS fixes."""

from dataclasses import dataclass
from math import atan2, hypot
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.errors import BadPose

AFTER_S: Final = 5.0
LEAST_FIXES: Final = 2
LEAST_WAY_M: Final = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class FilterStart:
    """A first pose.

    Attributes:
        t_ns: when.
        pose: (3,) x, y [m], heading [rad] in the map frame.
        cov: (3, 3).
    """

    t_ns: int
    pose: F64
    cov: F64


def first_pose_of(
    motion_ns: I64, speed_mps: F64, yaw_rate_radps: F64, fix_ns: I64, fix_m: F64, sigma_m: float
) -> FilterStart:
    """Return the pose at the last of some motion samples, of nothing but these and the fixes until then.

    Args:
        motion_ns: (N,) times of the samples, rising.
        speed_mps: (N,) of the wheels.
        yaw_rate_radps: (N,) of the gyro.
        fix_ns: (K,) times of the fixes.
        fix_m: (K, 2) of the fixes, map frame.
        sigma_m: one sigma of each axis of a fix.

    Raises:
        BadPose: too little was driven, or too few fixes came, for a heading.
    """
    dt_s = np.diff(motion_ns, prepend=motion_ns[:1]) * 1e-9
    heading = np.cumsum(yaw_rate_radps * dt_s)
    step = speed_mps * dt_s
    track = np.column_stack([np.cumsum(step * np.cos(heading)), np.cumsum(step * np.sin(heading)), heading])
    moved_m = hypot(*(track[-1, :2] - track[0, :2])) if len(track) else 0.0
    if len(fix_ns) < LEAST_FIXES or moved_m < LEAST_WAY_M:
        raise BadPose(f"{moved_m:.1f} m and {len(fix_ns)} fixes give no heading")
    at = np.column_stack([np.interp(fix_ns, motion_ns, track[:, axis]) for axis in (0, 1)])
    turn, shift = _laid_onto(at, fix_m)
    c, s = np.cos(turn), np.sin(turn)
    x, y, last_rad = track[-1]
    pose = np.array([c * x - s * y + shift[0], s * x + c * y + shift[1], last_rad + turn])
    sigma_rad = 2.0 * sigma_m / moved_m
    return FilterStart(int(motion_ns[-1]), pose, np.diag([sigma_m**2, sigma_m**2, sigma_rad**2]))


def _laid_onto(points: F64, onto: F64) -> tuple[float, F64]:
    """Rotation [rad] and shift (2,) that lay points (N, 2) onto others best (Umeyama 1991, without scale)."""
    a, b = points - points.mean(axis=0), onto - onto.mean(axis=0)
    turn = atan2(float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), float(np.sum(a * b)))
    c, s = np.cos(turn), np.sin(turn)
    x, y = points.mean(axis=0)
    return turn, onto.mean(axis=0) - np.array([c * x - s * y, s * x + c * y])
