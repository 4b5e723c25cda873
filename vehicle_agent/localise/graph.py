"""The pose graph: a fixed-lag smoother over the last seconds of poses (GTSAM, built-in factors only)."""

from dataclasses import dataclass
from typing import Final, NamedTuple

import gtsam
import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.localise.parameters import GraphParameters
from gnd.vehicle_agent.localise.scan_odometry import ScanStep

_GNSS_INFLATION: Final = 5.0
"""GNSS errors last for tens of seconds, so a fix's sigma is taken this many times."""
_GNSS_VERTICAL: Final = 2.0
"""Its vertical sigma in horizontal ones."""
GRAPH_ROBUST_K: Final = 2.0
"""Cauchy scale of map matches and GNSS, in sigmas."""

SLACK_S = 0.01


class OdometryEdge(NamedTuple):
    """Motion since the pose before: (4, 4), and (6,) sigmas, rotation [rad] first, translation [m]."""

    T_before_now: F64
    sigmas: F64


class MapMatch(NamedTuple):
    """The pose that the map gives: (4, 4), and covariance (6, 6), rotation first, vehicle frame."""

    T_map_vehicle: F64
    covariance: F64


class Position(NamedTuple):
    """The vehicle's position by GNSS: (3,) in the map frame, and the sigma of a horizontal axis."""

    p_map_m: F64
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedPose:
    """A pose of the graph.

    Attributes:
        number, t_ns: of its scan.
        T_map_vehicle: (4, 4).
        covariance: (6, 6), rotation first, vehicle frame.
        certain: submaps leave no doubt about it.
        axle_variance: of the direction in which the rear axle drives [rad²], where it is known better than that of the
            LiDAR.
    """

    number: int
    t_ns: int
    T_map_vehicle: F64
    covariance: F64
    certain: bool = False
    axle_variance: float | None = None


class PoseGraph:
    """Poses of the last `lag_s` seconds, tied by odometry, map matches and GNSS; the oldest leave it as final."""

    def __init__(self, parameters: GraphParameters) -> None:
        self.parameters = parameters
        # A little longer than our lag, so that a pose is taken out before the smoother forgets it.
        self._smoother = gtsam.BatchFixedLagSmoother(parameters.lag_s + SLACK_S)
        self._solved: tuple[gtsam.Values, gtsam.Marginals] | None = None  # since the last update
        self._t_ns: dict[int, int] = {}
        self._first_ns = 0
        self._next = 0

    def __len__(self) -> int:
        return len(self._t_ns)

    @property
    def newest(self) -> int:
        """Number of the newest pose."""
        return self._next - 1

    def add(
        self,
        t_ns: int,
        T_start: F64,
        odometry: OdometryEdge | None,
        match: MapMatch | None,
        gnss: Position | None,
        scans: ScanStep | None = None,
    ) -> list[SmoothedPose]:
        """Add the pose at `t_ns`, optimisation starting at `T_start` (4, 4); give the poses that leave the lag, oldest
        first. The first pose has no odometry.
        """
        number, factors, values = self._next, gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(number, gtsam.Pose3(T_start))
        if odometry is not None:
            drift = gtsam.noiseModel.Diagonal.Sigmas(odometry.sigmas)
            factors.add(gtsam.BetweenFactorPose3(number - 1, number, gtsam.Pose3(odometry.T_before_now), drift))
        if scans is not None:
            seen = self._robust(gtsam.noiseModel.Gaussian.Covariance(scans.covariance))
            factors.add(gtsam.BetweenFactorPose3(number - 1, number, gtsam.Pose3(scans.T_before_now), seen))
        if match is not None:
            noise = self._robust(gtsam.noiseModel.Gaussian.Covariance(match.covariance))
            factors.add(gtsam.PriorFactorPose3(number, gtsam.Pose3(match.T_map_vehicle), noise))
        if gnss is not None:
            factors.add(gtsam.GPSFactor(number, gnss.p_map_m, self._gnss_noise(gnss.sigma_m)))
        final = self._leaving(t_ns)
        if number == 0:
            self._first_ns = t_ns
        self._t_ns[number] = t_ns
        self._next += 1
        self._smoother.update(factors, values, {number: (t_ns - self._first_ns) * 1e-9})
        self._solved = None
        return final

    def restart(self, T_map_vehicle: F64, covariance: F64) -> None:
        """Forget everything but the newest pose, and hold that to be (4, 4) with covariance (6, 6)."""
        number, factors, values = self.newest, gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = gtsam.Pose3(T_map_vehicle)
        values.insert(number, pose)
        factors.add(gtsam.PriorFactorPose3(number, pose, gtsam.noiseModel.Gaussian.Covariance(covariance)))
        self._t_ns = {number: self._t_ns[number]}
        self._smoother = gtsam.BatchFixedLagSmoother(self.parameters.lag_s + SLACK_S)
        self._smoother.update(factors, values, {number: (self._t_ns[number] - self._first_ns) * 1e-9})
        self._solved = None

    def _leaving(self, now_ns: int) -> list[SmoothedPose]:
        return self._take([n for n, t in self._t_ns.items() if now_ns - t > self.parameters.lag_s * 1e9])

    def flush(self) -> list[SmoothedPose]:
        """All poses still inside, as they stand now; the graph is empty afterwards."""
        return self._take(list(self._t_ns))

    def pose(self, number: int) -> F64:
        """(4, 4) present estimate of a pose inside the lag."""
        return np.asarray(self._smoother.calculateEstimatePose3(number).matrix())

    def smoothed(self, *numbers: int) -> list[SmoothedPose]:
        """Poses inside the lag with their marginal covariances."""
        if not numbers:
            return []
        if self._solved is None:
            estimate = self._smoother.calculateEstimate()
            self._solved = estimate, gtsam.Marginals(self._smoother.getFactors(), estimate)
        poses, marginals = self._solved
        return [
            SmoothedPose(n, self._t_ns[n], poses.atPose3(n).matrix(), np.asarray(marginals.marginalCovariance(n)))
            for n in numbers
        ]

    def _take(self, numbers: list[int]) -> list[SmoothedPose]:
        poses = self.smoothed(*numbers)
        for number in numbers:
            del self._t_ns[number]
        return poses

    def _gnss_noise(self, sigma_m: float) -> gtsam.noiseModel.Base:
        axes = np.array([1.0, 1.0, _GNSS_VERTICAL])
        return self._robust(gtsam.noiseModel.Diagonal.Sigmas(sigma_m * _GNSS_INFLATION * axes))

    def _robust(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(GRAPH_ROBUST_K)
        return gtsam.noiseModel.Robust.Create(cauchy, noise)
