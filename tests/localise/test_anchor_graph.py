"""The graph over anchors: right matches are believed, wrong ones that agree with each other are not."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import chi2
from yard import offset

from gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, log_so3
from vehicle_agent.localise.anchor_graph import AnchorStep, solve
from vehicle_agent.localise.graph import MapMatch
from vehicle_agent.localise.refine_parameters import RefineParameters

N, EVERY_M, BEND_RAD = 24, 5.0, 0.04
PAR = RefineParameters()
STEP_SIGMAS = np.array([*np.radians([0.2, 0.2, 0.02]), 0.004, 0.003, 0.02])
MATCH_SIGMAS = np.array([*np.radians([0.1, 0.1, 0.05]), 0.02, 0.02, 0.015])
LOOSE_SIGMAS = np.array([0.02] * 3 + [0.5] * 3)
WRONG_M = 0.4


def off_by(rng, sigmas):
    error = rng.normal(0.0, sigmas)
    return T_from_R_t(exp_so3(error[:3]), error[3:])


def true_chain(n=N):
    """(n, 4, 4) poses along a bend."""
    poses = [T_from_R_t(exp_so3([0.0, 0.0, 0.6]), [100.0, -50.0, 20.0])]
    while len(poses) < n:
        poses.append(poses[-1] @ T_from_R_t(exp_so3([0.0, 0.0, BEND_RAD]), [EVERY_M, 0.0, 0.0]))
    return np.stack(poses)


def odometry(rng, true, noise=STEP_SIGMAS, said=STEP_SIGMAS):
    return [AnchorStep(T_inverse(a) @ b @ off_by(rng, noise), said) for a, b in pairwise(true)]


def matched(rng, true):
    return [MapMatch(T @ off_by(rng, MATCH_SIGMAS), np.diag(MATCH_SIGMAS**2)) for T in true]


def started(rng, T, sigmas=LOOSE_SIGMAS):
    return MapMatch(T @ off_by(rng, sigmas), np.diag(sigmas**2))


def shifted(matches, first, last, shift_m):
    """Matches from `first` to before `last` agree on a world that is shifted by (3,) in the map frame."""
    T = T_from_R_t(np.eye(3), shift_m)
    return [m._replace(T_map_vehicle=T @ m.T_map_vehicle) if first <= n < last else m for n, m in enumerate(matches)]


def worst_m(true, found):
    """Largest horizontal error."""
    return float(np.linalg.norm(found[:, :2, 3] - true[:, :2, 3], axis=1).max())


def small(T_true, T):
    error = T_inverse(T_true) @ T
    return np.concatenate([log_so3(error[:3, :3]), error[:3, 3]])


# --- what to believe -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("first", "share"), [(7, 0.2), (5, 0.4), (12, 0.4)])
@pytest.mark.parametrize("direction_rad", [0.0, 1.2, 2.5])
def test_matches_in_a_row_that_agree_on_a_wrong_place_are_not_trusted(seed, first, share, direction_rad):
    rng, true = np.random.default_rng(seed), true_chain()
    last = first + int(share * N)
    shift = WRONG_M * np.array([np.cos(direction_rad), np.sin(direction_rad), 0.0])
    matches = shifted(matched(rng, true), first, last, shift)
    solution = solve(started(rng, true[0]), odometry(rng, true), matches, PAR.inlier_chi2)
    assert worst_m(true, solution.T_map_vehicle) < 0.06
    assert not solution.trusted[first:last].any()
    right = np.r_[solution.trusted[:first], solution.trusted[last:]]
    assert right.mean() > 0.85


def test_single_matches_that_are_wrong_are_not_trusted():
    rng, true = np.random.default_rng(5), true_chain()
    matches = matched(rng, true)
    for n, shift in ((3, (1.0, 0, 0)), (11, (0, -0.4, 0)), (12, (0.5, 0.5, 0)), (23, (0, 0.6, 0))):
        matches = shifted(matches, n, n + 1, shift)
    solution = solve(started(rng, true[0]), odometry(rng, true), matches, PAR.inlier_chi2)
    assert not solution.trusted[[3, 11, 12, 23]].any()
    assert solution.trusted.sum() >= 18
    assert worst_m(true, solution.T_map_vehicle) < 0.05


def test_right_matches_are_trusted_and_better_than_each_alone():
    off, single, trusted = [], [], []
    for seed in range(5):
        rng, true = np.random.default_rng(seed), true_chain()
        matches = matched(rng, true)
        solution = solve(started(rng, true[0]), odometry(rng, true), matches, PAR.inlier_chi2)
        off += [offset(a, b)[0] for a, b in zip(true, solution.T_map_vehicle, strict=True)]
        single += [offset(a, m.T_map_vehicle)[0] for a, m in zip(true, matches, strict=True)]
        trusted.append(solution.trusted.mean())
    assert np.mean(trusted) > 0.95
    assert np.sqrt(np.mean(np.square(off))) < 0.7 * np.sqrt(np.mean(np.square(single)))


# --- without matches -----------------------------------------------------------------------------------------------


def test_without_a_match_the_chain_is_dead_reckoned_and_less_and_less_known():
    rng, true = np.random.default_rng(1), true_chain()
    start, steps = started(rng, true[0]), odometry(rng, true)
    solution = solve(start, steps, [None] * N, PAR.inlier_chi2)
    T = start.T_map_vehicle
    np.testing.assert_allclose(solution.T_map_vehicle[0], T, atol=1e-9)
    for step, found in zip(steps, solution.T_map_vehicle[1:], strict=True):
        T = T @ step.T_before_now
        np.testing.assert_allclose(found, T, atol=1e-7)
    assert not solution.trusted.any()
    grown = np.array([np.trace(c[3:, 3:]) for c in solution.covariance])
    assert (np.diff(grown) > 0).all()
    assert (np.diff(solution.covariance[:, 2, 2]) > 0).all()
    np.testing.assert_allclose(solution.covariance[0], start.covariance, rtol=1e-6, atol=1e-10)


def test_covariance_without_matches_is_that_of_many_drives():
    rng, true = np.random.default_rng(2), true_chain(8)
    sigmas = LOOSE_SIGMAS / 10.0
    ends = []
    for _ in range(3000):
        T = true[0] @ off_by(rng, sigmas)
        for step in odometry(rng, true):
            T = T @ step.T_before_now
        ends.append(small(true[-1], T))
    start = MapMatch(true[0], np.diag(sigmas**2))
    steps = [AnchorStep(T_inverse(a) @ b, STEP_SIGMAS) for a, b in pairwise(true)]
    said = solve(start, steps, [None] * 8, PAR.inlier_chi2).covariance[-1]
    np.testing.assert_allclose(np.sqrt(np.diag(said)), np.std(ends, axis=0), rtol=0.06)


def test_a_gap_between_matches_is_least_known_in_its_middle():
    rng, true = np.random.default_rng(3), true_chain()
    matches = [m if n < 4 or n >= 20 else None for n, m in enumerate(matched(rng, true))]
    solution = solve(started(rng, true[0]), odometry(rng, true), matches, PAR.inlier_chi2)
    left = solution.covariance[:, 4, 4]
    assert 8 <= int(np.argmax(left)) <= 16
    assert not solution.trusted[4:20].any()
    assert worst_m(true, solution.T_map_vehicle) < 0.15


def test_one_anchor_alone_is_between_its_start_and_its_match():
    rng, true = np.random.default_rng(4), true_chain(1)
    solution = solve(started(rng, true[0]), [], matched(rng, true), PAR.inlier_chi2)
    assert solution.trusted.tolist() == [True]
    assert worst_m(true, solution.T_map_vehicle) < 0.1
    assert (np.diag(solution.covariance[0]) <= MATCH_SIGMAS**2 + 1e-12).all()


# --- how good the odometry is --------------------------------------------------------------------------------------


@pytest.mark.parametrize("times_worse", [3.0, 5.0])
def test_where_the_odometry_is_far_worse_than_it_says_matches_win(times_worse):
    driven, placed, trusted = [], [], []
    for seed in range(8):
        rng, true = np.random.default_rng(seed), true_chain()
        steps, matches = odometry(rng, true, noise=times_worse * STEP_SIGMAS), matched(rng, true)
        solution = solve(started(rng, true[0]), steps, matches, PAR.inlier_chi2)
        alone = solve(MapMatch(true[0], np.diag(LOOSE_SIGMAS**2)), steps, [None] * N, PAR.inlier_chi2)
        driven.append(worst_m(true, alone.T_map_vehicle))
        placed.append(worst_m(true, solution.T_map_vehicle))
        trusted.append(solution.trusted.mean())
    assert max(placed) < 0.2
    assert np.mean(placed) < 0.35 * np.mean(driven)
    assert np.mean(trusted) > 0.75


def test_a_few_wrong_matches_do_not_make_the_odometry_seem_bad():
    """As sure as without them: what it is off by is the median over the stretch."""
    rng, true = np.random.default_rng(7), true_chain()
    steps, matches, start = odometry(rng, true), matched(rng, true), started(rng, true[0])
    clean = solve(start, steps, matches, PAR.inlier_chi2)
    spoilt = solve(start, steps, shifted(matches, 8, 13, [0.0, WRONG_M, 0.0]), PAR.inlier_chi2)
    sigma = [np.sqrt(s.covariance[[0, -1], 4, 4]) for s in (clean, spoilt)]
    assert (sigma[1] < 1.5 * sigma[0]).all()


def test_covariance_says_how_wrong_the_poses_are():
    """Normalised errors squared of 100 drives lie in the 95 % band of chi-square, at the ends and in the middle."""
    squares = {0: [], N // 2: [], N - 1: []}
    for seed in range(100):
        rng, true = np.random.default_rng(seed), true_chain()
        solution = solve(started(rng, true[0]), odometry(rng, true), matched(rng, true), PAR.inlier_chi2)
        for n, found in squares.items():
            error = small(true[n], solution.T_map_vehicle[n])
            found.append(error @ np.linalg.solve(solution.covariance[n], error))
    low, high = chi2.ppf([0.025, 0.975], 600) / 100
    for found in squares.values():
        assert low < np.mean(found) < high
