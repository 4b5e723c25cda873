"""Numba kernels of a stretch of scans: residuals of its steps, its normal equations, and their solution.

A stretch has N poses of 6 unknowns (rotation first) and `SHARED` that all steps have in common, behind them. The plain
twins are in `tests/localise/test_stretch_kernels.py`.
"""

import numpy as np

from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.jit import bare, kernel
from gnd.vehicle_agent.localise.chain_kernels import chain_covariances, factor_chain, solve_chain_columns
from gnd.vehicle_agent.localise.kernels import rotation_of
from gnd.vehicle_agent.localise.register_kernels import linearise_pose

SHARED = 4


@bare
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


@bare
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


@bare
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


@bare
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


@kernel
def eliminate(A: F64, g: F64, x: F64) -> bool:
    """Fill x (n,) with A^-1 g by Gaussian elimination with pivots, for a symmetric A (n, n) that is not positive
    definite; A and g are used up. False where it is singular.
    """
    n = g.shape[0]
    for c in range(n):
        best = c + int(np.argmax(np.abs(A[c:, c])))
        if A[best, c] == 0.0:
            return False
        for k in range(c, n):
            A[c, k], A[best, k] = A[best, k], A[c, k]
        g[c], g[best] = g[best], g[c]
        for r in range(c + 1, n):
            factor = A[r, c] / A[c, c]
            if factor != 0.0:
                for k in range(c, n):
                    A[r, k] -= factor * A[c, k]
                g[r] -= factor * g[c]
    for r in range(n - 1, -1, -1):
        x[r] = g[r]
        for k in range(r + 1, n):
            x[r] -= A[r, k] * x[k]
        x[r] /= A[r, r]
    return True


@kernel
def match_moved(
    points: F64, ends: I64, wheels: F64, T: F64, index: I32, A: F64, b: F64, mean: F64, omega: F64, scale: float,
    wheel_scale: float, gate: float, wheel_weight: float, share: float, small_m: float, small_rad: float,
    T_match: F64, scale_match: F64, H: F64, slope: F64, constrained: F64, cost: F64, matched: I64, inside: I64,
) -> None:  # fmt: skip
    """Match the scans of N poses T (N, 4, 4) with the map that have moved by more than `small_m` or `small_rad` since
    they were, or were matched with another scale; the rest stays as it is.

    points (P, 3) are in vehicle frames, those of scan k up to ends[k] (N,); wheels (N, W, 3); what is about the map is
    as in `linearise_pose`. Kept up to date: T_match (N, 4, 4) and scale_match (N,), where and how each was matched,
    scale 0 if never, and the matches: H (N, 6, 6), slope (N, 6), constrained (N, 6, 6), cost, matched and inside (N,).
    """
    R_off, off = np.empty((3, 3)), np.empty(6)
    R, t = np.empty((3, 3)), np.empty(3)
    start = 0
    for k in range(T.shape[0]):
        first, start = start, ends[k]
        if scale_match[k] == scale:
            motion(T_match[k], T[k], R_off, off)
            if np.abs(off[3:]).max() < small_m and np.abs(off[:3]).max() < small_rad:
                continue
        for r in range(3):
            t[r] = T[k, r, 3]
            for c in range(3):
                R[r, c] = T[k, r, c]
        cost[k], matched[k], inside[k] = linearise_pose(
            points[first:start], wheels[k], R, t, index, A, b, mean, omega, scale, wheel_scale, gate, wheel_weight,
            share, H[k], slope[k], constrained[k],
        )  # fmt: skip
        T_match[k], scale_match[k] = T[k], scale


@kernel
def normal_equations(
    T: F64, weight: F64, T_match: F64, H: F64, slope: F64, first: I32, T_step: F64, information: F64, shared: F64,
    chi2: float, T_belief: F64, shared_belief: F64, information_belief: F64, gradient_belief: F64, shared_now: F64,
    A: F64, g: F64,
) -> None:  # fmt: skip
    """Fill A (n, n) and g (n,), n = 6 N + `SHARED`, of a stretch of N poses T (N, 4, 4) that all have a match.

    weight (N,) is that of each match, T_match, H and slope are as in `match_moved`, the steps as in `residuals`. What
    is known of the first pose and of `shared_now` (`SHARED`,): T_belief (4, 4), shared_belief (`SHARED`,), and
    information (10, 10) and gradient (10,) there.
    """
    n, m = g.shape[0], first.shape[0]
    A[:] = 0.0
    R_off, off = np.empty((3, 3)), np.empty(6 + SHARED)
    motion(T_belief, T[0], R_off, off[:6])
    for r in range(SHARED):
        off[6 + r] = shared_now[r] - shared_belief[r]
    g[:] = 0.0
    for r in range(6 + SHARED):
        at = r if r < 6 else n - SHARED + r - 6
        g[at] = gradient_belief[r]
        for c in range(6 + SHARED):
            to = c if c < 6 else n - SHARED + c - 6
            A[at, to] = information_belief[r, c]
            g[at] += information_belief[r, c] * off[c]
    moved = np.empty((T.shape[0], 6))
    motions(T_match, T, moved)
    add_matches(np.arange(T.shape[0]).astype(np.int32), moved, weight, H, slope, A, g)
    e, J, robust = np.empty((m, 6)), np.empty((m, 6, 12 + SHARED)), np.empty(m)
    residuals(T, first, T_step, information, shared, off[6:], chi2, e, J, robust)
    add_steps(first, information, e, J, robust, A, g)


@bare
def move(T: F64, step: F64) -> None:
    """Move poses T (N, 4, 4) by -step (6 N + `SHARED`,): small motions of each vehicle in its own frame."""
    for k in range(T.shape[0]):
        at = 6 * k
        e00, e01, e02, e10, e11, e12, e20, e21, e22 = rotation_of(-step[at], -step[at + 1], -step[at + 2])
        for r in range(3):
            a, b, d = T[k, r, 0], T[k, r, 1], T[k, r, 2]
            T[k, r, 3] -= a * step[at + 3] + b * step[at + 4] + d * step[at + 5]
            T[k, r, 0] = a * e00 + b * e10 + d * e20
            T[k, r, 1] = a * e01 + b * e11 + d * e21
            T[k, r, 2] = a * e02 + b * e12 + d * e22


@kernel
def settle_stretch(
    points: F64, ends: I64, wheels: F64, T: F64, weight: F64, index: I32, A_map: F64, b_map: F64, mean: F64,
    omega: F64, scales: F64, least_wheel_scale: float, gate: float, wheel_weight: float, share: float, small_m: float,
    small_rad: float, T_match: F64, scale_match: F64, H: F64, slope: F64, constrained: F64, cost: F64, matched: I64,
    inside: I64, first: I32, T_step: F64, information: F64, shared: F64, chi2: float, T_belief: F64,
    shared_belief: F64, information_belief: F64, gradient_belief: F64, shared_now: F64, most_steps: int, stop_m: float,
    stop_rad: float, A: F64, g: F64,
) -> bool:  # fmt: skip
    """Move the poses T (N, 4, 4) of a stretch, and `shared_now`, to where map, steps and belief agree best: steps of
    Gauss-Newton at each of `scales` (S,), at most `most_steps`, until no pose moves by `stop_m` or `stop_rad`.

    The rest is as in `match_moved` and `normal_equations`; A and g are those at the last poses. False where the normal
    equations are singular.
    """
    n = g.shape[0]
    L, x = np.empty((n, n)), np.empty(n)
    for stage in range(scales.shape[0] + 1):
        scale = scales[min(stage, scales.shape[0] - 1)]
        for _ in range(most_steps):
            match_moved(
                points, ends, wheels, T, index, A_map, b_map, mean, omega, scale, max(scale, least_wheel_scale), gate,
                wheel_weight, share, small_m, small_rad, T_match, scale_match, H, slope, constrained, cost, matched,
                inside,
            )  # fmt: skip
            normal_equations(
                T, weight, T_match, H, slope, first, T_step, information, shared, chi2, T_belief, shared_belief,
                information_belief, gradient_belief, shared_now, A, g,
            )  # fmt: skip
            if stage == scales.shape[0]:  # once more, at the last poses
                return True
            if not solve(A, g, L, x) and not eliminate(A.copy(), g.copy(), x):
                return False
            move(T, x)
            for r in range(SHARED):
                shared_now[r] -= x[n - SHARED + r]
            turn, shift = 0.0, 0.0
            for r in range(n - SHARED):
                if r % 6 < 3:
                    turn = max(turn, abs(x[r]))
                else:
                    shift = max(shift, abs(x[r]))
            if shift < stop_m and turn < stop_rad:
                break
    return True


@bare
def _inverted(S: F64, out: F64) -> bool:
    """Fill `out` (n, n) with the inverse of S, symmetric, which is used up. False where it is not positive definite."""
    n = S.shape[0]
    for r in range(n):
        for c in range(n):
            out[r, c] = 1.0 if r == c else 0.0
    for p in range(n):
        if not S[p, p] > 0.0:
            return False
        pivot = S[p, p]
        for c in range(n):
            S[p, c] /= pivot
            out[p, c] /= pivot
        for r in range(n):
            if r != p:
                factor = S[r, p]
                for c in range(n):
                    S[r, c] -= factor * S[p, c]
                    out[r, c] -= factor * out[p, c]
    return True


@kernel
def _taken_apart(A: F64, middle: int, D: F64, U: F64, X: F64) -> None:
    """Fill blocks D and U (N, 6, 6) of the poses' part of A, and the right sides X (N, 6, `SHARED` + 6): how the poses
    know what all share, and the unit vectors of the pose `middle`; X is 0 before.
    """
    n = D.shape[0]
    for k in range(n):
        at = 6 * k
        D[k] = A[at : at + 6, at : at + 6]
        if k < n - 1:
            U[k] = A[at : at + 6, at + 6 : at + 12]
        X[k, :, :SHARED] = A[at : at + 6, 6 * n :]
    for r in range(6):
        X[middle, r, SHARED + r] = 1.0


@kernel
def _covariance_of_shared(A: F64, B: F64, X: F64, shared: F64) -> bool:
    """Fill `shared` (`SHARED`, `SHARED`), where X solves the poses' part of A for B (N, 6, `SHARED`). False where A is
    not positive definite.
    """
    n = B.shape[0]
    left = A[6 * n :, 6 * n :].copy()
    for k in range(n):
        for a in range(SHARED):
            for b in range(SHARED):
                for r in range(6):
                    left[a, b] -= B[k, r, a] * X[k, r, b]
    return _inverted(left, shared)


@bare
def _put(own: F64, through: F64, X: F64, covariance: F64, k: int, m: int) -> None:
    """Put the covariance of the poses k and m into place, on both sides: `own` (6, 6) by the poses' part alone, and
    what comes through all they share, `through` (6, `SHARED`) of k and X (6, `SHARED` or more) of m.
    """
    for r in range(6):
        for c in range(6):
            value = own[r, c]
            for a in range(SHARED):
                value += through[r, a] * X[c, a]
            covariance[6 * k + r, 6 * m + c] = covariance[6 * m + c, 6 * k + r] = value


@kernel
def covariances_asked(A: F64, middle: int, covariance: F64) -> bool:
    """Fill what is asked of the inverse of the normal equations A (n, n), n = 6 N + `SHARED`: of each pose, of each and
    its neighbours, of each and what all share, and all of the pose `middle`. The rest of `covariance` (n, n) is NaN.

    False where A is not positive definite; nothing is filled then.
    """
    n = (A.shape[0] - SHARED) // 6
    D, U, inverse, X = np.empty((n, 6, 6)), np.zeros((n, 6, 6)), np.empty((n, 6, 6)), np.zeros((n, 6, SHARED + 6))
    _taken_apart(A, middle, D, U, X)
    if not factor_chain(D, U, inverse):
        return False
    B, shared, through = X[:, :, :SHARED].copy(), np.empty((SHARED, SHARED)), np.zeros((n, 6, SHARED))
    solve_chain_columns(U, inverse, X)
    if not _covariance_of_shared(A, B, X, shared):
        return False
    own, beside = D, np.zeros((n, 6, 6))
    chain_covariances(U, inverse, own, beside)
    covariance[:] = np.nan
    covariance[6 * n :, 6 * n :] = shared
    for k in range(n):
        for r in range(6):
            for a in range(SHARED):
                for b in range(SHARED):
                    through[k, r, a] += X[k, r, b] * shared[b, a]
                covariance[6 * k + r, 6 * n + a] = covariance[6 * n + a, 6 * k + r] = -through[k, r, a]
    for k in range(n):
        _put(X[k, :, SHARED:], through[k], X[middle], covariance, k, middle)
        _put(own[k], through[k], X[k], covariance, k, k)
    for k in range(n - 1):
        _put(beside[k], through[k], X[k + 1], covariance, k, k + 1)
    return True
