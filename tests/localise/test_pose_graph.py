"""The fixed-lag graph: what it fuses, what it does not believe, and when poses leave it."""

import gtsam
import numpy as np
import pytest

from gnd.gnd_map.se3 import exp_so3
from gnd.vehicle_agent.localise.graph import GRAPH_ROBUST_K, MapMatch, OdometryEdge, PoseGraph, Position
from gnd.vehicle_agent.localise.parameters import GraphParameters
from gnd.vehicle_agent.localise.scan_odometry import ScanStep

STEP_NS = 100_000_000
SIGMAS = np.array([3e-3, 3e-3, 6e-4, 0.01, 0.01, 0.02])
MATCH_COVARIANCE = np.diag([5e-4] * 3 + [0.015] * 3) ** 2


def true_pose(k):
    T = np.eye(4)
    T[:3, :3] = exp_so3([0.0, 0.0, 0.02 * k])
    T[:3, 3] = 0.9 * k, 0.01 * k * k, 0.02 * k
    return T


def step(k):
    return np.linalg.inv(true_pose(k - 1)) @ true_pose(k)


def noisy(rng, T, shift=0.015, turn=5e-4):
    N = np.eye(4)
    N[:3, :3], N[:3, 3] = exp_so3(rng.normal(0, turn, 3)), rng.normal(0, shift, 3)
    return T @ N


def run(n=60, matched=lambda k: True, match=None, gnss=None, lag_s=2.0, seed=0):
    """Final poses of a drive: exact odometry, noisy matches."""
    rng = np.random.default_rng(seed)
    graph, final = PoseGraph(GraphParameters(lag_s=lag_s)), []
    for k in range(n):
        T_match = noisy(rng, true_pose(k)) if match is None else match(k, noisy(rng, true_pose(k)))
        start = true_pose(0) if k == 0 else graph.pose(graph.newest) @ step(k)
        odometry = None if k == 0 else OdometryEdge(step(k), SIGMAS)
        found = MapMatch(T_match, MATCH_COVARIANCE) if matched(k) else None
        final += graph.add(k * STEP_NS, start, odometry, found, None if gnss is None else gnss(k))
        assert len(graph) <= lag_s * 10 + 1
    return graph, final


def errors(final):
    return np.array([np.linalg.norm(p.T_map_vehicle[:3, 3] - true_pose(p.number)[:3, 3]) for p in final])


def test_poses_leave_in_order_when_the_lag_has_passed():
    graph, final = run(n=60, lag_s=2.0)
    assert [p.number for p in final] == list(range(39))
    rest = graph.flush()
    assert [p.number for p in rest] == list(range(39, 60))
    assert len(graph) == 0
    assert graph.flush() == []


def test_final_poses_are_better_than_the_matches_they_are_made_of():
    graph, final = run()
    single = np.linalg.norm(np.random.default_rng(0).normal(0, 0.015, (1000, 3)), axis=1)
    assert np.median(errors(final + graph.flush())) < 0.6 * np.median(single)


def test_a_match_half_a_metre_off_is_not_believed():
    def shifted(k, T):
        T = T.copy()
        T[1, 3] += 0.5 if k in (20, 21, 22) else 0.0
        return T

    graph, final = run(match=shifted)
    assert errors(final + graph.flush()).max() < 0.05


def test_odometry_carries_over_a_gap():
    graph, final = run(matched=lambda k: not 20 <= k < 35)
    assert errors(final + graph.flush()).max() < 0.08


def test_gnss_bounds_what_nothing_else_tells():
    """No matches after the first: with fixes around the truth the end is nearer than its own doubt."""
    graph, _ = run(matched=lambda k: k == 0, gnss=lambda k: Position(true_pose(k)[:3, 3], 0.05))
    with_fixes = graph.flush()[-1]
    graph, _ = run(matched=lambda k: k == 0)
    without = graph.flush()[-1]
    assert with_fixes.covariance[3, 3] < 0.7 * without.covariance[3, 3]


def test_agrees_with_one_batch_over_all_factors():
    """The oracle: Levenberg-Marquardt over every factor at once, nothing marginalised."""
    rng, factors, values = np.random.default_rng(0), gtsam.NonlinearFactorGraph(), gtsam.Values()
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(GRAPH_ROBUST_K)
    noise = gtsam.noiseModel.Robust.Create(cauchy, gtsam.noiseModel.Gaussian.Covariance(MATCH_COVARIANCE))
    for k in range(60):
        factors.add(gtsam.PriorFactorPose3(k, gtsam.Pose3(noisy(rng, true_pose(k))), noise))
        values.insert(k, gtsam.Pose3(true_pose(k)))
        if k:
            odometry = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
            factors.add(gtsam.BetweenFactorPose3(k - 1, k, gtsam.Pose3(step(k)), odometry))
    batch = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    _, final = run(lag_s=4.0)
    for pose in final[3:]:
        expected = batch.atPose3(pose.number).matrix()
        np.testing.assert_allclose(pose.T_map_vehicle, expected, atol=2e-3)


def everything_known(lag_s, n=40):
    """A graph of noisy odometry, scans, matches and fixes, some of them wrong; and the same factors for GTSAM."""
    rng, graph = np.random.default_rng(3), PoseGraph(GraphParameters(lag_s=lag_s))
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(GRAPH_ROBUST_K)

    def robust(noise):
        return gtsam.noiseModel.Robust.Create(cauchy, noise)

    seen_covariance = np.diag([1e-3, 1e-3, 5e-4, 0.01, 0.008, 0.02]) ** 2
    seen_covariance[2, 4] = seen_covariance[4, 2] = 2e-6
    for k in range(n):
        shift = 0.5 if k % 7 == 3 else 0.015
        match = MapMatch(noisy(rng, true_pose(k), shift), MATCH_COVARIANCE) if k % 3 != 1 else None
        fix = Position(true_pose(k)[:3, 3] + rng.normal(0.0, 0.3, 3), 0.2) if k % 5 == 0 else None
        odometry = OdometryEdge(noisy(rng, step(k), 0.01, 1e-3), SIGMAS) if k else None
        scans = ScanStep(noisy(rng, step(k), 0.01, 5e-4), seen_covariance) if k and k % 4 else None
        graph.add(k * STEP_NS, true_pose(k), odometry, match, fix, scans)
        values.insert(k, gtsam.Pose3(true_pose(k)))
        if match is not None:
            noise = robust(gtsam.noiseModel.Gaussian.Covariance(MATCH_COVARIANCE))
            factors.add(gtsam.PriorFactorPose3(k, gtsam.Pose3(match.T_map_vehicle), noise))
        if fix is not None:
            noise = robust(gtsam.noiseModel.Diagonal.Sigmas(0.2 * 5.0 * np.array([1.0, 1.0, 2.0])))
            factors.add(gtsam.GPSFactor(k, fix.p_map_m, noise))
        if odometry is not None:
            noise = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
            factors.add(gtsam.BetweenFactorPose3(k - 1, k, gtsam.Pose3(odometry.T_before_now), noise))
        if scans is not None:
            noise = robust(gtsam.noiseModel.Gaussian.Covariance(seen_covariance))
            factors.add(gtsam.BetweenFactorPose3(k - 1, k, gtsam.Pose3(scans.T_before_now), noise))
    return graph, factors, values


def test_agrees_with_gtsam_about_everything_that_can_be_known():
    graph, factors, values = everything_known(lag_s=10.0)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    batch = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters).optimize()
    marginals = gtsam.Marginals(factors, batch)
    for found in graph.flush():
        np.testing.assert_allclose(found.T_map_vehicle, batch.atPose3(found.number).matrix(), atol=5e-4)
        np.testing.assert_allclose(found.covariance, marginals.marginalCovariance(found.number), rtol=0.02, atol=1e-7)


def test_what_has_left_the_graph_is_not_forgotten():
    whole, short = (everything_known(lag_s)[0] for lag_s in (10.0, 0.5))
    assert len(short) == 6
    for here, there in zip(short.flush(), whole.flush()[-6:], strict=True):
        np.testing.assert_allclose(here.T_map_vehicle, there.T_map_vehicle, atol=2e-3)
        np.testing.assert_allclose(here.covariance, there.covariance, rtol=0.1, atol=1e-6)


def test_a_graph_that_nothing_ties_to_the_map_is_refused():
    with pytest.raises(np.linalg.LinAlgError, match="1 poses are singular"):
        PoseGraph(GraphParameters()).add(0, np.eye(4), None, None, None)


def test_a_graph_begins_anew_at_a_corrected_pose():
    graph, _, _ = everything_known(lag_s=10.0)
    corrected = noisy(np.random.default_rng(1), true_pose(39), 0.3)
    graph.restart(corrected, MATCH_COVARIANCE)
    assert len(graph) == 1
    (one,) = graph.smoothed(39)
    np.testing.assert_allclose(one.T_map_vehicle, corrected, atol=1e-12)
    np.testing.assert_allclose(one.covariance, MATCH_COVARIANCE, atol=1e-12)


def test_covariance_is_what_the_errors_are():
    """Errors of many drives against the sigmas that the graph claims; the robust kernel makes it a little modest."""
    found = [pose for seed in range(12) for pose in run(n=45, seed=seed)[1][8:]]
    off = np.array([np.linalg.inv(true_pose(p.number)) @ p.T_map_vehicle for p in found])[:, :3, 3]
    sigmas = np.sqrt(np.array([np.diag(p.covariance)[3:] for p in found]))
    ratio = np.sqrt(np.mean((off / sigmas) ** 2, axis=0))
    assert (ratio > 0.3).all()
    assert (ratio < 1.3).all()
