"""Numba kernels of the pose graph: its normal equations, which are a chain of poses, and their solution.

A graph has N poses of 6 unknowns (rotation first), each a small motion of the vehicle in its own frame. A pose is tied
to the one before it and to the map; so the equations are blocks (6, 6) on the diagonal and beside it. GTSAM is the
oracle in `tests/localise/test_pose_graph.py`.
"""

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.jit import bare, kernel
from gnd.vehicle_agent.localise.chain_kernels import (
    chain_covariances,
    factor_chain,
    inverse_of,
    solve_chain_columns,
    take_product,
    through_pose,
)
from gnd.vehicle_agent.localise.stretch_kernels import motion, move

ODOMETRY, SCANS, MATCH = range(3)
"""What is measured of a pose: the motion since the one before by wheels and gyro, by the scans, and itself by the map.
"""


@bare
def _add(weighted: F64, K: F64, into: F64) -> None:
    """Add `weighted` K (6, 6) to `into`."""
    for r in range(6):
        for c in range(6):
            for k in range(6):
                into[r, c] += weighted[r, k] * K[k, c]


@bare
def _weigh(J: F64, information: F64, weight: float, weighted: F64) -> None:
    """Fill `weighted` (6, 6) with `weight` J' `information`."""
    for r in range(6):
        for c in range(6):
            total = 0.0
            for k in range(6):
                total += J[k, r] * information[k, c]
            weighted[r, c] = weight * total


@bare
def _robust(e: F64, information: F64, k2: float) -> float:
    """Cauchy weight of a residual e (6,), 0 ... 1; 1 where `k2` is 0."""
    far = 0.0
    for r in range(6):
        for c in range(6):
            far += e[r] * information[r, c] * e[c]
    return k2 / (k2 + far) if k2 > 0.0 else 1.0


@bare
def _pull(weighted: F64, e: F64, g: F64) -> None:
    """Add `weighted` (6, 6) times e (6,) to g (6,)."""
    for r in range(6):
        for k in range(6):
            g[r] += weighted[r, k] * e[k]


@bare
def _derivatives(R: F64, R_off: F64, p: F64, Z: F64, J_from: F64, J_to: F64) -> None:
    """Fill the derivatives (6, 6) of the residual of a motion Z (4, 4) after both its poses, as in `residuals`.

    R (3, 3) and p (3,) are the motion between the poses, R_off (3, 3) the rotation that is left over.
    """
    J_from[:] = 0.0
    J_to[:] = 0.0
    for r in range(3):
        J_to[r, r] = 1.0
        J_from[r + 3, 0] = Z[1, r] * p[2] - Z[2, r] * p[1]
        J_from[r + 3, 1] = Z[2, r] * p[0] - Z[0, r] * p[2]
        J_from[r + 3, 2] = Z[0, r] * p[1] - Z[1, r] * p[0]
        for c in range(3):
            J_from[r, c] = -R[c, r]
            J_from[r + 3, c + 3] = -Z[c, r]
            J_to[r + 3, c + 3] = R_off[r, c]


@bare
def _add_fix(T: F64, fix_m: F64, information: F64, k2: float, D: F64, g: F64) -> None:
    """Add a position (3,) with information (3,) along map axes of a pose T (4, 4)."""
    far = 0.0
    for a in range(3):
        far += information[a] * (T[a, 3] - fix_m[a]) ** 2
    weight = k2 / (k2 + far)
    for r in range(3):
        for a in range(3):
            g[r + 3] += weight * T[a, r] * information[a] * (T[a, 3] - fix_m[a])
            for c in range(3):
                D[r + 3, c + 3] += weight * T[a, r] * information[a] * T[a, c]


@kernel
def chain_equations(
    T: F64, measured: F64, information: F64, fix_m: F64, fix_information: F64, T_belief: F64, H_belief: F64,
    g_belief: F64, k2: float, D: F64, U: F64, g: F64,
) -> None:  # fmt: skip
    """Fill the normal equations of a chain at its present poses.

    Args:
        T: (N, 4, 4) poses T_map_vehicle.
        measured: (N, 3, 4, 4) of each pose, see `ODOMETRY`.
        information: (N, 3, 6, 6) of these; zeros: not measured. Only odometry is believed whatever it says.
        fix_m: (N, 3) GNSS positions, map frame.
        fix_information: (N, 3) of these along map axes; zeros: there is none.
        T_belief: (4, 4) what was known of the first pose before ...
        H_belief: (6, 6) ... its information ...
        g_belief: (6,) ... and gradient there.
        k2: square of the Cauchy scale, in sigmas.
        D: (N, 6, 6), filled: blocks on the diagonal.
        U: (N, 6, 6), filled: blocks beside it, of a pose and the next one.
        g: (N, 6), filled: gradient.
    """
    relative, R_off, e = np.zeros((4, 4)), np.empty((3, 3)), np.empty(6)
    R, p, between = relative[:3, :3], relative[:3, 3], np.empty(6)
    J_from, J_to, weighted = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    motion(T_belief, T[0], R_off, e)
    D[:] = 0.0
    U[:] = 0.0
    g[:] = 0.0
    D[0] = H_belief
    g[0] = g_belief
    _pull(H_belief, e, g[0])
    for n in range(T.shape[0]):
        for kind in range(3):
            W, Z = information[n, kind], measured[n, kind]
            if W[0, 0] == 0.0 or (n == 0 and kind != MATCH):
                continue
            if kind == MATCH:
                motion(Z, T[n], R_off, e)
            else:
                motion(T[n - 1], T[n], R, between)
                for r in range(3):
                    p[r] = between[r + 3]
                motion(Z, relative, R_off, e)
            _derivatives(R, R_off, p, Z, J_from, J_to)
            weight = _robust(e, W, 0.0 if kind == ODOMETRY else k2)
            _weigh(J_to, W, weight, weighted)
            _add(weighted, J_to, D[n])
            _pull(weighted, e, g[n])
            if kind != MATCH:
                _weigh(J_from, W, weight, weighted)
                _add(weighted, J_from, D[n - 1])
                _add(weighted, J_to, U[n - 1])
                _pull(weighted, e, g[n - 1])
        if fix_information[n, 0] > 0.0:
            _add_fix(T[n], fix_m[n], fix_information[n], k2, D[n], g[n])


@kernel
def leave_first(
    T: F64, measured: F64, information: F64, fix_m: F64, fix_information: F64, T_belief: F64, H_belief: F64,
    g_belief: F64, k2: float,
) -> bool:  # fmt: skip
    """Put what is known of the second of two poses by the first into the belief, which was about the first (Schur
    complement). What is measured of the second itself is not part of it. False where nothing ties the first.
    """
    information, fix_information = information.copy(), fix_information.copy()
    information[1, MATCH] = 0.0
    fix_information[1] = 0.0
    D, U, g = np.empty((2, 6, 6)), np.empty((2, 6, 6)), np.empty((2, 6))
    L, inverse, through = np.zeros((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    chain_equations(T, measured, information, fix_m, fix_information, T_belief, H_belief, g_belief, k2, D, U, g)
    if not inverse_of(D[0], L, inverse):
        return False
    through_pose(U[0], inverse, through)
    T_belief[:], H_belief[:], g_belief[:] = T[1], D[1], g[1]
    take_product(through, U[0], H_belief)
    take_product(through, g[0].reshape(6, 1), g_belief.reshape(6, 1))
    return True


@kernel
def settle_chain(
    T: F64, measured: F64, information: F64, fix_m: F64, fix_information: F64, T_belief: F64, H_belief: F64,
    g_belief: F64, gone: int, k2: float, most_steps: int, stop_m: float, stop_rad: float, covariance: F64,
) -> bool:  # fmt: skip
    """Let the first `gone` poses of a chain leave, the belief is about the next one then, and move the others to where
    all that is known of them agrees best: Gauss-Newton steps, at most `most_steps`, until none moves by `stop_m` or
    `stop_rad`.

    T (N, 4, 4) and the belief are moved, `covariance` (N - gone, 6, 6) is filled; the rest is as in `chain_equations`.
    False where the equations are singular.
    """
    for k in range(gone):
        two = slice(k, k + 2)
        if not leave_first(
            T[two], measured[two], information[two], fix_m[two], fix_information[two], T_belief, H_belief, g_belief, k2
        ):
            return False
    T, measured, information = T[gone:], measured[gone:], information[gone:]
    fix_m, fix_information, n = fix_m[gone:], fix_information[gone:], T.shape[0]
    D, U, g = np.empty((n, 6, 6)), np.empty((n, 6, 6)), np.empty((n, 6))
    inverse, beside = np.empty((n, 6, 6)), np.empty((n, 6, 6))
    for _ in range(most_steps):
        chain_equations(T, measured, information, fix_m, fix_information, T_belief, H_belief, g_belief, k2, D, U, g)
        if not factor_chain(D, U, inverse):
            return False
        solve_chain_columns(U, inverse, g.reshape(n, 6, 1))
        move(T, g.reshape(-1))
        if np.abs(g[:, 3:]).max() < stop_m and np.abs(g[:, :3]).max() < stop_rad:
            break
    chain_covariances(U, inverse, covariance, beside)
    return True
