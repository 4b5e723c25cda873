"""Numba kernels of a stretch of scans: residuals of its steps, its normal equations, and their solution.

A stretch has N poses of 6 unknowns (rotation first) and `SHARED` that all steps have in common, behind them. The plain
twins are in `tests/localise/test_stretch_kernels.py`.
"""

import numpy as np

from gnd.gnd_map.arrays import F64, I32
from gnd.gnd_map.jit import kernel

SHARED = 4


@kernel
def _log(R: F64, vector: F64) -> None:
    """Fill `vector` (3,) with the rotation vector of R (3, 3). Of a half-turn, which no step is, only the length is
    right: nothing fits there, and must not seem to.
    """
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    twice_sine = np.sqrt(x * x + y * y + z * z)
    twice_cosine = R[0, 0] + R[1, 1] + R[2, 2] - 1.0
    if twice_sine < 1e-9 and twice_cosine < 0.0:
        vector[0], vector[1], vector[2] = np.pi, 0.0, 0.0
        return
    per = np.arctan2(twice_sine, twice_cosine) / twice_sine if twice_sine > 1e-12 else 0.5
    vector[0], vector[1], vector[2] = per * x, per * y, per * z


@kernel
def motion(T_from: F64, T_to: F64, R: F64, off: F64) -> None:
    """Fill R (3, 3) and off[3:] with T_from^-1 T_to, and off[:3] with its rotation vector."""
    for r in range(3):
        off[r + 3] = 0.0
        for k in range(3):
            off[r + 3] += T_from[k, r] * (T_to[k, 3] - T_from[k, 3])
        for c in range(3):
            R[r, c] = T_from[0, r] * T_to[0, c] + T_from[1, r] * T_to[1, c] + T_from[2, r] * T_to[2, c]
    _log(R, off)


@kernel
def motions(T_from: F64, T_to: F64, off: F64) -> None:
    """Fill `off` (N, 6) with the small motions T_from^-1 T_to, rotation vector first, of poses (N, 4, 4)."""
    R = np.empty((3, 3))
    for n in range(T_from.shape[0]):
        motion(T_from[n], T_to[n], R, off[n])


@kernel
def residuals(
    T: F64, first: I32, T_step: F64, information: F64, shared: F64, shared_off: F64, chi2: float, e: F64, J: F64,
    weight: F64,
) -> None:  # fmt: skip
    """Residual e = log(Z^-1 T_k^-1 T_k+1) - S shared of every measured step, and its derivative.

    Args:
        T: (N, 4, 4) poses T_map_vehicle.
        first: (M,) int32, the pose k that each step starts from.
        T_step: (M, 4, 4) Z, the measured motion.
        information: (M, 6, 6) of it.
        shared: (M, 6, `SHARED`) S, see `StretchStep`.
        shared_off: (`SHARED`,) the parameters.
        chi2: squared residual [sigmas²] from where on a step counts less (Geman-McClure).
        e: (M, 6), filled.
        J: (M, 6, 12 + `SHARED`), filled: after both poses and the shared parameters.
        weight: (M,), filled: robust weight, 0 ... 1.
    """
    relative, R_off = np.zeros((4, 4)), np.empty((3, 3))
    R, p = relative[:3, :3], relative[:3, 3]
    between = np.empty(6)
    for m in range(first.shape[0]):
        k, Z = first[m], T_step[m]
        motion(T[k], T[k + 1], R, between)
        for r in range(3):
            p[r] = between[r + 3]
        motion(Z, relative, R_off, e[m])
        J[m] = 0.0
        for r in range(3):
            J[m, r, r + 6] = 1.0
            J[m, r + 3, 0] = Z[1, r] * p[2] - Z[2, r] * p[1]
            J[m, r + 3, 1] = Z[2, r] * p[0] - Z[0, r] * p[2]
            J[m, r + 3, 2] = Z[0, r] * p[1] - Z[1, r] * p[0]
            for c in range(3):
                J[m, r, c] = -R[c, r]
                J[m, r + 3, c + 3] = -Z[c, r]
                J[m, r + 3, c + 9] = R_off[r, c]
        far = 0.0
        for r in range(6):
            for c in range(SHARED):
                e[m, r] -= shared[m, r, c] * shared_off[c]
                J[m, r, c + 12] = -shared[m, r, c]
        for r in range(6):
            for c in range(6):
                far += e[m, r] * information[m, r, c] * e[m, c]
        weight[m] = 1.0 / ((1.0 + far / chi2) * (1.0 + far / chi2))


@kernel
def add_steps(first: I32, information: F64, e: F64, J: F64, weight: F64, A: F64, g: F64) -> None:
    """Add what `residuals` gives to the normal equations A (n, n) and g (n,), n = 6 N + `SHARED`."""
    n, wide = g.shape[0], 12 + SHARED
    weighted = np.empty((wide, 6))
    for m in range(first.shape[0]):
        for i in range(wide):
            for c in range(6):
                weighted[i, c] = 0.0
                for r in range(6):
                    weighted[i, c] += J[m, r, i] * information[m, r, c]
                weighted[i, c] *= weight[m]
        for i in range(wide):
            at = 6 * first[m] + i if i < 12 else n - SHARED + i - 12
            for r in range(6):
                g[at] += weighted[i, r] * e[m, r]
            for j in range(wide):
                to = 6 * first[m] + j if j < 12 else n - SHARED + j - 12
                for r in range(6):
                    A[at, to] += weighted[i, r] * J[m, r, j]


@kernel
def add_matches(knot: I32, off: F64, weight: F64, H: F64, slope: F64, A: F64, g: F64) -> None:
    """Add the matches of the scans `knot` (M,) with the map: H (M, 6, 6) and slope (M, 6) where they were made, `off`
    (M, 6) how far the poses have moved since, `weight` (M,) of each.
    """
    for m in range(knot.shape[0]):
        at = 6 * knot[m]
        for r in range(6):
            pull = slope[m, r]
            for c in range(6):
                pull += H[m, r, c] * off[m, c]
                A[at + r, at + c] += weight[m] * H[m, r, c]
            g[at + r] += weight[m] * pull


@kernel
def solve(A: F64, g: F64, L: F64, x: F64) -> bool:
    """Fill x (n,) with A^-1 g by a Cholesky factor L (n, n), filled, that keeps to where A (n, n) has entries: poses
    know their neighbours and what all share. False where A is not positive definite; x is undefined then.
    """
    n = g.shape[0]
    poses = n - SHARED
    for r in range(n):
        start = max(0, 6 * (r // 6) - 6) if r < poses else 0
        for c in range(start, r):
            rest = A[r, c]
            for k in range(max(start, max(0, 6 * (c // 6) - 6) if c < poses else 0), c):
                rest -= L[r, k] * L[c, k]
            L[r, c] = rest / L[c, c]
        rest, pull = A[r, r], g[r]
        for k in range(start, r):
            rest -= L[r, k] * L[r, k]
            pull -= L[r, k] * x[k]
        if not rest > 0.0:
            return False
        L[r, r] = np.sqrt(rest)
        x[r] = pull / L[r, r]
    for r in range(n - 1, -1, -1):
        x[r] /= L[r, r]
        for c in range(max(0, 6 * (r // 6) - 6) if r < poses else 0, r):
            x[c] -= L[r, c] * x[r]
    return True
