"""The pose graph: a fixed-lag smoother over the last seconds of poses."""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.localise.graph_kernels import MATCH, ODOMETRY, SCANS, settle_chain
from gnd.vehicle_agent.localise.parameters import GraphParameters
from gnd.vehicle_agent.localise.scan_odometry import ScanStep

_GNSS_INFLATION: Final = 5.0
"""GNSS errors last for tens of seconds, so a fix's sigma is taken this many times."""
_GNSS_VERTICAL: Final = 2.0
"""Its vertical sigma in horizontal ones."""
GRAPH_ROBUST_K: Final = 2.0
"""Cauchy scale of map matches and GNSS, in sigmas."""

_MOST_STEPS: Final = 10
_STOP_M: Final = 1e-4
_STOP_RAD: Final = 1e-5
"""Of Gauss-Newton: at most so many steps, until no pose moves by so much."""


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


class _KnownPoses(NamedTuple):
    """What is measured of N poses in a row, as `chain_equations` takes it: `measured` (N, 3, 4, 4), `information`
    (N, 3, 6, 6), `fix_m` (N, 3), `fix_information` (N, 3).
    """

    measured: F64
    information: F64
    fix_m: F64
    fix_information: F64

    @classmethod
    def of(
        cls, odometry: OdometryEdge | None, scans: ScanStep | None, match: MapMatch | None, gnss: Position | None
    ) -> "_KnownPoses":
        """Of one pose."""
        known = cls(np.zeros((1, 3, 4, 4)), np.zeros((1, 3, 6, 6)), np.zeros((1, 3)), np.zeros((1, 3)))
        if odometry is not None:
            known.measured[0, ODOMETRY] = odometry.T_before_now
            known.information[0, ODOMETRY] = np.diag(1.0 / np.square(odometry.sigmas))
        if scans is not None:
            known.measured[0, SCANS] = scans.T_before_now
            known.information[0, SCANS] = np.linalg.inv(scans.covariance)
        if match is not None:
            known.measured[0, MATCH] = match.T_map_vehicle
            known.information[0, MATCH] = np.linalg.inv(match.covariance)
        if gnss is not None:
            sigma_m = gnss.sigma_m * _GNSS_INFLATION * np.array([1.0, 1.0, _GNSS_VERTICAL])
            known.fix_m[0], known.fix_information[0] = gnss.p_map_m, 1.0 / sigma_m**2
        return known

    def and_then(self, more: "_KnownPoses") -> "_KnownPoses":
        """These poses, and others behind them."""
        return _KnownPoses(*(np.concatenate(both) for both in zip(self, more, strict=True)))

    def later(self, n: int) -> "_KnownPoses":
        """Without the first n poses."""
        return _KnownPoses(*(of[n:] for of in self))


class _PoseBelief(NamedTuple):
    """What is known of the first pose by all that has left the graph: information (6, 6) and gradient (6,) at a pose
    (4, 4).
    """

    T_map_vehicle: F64
    information: F64
    gradient: F64


class PoseGraph:
    """Poses of the last `lag_s` seconds, tied by odometry, map matches and GNSS; the oldest leave it as final.

    What has left is remembered as a belief about the oldest pose that stays (Schur complement).
    """

    def __init__(self, parameters: GraphParameters) -> None:
        self.parameters = parameters
        self._T, self._covariance = np.empty((0, 4, 4)), np.empty((0, 6, 6))
        self._known = _KnownPoses.of(None, None, None, None).later(1)
        self._belief = _PoseBelief(np.eye(4), np.zeros((6, 6)), np.zeros(6))
        self._t_ns: dict[int, int] = {}
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

        Raises:
            LinAlgError: nothing ties the poses to the map.
        """
        final = self._leaving(t_ns)
        self._known = self._known.and_then(_KnownPoses.of(odometry, scans, match, gnss))
        self._T = np.concatenate([self._T, T_start[None]])
        self._t_ns[self._next] = t_ns
        self._next += 1
        self._settle(len(final))
        return final

    def restart(self, T_map_vehicle: F64, covariance: F64) -> None:
        """Forget everything but the newest pose, and hold that to be (4, 4) with covariance (6, 6)."""
        number = self.newest
        self._t_ns = {number: self._t_ns[number]}
        self._T, self._known = T_map_vehicle[None].copy(), _KnownPoses.of(None, None, None, None)
        information = np.asarray(np.linalg.inv(covariance), np.float64)
        self._belief = _PoseBelief(T_map_vehicle.copy(), information, np.zeros(6))
        self._settle()

    def _settle(self, gone: int = 0) -> None:
        """Let go of the first poses, and place the others anew."""
        self._covariance = np.empty((len(self._T) - gone, 6, 6))
        if not settle_chain(
            self._T, *self._known, *self._belief, gone, GRAPH_ROBUST_K**2, _MOST_STEPS, _STOP_M, _STOP_RAD,
            self._covariance,
        ):  # fmt: skip
            raise np.linalg.LinAlgError(f"the normal equations of {len(self._T)} poses are singular")
        self._T, self._known = self._T[gone:], self._known.later(gone)

    def _leaving(self, now_ns: int) -> list[SmoothedPose]:
        return self._take([n for n, t in self._t_ns.items() if now_ns - t > self.parameters.lag_s * 1e9])

    def flush(self) -> list[SmoothedPose]:
        """All poses still inside, as they stand now; the graph is empty afterwards."""
        return self._take(list(self._t_ns))

    def pose(self, number: int) -> F64:
        """(4, 4) present estimate of a pose inside the lag."""
        return np.array(self._T[self._at(number)])

    def smoothed(self, *numbers: int) -> list[SmoothedPose]:
        """Poses inside the lag with their marginal covariances."""
        return [SmoothedPose(n, self._t_ns[n], self.pose(n), self._covariance[self._at(n)].copy()) for n in numbers]

    def _at(self, number: int) -> int:
        """Where a pose inside the lag stands."""
        return number - (self._next - len(self._T))

    def _take(self, numbers: list[int]) -> list[SmoothedPose]:
        poses = self.smoothed(*numbers)
        for number in numbers:
            del self._t_ns[number]
        return poses
