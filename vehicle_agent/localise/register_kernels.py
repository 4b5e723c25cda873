"""Numba kernels of a whole registration: stages of Gauss-Newton, directions that count, and the covariance.

`registration` calls them; the plain twins are in `tests/localise/test_register_kernels.py`.
"""

import numpy as np

from gnd.gnd_map.arrays import BOOL, F64, I32
from gnd.gnd_map.jit import bare, kernel
from gnd.vehicle_agent.localise.kernels import LEVER_M, by_levers, descend, linearise, principal, stand, without_hints

FREE_M2 = 100.0
"""Variance of a direction that nothing constrains: it gets 10 m."""


@kernel
def in_vehicle_axes(R: F64, H: F64, g: F64) -> None:
    """Turn H (6, 6) and g (6,) of a motion along map axes into those of the same motion along the vehicle's axes,
    R (3, 3) its attitude.
    """
    block, turned = np.empty((3, 3)), np.empty(3)
    for top in (0, 3):
        for r in range(3):
            turned[r] = R[0, r] * g[top] + R[1, r] * g[top + 1] + R[2, r] * g[top + 2]
        for r in range(3):
            g[top + r] = turned[r]
        for left in (0, 3):
            for r in range(3):
                for c in range(3):
                    block[r, c] = 0.0
                    for k in range(3):
                        block[r, c] += H[top + r, left + k] * R[k, c]
            for r in range(3):
                for c in range(3):
                    H[top + r, left + c] = R[0, r] * block[0, c] + R[1, r] * block[1, c] + R[2, r] * block[2, c]


@kernel
def _projected(P: F64, H: F64, g: F64) -> None:
    """H (6, 6) becomes P' H P, and g (6,) becomes P' g."""
    half, slope = np.zeros((6, 6)), np.zeros(6)
    for r in range(6):
        for k in range(6):
            slope[r] += P[k, r] * g[k]
            for c in range(6):
                half[r, c] += H[r, k] * P[k, c]
    for r in range(6):
        g[r] = slope[r]
        for c in range(6):
            H[r, c] = 0.0
            for k in range(6):
                H[r, c] += P[k, r] * half[k, c]


@kernel
def linearise_pose(
    points: F64, wheels: F64, R: F64, t: F64, index: I32, A: F64, b: F64, mean: F64, omega: F64, scale: float,
    wheel_scale: float, gate: float, wheel_weight: float, share: float, H: F64, g: F64, constrained: F64,
) -> tuple[float, int, int]:  # fmt: skip
    """Fill H (6, 6) and g (6,) of points and wheels for a small motion along the vehicle's own axes, and `constrained`
    (6, 6), which projects on the directions that count; arguments as of `descend`, share as of `without_hints`.

    Returns:
        robust cost of the points, points matched, points in known voxels.
    """
    said = linearise(points, R, t, index, A, b, mean, omega, scale**2, (gate * scale) ** 2, H, g)
    stand(wheels, R, t, index, A, b, mean, omega, wheel_scale, gate, wheel_weight, H, g)
    in_vehicle_axes(R, H, g)
    if without_hints(H, share, constrained):
        _projected(constrained, H, g)
    return said


@kernel
def strong_directions(H: F64, least: float, share: float, values: F64, vectors: F64, strong: BOOL) -> None:
    """Principal directions of H (6, 6), turns measured as motion at `LEVER_M`, and which of them are constrained.

    Args:
        H: (6, 6).
        least: information that a direction must have.
        share: what a horizontal one must have of the strongest horizontal one: more than the noise of a map gives along
            an even wall. The vertical one, which wheels on the road hold firmly, is no measure.
        values: (6,), filled, rising.
        vectors: (6, 6), filled, columns.
        strong: (6,), filled.
    """
    S, V = np.empty((6, 6)), np.empty((6, 6))
    by_levers(H, S)
    principal(S, V)
    found = np.empty(6)
    for k in range(6):
        found[k] = S[k, k]
    order = np.argsort(found)
    strongest = 0.0
    for k in range(6):
        values[k] = found[order[k]]
        vectors[:, k] = V[:, order[k]]
        strong[k] = vectors[3, k] ** 2 + vectors[4, k] ** 2 > 0.5  # horizontal, for the moment
        if strong[k]:
            strongest = max(strongest, values[k])
    for k in range(6):
        strong[k] = values[k] > (max(least, share * strongest) if strong[k] else least)


@kernel
def taken_back(t: F64, t_start: F64, least: float, values: F64, vectors: F64, strong: BOOL) -> bool:
    """Take from t (3,) what it was moved from t_start (3,) along directions that have some information, though too
    little; False where there are none.
    """
    off, back, any_weak = t - t_start, np.zeros(3), False
    for k in range(6):
        if not strong[k] and values[k] > least:
            any_weak = True
            length2 = vectors[3, k] ** 2 + vectors[4, k] ** 2 + vectors[5, k] ** 2
            along = (vectors[3, k] * off[0] + vectors[4, k] * off[1] + vectors[5, k] * off[2]) / length2
            for r in range(3):
                back[r] += along * vectors[r + 3, k]
    for r in range(3):
        t[r] -= back[r]
    return any_weak


@bare
def covariance_of(
    values: F64, vectors: F64, strong: BOOL, correlation: float, floor_rad: float, floor_m: float, covariance: F64
) -> None:
    """Fill `covariance` (6, 6): inverse Hessian, enlarged because points share errors, plus the floor."""
    for r in range(6):
        for c in range(6):
            covariance[r, c] = 0.0
    for k in range(6):
        variance = min(correlation / max(values[k] if strong[k] else 0.0, 1e-9), FREE_M2)
        for r in range(6):
            for c in range(6):
                levers = (LEVER_M if r < 3 else 1.0) * (LEVER_M if c < 3 else 1.0)
                covariance[r, c] += variance * vectors[r, k] * vectors[c, k] / levers
    for r in range(6):
        covariance[r, r] += floor_rad**2 if r < 3 else floor_m**2


@kernel
def believed(
    R: F64, H: F64, g: F64, least: float, share: float, correlation: float, floor_rad: float, floor_m: float,
    covariance: F64, degenerate: F64,
) -> int:  # fmt: skip
    """How far to believe a pose with attitude R (3, 3): H (6, 6) and g (6,) come along map axes, and are turned.

    `least` and `share` are as of `strong_directions`, the next three as of `MatchRules`. Fills `covariance` (6, 6), and
    the first rows of `degenerate` (6, 6) with unit directions that are not constrained; gives how many they are.
    """
    values, vectors, strong = np.empty(6), np.empty((6, 6)), np.empty(6, np.bool_)
    in_vehicle_axes(R, H, g)
    strong_directions(H, least, share, values, vectors, strong)
    covariance_of(values, vectors, strong, correlation, floor_rad, floor_m, covariance)
    n = 0
    for k in range(6):
        if not strong[k]:
            degenerate[n] = vectors[:, k]
            n += 1
    return n


@kernel
def registered(
    points: F64, wheels: F64, R: F64, t: F64, index: I32, A: F64, b: F64, mean: F64, omega: F64, scales: F64,
    wheel_scale: float, gate: float, wheel_weight: float, least: float, share: float, correlation: float,
    floor_rad: float, floor_m: float, stop_rad: float, stop_m: float, most_steps: int, least_matched: int,
    covariance: F64, degenerate: F64,
) -> tuple[int, bool, float, int, int, int]:  # fmt: skip
    """Move a scan onto the map, stage by stage of `scales` (S,), wide to narrow, and say how far to believe the pose.

    R (3, 3) and t (3,) are moved. The rest is as in `descend`, `strong_directions` and `believed`; steps of all stages
    but the last may be ten times as large.

    Returns:
        steps; whether the last was small; cost; points matched, and in known voxels; directions that are degenerate,
        or -1 where fewer than `least_matched` points match.
    """
    H, g, t_start = np.empty((6, 6)), np.empty(6), t.copy()
    values, vectors, strong = np.empty(6), np.empty((6, 6)), np.empty(6, np.bool_)
    last, steps, small = scales.shape[0] - 1, 0, False
    for stage in range(last + 1):
        scale, coarse = scales[stage], 1.0 if stage == last else 10.0
        used, small, matched, inside = descend(
            points, wheels, R, t, index, A, b, mean, omega, scale, max(scale, wheel_scale), gate, wheel_weight, least,
            coarse * stop_rad, coarse * stop_m, most_steps, least_matched,
        )  # fmt: skip
        steps += used
        if matched < least_matched:
            return steps, False, 0.0, matched, inside, -1
    scale = scales[last]
    for again in range(2):
        cost, matched, inside = linearise(points, R, t, index, A, b, mean, omega, scale**2, (gate * scale) ** 2, H, g)
        stand(wheels, R, t, index, A, b, mean, omega, max(scale, wheel_scale), gate, wheel_weight, H, g)
        if matched < least_matched:
            return steps, False, cost, matched, inside, -1
        strong_directions(H, least, share, values, vectors, strong)
        if again or not taken_back(t, t_start, least, values, vectors, strong):
            break
    n = believed(R, H, g, least, share, correlation, floor_rad, floor_m, covariance, degenerate)
    return steps, small, cost, matched, inside, n
