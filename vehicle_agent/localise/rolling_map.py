"""The last scans as a map: Gaussians in a dense window of 1 m voxels that rolls along in a drifting odometry frame."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.localise.kernels import tapered_information
from gnd.vehicle_agent.localise.match_map import UNIFORM_VOXEL_M2, MatchMap
from gnd.vehicle_agent.localise.rolling_kernels import SUMS, add_points, move_window, refresh

_HEIGHT_M: Final = 28.0
_BELOW_M: Final = 8.0
"""The window's height, and how much of that lies below the vehicle."""
ROLLING_REACH_M: Final = 60.0
"""The window's half side."""
ROLLING_MAX_VOXELS: Final = 8192
"""Room for so many."""
ROLLING_KEEP_SCANS: Final = 20
"""A voxel not seen in so many added scans is forgotten when the window moves."""
ROLLING_MOVE_M: Final = 8.0
"""The window moves when the vehicle is so far from its middle."""
_FADE: Final = 0.9
"""What a voxel's points count for each later scan that sees it."""
_MIN_CELLS: Final = 6
"""So many of 64 sub-cells must have been hit."""
_LINE_RATIO: Final = 0.1
_UPRIGHT: Final = 0.7
"""A Gaussian whose second variance is less than this share of the first is one ring, unless it is a post (cosine to the
vertical)."""

VOXEL_M = 1.0  # what UNIFORM_VOXEL_M2 and the registration's scales are measured for


class RollingMap:
    """Takes the points of scan after scan, in metres in the odometry frame; what is not seen again is forgotten."""

    def __init__(
        self,
        noise_m: float,
        *,
        reach_m: float = ROLLING_REACH_M,
        max_voxels: int = ROLLING_MAX_VOXELS,
        keep_scans: int = ROLLING_KEEP_SCANS,
    ) -> None:
        self._keep_scans = keep_scans
        self.noise_m = noise_m
        side, height = 2 * round(reach_m / VOXEL_M), round(_HEIGHT_M / VOXEL_M)
        rows = max_voxels
        self._index = np.full((side, side, height), -1, np.int32)
        self._origin = np.zeros(3, np.int64)
        self._voxel, self._last = np.zeros((rows, 3), np.int32), np.zeros(rows, np.int32)
        self._mask, self._sums = np.zeros(rows, np.uint64), np.zeros((rows, SUMS))
        self._mean, self._information = np.zeros((rows, 3)), np.zeros((rows, 6))
        self._touched = np.zeros(rows, np.int64)
        self._used = self._calls = 0

    def __len__(self) -> int:
        """Voxels in which something was seen."""
        return self._used

    @property
    def scans(self) -> int:
        """Scans added since the last `clear`."""
        return self._calls

    def clear(self, p_odom_m: F64) -> None:
        """Forget everything; the window is laid around the vehicle at `p_odom_m` (3,)."""
        self._index[:] = -1
        self._used = self._calls = 0
        self._origin = self._around(p_odom_m)

    def add(self, points_odom_m: F64, p_odom_m: F64) -> None:
        """Take a scan's points (N, 3), seen by the vehicle at `p_odom_m` (3,)."""
        self._follow(p_odom_m)
        self._calls += 1
        self._used, n = add_points(
            points_odom_m, 1.0 / VOXEL_M, self._origin, _FADE, self._calls, self._used, self._index,
            self._voxel, self._last, self._mask, self._sums, self._touched,
        )  # fmt: skip
        self._refresh(self._touched[:n])

    def match_map(self) -> MatchMap:
        """The map as it stands, ready for registration; what it holds changes with the next `add`."""
        n = max(self._used, 1)
        A, b = np.eye(3) / VOXEL_M, -self._origin.astype(np.float64)
        return MatchMap(self._index, A, b, self._mean[:n], self._information[:n])

    def _refresh(self, rows: NDArray[np.int64]) -> None:
        cov, information = np.empty((len(rows), 6)), np.empty((len(rows), 6))
        refresh(
            rows, 1.0 / VOXEL_M, self._origin, _MIN_CELLS, _LINE_RATIO, _UPRIGHT, self._voxel, self._mask,
            self._sums, self._index, self._mean, cov,
        )  # fmt: skip
        tapered_information(cov, self.noise_m**2, UNIFORM_VOXEL_M2, information)
        self._information[rows] = information

    def _follow(self, p_odom_m: F64) -> None:
        """Move the window when the vehicle has left its middle, or when there is no room for another scan."""
        origin = self._around(p_odom_m)
        full = self._used > 0.8 * len(self._mask)
        if not full and np.abs(origin - self._origin).max() * VOXEL_M < ROLLING_MOVE_M:
            return
        oldest = self._calls - self._keep_scans
        self._used = move_window(
            self._origin, origin, oldest, self._used, self._index, self._voxel, self._last, self._mask, self._sums,
            self._mean, self._information,
        )  # fmt: skip
        self._origin = origin

    def _around(self, p_odom_m: F64) -> NDArray[np.int64]:
        below = round(_BELOW_M / VOXEL_M)
        half = np.array([self._index.shape[0] // 2, self._index.shape[1] // 2, below])
        return np.asarray(np.floor(p_odom_m / VOXEL_M).astype(np.int64) - half)
