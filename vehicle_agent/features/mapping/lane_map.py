"""The HD map's lanes made ready for matching: sampled every 0.1 m as in Kim et al. 2018, section 5.1."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnd.extras import explained
from gnd.gnd_map.arrays import F64, I64, check_array
from gnd.vehicle_agent.errors import NewLayerError

SAMPLE_M = 0.1
RIBBON_M = (-0.05, 0.05)
"""Heights that lanes are lifted to for GICP: as ribbons their covariances are flat along the lane and upright, not
along the lane and across. In the plane alone, the thinnest direction would be the height."""
NEIGHBOURS = 12  # of a sample, for its covariance: 0.3 m to either side, on both heights
CLOSED_M = 0.5  # a lane whose ends are nearer than this goes round
FOOT_STEPS = 4


class Feet(NamedTuple):
    """Nearest places on lanes, for (...,) points."""

    xy_m: F64
    """(..., 2)"""
    normal: F64
    """(..., 2) to the left of the lane."""
    off_m: F64
    """(...,) the point lies so far along the normal."""
    valid: NDArray[np.bool_]
    """(...,) False beyond the lane's ends."""


@dataclass(frozen=True, slots=True, eq=False)
class LaneMap:
    """Lanes as S samples, lane after lane.

    xy_m: (S, 2). tangent: (S, 2). first, count: (L,) rows of each lane. closed: (L,) bool.
    """

    xy_m: F64
    tangent: F64
    first: I64
    count: I64
    closed: NDArray[np.bool_]
    _trees: tuple[Any, ...] = field(repr=False)

    @classmethod
    def of(cls, lanes: Sequence[F64]) -> "LaneMap":
        """Sample polylines (N, 2), N >= 2, in the map frame.

        Raises:
            NewLayerError: a lane is shorter than a sample.
            ShapeError: a lane is no polyline.
        """
        sampled = [_sampled(n, lane) for n, lane in enumerate(lanes)]
        if not sampled:
            raise NewLayerError("an HD map without lanes cannot be matched: pass None instead")
        count = np.array([len(lane) for lane in sampled], np.int64)
        closed = np.array([np.hypot(*(lane[0] - lane[-1])) < CLOSED_M for lane in sampled])
        tangents = [_tangents(lane) for lane in sampled]
        return cls(
            np.concatenate(sampled),
            np.concatenate(tangents),
            np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int64),
            count,
            closed,
            tuple(cKDTree(lane) for lane in sampled),
        )

    def __len__(self) -> int:
        return len(self.count)

    def nearest(self, lane: int, xy_m: F64, within_m: float) -> tuple[F64, I64]:
        """(N,) distance and sample of a lane nearest to points (N, 2); inf where it is farther than `within_m`."""
        distance, sample = self._trees[lane].query(xy_m, distance_upper_bound=within_m)
        return distance, np.minimum(sample, self.count[lane] - 1).astype(np.int64)

    def feet(self, lane: I64, start: F64, xy_m: F64) -> Feet:
        """The nearest places on lanes (...,) to points (..., 2), looked for from samples `start` (...,) on."""
        at, n = start, self.count[lane]
        for _ in range(FOOT_STEPS):
            row = self.first[lane] + np.clip(np.rint(self._around(lane, at)), 0, n - 1).astype(np.int64)
            ahead = ((xy_m - self.xy_m[row]) * self.tangent[row]).sum(axis=-1)
            at = np.clip(np.rint(self._around(lane, at)), -1, n) + ahead / SAMPLE_M
        normal = np.stack([-self.tangent[row][..., 1], self.tangent[row][..., 0]], axis=-1)
        foot = self.xy_m[row] + ahead[..., None] * self.tangent[row]
        off = ((xy_m - foot) * normal).sum(axis=-1)
        return Feet(foot, normal, off, np.abs(ahead) < 2.0 * SAMPLE_M)

    def _around(self, lane: I64, at: F64) -> F64:
        """Samples of lanes that go round, brought back to 0 … count."""
        return np.where(self.closed[lane], at % self.count[lane], at)

    def near(self, xy_m: F64, reach_m: float) -> F64:
        """(N, 2) samples of all lanes that pass a point (2,), so far along them to either side."""
        parts = [self.stretch(lane, xy_m, reach_m) for lane in range(len(self))]
        return np.concatenate(parts)

    def stretch(self, lane: int, xy_m: F64, reach_m: float) -> F64:
        """(N, 2) samples of a lane so far to either side of where it passes a point (2,); none if it is farther."""
        distance, sample = self.nearest(lane, xy_m[None], reach_m)
        if not np.isfinite(distance[0]):
            return np.empty((0, 2))
        n, reach = int(self.count[lane]), round(reach_m / SAMPLE_M)
        rows = np.arange(int(sample[0]) - reach, int(sample[0]) + reach)
        rows = np.unique(rows % n) if self.closed[lane] else rows[(rows >= 0) & (rows < n)]
        return np.asarray(self.xy_m[self.first[lane] + rows])


def _sampled(n: int, lane: F64) -> F64:
    check_array(f"lane {n}", lane, np.float64, (None, 2))
    steps = np.hypot(*np.diff(lane, axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    if way[-1] < 2.0 * SAMPLE_M:
        raise NewLayerError(f"lane {n} of the HD map is {way[-1]:.3f} m long, expected at least {2.0 * SAMPLE_M} m")
    at = np.arange(0.0, way[-1], SAMPLE_M)
    return np.stack([np.interp(at, way, column) for column in lane.T], axis=1)


def _tangents(lane: F64) -> F64:
    ahead = np.gradient(lane, axis=0)
    return np.asarray(ahead / np.maximum(np.hypot(*ahead.T), 1e-12)[:, None])


def ribbon(xy_m: F64) -> F64:
    """(2 N, 3) points (N, 2) of lanes as upright ribbons."""
    return np.concatenate([np.column_stack([xy_m, np.full(len(xy_m), z)]) for z in RIBBON_M])


def gicp(target_xy_m: F64, source_xy_m: F64, pose: F64, max_correspondence_m: float) -> F64 | None:
    """Match lanes as seen with those of the map by generalised ICP: Eq. (8); None when it does not settle.

    Args:
        target_xy_m: (N, 2) samples of the map's lanes.
        source_xy_m: (M, 2) samples of the lanes in the vehicle frame.
        pose: (3,) first guess, the vehicle in the map frame.
        max_correspondence_m: farther points are no pair.

    Returns:
        (3,) the pose. Along straight lanes it stays with the first guess.

    Raises:
        MissingExtra: `gnd-fleet[lanes]` is not installed.
    """
    with explained():
        import small_gicp
    origin = pose[:2]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    target, source = (small_gicp.PointCloud(ribbon(xy)) for xy in (target_xy_m - origin, source_xy_m))
    tree = small_gicp.KdTree(target)
    small_gicp.estimate_covariances(target, tree, NEIGHBOURS)
    small_gicp.estimate_covariances(source, None, NEIGHBOURS)
    found = small_gicp.align(
        target, source, tree, T, registration_type="GICP", max_correspondence_distance=max_correspondence_m
    )
    if not found.converged or found.num_inliers < 0.5 * source.size():
        return None
    T = found.T_target_source
    return np.array([*(T[:2, 3] + origin), np.arctan2(T[1, 0], T[0, 0])])
