"""A stretch of scans matched with the map together: the submap of GND 6.2, as stiff as the odometry is good.

A rigid submap is shaped by odometry alone. Where wheels, clock or stamps are off by centimetres a step, its match is
off by decimetres and does not know. Here every scan keeps a pose of its own: all scans of the stretch are matched
point to Gaussian at once, and odometry ties their poses as tightly as its sigmas say. What all steps share (wheel
scale, gyro bias, course) is estimated beside the poses, so that it does not count as independent noise.

Everything is one least-squares problem: Gauss-Newton over 6 N pose parameters and `N_SHARED` shared ones, with robust
weights (Geman-McClure, on points and on steps). Old scans leave by marginalisation, so nothing counts twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.vehicle_agent.localise.influence import SeenScan, influence
from gnd.vehicle_agent.localise.kernels import LEVER_M
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import (
    DEGENERATE_SHARE,
    REGISTRATION_GATE_PER_SCALE,
    WHEEL_SCALE,
    WHEELS_M,
    Linearised,
    wheel_weight,
)
from gnd.vehicle_agent.localise.stretch_kernels import (
    SHARED,
    add_matches,
    add_steps,
    covariances_asked,
    motions,
    residuals,
    settle_stretch,
)

N_SHARED: Final = SHARED
"""What all steps share: gyro bias [rad/s], wheel scale [1], motion to the left and upwards per metre forward [1]."""
BIAS, SCALE, LEFT, UP = range(N_SHARED)
STEP_CHI2: Final = 12.6
"""Of a step's six residuals, from where on it counts less: 95 % of right ones lie below."""
MOST_SQUARE: Final = 9.0
"""Of a residual in sigmas, as far as one step may raise the noise of all: a slip does not, many of 3 sigmas do."""
TORN_WEIGHT: Final = 0.1
"""Robust weight below which a measured motion ties nothing."""
SMALL_M, SMALL_RAD = 2e-3, 2e-4
"""Scans that moved less since they were matched with the map are not matched again."""
STOP_M, STOP_RAD = 1e-3, 5e-5


@dataclass(frozen=True, slots=True, eq=False)
class StretchStep:
    """Motion from one scan of the stretch to the next, by odometry.

    Attributes:
        T_before_now: (4, 4).
        covariance: (6, 6) of a small motion of the later vehicle, rotation [rad] first.
        shared: (6, N_SHARED) how this motion would differ if the shared parameters were larger by one; zeros for steps
            between scans.
    """

    T_before_now: F64
    covariance: F64
    shared: F64


class StretchBelief(NamedTuple):
    """What is known of the first pose of a stretch and the shared parameters from the time before, as a quadratic in
    their difference (6 + N_SHARED,) from where it was made: `information` (10, 10), and its gradient there (10,).
    """

    T_map_vehicle: F64
    shared: F64
    information: F64
    gradient: F64


@dataclass(slots=True, eq=False)
class Knot:
    """A scan of the stretch: points (K, 3) float64 in the vehicle frame, present pose (4, 4), `weight` (0 ... 1) of its
    match because neighbours see the same surfaces, its match where it was last made, and where its wheels are (W, 3).
    """

    points_m: F64
    T_map_vehicle: F64
    weight: float
    match: Linearised | None = field(default=None)
    wheels_m: F64 = field(default_factory=lambda: WHEELS_M)


@dataclass(frozen=True, slots=True, eq=False)
class SolvedStretch:
    """The solution of a stretch of N scans.

    Attributes:
        shared, shared_covariance: (N_SHARED,) estimate, and (N_SHARED, N_SHARED).
        covariance: (N, 6, 6) of each pose, rotation first, vehicle frame.
        fit: (N,) 1 - mean robust cost of each scan's points, 0 ... 1, at the last scale.
        known: (N,) share of them in known voxels.
        misfit: mean square of the innovation of each scan's own match, in sigmas (1 = as expected).
        step_squares, step_redundancy: (6,) sums over the first measurement of each step: squared residual in sigmas,
            and how much of each the others can check (0: nothing else knows, 1: all is known otherwise). Their ratio is
            the variance of these measurements in units of what they claim (variance components, Förstner 1979).
        seen: (3,) of yaw, forward and left: variance of the errors that residuals show, in units of those that are
            assumed (`influence`).
        matched: (3,) share of the map in these variances of the poses; the rest is odometry's.
        axle_variance: (N,) of the direction in which the rear axle drives, yaw and course together [rad²].
        torn: somewhere no measured motion fits its two poses, so that nothing ties what lies before to what follows.
    """

    shared: F64
    covariance: F64
    shared_covariance: F64
    fit: F64
    known: F64
    misfit: float
    step_squares: F64
    step_redundancy: F64
    seen: F64
    matched: F64
    axle_variance: F64
    torn: bool


class _System(NamedTuple):
    """Normal equations of a stretch at its present poses: information (n, n) and gradient (n,)."""

    A: F64
    g: F64


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    """N knots side by side, as kernels take them.

    Attributes:
        points_m, ends: (P, 3) of all scans, those of scan k up to ends[k]; (N,) int64.
        wheels_m: (N, W, 3).
        T, weight: (N, 4, 4) present poses, and (N,).
        T_match, scale: (N, 4, 4) and (N,), where and how each was matched; scale 0: it was not.
        H, g, constrained, cost, matched, inside: of each match, see `Linearised`.
    """

    points_m: F64
    ends: I64
    wheels_m: F64
    T: F64
    weight: F64
    T_match: F64
    scale: F64
    H: F64
    g: F64
    constrained: F64
    cost: F64
    matched: I64
    inside: I64

    @classmethod
    def of(cls, knots: Sequence[Knot]) -> "_Held":
        """From knots with or without a match."""
        n = len(knots)
        held = cls(
            np.concatenate([knot.points_m for knot in knots]),
            np.cumsum([len(knot.points_m) for knot in knots]),
            np.array([knot.wheels_m for knot in knots]),
            _poses(knots),
            np.array([knot.weight for knot in knots]),
            np.zeros((n, 4, 4)), np.zeros(n), np.empty((n, 6, 6)), np.empty((n, 6)), np.empty((n, 6, 6)), np.empty(n),
            np.empty(n, np.int64), np.empty(n, np.int64),
        )  # fmt: skip
        for k, knot in enumerate(knots):
            if (match := knot.match) is not None:
                held.T_match[k], held.scale[k], held.H[k], held.g[k] = (
                    match.T_map_vehicle,
                    match.scale,
                    match.H,
                    match.g,
                )
                held.constrained[k], held.cost[k] = match.constrained, match.cost
                held.matched[k], held.inside[k] = match.matched, match.inside
        return held

    def give_back(self, knots: Sequence[Knot]) -> None:
        """Poses and matches to the knots that they are of."""
        for k, knot in enumerate(knots):
            knot.T_map_vehicle = self.T[k]
            knot.match = Linearised(
                self.T_match[k], float(self.scale[k]), self.H[k], self.g[k], float(self.cost[k]), int(self.matched[k]),
                int(self.inside[k]), self.constrained[k],
            )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """All M measurements of the motions of a stretch.

    Attributes:
        first: (M,) int32, the knot that each starts from.
        T_before_now: (M, 4, 4).
        information: (M, 6, 6).
        shared: (M, 6, N_SHARED).
        variance: (M, 6).
        leads: (M,) bool, whether it is the first measurement of its motion.
    """

    first: I32
    T_before_now: F64
    information: F64
    shared: F64
    variance: F64
    leads: NDArray[np.bool_]

    @classmethod
    def of(cls, steps: Sequence[Sequence[StretchStep]]) -> "_Steps":
        """From what is known of the motion between neighbours."""
        all_of_them = [step for measured in steps for step in measured]
        covariance = np.array([step.covariance for step in all_of_them], np.float64).reshape(-1, 6, 6)
        return cls(
            np.repeat(np.arange(len(steps), dtype=np.int32), [len(measured) for measured in steps]),
            np.array([step.T_before_now for step in all_of_them], np.float64).reshape(-1, 4, 4),
            np.linalg.inv(covariance).astype(np.float64),
            np.array([step.shared for step in all_of_them], np.float64).reshape(-1, 6, N_SHARED),
            np.einsum("mii->mi", covariance),
            np.array([n == 0 for measured in steps for n in range(len(measured))], np.bool_),
        )

    def residuals(self, T_map_vehicle: F64, shared_off: F64) -> tuple[F64, F64, F64]:
        """Residuals (M, 6) at poses (N, 4, 4), their derivatives (M, 6, 12 + N_SHARED), and robust weights (M,)."""
        m = len(self.first)
        e, J, weight = np.empty((m, 6)), np.empty((m, 6, 12 + N_SHARED)), np.empty(m)
        residuals(
            T_map_vehicle, self.first, self.T_before_now, self.information, self.shared, shared_off, STEP_CHI2, e, J,
            weight,
        )  # fmt: skip
        return e, J, weight


def solve_stretch(
    knots: Sequence[Knot],
    steps: Sequence[Sequence[StretchStep]],
    belief: StretchBelief,
    match_map: MatchMap,
    registration: RegistrationParameters,
    scales: Sequence[float],
    max_iterations: int = 8,
) -> SolvedStretch:
    """Move the poses of N knots (in place) to where map, odometry and belief agree best.

    Args:
        knots: in order of time; their poses are where to begin.
        steps: (N - 1) what is known of the motion between neighbours: one or more measurements each.
        belief: of the first pose and the shared parameters; its `shared` is where those begin.
        match_map: the map around the stretch.
        registration: noise of points and wheels, correlation.
        scales: robust scales in sigmas, wide to narrow.
        max_iterations: Gauss-Newton steps at each scale.
    """
    measured, held = _Steps.of(steps), _Held.of(knots)
    n, shared = 6 * len(knots) + N_SHARED, belief.shared.copy()
    system = _System(np.empty((n, n)), np.empty(n))
    m, par = match_map, registration
    if not settle_stretch(
        held.points_m, held.ends, held.wheels_m, held.T, held.weight / par.rules.correlation, m.index, m.A, m.b,
        m.mean_m, m.information, np.array(scales, np.float64), WHEEL_SCALE, REGISTRATION_GATE_PER_SCALE,
        wheel_weight(par), DEGENERATE_SHARE, SMALL_M, SMALL_RAD, held.T_match, held.scale, held.H, held.g,
        held.constrained, held.cost, held.matched, held.inside, measured.first, measured.T_before_now,
        measured.information, measured.shared, STEP_CHI2, *belief, shared, max_iterations, STOP_M,
        STOP_RAD, *system,
    ):  # fmt: skip
        raise np.linalg.LinAlgError(f"the normal equations of {len(knots)} scans and {len(steps)} steps are singular")
    held.give_back(knots)
    covariance = _covariance(system.A)
    seen = _as_seen(knots, belief, covariance, match_map, registration)
    return _solved(knots, measured, covariance, shared - belief.shared, belief.shared, registration, scales[-1], *seen)


def _covariance(A: F64) -> F64:
    """What is asked of the inverse of A (n, n), see `covariances_asked`."""
    covariance = np.empty_like(A)
    if covariances_asked(A, len(A) // 6 // 2, covariance):
        return covariance
    return np.asarray(np.linalg.inv(A), np.float64)


def marginalised(
    knots: Sequence[Knot],
    steps: Sequence[Sequence[StretchStep]],
    belief: StretchBelief,
    shared: F64,
    registration: RegistrationParameters,
) -> StretchBelief:
    """The belief about the last knot and the shared parameters by all knots before it (Schur complement).

    The match of the last knot is not part of it: it stays with the stretch that goes on there.
    """
    last = Knot(knots[-1].points_m, knots[-1].T_map_vehicle, knots[-1].weight)
    A, g = _system([*knots[:-1], last], _Steps.of(steps), belief, shared, registration)
    kept = slice(6 * (len(knots) - 1), None)
    gone = slice(0, 6 * (len(knots) - 1))
    through = np.linalg.solve(A[gone, gone], np.column_stack([A[gone, kept], g[gone]]))
    information = A[kept, kept] - A[kept, gone] @ through[:, :-1]
    gradient = g[kept] - A[kept, gone] @ through[:, -1]
    return StretchBelief(last.T_map_vehicle, shared.copy(), 0.5 * (information + information.T), gradient)


def _moved(matched: Sequence[Knot]) -> F64:
    """(M, 6) how far M matched knots have moved since they were matched."""
    off = np.empty((len(matched), 6))
    then = [knot.match.T_map_vehicle for knot in matched if knot.match is not None]
    motions(np.array(then).reshape(-1, 4, 4), _poses(matched), off)
    return off


def _poses(knots: Sequence[Knot]) -> F64:
    return np.array([knot.T_map_vehicle for knot in knots], np.float64).reshape(-1, 4, 4)


def _system(
    knots: Sequence[Knot], steps: _Steps, belief: StretchBelief, shared: F64, par: RegistrationParameters
) -> _System:
    n = 6 * len(knots) + N_SHARED
    A, g = np.zeros((n, n)), np.zeros(n)
    _add_belief(A, g, knots[0], belief, shared)
    at, matched = _matched(knots)
    weight = np.array([knot.weight for knot in matched]) / par.rules.correlation
    add_matches(at, _moved(matched), weight, *_second_order(matched), A, g)
    add_steps(steps.first, steps.information, *steps.residuals(_poses(knots), shared - belief.shared), A, g)
    return _System(A, g)


def _matched(knots: Sequence[Knot]) -> tuple[I32, list[Knot]]:
    """The knots that have a match, and where they stand, (M,) int32."""
    found = [(k, knot) for k, knot in enumerate(knots) if knot.match is not None]
    return np.array([k for k, _ in found], np.int32), [knot for _, knot in found]


def _second_order(matched: Sequence[Knot]) -> tuple[F64, F64]:
    """H (M, 6, 6) and g (M, 6) of M matches."""
    matches = [knot.match for knot in matched if knot.match is not None]
    H, g = (np.array([getattr(match, name) for match in matches], np.float64) for name in ("H", "g"))
    return H.reshape(-1, 6, 6), g.reshape(-1, 6)


def _add_belief(A: F64, g: F64, first: Knot, belief: StretchBelief, shared: F64) -> None:
    at = np.r_[0:6, len(g) - N_SHARED : len(g)]
    off = np.concatenate([log_se3(T_inverse(belief.T_map_vehicle) @ first.T_map_vehicle), shared - belief.shared])
    A[np.ix_(at, at)] += belief.information
    g[at] += belief.gradient + belief.information @ off


def residual(relative: F64, step: StretchStep, shared_off: F64) -> F64:
    """Residual e = log(Z^-1 T_k^-1 T_k+1) - S shared (6,) of a step."""
    return log_se3(T_inverse(step.T_before_now) @ relative) - step.shared @ shared_off


def _solved(
    knots: Sequence[Knot],
    steps: _Steps,
    covariance: F64,
    shared_off: F64,
    shared_before: F64,
    par: RegistrationParameters,
    scale: float,
    seen: F64,
    matched: F64,
) -> SolvedStretch:
    blocks = np.stack([covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(len(knots))])
    matches = [(knot, knot.match) for knot in knots if knot.match is not None]
    squares, redundancy = _checked_steps(knots, steps, covariance, shared_off)
    return SolvedStretch(
        shared=shared_before + shared_off,
        covariance=blocks,
        shared_covariance=covariance[-N_SHARED:, -N_SHARED:],
        fit=np.array([match.fit(scale) for _, match in matches]),
        known=np.array([match.inside / max(len(knot.points_m), 1) for knot, match in matches]),
        misfit=_misfit(knots, par),
        step_squares=squares,
        step_redundancy=redundancy,
        seen=seen,
        matched=matched,
        axle_variance=_axle_variance(covariance),
        torn=_is_torn(knots, steps, shared_off),
    )


def _axle_variance(covariance: F64) -> F64:
    """(N,) of yaw and course together: a scan that is turned makes the course seem turned the other way."""
    yaw, left = np.arange(2, len(covariance) - N_SHARED, 6), len(covariance) - N_SHARED + LEFT
    return np.asarray(covariance[yaw, yaw] + 2.0 * covariance[yaw, left] + covariance[left, left])


def _as_seen(
    knots: Sequence[Knot], belief: StretchBelief, covariance: F64, match_map: MatchMap, par: RegistrationParameters
) -> tuple[F64, F64]:
    """(3,) and (3,), of yaw, forward and left: variance that the map's errors have, as residuals show them, in units
    of what is assumed, and the share of the map in the variance of the pose in the middle. What was matched before is
    taken to be as good as what is matched now.
    """
    rows = [6 * (len(knots) // 2) + row for row in (2, 3, 4)]
    answers, matched, scans = covariance[rows], np.zeros(3), []
    for k, knot in enumerate(knots):
        if knot.match is not None:
            v, weight = answers[:, 6 * k : 6 * k + 6], knot.weight / par.rules.correlation
            matched += weight * np.einsum("di,ij,dj->d", v, knot.match.H, v)
            scans.append(SeenScan(knot.points_m, knot.match, weight * v))
    first = np.r_[0:6, len(covariance) - N_SHARED : len(covariance)]
    matched += np.einsum("di,ij,dj->d", answers[:, first], belief.information, answers[:, first])
    seen = influence(scans, match_map).factor if scans else np.ones(3)
    share = np.clip(matched / np.diag(covariance)[rows], 0.0, 1.0)
    return seen, np.asarray(share)


def _is_torn(knots: Sequence[Knot], steps: _Steps, shared_off: F64) -> bool:
    best = np.zeros(len(knots) - 1)
    np.maximum.at(best, steps.first, steps.residuals(_poses(knots), shared_off)[2])
    return bool((best < TORN_WEIGHT).any())


def _checked_steps(knots: Sequence[Knot], steps: _Steps, covariance: F64, shared_off: F64) -> tuple[F64, F64]:
    e, J, weight = (of[steps.leads] for of in steps.residuals(_poses(knots), shared_off))
    variance, n = steps.variance[steps.leads], len(covariance)
    at = np.concatenate([np.arange(12), np.arange(n - N_SHARED, n)]) + np.zeros((len(e), 1), np.int64)
    at[:, :12] += 6 * steps.first[steps.leads][:, None]
    by_others = np.einsum("mri,mij,mrj->mr", J, covariance[at[:, :, None], at[:, None, :]], J, optimize=True)
    redundancy = np.clip(1.0 - weight[:, None] * by_others / variance, 0.0, 1.0)
    return np.minimum(e**2 / variance, MOST_SQUARE).sum(axis=0), redundancy.sum(axis=0)


def _misfit(knots: Sequence[Knot], par: RegistrationParameters) -> float:
    """Mean over the knots' constrained directions of their squared disagreement with the solution, in sigmas."""
    scale = np.array([1.0 / LEVER_M] * 3 + [1.0] * 3)
    _, matched = _matched(knots)
    H, g = _second_order(matched)
    values, vectors = np.linalg.eigh(H * scale * scale[:, None])
    strong = values > par.rules.correlation / par.rules.degenerate_m**2
    pull = np.einsum("mij,mi->mj", vectors, (g + np.einsum("mij,mj->mi", H, _moved(matched))) * scale)
    return float((pull[strong] ** 2 / values[strong]).sum()) / par.rules.correlation / max(int(strong.sum()), 1)


def shared_of(T_driven: F64, dt_s: float) -> F64:
    """(6, N_SHARED) how a motion (4, 4) by wheels and gyro that took `dt_s` differs with a larger shared parameter."""
    S = np.zeros((6, N_SHARED))
    S[2, BIAS] = -dt_s  # what is taken off the yaw rate
    forward_m = T_driven[0, 3]
    turned = T_driven[:3, :3].T
    S[3:, SCALE] = turned @ T_driven[:3, 3]
    S[3:, LEFT], S[3:, UP] = turned @ [0.0, forward_m, 0.0], turned @ [0.0, 0.0, forward_m]
    return S


def log_se3(T: F64) -> F64:
    """(6,) rotation vector and position of a small motion (4, 4)."""
    return np.concatenate([log_so3(T[:3, :3]), T[:3, 3]])
