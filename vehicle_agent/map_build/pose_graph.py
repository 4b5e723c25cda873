"""The graph over all anchors of all drives: odometry along each, loops between passes, GNSS fixes.

Loops and fixes take part or do not, by graduated non-convexity with truncated least squares (Yang et al., RA-L 2020);
the odometry always does, so that a wrong loop is one that it cannot be bent to.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import gtsam
import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, exp_so3, log_so3
from gnd.vehicle_agent.map_build.loops import Loop

STEP_SHARE, STEP_M = 0.01, 0.01
"""One sigma of an odometry step along each axis: of its length, and at least."""
TURN_DEG_ROOT_M: Final = 0.03
"""One sigma of its turn about each axis, in degrees by the root of its length in metres."""
FIRST_M, FIRST_DEG = 10.0, 3.0
"""One sigma of where each drive begins, before anything else is known."""
HELD: Final = 1e-3
"""... of the first drive where no fix is better: it carries the frame."""
GNSS_CORRELATION_S: Final = 40.0
"""Errors of fixes (multipath, ionosphere) live so long: fixes nearer in time count less each."""
INLIER_CHI2: Final = 8.4
"""Half of chi-square with 6 degrees of freedom at 99 %."""


@dataclass(frozen=True, slots=True, eq=False)
class GnssTies:
    """GNSS positions of anchors: numbers (G,), places (G, 3) in the map frame, one sigma (G,) of each, as if they were
    independent of each other.
    """

    anchor: I64
    p_map_m: F64
    sigma_m: F64


@dataclass(frozen=True, slots=True, eq=False)
class SolvedGraph:
    """T (N, 4, 4) of the anchors; which loops (L,) and fixes (G,) were believed."""

    T: F64
    loops: NDArray[np.bool_]
    fixes: NDArray[np.bool_]


def solve(drive: I64, T: F64, loops: Sequence[Loop], fixes: GnssTies) -> SolvedGraph:
    """Place the anchors.

    Args:
        drive: (N,) number of the drive of each anchor, ascending.
        T: (N, 4, 4) their poses by odometry.
        loops: between them.
        fixes: of them.
    """
    known, values = _chains(drive, T, held=not len(fixes.anchor)), gtsam.Values()
    doubted: list[gtsam.NonlinearFactor] = []
    for n, pose in enumerate(T):
        values.insert(n, gtsam.Pose3(pose))
    for loop in loops:
        noise = gtsam.noiseModel.Gaussian.Covariance(loop.covariance)
        doubted.append(gtsam.BetweenFactorPose3(loop.early, loop.late, gtsam.Pose3(loop.T_early_late), noise))
    for n, p, sigma_m in zip(fixes.anchor.tolist(), fixes.p_map_m, fixes.sigma_m, strict=True):
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigma_m * np.array([1.0, 1.0, 2.0]))
        doubted.append(gtsam.GPSFactor(n, p, noise))
    weights = _graduated(known, doubted, values) if doubted else np.zeros(0)
    believed = weights > 0.5
    graph = gtsam.NonlinearFactorGraph(known)
    for factor, taken in zip(doubted, believed, strict=True):
        if taken:
            graph.add(factor)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    solved = np.stack([values.atPose3(n).matrix() for n in range(len(T))])
    return SolvedGraph(solved, believed[: len(loops)], believed[len(loops) :])


def _chains(drive: I64, T: F64, *, held: bool) -> gtsam.NonlinearFactorGraph:
    """Where each drive begins, and its steps."""
    graph = gtsam.NonlinearFactorGraph()
    for n in range(len(T)):
        if n == 0 or drive[n] != drive[n - 1]:
            loose = np.array([np.radians(FIRST_DEG)] * 3 + [FIRST_M] * 3)
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.full(6, HELD) if n == 0 and held else loose)
            graph.add(gtsam.PriorFactorPose3(n, gtsam.Pose3(T[n]), noise))
            continue
        step = T_inverse(T[n - 1]) @ T[n]
        length_m = float(np.linalg.norm(step[:3, 3]))
        turn = np.radians(TURN_DEG_ROOT_M) * np.sqrt(max(length_m, 1.0))
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([turn] * 3 + [STEP_M + STEP_SHARE * length_m] * 3))
        graph.add(gtsam.BetweenFactorPose3(n - 1, n, gtsam.Pose3(step), noise))
    return graph


def _graduated(
    known: gtsam.NonlinearFactorGraph, doubted: Sequence[gtsam.NonlinearFactor], values: gtsam.Values
) -> F64:
    """Weight (0 ... 1) of each doubted factor at the optimum."""
    graph = gtsam.NonlinearFactorGraph(known)
    for factor in doubted:
        graph.add(factor)
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(list(range(known.size())))
    optimizer = gtsam.GncLMOptimizer(graph, values, parameters)
    optimizer.setInlierCostThresholds(INLIER_CHI2)
    optimizer.optimize()
    return np.asarray(optimizer.getWeights())[known.size() :]


def bent(poses: Trajectory, anchor_ns: I64, T_old: F64, T_new: F64) -> Trajectory:
    """A track moved with its anchors: each pose goes with the anchors before and after it, blended by time.

    Args:
        poses: the whole track.
        anchor_ns: (K,) times of its anchors, ascending, at least one.
        T_old: (K, 4, 4) where they were.
        T_new: (K, 4, 4) where they are now.
    """
    after = np.clip(np.searchsorted(anchor_ns, poses.t_ns), 1, max(len(anchor_ns) - 1, 1)).clip(0, len(anchor_ns) - 1)
    before = np.maximum(after - 1, 0)
    span = np.maximum(anchor_ns[after] - anchor_ns[before], 1)
    share = np.clip((poses.t_ns - anchor_ns[before]) / span, 0.0, 1.0)
    A, B = (T_new[k] @ T_inverse(T_old[k]) @ poses.T_dst_vehicle for k in (before, after))
    T = A.copy()
    turn = log_so3(np.swapaxes(A[:, :3, :3], 1, 2) @ B[:, :3, :3])
    T[:, :3, :3] = A[:, :3, :3] @ exp_so3(share[:, None] * turn)
    T[:, :3, 3] += share[:, None] * (B[:, :3, 3] - A[:, :3, 3])
    return Trajectory(poses.t_ns, T)
