"""Numba kernels of the point-to-Gaussian registration (DESIGN 8): plain loops over flat arrays, no allocation."""

import numpy as np

from gnd.gnd_map.arrays import F64, I32
from gnd.gnd_map.jit import bare, bare_inlined, kernel

JACOBI_SWEEPS = 6  # a symmetric 3x3 matrix is diagonal to 1e-15 after five
MOST_SWEEPS = 30  # of larger ones, which stop when they are diagonal: after six or seven
LEVER_M = 10.0  # a turn moves the points that constrain it by about this times its angle


@bare_inlined
def _rotation(S: F64, p: int, q: int) -> tuple[float, float, float]:
    """Tangent, cosine and sine of the turn of the symmetric S (n, n) after which S[p, q], not 0 now, is 0."""
    theta = 0.5 * (S[q, q] - S[p, p]) / S[p, q]
    t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
    c = 1.0 / np.sqrt(t * t + 1.0)
    return t, c, t * c


@bare
def _jacobi_rotate(S: F64, V: F64, p: int, q: int) -> None:
    """Turn the symmetric S (3, 3) so that S[p, q] becomes 0, and the columns of V with it."""
    if S[p, q] == 0.0:
        return
    t, c, s = _rotation(S, p, q)
    o = 3 - p - q
    S[p, p], S[q, q] = S[p, p] - t * S[p, q], S[q, q] + t * S[p, q]
    S[p, q] = S[q, p] = 0.0
    S[o, p], S[o, q] = c * S[o, p] - s * S[o, q], s * S[o, p] + c * S[o, q]
    S[p, o], S[q, o] = S[o, p], S[o, q]
    for r in range(3):
        V[r, p], V[r, q] = c * V[r, p] - s * V[r, q], s * V[r, p] + c * V[r, q]


@kernel
def tapered_information(cov: F64, noise_m2: float, uniform_m2: float, information: F64) -> None:
    """Fill `information` (M, 6) from the covariances `cov` (M, 6), both xx,xy,xz,yy,yz,zz.

    Along each principal axis 1/(variance + noise), less what a voxel filled evenly (variance `uniform_m2`) would give,
    never below 0. Eigenvectors by cyclic Jacobi rotations; `numpy.linalg.eigh` is the oracle in the tests.
    """
    S, V = np.empty((3, 3)), np.empty((3, 3))
    for m in range(cov.shape[0]):
        V[:] = 0.0
        V[0, 0] = V[1, 1] = V[2, 2] = 1.0
        S[0, 0], S[0, 1], S[0, 2], S[1, 1], S[1, 2], S[2, 2] = cov[m]
        S[1, 0], S[2, 0], S[2, 1] = S[0, 1], S[0, 2], S[1, 2]
        for _ in range(JACOBI_SWEEPS):
            _jacobi_rotate(S, V, 0, 1)
            _jacobi_rotate(S, V, 0, 2)
            _jacobi_rotate(S, V, 1, 2)
        information[m] = 0.0
        for k in range(3):
            i = max(0.0, 1.0 / (max(S[k, k], 0.0) + noise_m2) - 1.0 / (uniform_m2 + noise_m2))
            x, y, z = V[0, k], V[1, k], V[2, k]
            information[m, 0] += i * x * x
            information[m, 1] += i * x * y
            information[m, 2] += i * x * z
            information[m, 3] += i * y * y
            information[m, 4] += i * y * z
            information[m, 5] += i * z * z


@bare_inlined
def _mahalanobis2(o: F64, d0: float, d1: float, d2: float) -> float:
    """Squared distance d' Omega d with Omega as upper triangle (6,)."""
    mixed = o[1] * d0 * d1 + o[2] * d0 * d2 + o[4] * d1 * d2
    return float(o[0] * d0 * d0 + o[3] * d1 * d1 + o[5] * d2 * d2 + 2.0 * mixed)


@bare_inlined
def _nearest(
    q0: float, q1: float, q2: float, cell: int, ny: int, nz: int, flat: I32, mean: F64, omega: F64, gate_m2: float
) -> tuple[int, float]:
    """Row and squared Mahalanobis distance of the nearest Gaussian of the voxel and its six face neighbours, or -1."""
    best, best_m2 = -1, gate_m2
    for step in (0, ny * nz, -ny * nz, nz, -nz, 1, -1):
        row = flat[np.uint64(cell + step)]
        if row >= 0:
            u = np.uint64(row)  # not below 0: no look from the end
            m2 = _mahalanobis2(omega[u], q0 - mean[u, 0], q1 - mean[u, 1], q2 - mean[u, 2])
            if m2 < best_m2:
                best, best_m2 = row, m2
    return best, best_m2


@bare_inlined
def _known_cell(q0: float, q1: float, q2: float, nx: int, ny: int, nz: int, flat: I32, A: F64, b: F64) -> int:
    """Number of the cell of the window (nx, ny, nz), `flat`, that a map point lies in; -1 at its edge, outside, and in
    tiles not held.
    """
    gx = A[0, 0] * q0 + A[0, 1] * q1 + A[0, 2] * q2 + b[0]
    gy = A[1, 0] * q0 + A[1, 1] * q1 + A[1, 2] * q2 + b[1]
    gz = A[2, 0] * q0 + A[2, 1] * q1 + A[2, 2] * q2 + b[2]
    if not (1.0 <= gx < nx - 1 and 1.0 <= gy < ny - 1 and 1.0 <= gz < nz - 1):
        return -1
    cell = (int(gx) * ny + int(gy)) * nz + int(gz)
    return -1 if flat[np.uint64(cell)] < -1 else cell


@bare
def linearise(
    points: F64, R: F64, t: F64, index: I32, A: F64, b: F64, mean: F64, omega: F64, scale2: float, gate_m2: float,
    H: F64, g: F64,
) -> tuple[float, int, int]:  # fmt: skip
    """Normal equations of sum rho(d' Omega d), d = R p + t - mean, about the pose (R, t).

    Args:
        points: (N, 3) in the vehicle frame.
        R: (3, 3), with t the pose in the map frame.
        t: (3,).
        index: (nx, ny, nz) int32: a row of `mean` and `omega`, -1 empty, below -1 unknown.
        A: (3, 3); window coordinates of a map point q are A q + b.
        b: (3,).
        mean: (M, 3) in the map frame.
        omega: (M, 6) information matrices, 1/m².
        scale2: square of the Geman-McClure scale.
        gate_m2: largest squared Mahalanobis distance of a match.
        H: (6, 6), filled: for a turn about the vehicle and a shift, both along map axes, rotation first.
        g: (6,), filled: the gradient to H.

    Returns:
        robust cost (between 0 and scale2 a point), points matched, points in known voxels.
    """
    nx, ny, nz = index.shape
    flat, t0, t1, t2 = index.reshape(-1), t[0], t[1], t[2]
    cost, matched, inside = 0.0, 0, 0
    # Sums in plain numbers, which the processor keeps; in an array each would be stored and loaded for each point.
    g0 = g1 = g2 = g3 = g4 = g5 = 0.0
    h00 = h01 = h02 = h11 = h12 = h22 = 0.0
    h03 = h04 = h05 = h13 = h14 = h15 = h23 = h24 = h25 = 0.0
    h33 = h34 = h35 = h44 = h45 = h55 = 0.0
    for n in range(points.shape[0]):
        p0, p1, p2 = points[n, 0], points[n, 1], points[n, 2]
        a0 = R[0, 0] * p0 + R[0, 1] * p1 + R[0, 2] * p2
        a1 = R[1, 0] * p0 + R[1, 1] * p1 + R[1, 2] * p2
        a2 = R[2, 0] * p0 + R[2, 1] * p1 + R[2, 2] * p2
        q0, q1, q2 = a0 + t0, a1 + t1, a2 + t2
        cell = _known_cell(q0, q1, q2, nx, ny, nz, flat, A, b)
        if cell < 0:
            continue
        inside += 1
        row, m2 = _nearest(q0, q1, q2, cell, ny, nz, flat, mean, omega, gate_m2)
        if row < 0:
            cost += scale2
            continue
        matched += 1
        cost += scale2 * m2 / (scale2 + m2)  # Geman-McClure
        w, o = (scale2 / (scale2 + m2)) * (scale2 / (scale2 + m2)), omega[row]
        d0, d1, d2 = q0 - mean[row, 0], q1 - mean[row, 1], q2 - mean[row, 2]
        # J = [-[a]x, I], H += w J' Omega J (upper triangle), g += w J' Omega d
        o00, o01, o02, o11, o12, o22 = w * o[0], w * o[1], w * o[2], w * o[3], w * o[4], w * o[5]
        f0, f1, f2 = o00 * d0 + o01 * d1 + o02 * d2, o01 * d0 + o11 * d1 + o12 * d2, o02 * d0 + o12 * d1 + o22 * d2
        g0 += a1 * f2 - a2 * f1
        g1 += a2 * f0 - a0 * f2
        g2 += a0 * f1 - a1 * f0
        g3 += f0
        g4 += f1
        g5 += f2
        b00, b01, b02 = a1 * o02 - a2 * o01, a1 * o12 - a2 * o11, a1 * o22 - a2 * o12  # B = [a]x Omega
        b10, b11, b12 = a2 * o00 - a0 * o02, a2 * o01 - a0 * o12, a2 * o02 - a0 * o22
        b20, b21, b22 = a0 * o01 - a1 * o00, a0 * o11 - a1 * o01, a0 * o12 - a1 * o02
        h00 += a1 * b02 - a2 * b01  # B [a]x'
        h01 += a2 * b00 - a0 * b02
        h02 += a0 * b01 - a1 * b00
        h11 += a2 * b10 - a0 * b12
        h12 += a0 * b11 - a1 * b10
        h22 += a0 * b21 - a1 * b20
        h03 += b00
        h04 += b01
        h05 += b02
        h13 += b10
        h14 += b11
        h15 += b12
        h23 += b20
        h24 += b21
        h25 += b22
        h33 += o00
        h34 += o01
        h35 += o02
        h44 += o11
        h45 += o12
        h55 += o22
    g[0], g[1], g[2], g[3], g[4], g[5] = g0, g1, g2, g3, g4, g5
    H[0, 0], H[0, 1], H[0, 2], H[0, 3], H[0, 4], H[0, 5] = h00, h01, h02, h03, h04, h05
    H[1, 1], H[1, 2], H[1, 3], H[1, 4], H[1, 5], H[2, 2] = h11, h12, h13, h14, h15, h22
    H[2, 3], H[2, 4], H[2, 5], H[3, 3], H[3, 4], H[3, 5] = h23, h24, h25, h33, h34, h35
    H[4, 4], H[4, 5], H[5, 5] = h44, h45, h55
    for r in range(6):
        for c in range(r):
            H[r, c] = H[c, r]
    return cost, matched, inside


@bare
def point_fits(
    points: F64, R: F64, t: F64, index: I32, A: F64, b: F64, mean: F64, omega: F64, scale2: float, gate_m2: float,
    fits: F64,
) -> None:  # fmt: skip
    """Fill `fits` (N,): 1 - robust cost of each point at the pose (R, t), 0 ... 1; arguments as of `linearise`."""
    nx, ny, nz = index.shape
    flat = index.reshape(-1)
    for n in range(points.shape[0]):
        fits[n] = 0.0
        p0, p1, p2 = points[n, 0], points[n, 1], points[n, 2]
        q0 = R[0, 0] * p0 + R[0, 1] * p1 + R[0, 2] * p2 + t[0]
        q1 = R[1, 0] * p0 + R[1, 1] * p1 + R[1, 2] * p2 + t[1]
        q2 = R[2, 0] * p0 + R[2, 1] * p1 + R[2, 2] * p2 + t[2]
        cell = _known_cell(q0, q1, q2, nx, ny, nz, flat, A, b)
        if cell < 0:
            continue
        row, m2 = _nearest(q0, q1, q2, cell, ny, nz, flat, mean, omega, gate_m2)
        if row >= 0:
            fits[n] = scale2 / (scale2 + m2)


@bare
def pulls(
    points: F64, R: F64, t: F64, index: I32, A: F64, b: F64, mean: F64, omega: F64, scale2: float, gate_m2: float,
    along: F64, pull: F64, weight: F64,
) -> None:  # fmt: skip
    """Add the slope of the cost along D motions, and its curvature, Gaussian by Gaussian.

    What is not named here is as in `linearise`. along: (D, 6) motions, each a turn about the vehicle and a shift along
    map axes, rotation first. pull: (M, D), added to: w u' Omega d, with u the motion of a point. weight: (M, D), added
    to: w u' Omega u.
    """
    nx, ny, nz = index.shape
    flat = index.reshape(-1)
    for n in range(points.shape[0]):
        p0, p1, p2 = points[n, 0], points[n, 1], points[n, 2]
        a0 = R[0, 0] * p0 + R[0, 1] * p1 + R[0, 2] * p2
        a1 = R[1, 0] * p0 + R[1, 1] * p1 + R[1, 2] * p2
        a2 = R[2, 0] * p0 + R[2, 1] * p1 + R[2, 2] * p2
        q0, q1, q2 = a0 + t[0], a1 + t[1], a2 + t[2]
        cell = _known_cell(q0, q1, q2, nx, ny, nz, flat, A, b)
        if cell < 0:
            continue
        row, m2 = _nearest(q0, q1, q2, cell, ny, nz, flat, mean, omega, gate_m2)
        if row < 0:
            continue
        o, s = omega[row], scale2 / (scale2 + m2)
        d0, d1, d2 = q0 - mean[row, 0], q1 - mean[row, 1], q2 - mean[row, 2]
        f0, f1, f2 = (
            o[0] * d0 + o[1] * d1 + o[2] * d2,
            o[1] * d0 + o[3] * d1 + o[4] * d2,
            o[2] * d0 + o[4] * d1 + o[5] * d2,
        )
        for k in range(along.shape[0]):
            w = along[k]
            u0 = w[1] * a2 - w[2] * a1 + w[3]
            u1 = w[2] * a0 - w[0] * a2 + w[4]
            u2 = w[0] * a1 - w[1] * a0 + w[5]
            pull[row, k] += s * s * (u0 * f0 + u1 * f1 + u2 * f2)
            weight[row, k] += s * s * _mahalanobis2(o, u0, u1, u2)


@bare
def cholesky(S: F64, least: float, L: F64) -> bool:
    """Fill L (6, 6) with the lower factor of S - `least` I, S symmetric; False where that is not positive definite, so
    that not all eigenvalues of S are above `least`.
    """
    for r in range(6):
        for c in range(r + 1):
            rest = S[r, c] - (least if r == c else 0.0)
            for k in range(c):
                rest -= L[r, k] * L[c, k]
            if r > c:
                L[r, c] = rest / L[c, c]
            elif rest > 0.0:
                L[r, r] = np.sqrt(rest)
            else:
                return False
    return True


@bare
def _rotate(S: F64, V: F64, p: int, q: int) -> None:
    """Turn the symmetric S (n, n) so that S[p, q] becomes 0, and the columns of V with it."""
    if S[p, q] == 0.0:
        return
    _, c, s = _rotation(S, p, q)
    for r in range(S.shape[0]):
        S[r, p], S[r, q] = c * S[r, p] - s * S[r, q], s * S[r, p] + c * S[r, q]
        V[r, p], V[r, q] = c * V[r, p] - s * V[r, q], s * V[r, p] + c * V[r, q]
    for r in range(S.shape[0]):
        S[p, r], S[q, r] = c * S[p, r] - s * S[q, r], s * S[p, r] + c * S[q, r]


@bare
def principal(S: F64, V: F64) -> None:
    """Make the symmetric S (n, n) diagonal; the columns of V (n, n) become its eigenvectors (cyclic Jacobi)."""
    V[:] = 0.0
    for r in range(S.shape[0]):
        V[r, r] = 1.0
    for _ in range(MOST_SWEEPS):
        beside, on = 0.0, 0.0
        for r in range(S.shape[0]):
            on += S[r, r] * S[r, r]
            for c in range(r):
                beside += S[r, c] * S[r, c]
        if beside <= 1e-30 * on:
            return
        for p in range(S.shape[0] - 1):
            for q in range(p + 1, S.shape[0]):
                _rotate(S, V, p, q)


@bare
def by_levers(H: F64, S: F64) -> None:
    """Fill S (6, 6) with H, turns measured as motion at `LEVER_M`."""
    for r in range(6):
        for c in range(6):
            S[r, c] = H[r, c] / ((LEVER_M if r < 3 else 1.0) * (LEVER_M if c < 3 else 1.0))


@bare
def _substitute(L: F64, x: F64) -> None:
    """Divide x (6,) by L L', L (6, 6) a lower triangle."""
    for r in range(6):
        for c in range(r):
            x[r] -= L[r, c] * x[c]
        x[r] /= L[r, r]
    for r in range(5, -1, -1):
        for c in range(r + 1, 6):
            x[r] -= L[c, r] * x[c]
        x[r] /= L[r, r]


@kernel
def newton_step(H: F64, g: F64, least: float, step: F64) -> None:
    """Fill `step` (6,) with -H^-1 g without the directions of which H, turns measured at `LEVER_M`, has no more than
    `least` (solution remapping, Zhang et al. 2016). `registration._solve` is the plain twin.
    """
    S, L, V = np.empty((6, 6)), np.zeros((6, 6)), np.empty((6, 6))
    by_levers(H, S)
    for r in range(6):
        step[r] = -g[r] / (LEVER_M if r < 3 else 1.0)
    if cholesky(S, least, L) and cholesky(S, 0.0, L):  # nearly always: all directions count
        _substitute(L, step)
    else:
        principal(S, V)
        down = step.copy()
        step[:] = 0.0
        for k in range(6):
            if S[k, k] > least:
                step += V[:, k] * ((V[:, k] * down).sum() / S[k, k])
    for r in range(3):
        step[r] /= LEVER_M


@bare_inlined
def rotation_of(x: float, y: float, z: float) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Entries, row by row, of the rotation about the vector x, y, z by its length in radians."""
    angle = np.sqrt(x * x + y * y + z * z)
    half_sine = np.sin(0.5 * angle) / angle if angle > 1e-8 else 0.5
    x, y, z, w = half_sine * x, half_sine * y, half_sine * z, np.cos(0.5 * angle)
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w),
        2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w),
        2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@bare
def _turned(step: F64, R: F64) -> None:
    """R (3, 3) becomes exp(step[:3]) R."""
    e00, e01, e02, e10, e11, e12, e20, e21, e22 = rotation_of(step[0], step[1], step[2])
    for c in range(3):
        a, b, d = R[0, c], R[1, c], R[2, c]
        R[0, c] = e00 * a + e01 * b + e02 * d
        R[1, c] = e10 * a + e11 * b + e12 * d
        R[2, c] = e20 * a + e21 * b + e22 * d


@kernel
def stand(
    wheels: F64, R: F64, t: F64, index: I32, A: F64, b: F64, mean: F64, omega: F64, scale: float, gate: float,
    weight: float, H: F64, g: F64,
) -> int:  # fmt: skip
    """Add points of the vehicle that stand on the map's ground, the wheels (W, 3), to H (6, 6) and g (6,) of
    `linearise`, each `weight` times; gives how many do.

    They tell turns about the map's east and north, and height: of a road of which the map holds single rings, its
    Gaussians would give where the rings lie. scale: of Geman-McClure [sigmas]. gate: largest distance in scales.
    """
    if weight <= 0.0:
        return 0
    more, slope = np.empty((6, 6)), np.empty(6)
    gate_m2 = (gate * scale) ** 2
    _, on_ground, _ = linearise(wheels, R, t, index, A, b, mean, omega, scale**2, gate_m2, more, slope)
    for r in (0, 1, 5):
        g[r] += weight * slope[r]
        for c in (0, 1, 5):
            H[r, c] += weight * more[r, c]
    return on_ground


@kernel
def descend(
    points: F64, wheels: F64, R: F64, t: F64, index: I32, A: F64, b: F64, mean: F64, omega: F64, scale: float,
    wheel_scale: float, gate: float, wheel_weight: float, least: float, stop_rad: float, stop_m: float, most_steps: int,
    least_matched: int,
) -> tuple[int, bool, int, int]:  # fmt: skip
    """Gauss-Newton steps of the pose R (3, 3), t (3,), which is moved, at one robust scale until they are small.

    What is not named here is as in `linearise` and `stand`. wheel_scale: the wheels' own. least: information that a
    direction must have, see `newton_step`. stop_rad, stop_m: a step is small below these. least_matched: it ends early
    where fewer points match.

    Returns:
        steps; whether the last was small; points matched, and in known voxels, at the last pose that was looked from.
    """
    H, g, step = np.empty((6, 6)), np.empty(6), np.empty(6)
    matched, inside = 0, 0
    gate_m2 = (gate * scale) ** 2
    for n in range(1, most_steps + 1):
        _, matched, inside = linearise(points, R, t, index, A, b, mean, omega, scale**2, gate_m2, H, g)
        if matched < least_matched:
            return n, False, matched, inside
        stand(wheels, R, t, index, A, b, mean, omega, wheel_scale, gate, wheel_weight, H, g)
        newton_step(H, g, least, step)
        _turned(step, R)
        turn, shift = 0.0, 0.0
        for r in range(3):
            t[r] += step[r + 3]
            turn, shift = max(turn, abs(step[r])), max(shift, abs(step[r + 3]))
        if turn < stop_rad and shift < stop_m:
            return n, True, matched, inside
    return most_steps, False, matched, inside


@kernel
def without_hints(H: F64, share: float, constrained: F64) -> bool:
    """Fill `constrained` (6, 6): takes from a motion the horizontal directions for which H (6, 6), turns measured at
    `LEVER_M`, has less than `share` of the strongest; False where it takes nothing.
    """
    S, V = np.empty((6, 6)), np.empty((6, 6))
    by_levers(H, S)
    principal(S, V)
    horizontal = V[3] ** 2 + V[4] ** 2 > 0.5
    strongest = 0.0
    for k in range(6):
        if horizontal[k]:
            strongest = max(strongest, S[k, k])
    constrained[:] = 0.0
    takes = False
    for k in range(6):
        if horizontal[k] and S[k, k] <= share * strongest:
            takes = True
        else:
            constrained += np.outer(V[:, k], V[:, k])
    for r in range(6):
        for c in range(6):
            levers = (LEVER_M if c < 3 else 1.0) / (LEVER_M if r < 3 else 1.0)
            constrained[r, c] = constrained[r, c] * levers if takes else (1.0 if r == c else 0.0)
    return takes
