"""The kernels of a stretch against plain twins: residuals, normal equations, and their solution."""

from itertools import pairwise

import numpy as np
import pytest
from yard import pose

from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3
from gnd.vehicle_agent.localise.stretch import STEP_CHI2, StretchStep, log_se3
from gnd.vehicle_agent.localise.stretch_kernels import (
    SHARED,
    add_matches,
    add_steps,
    eliminate,
    motions,
    residuals,
    solve,
)

N = 7


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def near(rng, T, m=0.05, rad=0.01):
    return T @ T_from_R_t(exp_so3(rng.normal(0.0, rad, 3)), rng.normal(0.0, m, 3))


@pytest.fixture
def stretch(rng):
    """Poses (N, 4, 4), two measurements of each motion, and parameters that they share."""
    T = np.array([near(rng, pose(1.5 * k, 0.02 * k**2, 4.0 * k), 0.2, 0.05) for k in range(N)])
    steps = []
    for a, b in pairwise(T):
        for _ in range(2):
            half = rng.normal(size=(6, 6)) * 1e-2
            steps.append(
                StretchStep(near(rng, T_inverse(a) @ b), half @ half.T + 1e-5 * np.eye(6), rng.normal(size=(6, SHARED)))
            )
    return T, np.repeat(np.arange(N - 1, dtype=np.int32), 2), steps, rng.normal(0.0, 1e-2, SHARED)


def packed(steps):
    T, covariance, shared = (
        np.array([getattr(s, name) for s in steps]) for name in ("T_before_now", "covariance", "shared")
    )
    return T, np.linalg.inv(covariance), shared


def of_kernel(T, first, steps, off):
    e, J, weight = np.empty((len(steps), 6)), np.empty((len(steps), 6, 12 + SHARED)), np.empty(len(steps))
    residuals(T, first, *packed(steps), off, STEP_CHI2, e, J, weight)
    return e, J, weight


def plain_residual(T_from, T_to, step, off):
    return log_se3(T_inverse(step.T_before_now) @ T_inverse(T_from) @ T_to) - step.shared @ off


def test_residuals_and_weights_equal_their_plain_twin(stretch):
    T, first, steps, off = stretch
    e, _, weight = of_kernel(T, first, steps, off)
    for m, (k, step) in enumerate(zip(first, steps, strict=True)):
        plain = plain_residual(T[k], T[k + 1], step, off)
        np.testing.assert_allclose(e[m], plain, atol=1e-12)
        far = plain @ np.linalg.inv(step.covariance) @ plain
        np.testing.assert_allclose(weight[m], (1.0 + far / STEP_CHI2) ** -2, rtol=1e-8)


def test_derivatives_are_the_slopes_of_the_residuals_where_these_are_small(rng):
    """The derivative is that at a residual of zero, as for any Gauss-Newton of poses."""
    T = np.array([pose(0.0, 0.0, 10.0), near(rng, pose(1.5, 0.1, 14.0))])
    step = StretchStep(T_inverse(T[0]) @ T[1], np.eye(6), rng.normal(size=(6, SHARED)))
    _, J, _ = of_kernel(T, np.zeros(1, np.int32), [step], np.zeros(SHARED))
    for i in range(12 + SHARED):
        small = np.zeros(12 + SHARED)
        small[i] = 1e-6
        ahead, behind = (
            plain_residual(*(P @ T_from_R_t(exp_so3(s * d[:3]), s * d[3:])
                             for P, d in zip(T, small[:12].reshape(2, 6), strict=True)), step, s * small[12:])
            for s in (1.0, -1.0)
        )  # fmt: skip
        np.testing.assert_allclose(J[0, :, i], (ahead - behind) / 2e-6, atol=2e-6)


def test_a_half_turn_does_not_look_like_no_turn_at_all():
    off = np.empty((1, 6))
    motions(np.eye(4)[None], T_from_R_t(exp_so3([0.0, 0.0, np.pi]), np.zeros(3))[None], off)
    assert np.linalg.norm(off[0, :3]) == pytest.approx(np.pi)


def test_motions_of_any_angle_equal_the_plain_twin(rng):
    T = np.array([T_from_R_t(exp_so3(rng.normal(size=3) * s), rng.normal(size=3)) for s in (0, 1e-9, 1e-4, 0.3, 1, 3)])
    off = np.empty((len(T), 6))
    start = near(rng, pose(3.0, 1.0, 70.0))
    motions(np.array([start] * len(T)), start @ T, off)
    np.testing.assert_allclose(off, [log_se3(one) for one in T], atol=1e-9)


def normal_equations(rng, stretch):
    T, first, steps, off = stretch
    n = 6 * N + SHARED
    A, g = np.zeros((n, n)), np.zeros(n)
    at = np.array([0, 2, 5], np.int32)
    half = rng.normal(size=(3, 6, 6))
    H, slope, moved, weight = (
        half @ np.swapaxes(half, 1, 2),
        rng.normal(size=(3, 6)),
        rng.normal(size=(3, 6)),
        [1, 2, 3],
    )
    add_matches(at, moved, np.array(weight, float), H, slope, A, g)
    add_steps(first, packed(steps)[1], *of_kernel(T, first, steps, off), A, g)
    return A, g, (at, moved, weight, H, slope)


def test_normal_equations_equal_their_plain_twin(rng, stretch):
    A, g, matches = normal_equations(rng, stretch)
    T, first, steps, off = stretch
    A_plain, g_plain = np.zeros_like(A), np.zeros_like(g)
    for k, moved, weight, H, slope in zip(*matches, strict=True):
        A_plain[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += weight * H
        g_plain[6 * k : 6 * k + 6] += weight * (slope + H @ moved)
    for k, step, e, J, w in zip(first, steps, *of_kernel(T, first, steps, off), strict=True):
        at = np.r_[6 * k : 6 * k + 12, len(g) - SHARED : len(g)]
        A_plain[np.ix_(at, at)] += w * J.T @ np.linalg.inv(step.covariance) @ J
        g_plain[at] += w * J.T @ np.linalg.inv(step.covariance) @ e
    np.testing.assert_allclose(A, A_plain, atol=1e-9 * np.abs(A_plain).max())
    np.testing.assert_allclose(g, g_plain, atol=1e-9 * np.abs(g_plain).max())


def test_the_solution_is_numpys(rng, stretch):
    A, g, _ = normal_equations(rng, stretch)
    A[-SHARED:, -SHARED:] += np.eye(SHARED)
    L, x = np.full_like(A, np.nan), np.empty_like(g)
    assert solve(A, g, L, x)
    np.testing.assert_allclose(x, np.linalg.solve(A, g), rtol=1e-6, atol=1e-9)


def test_what_is_not_positive_definite_is_told(stretch, rng):
    A, g, _ = normal_equations(rng, stretch)
    A[9, 9] = -1.0
    assert not solve(A, g, np.empty_like(A), np.empty_like(g))
    A[9, 9] = np.nan
    assert not solve(A, g, np.empty_like(A), np.empty_like(g))


def test_what_is_not_positive_definite_is_eliminated_with_pivots_and_what_is_singular_refused(rng):
    half = rng.normal(size=(20, 20))
    A, g, x = half + half.T, rng.normal(size=20), np.empty(20)
    A[0, 0] = 0.0
    assert not solve(A, g, np.empty_like(A), x)
    assert eliminate(A.copy(), g.copy(), x)
    np.testing.assert_allclose(x, np.linalg.solve(A, g), rtol=1e-8)
    assert not eliminate(np.zeros((3, 3)), np.ones(3), np.empty(3))
