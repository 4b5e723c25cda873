"""How well the places of a tile's rays are known: the uncertainty of the poses that its evidence rests on."""

import math
from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.errors import VehicleError
from gnd.vehicle_agent.localise.estimates import PoseEstimate

POINTS_OF_A_SCAN = 1024
"""So many of a scan's points tell how its evidence is shared out among tiles."""


class UncertaintyError(VehicleError):
    """A pose uncertainty that is negative or not finite."""


@dataclass(frozen=True, slots=True)
class PoseUncertainty:
    """One standard deviation of a position and an attitude, and how far away what was seen from there lies.

    Attributes:
        sigma_m: of the position, in its worst direction.
        sigma_rad: of the attitude, about its worst axis.
        range_m: root mean square distance of the points; 0 for one pose, whose rays have each their own.
    """

    sigma_m: float = 0.0
    sigma_rad: float = 0.0
    range_m: float = 0.0

    def __post_init__(self) -> None:
        values = (self.sigma_m, self.sigma_rad, self.range_m)
        if not all(math.isfinite(value) and value >= 0.0 for value in values):
            raise UncertaintyError(f"sigma_m, sigma_rad, range_m = {values}: each must be finite and >= 0")

    @classmethod
    def of(cls, estimate: PoseEstimate) -> "PoseUncertainty":
        """Return that of one pose. A height or a tilt that is known poorly counts as much as a place or a heading: rays
        then seem to pass the road.
        """
        if estimate.covariance is None:
            return cls(estimate.sigma_m, estimate.sigma_rad)
        rotation, position = (
            math.sqrt(max(float(np.linalg.eigvalsh(block)[-1]), 0.0))
            for block in (estimate.covariance[:3, :3], estimate.covariance[3:, 3:])
        )
        return cls(max(position, estimate.sigma_m), max(rotation, estimate.sigma_rad))

    @property
    def of_points_m(self) -> float:
        """Standard deviation of a point at `range_m`: the position's, and the attitude's times the lever."""
        return math.hypot(self.sigma_m, self.range_m * self.sigma_rad)


def poses_step(n: int) -> int:
    """Of n points, every so many tell which tiles a scan sees."""
    return 1 + n // POINTS_OF_A_SCAN


class TileUncertainties:
    """Mean variances of the poses by tile, each scan weighted with the share of its points that ended in the tile."""

    def __init__(self, grid_frame: GridFrame) -> None:
        self._grid_frame = grid_frame
        self._sums: dict[int, F64] = {}  # weight, position and heading variance, squared range, each times weight

    def add_scan(
        self, some_map_m: F64, n: int, origin_map_m: F64, affine: tuple[F64, F64], pose: PoseUncertainty
    ) -> None:
        """Take a scan with n points that are evidence, seen from about `origin_map_m` (3,), map frame.

        Args:
            some_map_m: (K, 3) float64, every `poses_step(n)`-th of them.
            n: how many they are.
            origin_map_m: float64.
            affine: of the grid frame there, `GridFrame.affine`.
            pose: of the scan.
        """
        some, step = some_map_m, poses_step(n)
        if not len(some):
            return
        A, b = affine
        morton, _ = self._grid_frame.tile_voxel_of(np.floor(some @ A.T + b).astype(np.int64))
        codes, member = np.unique(morton, return_inverse=True)
        points = np.bincount(member).astype(np.float64)
        range_m2 = np.bincount(member, weights=((some - origin_map_m) ** 2).sum(axis=1))
        rows = np.column_stack([points, points * pose.sigma_m**2, points * pose.sigma_rad**2, range_m2]) * step
        for code, row in zip(codes.tolist(), rows, strict=True):
            self._sums[code] = self._sums.get(code, np.zeros(4)) + row

    def pop(self, tile_id: TileId) -> PoseUncertainty | None:
        """Take out what is known of a tile; None where no point ended in it."""
        sums = self._sums.pop(tile_id.morton, None)
        if sums is None:
            return None
        m, rad, range_m = np.sqrt(sums[1:] / sums[0]).tolist()
        return PoseUncertainty(m, rad, range_m)

    def mean(self) -> PoseUncertainty:
        """Return the same over all tiles that are held: for a tile that rays only passed through."""
        if not self._sums:
            return PoseUncertainty()
        sums = np.sum(list(self._sums.values()), axis=0)
        m, rad, range_m = np.sqrt(sums[1:] / sums[0]).tolist()
        return PoseUncertainty(m, rad, range_m)
