"""What the map's errors do to poses, as residuals show them: against the normal equations, and against known errors."""

from itertools import pairwise

import numpy as np
import pytest
from yard import local_map_of, match_map_of, pose, seen_from

from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3
from gnd.vehicle_agent.localise.influence import FEW, SeenScan, _of_pieces, influence
from gnd.vehicle_agent.localise.kernels import linearise, pulls
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import REGISTRATION_GATE_PER_SCALE, linearised
from gnd.vehicle_agent.localise.step_noise import WINDOW, variance_by_scans
from gnd.vehicle_agent.localise.stretch import (
    N_SHARED,
    Knot,
    StretchBelief,
    StretchStep,
    log_se3,
    shared_of,
    solve_stretch,
)

PAR = RegistrationParameters()
SCALE = 2.0
SIGMAS = np.array([2e-3, 2e-3, 1e-3, 0.01, 0.008, 0.01])


def test_the_pulls_of_all_pieces_are_the_gradient_and_the_information(yard_map, yard_points):
    """Summed over the Gaussians, slopes and curvatures along motions u are u'g and u'Hu of the normal equations."""
    rng = np.random.default_rng(1)
    T, m = pose(3.0, -2.0, 20.0), match_map_of(yard_map)
    points, along = seen_from(rng, yard_points[::7], T, 1500), rng.normal(size=(4, 6))
    gate_m2 = (REGISTRATION_GATE_PER_SCALE * SCALE) ** 2
    there = (np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy(), m.index, m.A, m.b, m.mean_m, m.information)
    H, g, pull, weight = np.zeros((6, 6)), np.zeros(6), np.zeros((len(m), 4)), np.zeros((len(m), 4))
    linearise(points, *there, SCALE**2, gate_m2, H, g)
    pulls(points, *there, SCALE**2, gate_m2, along, pull, weight)
    np.testing.assert_allclose(pull.sum(axis=0), along @ g, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(weight.sum(axis=0), np.einsum("di,ij,dj->d", along, H, along), rtol=1e-9)


@pytest.mark.parametrize("grown", [0.5, 1.0, 3.0])
def test_errors_that_the_points_of_a_piece_share_are_seen(grown):
    rng, weight = np.random.default_rng(2), np.full((400, 3), 5.0)
    seen = _of_pieces(grown * rng.normal(size=(400, 3)) * np.sqrt(weight), weight)
    np.testing.assert_allclose(seen.factor, grown**2, rtol=0.25)
    np.testing.assert_allclose(seen.pieces, 400.0, rtol=1e-6)


def test_a_piece_that_decides_alone_does_not_prove_itself_right():
    """Its pull is nought where it was fitted: what all other directions show is taken instead."""
    rng, weight = np.random.default_rng(3), np.ones((200, 2))
    pull = 3.0 * rng.normal(size=(200, 2))
    weight[:, 1], pull[:, 1] = 1e-6, 0.0
    weight[0, 1] = 1.0
    seen = _of_pieces(pull, weight)
    assert seen.pieces[1] < 1.1
    assert seen.factor[1] > 9.0 * FEW / (FEW + 1.0) * 0.7


def test_nothing_seen_changes_nothing(yard_map):
    T = pose(500.0, 500.0, 0.0)
    m, far = match_map_of(yard_map), np.zeros((100, 3))
    seen = influence([SeenScan(far, linearised(far, T, m, PAR, SCALE), np.eye(3, 6))], m)
    np.testing.assert_array_equal(seen.factor, 1.0)


# --- a stretch on maps that are as wrong as they are ------------------------------------------------------------------


def through(k):
    return pose(-15.0 + k, -3.0 + 0.004 * k**2, np.degrees(np.arctan(0.008 * k)))


def small(rng, sigmas):
    off = rng.normal(0.0, 1.0, 6) * sigmas
    return T_from_R_t(exp_so3(off[:3]), off[3:])


def displaced(rng, points, sigma_m, side_m=2.0):
    """The points of a survey whose every piece is off by so much."""
    _, piece = np.unique(np.floor(points / side_m).astype(int), axis=0, return_inverse=True)
    return points + (rng.normal(0.0, sigma_m, (piece.max() + 1, 3)) * [1.0, 1.0, 0.3])[piece.ravel()]


def drive(rng, points, match_map, n=16):
    """Solve a stretch; NEES of place and heading in the middle by what it claims, and the stretch."""
    truth = [through(k) for k in range(n)]
    steps = []
    for a, b in pairwise(truth):
        T = T_inverse(a) @ b
        steps.append([StretchStep(T @ small(rng, SIGMAS), np.diag(SIGMAS**2), shared_of(T, 0.1))])
    knots = [Knot(seen_from(rng, points, T, 800), T @ small(rng, 2 * SIGMAS), 0.25) for T in truth]
    sigmas = np.concatenate([[0.02] * 3, [0.3] * 3, [3e-3, 0.01, 0.01, 0.01]])
    belief = StretchBelief(truth[0], np.array([0.0, 1.0, 0.0, 0.0]), np.diag(sigmas**-2.0), np.zeros(6 + N_SHARED))
    solved = solve_stretch(knots, steps, belief, match_map, PAR, (2.0, 1.5))
    off = log_se3(T_inverse(truth[n // 2]) @ knots[n // 2].T_map_vehicle)[[2, 3, 4]]
    grown = np.sqrt(1.0 + (solved.seen - 1.0) * solved.matched)
    C = grown[:, None] * solved.covariance[n // 2][2:5, 2:5] * grown
    return off[0] ** 2 / C[0, 0], off[1:] @ np.linalg.solve(C[1:, 1:], off[1:]) / 2.0, solved


@pytest.mark.parametrize("sigma_m", [0.0, 0.03, 0.06])
def test_errors_are_as_large_as_claimed_on_a_map_that_is_as_wrong_as_it_is(yard_points, sigma_m):
    """Nobody tells the vehicle how good its map is."""
    heading, place = [], []
    for seed in range(100, 110):
        rng = np.random.default_rng(seed)
        match_map = match_map_of(local_map_of(displaced(rng, yard_points, sigma_m)))
        one = drive(rng, yard_points[seed % 7 :: 7], match_map)
        heading.append(one[0])
        place.append(one[1])
    assert 0.5 < np.mean([*heading, *place, *place]) < 2.0
    assert 0.5 < np.mean(place) < 2.0
    assert np.mean(heading) < 2.0


def test_a_map_that_is_worse_is_seen_to_be(yard_points):
    seen = []
    for sigma_m in (0.0, 0.06):
        rng = np.random.default_rng(7)
        match_map = match_map_of(local_map_of(displaced(rng, yard_points, sigma_m)))
        seen.append(drive(rng, yard_points[::7], match_map)[2].seen)
    assert (seen[1] > 1.5 * seen[0]).all()


# --- whose fault it is ------------------------------------------------------------------------------------------------


def driven_and_seen(rng, worse, n=40):
    """Steps by odometry that is `worse` times what it claims, beside those that scans tell."""
    steps = []
    for k in range(n):
        T = T_inverse(through(k)) @ through(k + 1)
        driven = StretchStep(T @ small(rng, worse * SIGMAS), np.diag(SIGMAS**2), shared_of(T, 0.1))
        seen = StretchStep(T @ small(rng, 0.3 * SIGMAS), np.diag((0.3 * SIGMAS) ** 2), np.zeros((6, N_SHARED)))
        steps.append([driven, seen])
    return steps


@pytest.mark.parametrize("worse", [1.0, 5.0])
def test_odometry_that_is_too_sure_is_found_out_by_scans_and_right_one_is_not_blamed(worse):
    told = variance_by_scans(driven_and_seen(np.random.default_rng(8), worse), np.zeros(N_SHARED))
    assert (told[2:5] > 0.3 * worse**2).all()
    assert (told[2:5] < 3.0 * worse**2).all()


def test_where_scans_say_too_little_nobody_is_spared():
    steps = driven_and_seen(np.random.default_rng(9), 5.0)
    for k in range(WINDOW // 2, len(steps), WINDOW // 2):
        steps[k] = steps[k][:1]
    assert np.isinf(variance_by_scans(steps, np.zeros(N_SHARED))).all()
