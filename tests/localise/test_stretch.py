"""A stretch of scans solved together: against GTSAM, whole against piecewise, honest about odometry that is worse."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest
import stretch_twin
from yard import corridor, local_map_of, pose, seen_from

from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import linearised
from gnd.vehicle_agent.localise.stretch import (
    BIAS,
    LEFT,
    N_SHARED,
    SCALE,
    Knot,
    StretchBelief,
    StretchStep,
    log_se3,
    marginalised,
    shared_of,
    solve_stretch,
)

PAR = RegistrationParameters()
SCALES = (2.0, 1.5)
SIGMAS = np.array([2e-3, 2e-3, 1e-3, 0.01, 0.008, 0.01])
SHARED_SIGMAS = np.array([3e-3, 0.01, 0.01, 0.01])


@pytest.fixture(scope="module")
def nothing():
    return MatchMapCache(local_map_of(np.empty((0, 3))), PAR.noise_m).near(np.zeros(3))


@pytest.fixture(scope="module")
def yard(yard_map):
    return MatchMapCache(yard_map, PAR.noise_m).near(np.zeros(3))


def small(rng, sigmas):
    off = rng.normal(0.0, 1.0, 6) * sigmas
    return T_from_R_t(exp_so3(off[:3]), off[3:])


def through(k, step_m=1.0):
    """A bend through the yard."""
    return pose(-15.0 + step_m * k, -3.0 + 0.004 * (step_m * k) ** 2, np.degrees(np.arctan(0.008 * step_m * k)))


def belief_at(T, sigma_m=0.3, sigma_rad=0.02):
    sigmas = np.concatenate([[sigma_rad] * 3, [sigma_m] * 3, SHARED_SIGMAS])
    return StretchBelief(T, np.array([0.0, 1.0, 0.0, 0.0]), np.diag(sigmas**-2.0), np.zeros(6 + N_SHARED))


def problem(rng, n=12, grown=1.0, shared=(0.0,) * N_SHARED, points=None):
    """Knots off their places, steps with noise that is `grown` times what they claim, and what all steps share."""
    truth = [through(k) for k in range(n)]
    steps = []
    for a, b in pairwise(truth):
        T = T_inverse(a) @ b
        S = shared_of(T, 0.1)
        off = S @ np.asarray(shared)
        driven = T @ T_inverse(T_from_R_t(exp_so3(off[:3]), off[3:])) @ small(rng, grown * SIGMAS)
        steps.append([StretchStep(driven, np.diag(SIGMAS**2), S)])
    empty = np.zeros((0, 3))
    knots = [
        Knot(empty if points is None else seen_from(rng, points, T, 800), T @ small(rng, 2 * SIGMAS), 0.25)
        for T in truth
    ]
    return truth, knots, steps


def gtsam_solution(knots, steps, belief):
    """The same poses by GTSAM, the shared parameters held at what they begin with."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    sigmas = np.diag(belief.information)[:6] ** -0.5
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(belief.T_map_vehicle), gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    robust = gtsam.noiseModel.mEstimator.GemanMcClure.Create(np.sqrt(12.6))
    for k, measured in enumerate(steps):
        for step in measured:
            noise = gtsam.noiseModel.Robust.Create(robust, gtsam.noiseModel.Gaussian.Covariance(step.covariance))
            graph.add(gtsam.BetweenFactorPose3(k, k + 1, gtsam.Pose3(step.T_before_now), noise))
    for k, knot in enumerate(knots):
        values.insert(k, gtsam.Pose3(knot.T_map_vehicle))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return [found.atPose3(k).matrix() for k in range(len(knots))]


def test_odometry_alone_is_what_gtsam_says(nothing):
    """Two measurements of each step that contradict each other now and then; nothing shared, no map."""
    rng = np.random.default_rng(1)
    _, knots, steps = problem(rng)
    for k, measured in enumerate(steps):
        T = measured[0].T_before_now @ small(rng, (10.0 if k % 4 == 0 else 2.0) * SIGMAS)
        measured.append(StretchStep(T, np.diag((2.0 * SIGMAS) ** 2), np.zeros((6, N_SHARED))))
    fixed = [
        [StretchStep(s.T_before_now, s.covariance, np.zeros((6, N_SHARED))) for s in measured] for measured in steps
    ]
    belief = belief_at(through(0))
    expected = gtsam_solution(knots, fixed, belief)
    solve_stretch(knots, fixed, belief, nothing, PAR, SCALES, max_iterations=50)
    off = np.array([log_se3(T_inverse(T) @ knot.T_map_vehicle) for T, knot in zip(expected, knots, strict=True)])
    assert np.abs(off[:, 3:]).max() < 2e-3
    assert np.abs(off[:, :3]).max() < 2e-4


@pytest.mark.parametrize("mapped", [True, False])
def test_the_solution_equals_that_of_its_plain_twin(yard, nothing, yard_points, mapped):
    """Poses, shared parameters, information, and the matches that are left, also where some were matched before."""
    shared, points, m = np.array([1e-3, 4e-3, 2e-3, 0.0]), yard_points[::7] if mapped else None, yard
    (_, knots, steps), (_, plain, _) = (problem(np.random.default_rng(6), 9, 1.0, shared, points) for _ in range(2))
    m = yard if mapped else nothing
    belief = belief_at(through(0))
    for scales in ((8.0, 4.0), SCALES):  # the second begins with the matches of the first
        found = solve_stretch(knots, steps, belief, m, PAR, scales)
        shared_plain, A = stretch_twin.solve(plain, steps, belief, m, PAR, scales)
        np.testing.assert_allclose(found.shared, shared_plain, atol=1e-9)
        np.testing.assert_allclose(
            found.shared_covariance, np.linalg.inv(A)[-N_SHARED:, -N_SHARED:], rtol=1e-5, atol=1e-12
        )
        for one, other in zip(knots, plain, strict=True):
            np.testing.assert_allclose(one.T_map_vehicle, other.T_map_vehicle, atol=1e-9)
            np.testing.assert_allclose(one.match.H, other.match.H, rtol=1e-6, atol=1e-6 * max(1.0, other.match.H.max()))
            assert (one.match.matched, one.match.inside, one.match.scale) == (
                other.match.matched, other.match.inside, other.match.scale,
            )  # fmt: skip


def test_what_left_the_stretch_counts_once(yard, yard_points):
    """Solved as a whole, and with its first half marginalised: the same poses and the same covariances."""
    rng = np.random.default_rng(2)
    _, knots, steps = problem(rng, 14, shared=np.array([1e-3, 4e-3, 2e-3, 0.0]), points=yard_points[::7])
    belief = belief_at(through(0))
    whole = solve_stretch(knots, steps, belief, yard, PAR, SCALES, max_iterations=30)
    kept = marginalised(knots[:7], steps[:6], belief, whole.shared, PAR)
    poses = [knot.T_map_vehicle.copy() for knot in knots[6:]]
    rest = solve_stretch(knots[6:], steps[6:], kept._replace(shared=whole.shared), yard, PAR, SCALES, max_iterations=30)
    for before, knot, a, b in zip(poses, knots[6:], whole.covariance[6:], rest.covariance, strict=True):
        off = log_se3(T_inverse(before) @ knot.T_map_vehicle)
        assert (np.abs(off) < 0.7 * np.sqrt(np.diag(a))).all()  # matches are linearised once more at the end
        np.testing.assert_allclose(np.diag(b), np.diag(a), rtol=0.1)


def test_wheel_scale_gyro_bias_and_course_are_found(yard, yard_points):
    shared = np.array([2e-3, 8e-3, -5e-3, 0.0])
    _, knots, steps = problem(np.random.default_rng(3), 26, shared=shared, points=yard_points[::7])
    solved = solve_stretch(knots, steps, belief_at(through(0)), yard, PAR, SCALES)
    off = solved.shared - [0.0, 1.0, 0.0, 0.0] - shared
    sigma = np.sqrt(np.diag(solved.shared_covariance))
    for which in (BIAS, SCALE, LEFT):
        assert abs(off[which]) < 4.0 * sigma[which]
    assert sigma[SCALE] < 4e-3


@pytest.mark.parametrize("grown", [1.0, 4.0, 12.0])
def test_odometry_that_is_worse_than_it_claims_is_found_out(yard, yard_points, grown):
    """The ratio of squares to redundancy is the variance of the steps, in units of what they claim."""
    squares, redundancy = np.zeros(6), np.zeros(6)
    for seed in range(4):
        _, knots, steps = problem(np.random.default_rng(seed), 24, grown, points=yard_points[::7])
        for _ in range(3):  # at the fixed point, as the refiner does
            variance = np.ones(6) if not redundancy.any() else np.maximum(squares / redundancy, 1.0)
            scale = np.sqrt(variance)
            told = [
                [StretchStep(s.T_before_now, scale[:, None] * s.covariance * scale, s.shared) for s in m] for m in steps
            ]
            solved = solve_stretch(knots, told, belief_at(through(0)), yard, PAR, SCALES)
            squares, redundancy = (
                0.7 * squares + solved.step_squares * variance,
                0.7 * redundancy + solved.step_redundancy,
            )
    ratio = np.sqrt(squares / redundancy)[3:5]
    assert (ratio > 0.25 * grown).all()
    assert (ratio < 2.0 * max(grown, 1.0)).all()


def test_errors_are_as_large_as_the_covariances_say(yard, yard_points):
    """NEES of place and heading over drives through the yard: noise of points counts for less than the shared errors of
    a real map, so that this is cautious here; it must not be too sure.
    """
    nees = []
    for seed in range(20):
        truth, knots, steps = problem(np.random.default_rng(100 + seed), 16, points=yard_points[seed % 7 :: 7])
        solved = solve_stretch(knots, steps, belief_at(through(0)), yard, PAR, SCALES)
        off = log_se3(T_inverse(truth[8]) @ knots[8].T_map_vehicle)[[2, 3, 4]]
        nees.append(off @ np.linalg.solve(solved.covariance[8][np.ix_([2, 3, 4], [2, 3, 4])], off) / 3.0)
    assert np.mean(nees) < 1.5


def test_a_step_that_slipped_does_not_bend_the_stretch(yard, yard_points):
    truth, knots, steps = problem(np.random.default_rng(5), 16, points=yard_points[::7])
    slipped = steps[8][0]
    T = slipped.T_before_now.copy()
    T[0, 3] += 0.5
    steps[8][0] = StretchStep(T, slipped.covariance, slipped.shared)
    solve_stretch(knots, steps, belief_at(through(0)), yard, PAR, (8.0, 4.0, *SCALES))
    off = [np.linalg.norm((T_inverse(a) @ knot.T_map_vehicle)[:2, 3]) for a, knot in zip(truth, knots, strict=True)]
    assert max(off) < 0.05


def test_scans_that_contradict_the_odometry_are_noticed(yard, yard_points):
    """Every other scan sees the yard 10 cm aside, and odometry says that the vehicle did not: somebody is wrong."""
    truth, knots, steps = problem(np.random.default_rng(6), 16, points=yard_points[::7])
    agreeing = solve_stretch(knots, steps, belief_at(truth[0]), yard, PAR, (4.0,))
    aside = [
        Knot(k.points_m + np.array([0.0, 0.1 * (n % 2), 0.0]), T.copy(), 1.0)
        for n, (k, T) in enumerate(zip(knots, truth, strict=True))
    ]
    against = solve_stretch(aside, steps, belief_at(truth[0]), yard, PAR, (4.0,))
    ratio = [one.misfit + one.step_squares[4] / max(one.step_redundancy[4], 1.0) for one in (agreeing, against)]
    assert ratio[1] > 4.0 * ratio[0]


def test_along_even_walls_a_scan_tells_nothing_however_many_there_are():
    rng = np.random.default_rng(7)
    walls = corridor(rng)
    match_map = MatchMapCache(local_map_of(walls + rng.normal(0.0, 0.02, walls.shape)), PAR.noise_m).near(np.zeros(3))
    one = linearised(seen_from(rng, walls, np.eye(4), 1500), np.eye(4), match_map, PAR, 2.0)
    assert one.H[3, 3] < 1e-3 * one.H[4, 4]
    assert abs(one.g[3]) < 0.05 * np.sqrt(one.H[4, 4])
