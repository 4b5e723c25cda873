"""Which way the vehicle drives in its own axes, from its first metres: is the mount turned by more than a heading may?

The course that matches with the map teach takes some ten metres to be known; the motion between scans
is good to some tenths of a degree after two or three. Only a turned header is found out by it, none put right.
"""

from typing import Final

import numpy as np

from gnd.vehicle_agent.localise.scan_odometry import ScanStep

GROWN: Final = 1.0
"""Factor on the sigmas of the steps between scans."""
LEVER_M: Final = 1.0
"""How far ahead of the rear axle the vehicle's origin may lie: it moves sideways then where the vehicle turns."""
LEAST_STEP_M: Final = 0.05
ENOUGH_RAD: Final = float(np.radians(0.1))
"""The matches know better from here on."""


class FirstCourse:
    """Feeds on steps between scans."""

    def __init__(self) -> None:
        self._information = 0.0
        self._sum = 0.0

    def see(self, seen: ScanStep | None) -> None:
        """Take the motion between two scans by the scans, if it is known."""
        if seen is None or seen.slipping or self.sigma_rad < ENOUGH_RAD:
            return
        forward_m, left_m = float(seen.T_before_now[0, 3]), float(seen.T_before_now[1, 3])
        if abs(forward_m) < LEAST_STEP_M:
            return
        yaw_rad = float(np.arctan2(seen.T_before_now[1, 0], seen.T_before_now[0, 0]))
        sigma = GROWN * np.sqrt(np.diag(seen.covariance))
        across_m = np.hypot(sigma[4], 0.5 * forward_m * sigma[2])
        variance = float(across_m**2 + (LEVER_M * yaw_rad) ** 2) / forward_m**2
        self._information += 1.0 / variance
        self._sum += (left_m / forward_m - 0.5 * yaw_rad) / variance

    @property
    def course_rad(self) -> float:
        """Direction of driving straight, left of the x axis; 0 while nothing is known."""
        return self._sum / self._information if self._information else 0.0

    @property
    def sigma_rad(self) -> float:
        """One sigma of it, endless while nothing is known."""
        return float(self._information**-0.5) if self._information else float("inf")
