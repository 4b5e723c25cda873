"""One pose graph over the submaps of all drives of a piece, solved with GTSAM.

Steps along each drive hold always. Anchors, matches with the published map and closures between drives take part or do
not, by graduated non-convexity with truncated least squares (Yang et al., RA-L 2020): a wrong one is left out and
counted, it does not bend the map. Positions from satellites share one error a drive, with a Cauchy loss.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import gtsam
import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.survey.drives import SurveyedDrive
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, log_so3

INLIER_CHI2: Final = 22.5
"""Chi-square with 6 degrees of freedom at 99.9 %."""
FIRST_M, FIRST_RAD = 100.0, 3.0
"""One sigma of where a drive begins before anything is known."""
LEVEL_RAD: Final = np.radians(6.0)
"""One sigma of the slope of a road."""
OFFSET_M: Final = 3.0
"""One sigma of the error that all fixes of a drive share, horizontally; twice as much in height."""
CORRELATION_S: Final = 40.0
"""The rest of a fix's error lives so long (as in `map_build.pose_graph`)."""
_FREE_RAD: Final = 1e3
_ROUNDS: Final = 30
_GROW: Final = 1.6

TieKind = Literal["anchor", "map", "closure"]


@dataclass(frozen=True, slots=True, eq=False)
class SurveyTie:
    """What is believed only if the rest agrees: submap `late` lies at T in the frame of `early`, or of the map.

    Attributes:
        kind: an anchor by the vehicle's localiser, a match with the published map, a closure between two submaps.
        early: node; -1: the working frame.
        late: node.
        T_early_late: (4, 4).
        covariance: (6, 6) at `late`.
    """

    kind: TieKind
    early: int
    late: int
    T_early_late: F64
    covariance: F64


@dataclass(frozen=True, slots=True, eq=False)
class PlacedSubmaps:
    """The solution.

    Attributes:
        T: (N, 4, 4) of the nodes in the working frame.
        covariance: (N, 6, 6) of each, at the node.
        believed: (K,) of the ties.
        offset_m: (D, 3) what the fixes of each drive share.
        fix_offset_m, fix_sigma_m: by drive, how far its fixes lie off horizontally on the average, None without any,
            and how far satellites may.
        strain_of: of each drive, the largest chi-square of a step over its 6 degrees of freedom.
    """

    T: F64
    covariance: F64
    believed: NDArray[np.bool_]
    offset_m: F64
    fix_offset_m: tuple[float | None, ...]
    fix_sigma_m: tuple[float, ...]
    strain_of: tuple[float, ...]


class SurveyGraph:
    """The graph over some drives.

    Args:
        drives: of the piece.
        T_first: (N, 4, 4) of all nodes, drive after drive, as thought before.
        frame: the working frame.
    """

    def __init__(self, drives: Sequence[SurveyedDrive], T_first: F64, frame: LocalFrame) -> None:
        self.drives, self.T_first, self.frame = drives, T_first, frame
        self.drive_of = np.repeat(np.arange(len(drives)), [len(drive) for drive in drives])
        self._starts = np.cumsum([0, *(len(drive) for drive in drives)])
        self._steps = [
            (n - 1, n, node.step)
            for k, drive in enumerate(drives)
            for n, node in enumerate(drive.nodes, start=int(self._starts[k]))
            if node.step is not None
        ]

    def node(self, drive: int, number: int) -> int:
        """The node of the `number`th submap of a drive."""
        return int(self._starts[drive]) + number

    def anchors(self) -> list[SurveyTie]:
        """The anchors of all drives."""
        return [
            SurveyTie("anchor", -1, self.node(k, n), self.frame.T_self_other(LocalFrame.of_tile(one.tile)) @ one.pose.T,
                      one.pose.covariance)
            for k, drive in enumerate(self.drives)
            for n, node in enumerate(drive.nodes)
            for one in node.anchors
        ]  # fmt: skip

    def solve(self, ties: Sequence[SurveyTie]) -> PlacedSubmaps:
        """Place the nodes; ties that cannot be true together with the rest are left out."""
        values = self._first_values()
        weights, shape = np.ones(len(ties)), None
        for _ in range(_ROUNDS):
            values = self._optimised(ties, weights, values)
            chi2 = self._chi2(ties, values)
            if shape is None:
                worst = float(chi2.max(initial=0.0))
                if worst <= INLIER_CHI2:
                    break
                shape = INLIER_CHI2 / max(2.0 * worst - INLIER_CHI2, 1e-9)
            weights = _weights(chi2, shape)
            shape *= _GROW
            if ((weights < 1e-6) | (weights > 1.0 - 1e-6)).all():
                break
        believed = weights > 0.5
        values = self._optimised(ties, believed.astype(np.float64), values)
        return self._solution(ties, believed, values)

    def _first_values(self) -> gtsam.Values:
        values = gtsam.Values()
        for n, T in enumerate(self.T_first):
            values.insert(n, gtsam.Pose3(T))
        for k in range(len(self.drives)):
            values.insert(gtsam.symbol("g", k), gtsam.Pose3())
        return values

    def _optimised(self, ties: Sequence[SurveyTie], weights: F64, values: gtsam.Values) -> gtsam.Values:
        graph = self._graph(ties, weights, values)
        return gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()

    def _graph(self, ties: Sequence[SurveyTie], weights: F64, values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for k in range(len(self.drives)):
            first = int(self._starts[k])
            yaw_free = np.array([LEVEL_RAD, LEVEL_RAD, FIRST_RAD, FIRST_M, FIRST_M, FIRST_M])
            upright = gtsam.Pose3(_upright(self.T_first[first]))
            graph.add(gtsam.PriorFactorPose3(first, upright, gtsam.noiseModel.Diagonal.Sigmas(yaw_free)))
            shared = np.array([1e-6] * 3 + [OFFSET_M, OFFSET_M, 2 * OFFSET_M])
            noise = gtsam.noiseModel.Diagonal.Sigmas(shared)
            graph.add(gtsam.PriorFactorPose3(gtsam.symbol("g", k), gtsam.Pose3(), noise))
            self._add_fixes(graph, k, values)
        for before, now, step in self._steps:
            own = gtsam.noiseModel.Gaussian.Covariance(step.covariance)
            graph.add(gtsam.BetweenFactorPose3(before, now, gtsam.Pose3(step.T), own))
        for tie, weight in zip(ties, weights, strict=True):
            if weight > 1e-6:
                graph.add(_factor(tie, float(weight)))
        return graph

    def _add_fixes(self, graph: gtsam.NonlinearFactorGraph, k: int, values: gtsam.Values) -> None:
        """A fix says where a point of the submap lies in the frame of the drive's satellites, which is shifted."""
        fixes = [(self.node(k, n), fix) for n, node in enumerate(self.drives[k].nodes) for fix in node.fixes]
        if not fixes:
            return
        lasts_s = max((self.drives[k].last_ns - self.drives[k].first_ns) * 1e-9, 1.0)
        worth = min(1.0, (lasts_s / CORRELATION_S + 1.0) / len(fixes))
        for n, fix in fixes:
            R = values.atPose3(n).rotation().matrix()
            seen_m = self.frame.enu_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m)
            T = T_from_R_t(R, seen_m - R @ fix.place_m)
            sigma_m = fix.sigma_m / np.sqrt(worth)
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([_FREE_RAD] * 3 + [sigma_m] * 3))
            robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(2.0), noise)
            graph.add(gtsam.BetweenFactorPose3(gtsam.symbol("g", k), n, gtsam.Pose3(T), robust))

    def _chi2(self, ties: Sequence[SurveyTie], values: gtsam.Values) -> F64:
        return np.array([2.0 * _factor(tie, 1.0).error(values) for tie in ties], np.float64)

    def _solution(self, ties: Sequence[SurveyTie], believed: NDArray[np.bool_], values: gtsam.Values) -> PlacedSubmaps:
        graph = self._graph(ties, believed.astype(np.float64), values)
        marginals = gtsam.Marginals(graph, values)
        n = len(self.T_first)
        T = np.stack([values.atPose3(k).matrix() for k in range(n)])
        strain = [0.0] * len(self.drives)
        for before, now, step in self._steps:
            e = innovation(step.T, T_inverse(T[before]) @ T[now])
            k = int(self.drive_of[now])
            strain[k] = max(strain[k], float(e @ np.linalg.solve(step.covariance, e)) / 6.0)
        off = [self._fix_offset(k, T) for k in range(len(self.drives))]
        return PlacedSubmaps(
            T,
            np.stack([marginals.marginalCovariance(k) for k in range(n)]),
            believed,
            np.stack([values.atPose3(gtsam.symbol("g", k)).translation() for k in range(len(self.drives))]),
            tuple(off_m for off_m, _ in off),
            tuple(sigma_m for _, sigma_m in off),
            tuple(strain),
        )

    def _fix_offset(self, k: int, T: F64) -> tuple[float | None, float]:
        """How far the fixes of a drive lie off where it was placed, and one sigma of how far they may."""
        fixes = [(self.node(k, n), fix) for n, node in enumerate(self.drives[k].nodes) for fix in node.fixes]
        if not fixes:
            return None, OFFSET_M
        off = [
            self.frame.enu_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m)
            - (T[n, :3, :3] @ fix.place_m + T[n, :3, 3])
            for n, fix in fixes
        ]
        sigma_m = float(np.median([fix.sigma_m for _, fix in fixes]))
        return float(np.linalg.norm(np.median(off, axis=0)[:2])), float(np.hypot(OFFSET_M, sigma_m))

    def relative_covariances(self, solved: PlacedSubmaps, ties: Sequence[SurveyTie]) -> "RelativeCovariances":
        """What is known of how two nodes lie to each other, with the ties that were believed."""
        values = self._first_values()
        for n, T in enumerate(solved.T):
            values.update(n, gtsam.Pose3(T))
        for k, offset_m in enumerate(solved.offset_m):
            values.update(gtsam.symbol("g", k), gtsam.Pose3(T_from_R_t(np.eye(3), offset_m)))
        return RelativeCovariances(self._graph(ties, solved.believed.astype(np.float64), values), values)


class RelativeCovariances:
    """Covariances of poses between nodes."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        self._marginals, self._values = gtsam.Marginals(graph, values), values

    def of(self, early: int, late: int) -> F64:
        """(6, 6) of T_early_late, of a small motion at `late`."""
        keys = gtsam.KeyVector([early, late])
        joint = self._marginals.jointMarginalCovariance(keys)
        C = np.block([[joint.at(a, b) for b in (early, late)] for a in (early, late)])
        T = self._values.atPose3(late).between(self._values.atPose3(early))
        J = np.hstack([-T.AdjointMap(), np.eye(6)])
        return np.asarray(J @ C @ J.T)


def innovation(T_expected: F64, T_found: F64) -> F64:
    """(6,) the small motion from one pose to the other: rotation [rad] before translation [m]."""
    off = T_inverse(T_expected) @ T_found
    return np.concatenate([log_so3(off[:3, :3]), off[:3, 3]])


def _weights(chi2: F64, shape: float) -> F64:
    """Weights of graduated truncated least squares: Yang et al., Eq. 14."""
    low, high = shape / (shape + 1.0) * INLIER_CHI2, (shape + 1.0) / shape * INLIER_CHI2
    between = np.sqrt(INLIER_CHI2 * shape * (shape + 1.0) / np.maximum(chi2, 1e-12)) - shape
    return np.asarray(np.where(chi2 <= low, 1.0, np.where(chi2 >= high, 0.0, np.clip(between, 0.0, 1.0))))


def _factor(tie: SurveyTie, weight: float) -> gtsam.NonlinearFactor:
    noise = gtsam.noiseModel.Gaussian.Covariance(tie.covariance / weight)
    T = gtsam.Pose3(tie.T_early_late)
    if tie.early < 0:
        return gtsam.PriorFactorPose3(tie.late, T, noise)
    return gtsam.BetweenFactorPose3(tie.early, tie.late, T, noise)


def _upright(T: F64) -> F64:
    """The pose with its heading and place, level."""
    yaw = np.arctan2(T[1, 0], T[0, 0])
    level = np.eye(4)
    level[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    level[:3, 3] = T[:3, 3]
    return level
