from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.vehicle_agent.features.mapping import graph
from gnd.vehicle_agent.features.mapping.bias_chain import gauss_markov_springs
from gnd.vehicle_agent.features.mapping.dead_reckoning import Steps
from gnd.vehicle_agent.features.mapping.graph import solve
from gnd.vehicle_agent.features.mapping.graph_edges import FixNodes, PoseMatches, Problem, State
from gnd.vehicle_agent.features.mapping.sensors import SERIES_CAR, GnssReceiver


def precision(t_s, sigma, tau):
    springs = gauss_markov_springs(t_s, sigma, tau)
    P = np.diag(springs.prior)
    for k, weight in enumerate(springs.between):
        P[k : k + 2, k : k + 2] += weight * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return P


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0.2, 60.0), min_size=0, max_size=12), st.floats(0.1, 10.0), st.floats(1.0, 100.0))
def test_springs_are_the_gauss_markov_process_whatever_the_steps(steps, sigma, tau):
    t_s = np.concatenate([[0.0], np.cumsum(steps)])
    dense = sigma**2 * np.exp(-np.abs(t_s[:, None] - t_s) / tau)
    np.testing.assert_allclose(precision(t_s, sigma, tau) @ dense, np.eye(len(t_s)), atol=1e-6)


def test_with_equal_steps_the_precision_is_the_one_of_ar1():
    t_s, sigma, tau = np.arange(6.0), 2.0, 5.0
    phi = np.exp(-1.0 / tau)
    q = sigma**2 * (1.0 - phi**2)
    P = precision(t_s, sigma, tau)
    np.testing.assert_allclose(np.diag(P)[1:-1], (1.0 + phi**2) / q)
    np.testing.assert_allclose(np.diag(P, 1), -phi / q)
    np.testing.assert_allclose(gauss_markov_springs(t_s, sigma, tau).prior[1:-1], (1.0 - phi) ** 2 / q)


def test_poses_of_a_standing_vehicle_are_the_generalised_mean_of_its_fixes(monkeypatch):
    """With the poses tied together, the graph weighs fixes by the dense covariance of the process: numpy's answer."""
    n, sigma, tau, white = 8, 2.0, 5.0, 0.3
    xy = np.random.default_rng(1).normal([40.0, -7.0], 2.0, (n, 2))
    t_s = np.arange(n) * 1.5
    cov = sigma**2 * np.exp(-np.abs(t_s[:, None] - t_s) / tau) + white**2 * np.eye(n)
    weights = np.linalg.solve(cov, np.ones(n))
    expected, variance = weights @ xy / weights.sum(), 1.0 / weights.sum()
    still = Steps(np.zeros((n - 1, 3)), np.zeros((n - 1, 3, 2)), np.broadcast_to(1e-6 * np.eye(3), (n - 1, 3, 3)))
    fixes = FixNodes(np.arange(n), t_s, xy, np.full(n, white**2))
    start = State(np.zeros((n, 3)), np.empty((0, 2)), np.zeros(2))
    monkeypatch.setattr(graph, "ROBUST_K", 1e6)
    noise = replace(SERIES_CAR, gnss=GnssReceiver(sigma, tau, white))
    told = _heading_told(Problem(still, np.zeros(2), fixes))
    solution = solve(told, start, noise)
    np.testing.assert_allclose(solution.state.pose[:, :2], np.broadcast_to(expected, (n, 2)), atol=3e-3)
    cov = solution.pose_cov(np.array([3]))[0]
    np.testing.assert_allclose(np.diag(cov)[:2], variance, rtol=1e-3)


def _heading_told(problem):
    heading = PoseMatches(np.array([0]), np.zeros((1, 3)), np.zeros((1, 3)), np.diag([0.0, 0.0, 1e8])[None])
    return replace(problem, lanes=heading)
