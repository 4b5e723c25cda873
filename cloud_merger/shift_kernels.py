"""The kernels of the shift test (`cloud_merger.shift`): which surfaces fit, which shift most planes agree on, the fit.

Base Gaussians are found by buckets of a metre over the ground. Distances and bounds are those of a k-d tree's queries.
"""

import math

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.jit import inlined, kernel
from gnd.gnd_map.similarity import alike, far_at

Mask = NDArray[np.bool_]
Planes = tuple[F64, F64, F64, F64]
"""Places (N, 3) m, covariances (N, 6) m², normals (N, 3), how flat (N,): 0 a ball, 1 a plane."""
Buckets = tuple[I64, I64, F64]
"""First row of each bucket and one more (B + 1,), rows by bucket (N,), and low east, low north, columns, rows (4,)."""

NEIGHBOURS = 12
"""Base Gaussians that one is compared with."""
BESIDE_M = 1.0
"""Gaussians of one surface lie so near to each other."""
REACH_M = 1.6
"""Planes beyond the largest shift."""
STEP_M = 0.05
"""Of the search."""
FLAT = 0.5
PARALLEL = 0.95
"""Cosine."""
HUBER_M = 0.05
NEAR_M = 0.3
"""Along the normal, of the fit's correspondences."""
NOISE_M = 0.05
"""Of the similarity."""
ROUNDS = 6
_MOST_BUCKETS = 256.0  # along one axis; what lies beyond is in the last


@kernel
def normals(cov_m2: F64) -> tuple[F64, F64]:
    """Normals (N, 3) and flatness (N,) of covariances (N, 6): Jacobi's rotations, exact for balls and lines too."""
    n = len(cov_m2)
    normal, flat = np.empty((n, 3)), np.empty(n)
    s, v = np.empty((3, 3)), np.empty((3, 3))
    for k in range(n):
        s[0, 0], s[0, 1], s[0, 2] = cov_m2[k, 0], cov_m2[k, 1], cov_m2[k, 2]
        s[1, 1], s[1, 2], s[2, 2] = cov_m2[k, 3], cov_m2[k, 4], cov_m2[k, 5]
        _diagonalise(s, v)
        least = 0
        for i in range(1, 3):
            if s[i, i] < s[least, least]:
                least = i
        middle = np.inf
        for i in range(3):
            if i != least:
                middle = min(middle, s[i, i])
            normal[k, i] = v[i, least]
        flat[k] = 1.0 - math.sqrt(max(s[least, least], 0.0) / max(middle, 1e-9))
    return normal, flat


@inlined
def _diagonalise(s: F64, v: F64) -> None:
    """Make the upper triangle of s (3, 3) diagonal; its eigenvectors become the columns of v (3, 3)."""
    for i in range(3):
        for j in range(3):
            v[i, j] = 1.0 if i == j else 0.0
    size = abs(s[0, 0]) + abs(s[1, 1]) + abs(s[2, 2])
    for _ in range(16):
        if abs(s[0, 1]) + abs(s[0, 2]) + abs(s[1, 2]) <= 1e-18 * size:
            return
        for p in range(2):
            for q in range(p + 1, 3):
                if s[p, q] == 0.0:
                    continue
                theta = (s[q, q] - s[p, p]) / (2.0 * s[p, q])
                t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                t = -t if theta < 0.0 else t
                c = 1.0 / math.sqrt(t * t + 1.0)
                sn = t * c
                other = 3 - p - q
                s[p, p] -= t * s[p, q]
                s[q, q] += t * s[p, q]
                s[p, q] = 0.0
                i, j = min(other, p), max(other, p)
                k, m = min(other, q), max(other, q)
                at_p, at_q = s[i, j], s[k, m]
                s[i, j], s[k, m] = c * at_p - sn * at_q, sn * at_p + c * at_q
                for i in range(3):
                    at_p, at_q = v[i, p], v[i, q]
                    v[i, p], v[i, q] = c * at_p - sn * at_q, sn * at_p + c * at_q


@kernel
def buckets_of(place_m: F64) -> Buckets:
    """Sort places (N, 3) into columns of a metre over the ground, each in the order of its rows."""
    east, north = place_m[:, 0].min(), place_m[:, 1].min()
    nx = min(math.floor(place_m[:, 0].max() - east) + 1.0, _MOST_BUCKETS)
    ny = min(math.floor(place_m[:, 1].max() - north) + 1.0, _MOST_BUCKETS)
    frame = np.array([east, north, nx, ny])
    start = np.zeros(int(nx) * int(ny) + 1, np.int64)
    at, order = np.empty(len(place_m), np.int64), np.empty(len(place_m), np.int64)
    for k in range(len(place_m)):
        at[k] = _bucket(place_m[k, 1], north, ny) * int(nx) + _bucket(place_m[k, 0], east, nx)
        start[at[k] + 1] += 1
    for b in range(len(start) - 1):
        start[b + 1] += start[b]
    end = start.copy()
    for k in range(len(place_m)):
        order[end[at[k]]] = k
        end[at[k]] += 1
    return start, order, frame


@inlined
def _bucket(at_m: float, low_m: float, n: float) -> int:
    return int(min(max(math.floor(at_m - low_m), 0.0), n - 1.0))


@kernel
def _within(x: float, y: float, z: float, reach_m: float, place_m: F64, buckets: Buckets, found: I64, off: F64) -> int:
    """Rows within `reach_m` of a place (all three axes), into `found`, squared distances into `off`; how many."""
    start, order, frame = buckets
    east, north, nx, ny = frame[0], frame[1], frame[2], frame[3]
    n = 0
    first, last = _bucket(x - reach_m, east, nx), _bucket(x + reach_m, east, nx)
    for row in range(_bucket(y - reach_m, north, ny), _bucket(y + reach_m, north, ny) + 1):
        for at in range(start[row * int(nx) + first], start[row * int(nx) + last + 1]):
            k = order[at]
            dx, dy, dz = x - place_m[k, 0], y - place_m[k, 1], z - place_m[k, 2]
            squared = dx * dx + dy * dy + dz * dz
            if squared <= reach_m * reach_m:
                found[n], off[n] = k, squared
                n += 1
    return n


@kernel
def _nearest(x: float, y: float, z: float, place_m: F64, buckets: Buckets, found: I64, off: F64) -> int:
    """The `NEIGHBOURS` rows nearest to a place and nearer than `BESIDE_M`, in no order, into `found`; how many."""
    n = _within(x, y, z, BESIDE_M, place_m, buckets, found, off)
    kept = 0
    for k in range(n):
        if off[k] < BESIDE_M * BESIDE_M:
            found[kept], off[kept] = found[k], off[k]
            kept += 1
    for k in range(min(kept, NEIGHBOURS) if kept > NEIGHBOURS else 0):  # the nearest to the front
        least = k
        for j in range(k + 1, kept):
            if off[j] < off[least] or (off[j] == off[least] and found[j] < found[least]):
                least = j
        found[k], found[least] = found[least], found[k]
        off[k], off[least] = off[least], off[k]
    return min(kept, NEIGHBOURS)


@kernel
def fitting(surfaces: Planes, known: Planes, buckets: Buckets, motion: F64, up_m: float, fits: float) -> Mask:
    """(N,) whether a surface, moved (east, north, turn) and raised, is like one of the base Gaussians around it."""
    place, cov = surfaces[0], surfaces[1]
    base, base_cov, normal, flat = known
    c, s = math.cos(motion[2]), math.sin(motion[2])
    found, off = np.empty(len(base), np.int64), np.empty(len(base))
    zero, step, far = np.zeros(3), np.empty(3), far_at(fits)
    result = np.zeros(len(place), np.bool_)
    for k in range(len(place)):
        x = c * place[k, 0] - s * place[k, 1] + motion[0]
        y = s * place[k, 0] + c * place[k, 1] + motion[1]
        z = place[k, 2] + up_m
        for at in range(_nearest(x, y, z, base, buckets, found, off)):
            j = found[at]
            step[0], step[1], step[2] = x - base[j, 0], y - base[j, 1], z - base[j, 2]
            if flat[j] > FLAT:
                along = step[0] * normal[j, 0] + step[1] * normal[j, 1] + step[2] * normal[j, 2]
                step[0], step[1], step[2] = along * normal[j, 0], along * normal[j, 1], along * normal[j, 2]
            if alike(zero, base_cov[j], step, cov[k], NOISE_M**2, far) >= fits:
                result[k] = True
                break
    return result


@kernel
def votes_of(upright: Planes, known: Planes, buckets: Buckets, axis: F64) -> I64:
    """(A * A,) how many upright planes have a parallel one that a shift lays them into; east runs fastest.

    Args:
        upright: planes that look for their like.
        known: the base.
        buckets: of the base.
        axis: (A,) shifts on each axis, evenly apart.
    """
    n = len(axis)
    place, normal = upright[0], upright[2]
    base, _, other, flat = known
    votes, seen = np.zeros(n * n, np.int64), np.full(n * n, -1, np.int64)
    found, off = np.empty(len(base), np.int64), np.empty(len(base))
    for k in range(len(place)):
        for at in range(_within(place[k, 0], place[k, 1], place[k, 2], REACH_M, base, buckets, found, off)):
            j = found[at]
            cosine = other[j, 0] * normal[k, 0] + other[j, 1] * normal[k, 1] + other[j, 2] * normal[k, 2]
            if flat[j] > FLAT and abs(cosine) > PARALLEL and abs(base[j, 2] - place[k, 2]) < BESIDE_M:
                apart = (base[j, 0] - place[k, 0], base[j, 1] - place[k, 1], base[j, 2] - place[k, 2])
                off_m = apart[0] * other[j, 0] + apart[1] * other[j, 1] + apart[2] * other[j, 2]
                _vote(k, off_m, apart[0], apart[1], other[j, 0], other[j, 1], axis, seen, votes)
    return votes


@kernel
def _vote(
    voter: int,
    off_m: float,
    apart_x: float,
    apart_y: float,
    normal_x: float,
    normal_y: float,
    axis: F64,
    seen: I64,
    votes: I64,
) -> None:
    """One vote for each shift that takes a plane into one `off_m` away: a strip of the grid along the plane."""
    n = len(axis)
    is_east = abs(normal_x) > abs(normal_y)  # the axis along which the strip is narrow; the other one is gone along
    narrow, wide = (normal_x, normal_y) if is_east else (normal_y, normal_x)
    wide_m = apart_y if is_east else apart_x
    stride, step = (1, n) if is_east else (n, 1)
    half = STEP_M / abs(narrow)
    for i in range(n):
        if abs(wide_m - axis[i]) >= BESIDE_M:
            continue
        middle = (off_m - wide * axis[i]) / narrow
        first = max(math.floor((middle - half - axis[0]) / STEP_M) - 1, 0)
        last = min(math.floor((middle + half - axis[0]) / STEP_M) + 2, n - 1)
        for j in range(first, last + 1):
            at = i * step + j * stride
            east, north = (axis[j], axis[i]) if is_east else (axis[i], axis[j])
            is_into = abs(off_m - (normal_x * east + normal_y * north)) < STEP_M
            if is_into and seen[at] != voter and _is_beside(apart_x - east, apart_y - north):
                seen[at] = voter
                votes[at] += 1


@inlined
def _is_beside(x: float, y: float) -> bool:
    """Whether hypot(x, y) < `BESIDE_M`; that is only computed where it is close."""
    squared = x * x + y * y
    if abs(squared - BESIDE_M * BESIDE_M) > 1e-9:
        return squared < BESIDE_M * BESIDE_M
    return math.hypot(x, y) < BESIDE_M


@kernel
def best_shift(pro: F64, far: F64, east: F64, north: F64, normal_x: F64, normal_y: F64, displaced_m: float) -> int:
    """The shift with the largest score; of equal ones the most western, then the most southern.

    Args:
        pro: (S,) share of planes that vote for each.
        far: (S,) taken off for its length.
        east: (S,) metres.
        north: (S,) metres.
        normal_x: (P,) of upright planes that are unchanged.
        normal_y: (P,)
        displaced_m: a shift that moves such a plane by more along its normal has it against it.

    Those against are counted only where the votes for a shift could still win, of the likeliest first.
    """
    best, most = 0, -np.inf
    likeliest = int(np.argmax(pro - far))
    for turn in range(-1, len(pro)):
        k = likeliest if turn < 0 else turn
        if pro[k] - far[k] < most:
            continue
        against = 0
        for p in range(len(normal_x)):
            against += abs(normal_x[p] * east[k] + normal_y[p] * north[k]) > displaced_m
        score = pro[k] - against / max(len(normal_x), 1) - far[k]
        is_first = (east[k], north[k]) < (east[best], north[best])
        if score > most or (score == most and is_first):
            best, most = k, score
    return best


@kernel
def refined(begin: F64, surfaces: Planes, known: Planes, buckets: Buckets, prior: F64, least: int) -> F64:
    """The motion (east, north, turn) after `ROUNDS` of robust point-to-plane least squares from `begin`.

    Args:
        begin: (3,) where the search ended.
        surfaces: to be moved.
        known: the base.
        buckets: of the base.
        prior: (3,) weight of having stayed at `begin`.
        least: with fewer correspondences it ends.
    """
    motion = begin.copy()
    found, off = np.empty(len(known[0]), np.int64), np.empty(len(known[0]))
    matrix, right, row = np.empty((3, 3)), np.empty(3), np.empty(3)
    for _ in range(ROUNDS):
        matrix[:] = 0.0
        for i in range(3):
            matrix[i, i], right[i] = prior[i], -prior[i] * (motion[i] - begin[i])
        c, s, n = math.cos(motion[2]), math.sin(motion[2]), 0
        for k in range(len(surfaces[0])):
            x = c * surfaces[0][k, 0] - s * surfaces[0][k, 1] + motion[0]
            y = s * surfaces[0][k, 0] + c * surfaces[0][k, 1] + motion[1]
            j, off_m = _nearest_plane(k, x, y, surfaces, known, buckets, found, off)
            if j < 0:
                continue
            n += 1
            normal = known[2][j]
            row[0], row[1], row[2] = normal[0], normal[1], normal[1] * x - normal[0] * y
            weight = min(1.0, HUBER_M / max(abs(off_m), 1e-9))
            for i in range(3):
                right[i] -= weight * off_m * row[i]
                for m in range(3):
                    matrix[i, m] += weight * row[i] * row[m]
        if n < least:
            break
        _solve(matrix, right)
        motion += right
    return motion


@kernel
def _nearest_plane(
    k: int, x: float, y: float, surfaces: Planes, known: Planes, buckets: Buckets, found: I64, off: F64
) -> tuple[int, float]:
    """The parallel plane nearest to surface k, at (x, y), along its normal: base row or -1, distance m."""
    base, _, normal, flat = known
    own, z = surfaces[2][k], surfaces[0][k, 2]
    best, best_m = -1, np.inf
    if not surfaces[3][k] > FLAT:
        return best, best_m
    for at in range(_nearest(x, y, z, base, buckets, found, off)):
        j = found[at]
        cosine = own[0] * normal[j, 0] + own[1] * normal[j, 1] + own[2] * normal[j, 2]
        if not (abs(cosine) > PARALLEL and flat[j] > FLAT):
            continue
        off_m = (x - base[j, 0]) * normal[j, 0] + (y - base[j, 1]) * normal[j, 1] + (z - base[j, 2]) * normal[j, 2]
        is_nearer = abs(off_m) < abs(best_m) or (abs(off_m) == abs(best_m) and j < best)
        if abs(off_m) < NEAR_M and is_nearer:
            best, best_m = j, off_m
    return best, best_m


@inlined
def _solve(matrix: F64, right: F64) -> None:
    """Solve a positive definite 3 x 3 system in place by elimination."""
    for i in range(3):
        for j in range(i + 1, 3):
            factor = matrix[j, i] / matrix[i, i]
            right[j] -= factor * right[i]
            for m in range(i, 3):
                matrix[j, m] -= factor * matrix[i, m]
    for i in range(2, -1, -1):
        for j in range(i + 1, 3):
            right[i] -= matrix[i, j] * right[j]
        right[i] /= matrix[i, i]


@kernel
def votes_up(level: F64, ground: F64, buckets: Buckets, steps: F64) -> I64:
    """(S,) how many level planes (N, 3) have a ground plane (G, 3) beside them that a step up lays them into."""
    start, order, frame = buckets
    east, north, nx, ny = frame[0], frame[1], frame[2], frame[3]
    votes, seen = np.zeros(len(steps), np.int64), np.full(len(steps), -1, np.int64)
    for k in range(len(level)):
        x, y = level[k, 0], level[k, 1]
        first, last = _bucket(x - BESIDE_M, east, nx), _bucket(x + BESIDE_M, east, nx)
        for row in range(_bucket(y - BESIDE_M, north, ny), _bucket(y + BESIDE_M, north, ny) + 1):
            for at in range(start[row * int(nx) + first], start[row * int(nx) + last + 1]):
                j = order[at]
                dx, dy = ground[j, 0] - x, ground[j, 1] - y
                if dx * dx + dy * dy > BESIDE_M * BESIDE_M:
                    continue
                for i in range(len(steps)):
                    if seen[i] != k and abs((ground[j, 2] - level[k, 2]) - steps[i]) < STEP_M:
                        seen[i] = k
                        votes[i] += 1
    return votes


@kernel
def unchanged_share(known: Planes, is_seen: Mask, is_changed: Mask, motion: F64, displaced_m: float) -> float:
    """Of observed surfaces that the motion would have displaced along their normals, the share unchanged; 0 of none."""
    place, _, normal, flat = known
    c, s = math.cos(motion[2]), math.sin(motion[2])
    displaced, unchanged = 0, 0
    for k in range(len(place)):
        x = c * place[k, 0] - s * place[k, 1] + motion[0] - place[k, 0]
        y = s * place[k, 0] + c * place[k, 1] + motion[1] - place[k, 1]
        if is_seen[k] and flat[k] > FLAT and abs(x * normal[k, 0] + y * normal[k, 1]) > displaced_m:
            displaced += 1
            unchanged += not is_changed[k]
    return unchanged / displaced if displaced else 0.0
