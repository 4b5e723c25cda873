"""Numba kernels of chains: symmetric equations of N poses of 6 unknowns, each tied to the one before it only.

They are blocks on the diagonal, D (N, 6, 6), and beside it, U (N, 6, 6), of a pose and the next one; the last of U is
not read. The plain twins, dense matrices, are in `tests/localise/test_chain_kernels.py`.
"""

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.jit import bare, kernel
from gnd.vehicle_agent.localise.kernels import cholesky


@bare
def inverse_of(S: F64, L: F64, out: F64) -> bool:
    """Fill `out` (6, 6) with the inverse of a symmetric S; L (6, 6) is room. False where S is not positive definite."""
    if not cholesky(S, 0.0, L):
        return False
    for c in range(6):
        for r in range(6):
            rest = 1.0 if r == c else 0.0
            for k in range(r):
                rest -= L[r, k] * out[k, c]
            out[r, c] = rest / L[r, r]
        for r in range(5, -1, -1):
            for k in range(r + 1, 6):
                out[r, c] -= L[k, r] * out[k, c]
            out[r, c] /= L[r, r]
    return True


@bare
def through_pose(U: F64, inverse: F64, through: F64) -> None:
    """Fill `through` (6, 6) with U' `inverse`: what an eliminated pose passes on to the next one."""
    for r in range(6):
        for c in range(6):
            through[r, c] = 0.0
            for k in range(6):
                through[r, c] += U[k, r] * inverse[k, c]


@bare
def take_product(left: F64, right: F64, rest: F64) -> None:
    """Take `left` (6, 6) times `right` (6, M) from `rest` (6, M)."""
    for r in range(6):
        for k in range(6):
            for m in range(rest.shape[1]):
                rest[r, m] -= left[r, k] * right[k, m]


@kernel
def factor_chain(D: F64, U: F64, inverse: F64) -> bool:
    """Eliminate from the first pose on: fill `inverse` (N, 6, 6) of what is left of each block of the diagonal. False
    where the equations are not positive definite.
    """
    S, L, through = np.empty((6, 6)), np.zeros((6, 6)), np.empty((6, 6))
    for n in range(D.shape[0]):
        S[:] = D[n]
        if n:
            through_pose(U[n - 1], inverse[n - 1], through)
            take_product(through, U[n - 1], S)
        if not inverse_of(S, L, inverse[n]):
            return False
    return True


@kernel
def solve_chain_columns(U: F64, inverse: F64, X: F64) -> None:
    """Solve the equations that `factor_chain` has eliminated for M right sides X (N, 6, M), which the solutions
    replace.
    """
    last, through, rest = X.shape[0] - 1, np.empty((6, 6)), np.empty(X.shape[1:])
    for n in range(1, last + 1):
        through_pose(U[n - 1], inverse[n - 1], through)
        take_product(through, X[n - 1], X[n])
    for n in range(last, -1, -1):
        if n < last:
            take_product(U[n], X[n + 1], X[n])
        rest[:] = 0.0
        take_product(inverse[n], X[n], rest)
        X[n] = -rest


@kernel
def chain_covariances(U: F64, inverse: F64, own: F64, beside: F64) -> None:
    """Fill `own` (N, 6, 6), the covariance of each pose, and `beside` (N, 6, 6), that of each with the next one (the
    last stays), from what `factor_chain` leaves.
    """
    last, gain, turned = inverse.shape[0] - 1, np.empty((6, 6)), np.empty((6, 6))
    own[last] = inverse[last]
    for n in range(last - 1, -1, -1):
        gain[:] = 0.0
        beside[n] = 0.0
        take_product(inverse[n], U[n], gain)
        for r in range(6):
            for c in range(6):
                gain[r, c] = -gain[r, c]
                turned[c, r] = gain[r, c]
        take_product(gain, own[n + 1], beside[n])
        own[n] = inverse[n]
        take_product(beside[n], turned, own[n])
