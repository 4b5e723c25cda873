"""The graph with GTSAM against scipy's least squares of the same errors, written down once more."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from gnd.vehicle_agent.features.mapping import graph
from gnd.vehicle_agent.features.mapping.dead_reckoning import Steps, composed, relative
from gnd.vehicle_agent.features.mapping.graph import root_of, solve
from gnd.vehicle_agent.features.mapping.graph_edges import FixNodes, GraphAnchors, PoseMatches, Problem, State, Ties
from gnd.vehicle_agent.features.mapping.sensors import SERIES_CAR, GnssReceiver
from gnd.vehicle_agent.features.view import wrapped

K, N = 6, 3
QUIET = replace(SERIES_CAR, gnss=GnssReceiver(2.0, 8.0, 1.0))


@pytest.fixture(autouse=True)
def no_outliers(monkeypatch):
    """No edge is far enough off for Huber to matter."""
    monkeypatch.setattr(graph, "ROBUST_K", 1e6)


def problem():
    rng = np.random.default_rng(5)
    pose = np.cumsum(np.tile([[5.0, 0.6, 0.12]], (K, 1)), axis=0)
    xy = np.array([[10.0, 9.0], [22.0, -4.0], [30.0, 12.0]])
    delta = relative(pose[:-1], pose[1:]) + rng.normal(0.0, [0.1, 0.05, 0.01], (K - 1, 3))
    jacobian = np.zeros((K - 1, 3, 2))
    jacobian[:, 0, 0], jacobian[:, 2, 1], jacobian[:, 1, 1] = 5.0, -0.5, -1.2
    a = rng.normal(0.0, 0.05, (K - 1, 3, 3))
    cov = np.diag([0.01, 0.004, 1e-4]) + a @ a.transpose(0, 2, 1) * [[1.0, 1.0, 0.1], [1.0, 1.0, 0.1], [0.1, 0.1, 0.01]]
    fixes = FixNodes(np.array([0, 2, 5]), np.array([0.0, 3.0, 7.0]), pose[[0, 2, 5], :2] + rng.normal(0, 1.5, (3, 2)),
                     np.array([0.3, 0.2, 0.4]))  # fmt: skip
    key, landmark = np.array([0, 1, 2, 2, 4, 5]), np.array([0, 0, 1, 2, 1, 2])
    seen = relative(pose[key], np.column_stack([xy[landmark], np.zeros(6)]))
    polar = np.column_stack([np.arctan2(seen[:, 1], seen[:, 0]), np.hypot(seen[:, 0], seen[:, 1])])
    polar = polar + rng.normal(0.0, [0.02, 0.4], (6, 2))
    ties = Ties(key, landmark, polar, np.tile([[4e-4, 1e-3], [1e-3, 0.2]], (6, 1, 1)))
    information = np.zeros((2, 3, 3))
    information[:, 1:, 1:] = [[25.0, 3.0], [3.0, 900.0]]
    lanes = PoseMatches(np.array([1, 4]), pose[[1, 4]], rng.normal(0.0, [0.0, 0.2, 0.02], (2, 3)), information)
    anchors = GraphAnchors(np.array([1]), xy[[1]] + 0.3, np.array([[[0.5, 0.1], [0.1, 0.3]]]))
    start = State(
        pose + rng.normal(0.0, 0.3, pose.shape) * [1, 1, 0.1], xy + rng.normal(0.0, 0.5, xy.shape), np.zeros(2)
    )
    return Problem(Steps(delta, jacobian, cov), np.array([1e-3, -1e-3]), fixes, ties, lanes, anchors=anchors), start


def white(cov):
    return np.linalg.inv(np.linalg.cholesky(cov))


def logarithm(a, b):
    d = relative(a, b)
    half = 0.5 * d[2]
    f = half / np.tan(half) if abs(half) > 1e-9 else 1.0
    return np.array([f * d[0] + half * d[1], -half * d[0] + f * d[1], d[2]])


def errors(x, p):
    pose, xy = x[: 3 * K].reshape(K, 3), x[3 * K : 3 * K + 2 * N].reshape(N, 2)
    c, own = x[3 * K + 2 * N : 3 * K + 2 * N + 2], np.zeros((N, 2))
    if p.held.any():
        own = x[3 * K + 2 * N + 2 :].reshape(N, 2)
    out = [(own / np.sqrt(p.held)).ravel()] if p.held.any() else []
    out += [c / [QUIET.motion.wheel_scale, QUIET.motion.gyro_bias_radps]]
    off = relative(pose[:-1], pose[1:]) - p.steps.delta - p.steps.jacobian @ (c - p.calibration)
    out += [white(S) @ [d[0], d[1], wrapped(d[2])] for d, S in zip(off, p.steps.cov, strict=True)]
    g, t = QUIET.gnss, p.fixes.t_s
    dense = g.sigma_m**2 * np.exp(-np.abs(t[:, None] - t) / g.correlation_s) + np.diag(p.fixes.variance_m2)
    out += [white(dense) @ axis for axis in (pose[p.fixes.key, :2] - p.fixes.xy_m).T]
    for key, n, (bearing, distance), S in zip(*p.ties, strict=True):
        d = relative(pose[key], np.array([*xy[n], 0.0]))
        seen = np.arctan2(d[1], d[0]) + own[n, 1], np.hypot(d[0], d[1]) * (1.0 + own[n, 0])
        out.append(white(S) @ [wrapped(seen[0] - bearing), seen[1] - distance])
    for key, base, o, information in zip(*p.lanes, strict=True):
        out.append(root_of(information) @ (logarithm(base, pose[key]) - o))
    out += [white(S) @ (xy[n] - place) for n, place, S in zip(*p.anchors, strict=True)]
    return np.concatenate(out)


def oracle(p, start):
    own = np.zeros(2 * N if p.held.any() else 0)
    x0 = np.concatenate([start.pose.ravel(), start.xy_m.ravel(), start.calibration, own])
    return least_squares(errors, x0, args=(p,), xtol=1e-14, ftol=1e-14, gtol=1e-12)


@pytest.mark.parametrize("held", [(0.0, 0.0), (0.05**2, 0.02**2)])
def test_optimum_and_covariances_are_those_of_scipy(held):
    """Without and with errors of range (share) and bearing that stay with each feature."""
    p, start = problem()
    p = replace(p, held=np.array(held))
    found, expected = solve(p, start, QUIET), oracle(p, start)
    pose, xy = expected.x[: 3 * K].reshape(K, 3), expected.x[3 * K : 3 * K + 2 * N].reshape(N, 2)
    np.testing.assert_allclose(found.state.pose, pose, atol=1e-4)
    np.testing.assert_allclose(found.state.xy_m, xy, atol=1e-4)
    first = 3 * K + 2 * N
    np.testing.assert_allclose(found.state.calibration, expected.x[first : first + 2], atol=1e-6)
    np.testing.assert_allclose(found.state.errors.ravel(), expected.x[first + 2 :], atol=1e-5)
    cov = np.linalg.inv(expected.jac.T @ expected.jac)
    for n in range(N):
        rows = slice(3 * K + 2 * n, 3 * K + 2 * n + 2)
        np.testing.assert_allclose(found.landmark_cov()[n], cov[rows, rows], rtol=2e-3, atol=1e-6)
    np.testing.assert_allclose(found.error_variance().ravel(), np.diag(cov)[first + 2 :], rtol=2e-3, atol=1e-8)
    for k in range(K):
        rows = slice(3 * k, 3 * k + 3)
        np.testing.assert_allclose(found.pose_cov(np.array([k]))[0], cov[rows, rows], rtol=5e-3, atol=1e-6)


def test_cost_is_the_sum_of_the_edges():
    """Eq. (10); less the lanes it is Eq. (6). The chain of the GNSS costs the same as the dense covariance."""
    p, start = problem()
    for q in (p, replace(p, lanes=PoseMatches(*(column[:0] for column in p.lanes)))):
        assert np.isclose(solve(q, start, QUIET).cost, 2.0 * oracle(q, start).cost, rtol=1e-4)


def test_a_far_start_finds_the_same_optimum():
    p, start = problem()
    far = State(composed(np.tile([4.0, -6.0, 0.5], (K, 1)), start.pose), start.xy_m + 5.0, start.calibration)
    np.testing.assert_allclose(solve(p, far, QUIET).state.pose, solve(p, start, QUIET).state.pose, atol=1e-3)


def test_root_of_a_singular_information():
    information = np.zeros((3, 3))
    information[1:, 1:] = [[4.0, 1.0], [1.0, 9.0]]
    R = root_of(information)
    np.testing.assert_allclose(R.T @ R, information, atol=1e-12)
    np.testing.assert_allclose(np.tril(R, -1), 0.0, atol=1e-12)
