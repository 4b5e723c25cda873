"""Gaussians onto Gaussians: robust Gauss-Newton of the distribution-to-distribution distance, and what it is worth.

The distance is that of Stoyanov et al. 2012 (D2D-NDT) and of Segal et al. 2009 (GICP): d^T (C_a + R C_b R^T)^-1 d. Its
covariances are opened along surfaces (see `cloud`), so a wall holds the two maps together across itself alone.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.se3 import exp_so3
from gnd.vehicle_agent.map_align.cloud import GaussianCloud

_REACH_M: Final = 1.5
"""A pair's means lie at most so far apart (voxels of 1 m), or as far as the scale asks."""
_NEIGHBOURS: Final = 4
NOISE_M: Final = 0.04
"""How well a surface of a voxel repeats between two passes: noise of poses and sensor, and what a voxel cuts off."""
_PARALLEL: Final = 0.85
"""Cosine between the normals of a pair."""
_SCALES_M: Final = (1.0, 0.4, 0.15)
"""Robust scales, coarse to fine."""
_ROUNDS: Final = (6, 6, 10)
_TILT_PRIOR_RAD: Final = float(np.radians(1.0))
"""Two frames that both know the vertical differ by less; what no surface says stays there."""
MATCHED_SIGMA: Final = 3.0
_COVER_M: Final = 2.0
_SHARED: Final = 20.0
"""Pairs of neighbouring voxels share the errors of the passes that measured them: so many count as one."""
_STOP: Final = 2e-5
_PART_M: Final = 5.0
"""A turn moves the surfaces of a part by about this times its angle."""
_FIRM: Final = 0.03
"""A direction with less of the strongest one's information is held by chance."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Gaussians of B beside those of A that are the same surface.

    Attributes:
        row: (M,) rows of B.
        offset_m: (M, 3) mean of A less mean of B.
        information: (M, 3, 3) inverse of the pair's covariance.
        across_m: (M,) distance along the common normal.
        squared: (M,) distance in sigmas, squared.
    """

    row: I64
    offset_m: F64
    information: F64
    across_m: F64
    squared: F64


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """B laid onto A.

    Attributes:
        T_a_b: (4, 4) moves B onto A, in the common frame.
        covariance: (6, 6) of a small motion about `centre_m` along the frame's axes, rotation [rad] first.
        centre_m: (3,) middle of the pairs.
        H: (6, 6) information of it; pairs count as independent.
    """

    T_a_b: F64
    covariance: F64
    centre_m: F64
    H: F64


@dataclass(frozen=True, slots=True, eq=False)
class FitScore:
    """What a pose is worth.

    Attributes:
        upright: surfaces of B that stand where A knows anything.
        matched: those that have their surface in A.
        mass: sum over them of 1 - squared distance / 9: what candidates are compared by.
        level, level_matched: the same of level surfaces.
    """

    upright: int
    matched: int
    mass: float
    level: int
    level_matched: int

    @property
    def share(self) -> float:
        """Matched share of the upright surfaces."""
        return self.matched / max(self.upright, 1)

    @property
    def level_share(self) -> float:
        """Matched share of the level surfaces."""
        return self.level_matched / max(self.level, 1)


def pairs_of(a: GaussianCloud, b: GaussianCloud, scale_m: float) -> Pairs:
    """The nearest surface of A of each surface of B, among those with the same normal (posts: the same axis); B lies in
    A's frame.

    Args:
        a: what stays.
        b: what was moved onto it.
        scale_m: how far surfaces may lie apart, beyond what their own spread explains.
    """
    rows = b.surfaces
    if not len(rows) or not len(a.surfaces):
        return _no_pairs()
    reach_m = max(_REACH_M, 2.0 * scale_m)
    _, near = a.tree.query(b.mean_m[rows], k=_NEIGHBOURS, distance_upper_bound=reach_m)
    there = near < len(a.surfaces)
    near_a = a.surfaces[np.where(there, near, 0)]
    apart = a.mean_m[near_a] - b.mean_m[rows, None]
    is_like = np.abs(np.einsum("nki,ni->nk", a.normal[near_a], b.normal[rows])) > _PARALLEL
    posts = a.is_post[near_a] & b.is_post[rows, None]
    is_like = np.where(
        posts, np.abs(np.einsum("nki,ni->nk", a.axes[near_a, :, 2], b.axes[rows, :, 2])) > _PARALLEL, is_like
    )
    across = np.abs(np.einsum("nki,nki->nk", a.normal[near_a], apart))
    across = np.where(posts, np.hypot(across, np.einsum("nki,nki->nk", a.axes[near_a, :, 1], apart)), across)
    there &= is_like
    across = np.where(there, across, 9e9)
    best = across.argmin(axis=1)
    found = np.flatnonzero(there[np.arange(len(rows)), best])
    chosen_a, chosen_b = near_a[found, best[found]], rows[found]
    offset = a.mean_m[chosen_a] - b.mean_m[chosen_b]
    C = a.constraint_m2[chosen_a] + b.constraint_m2[chosen_b] + NOISE_M**2 * np.eye(3)
    information = np.linalg.inv(C)
    squared = np.einsum("ni,nij,nj->n", offset, information, offset)
    return Pairs(chosen_b, offset, information, across[found, best[found]], squared)


def _no_pairs() -> Pairs:
    return Pairs(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0), np.empty(0))


def lay_onto(a: GaussianCloud, b: GaussianCloud, T_start: F64, scales_m: tuple[float, ...] = _SCALES_M) -> Fit | None:
    """Move B onto A from a start (4, 4) within about a metre; None when fewer than 30 surfaces meet.

    All six degrees of freedom, with a prior of 1 degree on the tilt of two frames that both know the vertical.
    """
    T = np.array(T_start, dtype=np.float64)
    for scale_m, rounds in zip(scales_m, _ROUNDS[-len(scales_m) :], strict=True):
        for _ in range(rounds):
            moved = b.moved(T)
            pairs = pairs_of(a, moved, scale_m)
            if len(pairs.row) < 30:
                return None
            centre = moved.mean_m[pairs.row].mean(axis=0)
            H, g = _normal_equations(moved.mean_m[pairs.row] - centre, pairs, scale_m)
            tilt = _tilt_of(T)
            prior = np.array([1.0, 1.0]) / _TILT_PRIOR_RAD**2
            H[:2, :2] += np.diag(prior)
            g[:2] += prior * tilt
            step = np.asarray(-np.linalg.solve(H + 1e-6 * np.eye(6), g), np.float64)
            T = _stepped(T, step, centre)
            if np.abs(step[:3]).max() < _STOP / 10 and np.abs(step[3:]).max() < _STOP:
                break
    return Fit(T, _covariance(H, pairs), centre, H)


def _tilt_of(T: F64) -> F64:
    """(2,) rotation about east and north [rad] of a pose that turns mostly about the vertical."""
    up = T[:3, :3] @ [0.0, 0.0, 1.0]
    return np.array([-up[1], up[0]])


def _stepped(T: F64, step: F64, centre: F64) -> F64:
    """T followed by a small motion (6,) about `centre`."""
    R = exp_so3(step[:3])
    after = np.eye(4)
    after[:3, :3] = R @ T[:3, :3]
    after[:3, 3] = R @ (T[:3, 3] - centre) + centre + step[3:]
    return after


def _normal_equations(arm_m: F64, pairs: Pairs, scale_m: float) -> tuple[F64, F64]:
    """H (6, 6) and g (6,) of a small motion about the arms' origin; Geman-McClure weights at `scale_m`."""
    sigma = np.hypot(scale_m, NOISE_M) / NOISE_M
    weight = (1.0 + pairs.squared / sigma**2) ** -2.0
    J = np.zeros((len(arm_m), 3, 6))  # of the moved mean: rotation, then shift
    J[:, 0, 1], J[:, 0, 2] = arm_m[:, 2], -arm_m[:, 1]
    J[:, 1, 0], J[:, 1, 2] = -arm_m[:, 2], arm_m[:, 0]
    J[:, 2, 0], J[:, 2, 1] = arm_m[:, 1], -arm_m[:, 0]
    J[:, :, 3:] = np.eye(3)
    WJ = (weight[:, None, None] * pairs.information) @ J
    H = np.einsum("nij,nik->jk", J, WJ)
    g = -np.einsum("nij,ni->j", WJ, pairs.offset_m)
    return H, g


def _covariance(H: F64, pairs: Pairs) -> F64:
    """Inverse information, enlarged by what pairs share and by residuals that are larger than their own sigmas."""
    inside = pairs.squared[pairs.squared < MATCHED_SIGMA**2]
    excess = max(1.0, float(inside.mean())) if len(inside) else 1.0
    return np.asarray(np.linalg.inv(H + 1e-9 * np.eye(6)) * _SHARED * excess)


def gains(a: GaussianCloud, b_moved: GaussianCloud) -> F64:
    """(N,) of each surface of B, which was moved: 1 - squared distance / 9 from A's, 0 where it has no partner."""
    pairs = pairs_of(a, b_moved, 0.0)
    gain = np.zeros(len(b_moved))
    gain[pairs.row] = np.maximum(0.0, 1.0 - pairs.squared / MATCHED_SIGMA**2)
    return gain


def score_of(a: GaussianCloud, b_moved: GaussianCloud) -> FitScore:
    """How well B, which was moved, lies on A."""
    known = a.plan_tree.query(b_moved.mean_m[:, :2], distance_upper_bound=_COVER_M)[0] < _COVER_M
    gain = gains(a, b_moved)
    upright, level = b_moved.is_upright & known, b_moved.is_ground & known
    return FitScore(
        int(upright.sum()),
        int((gain[upright] > 0).sum()),
        float(gain[upright].sum()),
        int(level.sum()),
        int((gain[level] > 0).sum()),
    )


def residuals_m(a: GaussianCloud, b_moved: GaussianCloud) -> tuple[I64, F64, NDArray[np.bool_]]:
    """Rows of B (M,) with a surface of A nearby, the distance across it (M,), and whether it is matched (M,)."""
    pairs = pairs_of(a, b_moved, 0.0)
    return pairs.row, pairs.across_m, pairs.squared < MATCHED_SIGMA**2


def local_motion(a: GaussianCloud, part: GaussianCloud, *, turns: bool = True) -> F64 | None:
    """(4, 4) by which a part of B, which was moved, would lie better on A; None: too few pairs.

    Shift, and heading where asked for; what its surfaces do not hold firmly is left as it is. Pairs up to a metre
    apart count: a part of a bent map lies farther off than a matched surface does.
    """
    T, free = np.eye(4), slice(2, 6) if turns else slice(3, 6)
    lever = np.array([1.0 / _PART_M, 1.0, 1.0, 1.0])[-(free.stop - free.start) :]
    for scale_m in (0.4, 0.4, 0.4, 0.15, 0.15, 0.15):
        moved = part.moved(T)
        pairs = pairs_of(a, moved, scale_m)
        if len(pairs.row) < 20:
            return None
        centre = moved.mean_m[pairs.row].mean(axis=0)
        H, g = _normal_equations(moved.mean_m[pairs.row] - centre, pairs, scale_m)
        values, axes = np.linalg.eigh(H[free, free] * lever * lever[:, None])
        firm = values > _FIRM * values[-1]
        step = np.zeros(6)
        step[free] = -(axes[:, firm] @ ((axes[:, firm].T @ (g[free] * lever)) / values[firm])) * lever
        T = _stepped(T, step, centre)
    return T
