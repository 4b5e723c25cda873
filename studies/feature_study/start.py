"""Where a drive begins, as the vehicle itself finds out: its first motion laid onto its first GNSS fixes."""

from dataclasses import dataclass
from math import atan2, hypot
from typing import Final

import numpy as np

from gnd.fleet_sim.roads.drive import RoadDrive
from gnd.gnd_map.arrays import F64
from studies.frame.errors import ReproduceError

AFTER_S: Final = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A first pose.

    Attributes:
        t_ns: when.
        pose: float64 (3,), x, y [m], heading [rad] in the route's frame.
        cov: float64 (3, 3).
    """

    t_ns: int
    pose: F64
    cov: F64


def start_of(drive: RoadDrive, after_s: float = AFTER_S) -> Start:
    """Return the pose some seconds after the start, of nothing but wheel speed, yaw rate and GNSS until then.

    Raises:
        ReproduceError: too little was driven or too few fixes came to tell a heading.
    """
    motion, gnss = drive.motion, drive.gnss
    begin_ns = int(motion.t_ns[0])
    end_ns = begin_ns + round(after_s * 1e9)
    n, fixes = int(np.searchsorted(motion.t_ns, end_ns, "right")), int(np.searchsorted(gnss.t_ns, end_ns, "right"))
    track = dead_reckoned(drive, n)
    moved_m = hypot(*(track[-1, :2] - track[0, :2]))
    if fixes < 2 or moved_m < 5.0:
        raise ReproduceError(f"{moved_m:.1f} m and {fixes} fixes in {after_s:g} s tell no heading")
    at = np.column_stack([np.interp(gnss.t_ns[:fixes], motion.t_ns[:n], track[:, axis]) for axis in (0, 1)])
    turn, shift = _laid_onto(at, gnss.xy_m[:fixes])
    c, s = np.cos(turn), np.sin(turn)
    x, y, heading = track[-1]
    pose = np.array([c * x - s * y + shift[0], s * x + c * y + shift[1], heading + turn])
    sigma_rad = 2.0 * gnss.sigma_m / moved_m
    return Start(int(motion.t_ns[n - 1]), pose, np.diag([gnss.sigma_m**2, gnss.sigma_m**2, sigma_rad**2]))


def dead_reckoned(drive: RoadDrive, n: int) -> F64:
    """Return poses (n, 3) of the first n motion samples alone, from zero."""
    motion = drive.motion
    dt_s = np.diff(motion.t_ns[:n], prepend=motion.t_ns[0]) * 1e-9
    heading = np.cumsum(motion.yaw_rate_radps[:n] * dt_s)
    step = motion.speed_mps[:n] * dt_s
    return np.column_stack([np.cumsum(step * np.cos(heading)), np.cumsum(step * np.sin(heading)), heading])


def _laid_onto(points: F64, onto: F64) -> tuple[float, F64]:
    """Rotation [rad] and shift (2,) that lay points (N, 2) onto others best (Umeyama 1991, without scale)."""
    a, b = points - points.mean(axis=0), onto - onto.mean(axis=0)
    turn = atan2(float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), float(np.sum(a * b)))
    c, s = np.cos(turn), np.sin(turn)
    x, y = points.mean(axis=0)
    return turn, onto.mean(axis=0) - np.array([c * x - s * y, s * x + c * y])
