"""The kernels of chains of poses against dense matrices."""

import numpy as np
import pytest

from gnd.vehicle_agent.localise.chain_kernels import chain_covariances, factor_chain, solve_chain_columns
from gnd.vehicle_agent.localise.stretch_kernels import SHARED, covariances_asked


def chain(n, seed=0, extra=0):
    """Positive definite equations (6 n + extra)² of a chain whose poses all know `extra` unknowns."""
    rng, size = np.random.default_rng(seed), 6 * n + extra
    A = np.diag(rng.uniform(1.0, 2.0, size))
    for k in range(n):
        tied = np.r_[6 * k : min(6 * k + 12, 6 * n), 6 * n : size]
        J = rng.normal(size=(8, len(tied)))
        A[np.ix_(tied, tied)] += J.T @ J
    return A


def blocks(A, n):
    D = np.array([A[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(n)])
    U = np.array([A[6 * k : 6 * k + 6, 6 * k + 6 : 6 * k + 12] for k in range(n - 1)] + [np.zeros((6, 6))])
    return D, U


@pytest.mark.parametrize("n", [1, 2, 9])
def test_solutions_and_covariances_are_those_of_the_dense_matrix(n):
    A, X = chain(n), np.random.default_rng(1).normal(size=(n, 6, 3))
    (D, U), inverse = blocks(A, n), np.empty((n, 6, 6))
    assert factor_chain(D, U, inverse)
    expected = np.linalg.solve(A, X.reshape(6 * n, 3))
    solve_chain_columns(U, inverse, X)
    np.testing.assert_allclose(X.reshape(6 * n, 3), expected, rtol=1e-9, atol=1e-12)
    own, beside, dense = np.empty((n, 6, 6)), np.zeros((n, 6, 6)), np.linalg.inv(A)
    chain_covariances(U, inverse, own, beside)
    expected_own, expected_beside = blocks(dense, n)
    np.testing.assert_allclose(own, expected_own, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(beside, expected_beside, rtol=1e-9, atol=1e-12)


def test_equations_that_are_not_positive_definite_are_refused():
    A = chain(4)
    A[12, 12] = -1.0
    assert not factor_chain(*blocks(A, 4), np.empty((4, 6, 6)))


@pytest.mark.parametrize("n", [1, 2, 8])
def test_what_is_asked_of_a_stretch_is_that_of_the_dense_inverse(n):
    A, dense = chain(n, 2, SHARED), np.linalg.inv(chain(n, 2, SHARED))
    found, middle = np.empty_like(A), n // 2
    assert covariances_asked(A, middle, found)
    pose = np.append(np.arange(6 * n) // 6, np.full(SHARED, -1))
    one, other = np.meshgrid(pose, pose)
    asked = (abs(one - other) <= 1) | (one < 0) | (other < 0) | (one == middle) | (other == middle)
    np.testing.assert_allclose(found[asked], dense[asked], rtol=1e-9, atol=1e-12)
    assert np.isnan(found[~asked]).all()


@pytest.mark.parametrize("at", [3, -1])
def test_a_stretch_that_is_not_positive_definite_has_no_covariances(at):
    A = chain(3, 4, SHARED)
    A[at, at] = -1.0
    assert not covariances_asked(A, 1, np.empty_like(A))
