"""GraphSLAM of a drive in the plane with GTSAM (Kim et al. 2018, sections 3.1 and 3.2).

Nodes are the poses of keyframes, the features, the slow errors of the GNSS, two numbers of the drive, wheel scale and
gyro bias, and of each feature the errors of range and bearing that stay with it. These show in passing: what is
measured too far lies ahead of its place while it comes nearer, and behind it afterwards. Edges are motion (Eq. 1-2),
measurements of features (Eq. 3-5), fixes, and matches with the HD map (Eq. 7-9). The cost is Eq. (6), or Eq. (10) when
there are matches.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import atan2, cos, hypot, pi, sin
from typing import Any

import gtsam
import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.errors import NewLayerError
from gnd.vehicle_agent.features.mapping.bias_chain import gauss_markov_springs
from gnd.vehicle_agent.features.mapping.graph_edges import FixNodes, GraphAnchors, PoseMatches, Problem, State, Ties
from gnd.vehicle_agent.features.mapping.sensors import DriveSensors

CALIBRATION = gtsam.symbol("c", 0)
PINNED_RAD = 1e-3  # sigma of the rotation of what has none
FREE_RAD = 1e4  # sigma of a rotation that is not constrained
ROBUST_K = 3.0  # Huber's k of fixes, measurements and matches with lanes, in sigmas
ITERATIONS = 30
LINEARISATIONS = 10
STAYS = 1e-4  # root mean square step of all numbers (m, rad) below which the optimum has been found


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The optimum of a graph, and what it takes to ask how certain it is."""

    state: State
    cost: float
    """J of Eq. (6) or (10)."""
    _graph: Any = field(repr=False)
    _values: Any = field(repr=False)

    def landmark_cov(self) -> F64:
        """(N, 2, 2) marginal covariances of the features in the map frame."""
        return self._marginals([_l(n) for n in range(len(self.state.xy_m))], 2)

    def pose_cov(self, keys: I64) -> F64:
        """(P, 3, 3) marginal covariances of keyframes (P,), x and y turned into the map frame."""
        found = self._marginals([_x(int(k)) for k in keys], 3)
        R = np.zeros((len(keys), 3, 3))
        yaw = self.state.pose[keys, 2]
        R[:, 0, 0], R[:, 0, 1], R[:, 1, 0], R[:, 1, 1] = np.cos(yaw), -np.sin(yaw), np.sin(yaw), np.cos(yaw)
        R[:, 2, 2] = 1.0
        return np.asarray(R @ found @ R.transpose(0, 2, 1))

    def error_variance(self) -> F64:
        """(N, 2) marginal variances of the errors of range (share) and bearing [rad] that stay with the features."""
        found = self._marginals([_e(n) for n in range(len(self.state.errors))], 2)
        return np.asarray(np.diagonal(found, axis1=1, axis2=2))

    def _marginals(self, keys: list[int], size: int) -> F64:
        with _determined(len(self.state.pose)):
            marginals = gtsam.Marginals(self._graph, self._values)
            return np.array([marginals.marginalCovariance(key) for key in keys]).reshape(-1, size, size)


@contextmanager
def _determined(n_poses: int) -> Iterator[None]:
    """GTSAM's error for a graph that is not determined, under our name."""
    try:
        yield
    except RuntimeError as error:
        what = f"the graph of {n_poses} poses leaves something open, such as the heading of a vehicle that never moved"
        raise NewLayerError(f"{what}: {str(error).strip().splitlines()[0]}") from error


def solve(problem: Problem, start: State, sensors: DriveSensors) -> Solution:
    """Minimise Eq. (6), or with matches Eq. (10), by Levenberg-Marquardt from `start`.

    Raises:
        NewLayerError: the edges leave something open.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    _add_poses(values, start)
    _add_calibration(graph, sensors)
    _add_fixes(graph, values, problem.fixes, start, sensors)
    _add_anchors(graph, problem.anchors)
    own = _motion(problem) + _matches(problem.lanes)
    errs = bool((problem.held > 0.0).all()) and len(start.xy_m) > 0
    if errs:
        _add_errors(graph, values, start, problem.held)
        own += _erring_ties(problem.ties)
    else:
        _add_ties(graph, problem.ties)
    with _determined(len(start.pose)):
        linear, optimum = _optimised(graph, own, values)
    cost = 2.0 * (graph.error(optimum) + sum(factor.error(optimum) for factor in own))  # Eq. (6), (10)
    return Solution(_state(optimum, len(start.pose), len(start.xy_m), errs=errs), cost, linear, optimum)


def pose2(pose: F64) -> Any:
    """A pose (3,) as GTSAM has it."""
    return gtsam.Pose2(float(pose[0]), float(pose[1]), float(pose[2]))


def _x(n: int) -> int:
    return int(gtsam.symbol("x", n))


def _l(n: int) -> int:
    return int(gtsam.symbol("l", n))


def _e(n: int) -> int:
    return int(gtsam.symbol("e", n))


def _b(n: int) -> int:
    return int(gtsam.symbol("b", n))


def _optimised(graph: Any, own: list[Any], values: Any) -> tuple[Any, Any]:
    """The graph as it is linear where our own edges are, and its optimum.

    Own edges are Python, which GTSAM's optimisers call very slowly. So they are linearised here, GTSAM optimises with
    that, and again at the optimum, until it stays.
    """
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(ITERATIONS)
    settings.setRelativeErrorTol(1e-6)
    settings.setAbsoluteErrorTol(1e-6)
    settings.setLinearSolverType("MULTIFRONTAL_QR")  # a standing vehicle's motion is too stiff for Cholesky
    for _ in range(LINEARISATIONS):
        linear, before = gtsam.NonlinearFactorGraph(graph), values
        for factor in own:
            linear.add(gtsam.LinearContainerFactor(factor.linearize(values), values))
        values = gtsam.LevenbergMarquardtOptimizer(linear, values, settings).optimize()
        step = before.localCoordinates(values)
        if step.norm() < STAYS * step.size() ** 0.5:
            break
    return linear, values


def _state(values: Any, n_poses: int, n_landmarks: int, *, errs: bool) -> State:
    poses = [values.atPose2(_x(k)) for k in range(n_poses)]
    return State(
        np.array([(p.x(), p.y(), p.theta()) for p in poses]),
        np.array([values.atPoint2(_l(n)) for n in range(n_landmarks)]).reshape(-1, 2),
        np.array(values.atPoint2(CALIBRATION)),
        np.array([values.atPoint2(_e(n)) for n in range(n_landmarks if errs else 0)]).reshape(-1, 2),
    )


def _add_poses(values: Any, start: State) -> None:
    for k, pose in enumerate(start.pose):
        values.insert(_x(k), pose2(pose))
    for n, xy in enumerate(start.xy_m):
        values.insert(_l(n), xy)
    values.insert(CALIBRATION, start.calibration)


def _motion(problem: Problem) -> list[Any]:
    """Eq. (1)-(2)."""
    factors = []
    rows = zip(problem.steps.delta, problem.steps.jacobian, problem.steps.cov, strict=True)
    for k, (delta, jacobian, cov) in enumerate(rows):
        noise = gtsam.noiseModel.Gaussian.Covariance(cov)
        keys = [_x(k), _x(k + 1), CALIBRATION]
        factors.append(gtsam.CustomFactor(noise, keys, _Motion(delta, jacobian, problem.calibration)))
    return factors


class _Motion:
    """Eq. (1) as GTSAM asks for it: the residual of the motion between two poses."""

    __slots__ = ("at", "by_calibration", "delta", "keys")

    def __init__(self, delta: F64, jacobian: F64, at: F64) -> None:
        self.delta = tuple(delta.tolist())
        self.by_calibration = -jacobian
        self.at = at

    def __call__(self, factor: Any, values: Any, jacobians: list[F64] | None) -> F64:
        before, now, calibration = factor.keys()
        a, b = values.atPose2(before), values.atPose2(now)
        c, s = cos(a.theta()), sin(a.theta())
        dx, dy, turn = b.x() - a.x(), b.y() - a.y(), b.theta() - a.theta()
        ux, uy = c * dx + s * dy, c * dy - s * dx
        if jacobians is not None:
            ct, st = cos(turn), sin(turn)
            jacobians[0] = np.array([[-1.0, 0.0, uy], [0.0, -1.0, -ux], [0.0, 0.0, -1.0]])
            jacobians[1] = np.array([[ct, -st, 0.0], [st, ct, 0.0], [0.0, 0.0, 1.0]])
            jacobians[2] = self.by_calibration
        x, y, yaw = self.delta
        off = (turn - yaw + pi) % (2.0 * pi) - pi
        return np.asarray(
            np.array([ux - x, uy - y, off]) + self.by_calibration @ (values.atPoint2(calibration) - self.at)
        )


def _add_calibration(graph: Any, sensors: DriveSensors) -> None:
    sigmas = np.array([sensors.motion.wheel_scale, sensors.motion.gyro_bias_radps])
    graph.add(gtsam.PriorFactorPoint2(CALIBRATION, np.zeros(2), gtsam.noiseModel.Diagonal.Sigmas(sigmas)))


def _add_fixes(graph: Any, values: Any, fixes: FixNodes, start: State, sensors: DriveSensors) -> None:
    """Fixes hang on poses through the receiver's slow error: pose = error + fix (docs/decisions/0069)."""
    if len(fixes.key) == 0:
        return
    springs = gauss_markov_springs(fixes.t_s, sensors.gnss.sigma_m, sensors.gnss.correlation_s)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(ROBUST_K)
    for n, (key, xy, variance) in enumerate(zip(fixes.key, fixes.xy_m, fixes.variance_m2, strict=True)):
        values.insert(_b(n), pose2(np.array([*(start.pose[key, :2] - xy), 0.0])))
        graph.add(gtsam.PriorFactorPose2(_b(n), gtsam.Pose2(), _spring(springs.prior[n], PINNED_RAD)))
        noise = gtsam.noiseModel.Robust.Create(huber, _spring(1.0 / variance, FREE_RAD))
        # The rotation is not constrained; that it is about right keeps GTSAM's error in metres of the map's axes.
        measured = gtsam.Pose2(xy[0], xy[1], start.pose[key, 2])
        graph.add(gtsam.BetweenFactorPose2(_b(n), _x(int(key)), measured, noise))
    for n, weight in enumerate(springs.between):
        graph.add(gtsam.BetweenFactorPose2(_b(n), _b(n + 1), gtsam.Pose2(), _spring(weight, PINNED_RAD)))


def _spring(information: float, sigma_rad: float) -> Any:
    sigma_m = float(information) ** -0.5
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma_m, sigma_m, sigma_rad]))


def _add_ties(graph: Any, ties: Ties) -> None:
    """Eq. (4)-(5): bearing and range of a feature from a keyframe."""
    huber = gtsam.noiseModel.mEstimator.Huber.Create(ROBUST_K)
    for key, landmark, (bearing, distance), cov in zip(*ties, strict=True):
        noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(cov))
        seen = gtsam.Rot2.fromAngle(bearing)
        graph.add(gtsam.BearingRangeFactor2D(_x(int(key)), _l(int(landmark)), seen, distance, noise))


def _add_errors(graph: Any, values: Any, start: State, held: F64) -> None:
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(held))
    errors = start.errors if len(start.errors) else np.zeros((len(start.xy_m), 2))
    for n, error in enumerate(errors):
        values.insert(_e(n), error)
        graph.add(gtsam.PriorFactorPoint2(_e(n), np.zeros(2), noise))


def _erring_ties(ties: Ties) -> list[Any]:
    """Eq. (4)-(5) of features with errors of their own."""
    huber = gtsam.noiseModel.mEstimator.Huber.Create(ROBUST_K)
    factors = []
    for key, landmark, (bearing, distance), cov in zip(*ties, strict=True):
        noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(cov))
        keys = [_x(int(key)), _l(int(landmark)), _e(int(landmark))]
        factors.append(gtsam.CustomFactor(noise, keys, _ErringTie(float(bearing), float(distance))))
    return factors


class _ErringTie:
    """Eq. (5) as GTSAM asks for it: bearing and range predicted minus measured, with the feature's own errors."""

    __slots__ = ("bearing", "distance")

    def __init__(self, bearing: float, distance: float) -> None:
        self.bearing, self.distance = bearing, distance

    def __call__(self, factor: Any, values: Any, jacobians: list[F64] | None) -> F64:
        key, landmark, error = factor.keys()
        pose, place, (share, turn) = values.atPose2(key), values.atPoint2(landmark), values.atPoint2(error)
        dx, dy, theta = place[0] - pose.x(), place[1] - pose.y(), pose.theta()
        c, s = cos(theta), sin(theta)
        ux, uy = c * dx + s * dy, c * dy - s * dx  # in the vehicle's frame
        r = max(hypot(ux, uy), 1e-3)
        if jacobians is not None:
            scale = (1.0 + share) / r
            bx, by, rx, ry = -uy / r**2, ux / r**2, scale * ux, scale * uy
            jacobians[0] = np.array([[-bx, -by, -1.0], [-rx, -ry, 0.0]])
            jacobians[1] = np.array([[bx * c - by * s, bx * s + by * c], [rx * c - ry * s, rx * s + ry * c]])
            jacobians[2] = np.array([[0.0, 1.0], [r, 0.0]])
        off = (atan2(uy, ux) + turn - self.bearing + pi) % (2.0 * pi) - pi
        return np.array([off, r * (1.0 + share) - self.distance])


def _matches(matches: PoseMatches) -> list[Any]:
    """Eq. (8)-(9); the information may be singular: a direction is then not constrained."""
    huber = gtsam.noiseModel.mEstimator.Huber.Create(ROBUST_K)
    noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Unit.Create(3))
    return [
        gtsam.CustomFactor(noise, [_x(int(key))], _LandmarkMatch(pose2(pose), off, root_of(information)))
        for key, pose, off, information in zip(*matches, strict=True)
    ]


class _LandmarkMatch:
    """Eq. (8) as GTSAM asks for it. A prior at the matched pose would not do: along lanes that constrain little that
    pose may lie far away, and what holds near by does not hold there.
    """

    __slots__ = ("off", "pose", "root")

    def __init__(self, pose: Any, off: F64, root: F64) -> None:
        self.pose, self.off, self.root = pose, off, root

    def __call__(self, factor: Any, values: Any, jacobians: list[F64] | None) -> F64:
        moved = self.pose.between(values.atPose2(factor.keys()[0]))
        if jacobians is not None:
            jacobians[0] = self.root @ gtsam.Pose2.LogmapDerivative(moved)
        return np.asarray(self.root @ (gtsam.Pose2.Logmap(moved) - self.off))


def root_of(information: F64) -> F64:
    """Upper triangular (3, 3) R with R.T @ R = information (3, 3), which may be singular."""
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return np.asarray(np.linalg.qr(root, mode="r"))


def _add_anchors(graph: Any, anchors: GraphAnchors) -> None:
    for landmark, xy, cov in zip(*anchors, strict=True):
        graph.add(gtsam.PriorFactorPoint2(_l(int(landmark)), xy, gtsam.noiseModel.Gaussian.Covariance(cov)))


def bearing_range(xy_m: F64, cov: F64) -> tuple[F64, F64]:
    """(T, 2) bearing and range of points (T, 2) in a keyframe's frame, and their covariances (T, 2, 2)."""
    x, y = xy_m.T
    distance = np.maximum(np.hypot(x, y), 1e-6)
    J = np.stack([np.stack([-y, x], axis=1) / distance[:, None] ** 2, xy_m / distance[:, None]], axis=1)
    return np.stack([np.arctan2(y, x), distance], axis=1), np.asarray(J @ cov @ J.transpose(0, 2, 1))
