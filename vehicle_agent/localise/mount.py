"""Whether the LiDAR is mounted as the drive's header has it, from the ground around the vehicle while it drives.

The vehicle stands on the ground, so a ground that lies above or below the wheels or is tilted in the vehicle's frame is
a mount that the header has wrong. Single scans see kerbs, ramps and the vehicle's own nodding; many of them agree on
what the mount is off by. What becomes of it: `remount.py`.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.vehicle_agent.importers.mount import (
    CROWN_RAD,
    LANE_WITHIN_M,
    GroundSeen,
    MountRefused,
    ground_of,
    ground_of_scans,
    upright,
)

MountDoubt = Literal["height", "roll", "pitch", "yaw"]
AXES: Final[tuple[MountDoubt, ...]] = ("height", "roll", "pitch")
"""The mount's error as observed on the ground."""

EVERY_NS: Final = 1_000_000_000
FIRST_NS: Final = 200_000_000
"""Until `FIRST_SCANS` have been looked at, one is looked at as often as this: a wrong header is found out at once."""
FIRST_SCANS: Final = 5
KEPT: Final = 60
DOUBTFUL_M, DOUBTFUL_RAD = 0.10, float(np.radians(0.3))
WRONG_M, WRONG_RAD = 0.30, float(np.radians(2.0))
"""By so much the poses themselves are wrong, whatever they match."""
TOLERANCE: Final = np.array([DOUBTFUL_M, DOUBTFUL_RAD, DOUBTFUL_RAD])
WRONG: Final = np.array([WRONG_M, WRONG_RAD, WRONG_RAD])
SIGMAS: Final = 3.0
MOST_POINTS: Final = 15_000
NOD_RAD: Final = float(np.radians(0.3))
"""One sigma of what a vehicle, or its piece of road, leans by at a moment."""


@dataclass(frozen=True, slots=True)
class MountResidual:
    """What the mount is off by against the header (true minus header), one sigma each; endless while not known.

    roll_rad, pitch_rad: about the vehicle's axes, as the header has them.
    """

    height_m: float = 0.0
    height_sigma_m: float = float("inf")
    roll_rad: float = 0.0
    roll_sigma_rad: float = float("inf")
    pitch_rad: float = 0.0
    pitch_sigma_rad: float = float("inf")
    scans: int = 0

    def __post_init__(self) -> None:
        if min(self.height_sigma_m, self.roll_sigma_rad, self.pitch_sigma_rad) <= 0.0 or self.scans < 0:
            raise ValueError(f"positive sigmas are required, got {self}")

    @property
    def values(self) -> F64:
        """(3,) height, roll, pitch."""
        return np.array([self.height_m, self.roll_rad, self.pitch_rad])

    @property
    def sigmas(self) -> F64:
        """(3,) one sigma of each."""
        return np.array([self.height_sigma_m, self.roll_sigma_rad, self.pitch_sigma_rad])

    @property
    def doubtful(self) -> tuple[MountDoubt, ...]:
        """Axes in which the header is certainly wrong, by more than 10 cm or 0.3°."""
        return self._beyond(TOLERANCE)

    @property
    def wrong(self) -> bool:
        """True when poses must be wrong, too, unless it is put right: by more than 30 cm or 2°."""
        return bool(self._beyond(WRONG))

    def _beyond(self, most: F64) -> tuple[MountDoubt, ...]:
        certain = np.abs(self.values) - SIGMAS * self.sigmas > most
        return tuple(name for name, is_so in zip(AXES, certain, strict=True) if is_so)


def near_points(points_lidar_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """Which points (K,) of a scan (N, 3) to look at for the ground: near ones, not too many."""
    near = np.flatnonzero(np.hypot(points_lidar_m[:, 0], points_lidar_m[:, 1]) < LANE_WITHIN_M + 1.0)
    return np.asarray(near[:: 1 + len(near) // MOST_POINTS])


class MountWatch:
    """Feeds on deskewed scans, of which it takes one a second."""

    def __init__(self, T_vehicle_lidar: F64) -> None:
        self._T_lidar_vehicle = T_inverse(T_vehicle_lidar)
        self._R_vehicle_lidar = np.asarray(T_vehicle_lidar[:3, :3], np.float64)
        x_lidar = self._T_lidar_vehicle[:3, 0]
        self._course_rad = float(np.arctan2(x_lidar[1], x_lidar[0]))
        self._height_m = float(T_vehicle_lidar[2, 3])
        self._lane: deque[GroundSeen | MountRefused] = deque(maxlen=KEPT)
        self._around: deque[GroundSeen | MountRefused] = deque(maxlen=KEPT)
        self._looked_ns: int | None = None
        self.residual = MountResidual()

    def due(self, t_ns: int) -> bool:
        """Whether a scan at this time is to be looked at."""
        pause_ns = FIRST_NS if len(self._lane) < FIRST_SCANS else EVERY_NS
        return self._looked_ns is None or not 0 <= t_ns - self._looked_ns < pause_ns

    @property
    def seen(self) -> int:
        """Scans in memory that show the ground."""
        return max(sum(isinstance(one, GroundSeen) for one in every) for every in (self._lane, self._around))

    def see(self, t_ns: int, points_vehicle_m: F64) -> None:
        """Take points (N, 3) of a scan, those of `near_points`, vehicle frame as the header has it, sweep motion
        removed.
        """
        self._looked_ns = t_ns
        points = transform(self._T_lidar_vehicle, points_vehicle_m)
        self._lane.append(ground_of(points, self._course_rad))
        together = ground_of_scans(self._lane)
        if isinstance(together, MountRefused):  # few lasers see little of the lane
            self._around.append(ground_of(points))
            together = ground_of_scans(self._around, CROWN_RAD)
        if isinstance(together, GroundSeen):
            self.residual = self._against_header(together)

    def _against_header(self, ground: GroundSeen) -> MountResidual:
        """The smallest turn about the vehicle's axes that sets its z upright on the ground that was seen."""
        normal = self._R_vehicle_lidar @ upright(ground)[2]
        level = float(np.hypot(normal[0], normal[1]))
        turn = np.arctan2(level, normal[2]) / max(level, 1e-12) * np.array([normal[1], -normal[0]])
        lidar_sigma = np.array([ground.roll_sigma_rad, ground.pitch_sigma_rad])
        variance = np.square(self._R_vehicle_lidar[:2, :2]) @ np.square(lidar_sigma)
        sigma = np.sqrt(variance + NOD_RAD**2 / ground.scans)
        return MountResidual(
            ground.height_m - self._height_m,
            ground.height_sigma_m,
            float(turn[0]),
            float(sigma[0]),
            float(turn[1]),
            float(sigma[1]),
            ground.scans,
        )
