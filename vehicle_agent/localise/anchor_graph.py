"""The graph over the anchors of a stretch: odometry between them, submap matches on them, wrong matches left out."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from gnd_map.se3 import T_inverse, log_so3
from vehicle_agent.localise.graph import MapMatch

F64 = NDArray[np.float64]

MIN_STEPS = 4  # between two matches each, before they say how good the odometry is
CLEARLY = 2.0  # factor by which odometry and matches disagree more than both admit, before it is all the odometry's
MEDIAN_OF_NORMAL = 0.6745  # of the absolute value, in sigmas


class AnchorStep(NamedTuple):
    """The motion from the anchor before: (4, 4), and (6,) sigmas, rotation [rad] first, translation [m]."""

    T_before_now: F64
    sigmas: F64


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """What the graph says of N anchors.

    T_map_vehicle: (N, 4, 4). covariance: (N, 6, 6), rotation first, vehicle frame. trusted: (N,) bool, the anchor has a
    match that takes part.
    """

    T_map_vehicle: F64
    covariance: F64
    trusted: NDArray[np.bool_]


def solve(
    start: MapMatch, steps: Sequence[AnchorStep], matches: Sequence[MapMatch | None], inlier_chi2: float
) -> Solution:
    """Place the anchors of a stretch.

    Where a street has changed, matches of submap after submap agree with each other and not with the world. What tells
    them apart is the odometry, which ties them to the places before and after. Hence matches take part or do not, by
    graduated non-convexity (Yang et al., RA-L 2020), and the odometry always does.

    Args:
        start: pose and covariance of the first anchor from the time before; its covariance is large when it is new.
        steps: (N - 1) motions between the anchors.
        matches: (N) matches of their submaps, None where there is none.
        inlier_chi2: half of chi-square beyond which a match is wrong.
    """
    chain = [start.T_map_vehicle]
    for step in steps:
        chain.append(chain[-1] @ step.T_before_now)
    known, doubted, owners = _factors(start, _as_bad_as_seen(steps, matches), matches)
    values = gtsam.Values()
    for n, T in enumerate(chain):
        values.insert(n, gtsam.Pose3(T))
    weights = np.zeros(len(owners))
    if owners:
        values, weights = _graduated(known, doubted, values, inlier_chi2)
    trusted = np.zeros(len(chain), bool)
    trusted[owners] = weights > 0.5
    return _solution(known, [f for f, w in zip(doubted, weights, strict=True) if w > 0.5], values, trusted)


def _factors(
    start: MapMatch, steps: Sequence[AnchorStep], matches: Sequence[MapMatch | None]
) -> tuple[gtsam.NonlinearFactorGraph, list[gtsam.NonlinearFactor], list[int]]:
    """The factors that hold always; those of the matches; and the anchor of each match."""
    known = gtsam.NonlinearFactorGraph()
    known.add(_prior(0, start))
    for n, step in enumerate(steps):
        noise = gtsam.noiseModel.Diagonal.Sigmas(step.sigmas)
        known.add(gtsam.BetweenFactorPose3(n, n + 1, gtsam.Pose3(step.T_before_now), noise))
    doubted = [(n, _prior(n, match)) for n, match in enumerate(matches) if match is not None]
    return known, [factor for _, factor in doubted], [n for n, _ in doubted]


def _prior(n: int, match: MapMatch) -> gtsam.NonlinearFactor:
    noise = gtsam.noiseModel.Gaussian.Covariance(match.covariance)
    return gtsam.PriorFactorPose3(n, gtsam.Pose3(match.T_map_vehicle), noise)


def _graduated(
    known: gtsam.NonlinearFactorGraph, doubted: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, chi2: float
) -> tuple[gtsam.Values, F64]:
    """The optimum, and the weight (0 ... 1) of each of the doubted factors in it."""
    graph = gtsam.NonlinearFactorGraph(known)
    for factor in doubted:
        graph.add(factor)
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(list(range(known.size())))
    optimizer = gtsam.GncLMOptimizer(graph, values, parameters)
    optimizer.setInlierCostThresholds(chi2)
    return optimizer.optimize(), np.asarray(optimizer.getWeights())[known.size() :]


def _solution(
    known: gtsam.NonlinearFactorGraph,
    believed: Sequence[gtsam.NonlinearFactor],
    values: gtsam.Values,
    trusted: NDArray[np.bool_],
) -> Solution:
    graph = gtsam.NonlinearFactorGraph(known)
    for factor in believed:
        graph.add(factor)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()  # the graduated one stops early
    marginals = gtsam.Marginals(graph, values)
    return Solution(
        np.stack([values.atPose3(n).matrix() for n in range(len(trusted))]),
        np.stack([marginals.marginalCovariance(n) for n in range(len(trusted))]),
        trusted,
    )


def _as_bad_as_seen(steps: Sequence[AnchorStep], matches: Sequence[MapMatch | None]) -> list[AnchorStep]:
    """The steps with sigmas grown to what the matches say that the odometry is off by, axis by axis.

    By the median over the stretch: a few steps between wrong matches do not count, wheels that are always off do.
    """
    off = [
        _off(step, before, now)
        for step, before, now in zip(steps, matches, matches[1:], strict=False)
        if before is not None and now is not None
    ]
    if len(off) < MIN_STEPS:
        return list(steps)
    grown = np.maximum(np.median(np.abs(off), axis=0) / MEDIAN_OF_NORMAL, 1.0)
    variance = np.median([np.diag(match.covariance) for match in matches if match is not None], axis=0)
    return [AnchorStep(step.T_before_now, _grown(step.sigmas, 2.0 * variance, grown)) for step in steps]


def _grown(sigmas: F64, match_variance: F64, factor: F64) -> F64:
    """(6,) sigmas of the odometry alone that make those of odometry and matches together larger by `factor` (6,)."""
    alone = np.sqrt(np.maximum(factor**2 * (sigmas**2 + match_variance) - match_variance, 0.0))
    return np.asarray(np.where(factor > CLEARLY, alone, factor * sigmas))


def _off(step: AnchorStep, before: MapMatch, now: MapMatch) -> F64:
    """(6,) how far the odometry is off from what two matches say, in sigmas of both."""
    seen = T_inverse(before.T_map_vehicle) @ now.T_map_vehicle
    off = T_inverse(step.T_before_now) @ seen
    variance = step.sigmas**2 + np.diag(before.covariance) + np.diag(now.covariance)
    return np.asarray(np.concatenate([log_so3(off[:3, :3]), off[:3, 3]]) / np.sqrt(variance))
