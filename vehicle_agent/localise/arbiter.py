"""Wheels and scans disagree on the motion: the map decides which of the two is wrong.

Wheels slip. Scan-to-scan odometry goes wrong where little stands: the rings on the ground move along with the vehicle,
and a step that is wrong once is predicted again. Neither knows it of itself. The match with the map is independent of
both: it lies where one of the two motions leads to and not the other, or it decides nothing.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Final, Literal, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse
from gnd.vehicle_agent.localise.registration import RegistrationResult
from gnd.vehicle_agent.localise.scan_odometry import JointStep, ScanStep, joint_step
from gnd.vehicle_agent.localise.stretch import log_se3

Wrong = Literal["wheels", "scans", "open"]

LEVEL: Final = [2, 3, 4]  # heading, forward, left
DECIDED: Final = 6.0
"""Difference of squared innovations from which on the map has decided: the odds are 20 to 1."""
LIKE_FIT: Final = 0.05
"""Two matches whose fits differ by less are as good as each other."""
APART_M, APART_RAD = 0.1, np.radians(0.5)  # farther from each other they are two


class ArbitratedMotion(NamedTuple):
    """A motion since the scan before: (4, 4), and its covariance (6, 6), rotation [rad] first, vehicle frame."""

    T_before_now: F64
    covariance: F64


def who_is_wrong(
    T_map_before: F64,
    covariance: F64,
    driven: ArbitratedMotion,
    seen: ArbitratedMotion,
    matches: Iterable[RegistrationResult],
) -> Wrong:
    """Say whose motion the matches contradict.

    Args:
        T_map_before: (4, 4) pose of the scan before.
        covariance: (6, 6) of that pose, rotation [rad] first, vehicle frame.
        driven: by wheels and gyro.
        seen: by the scans.
        matches: of the newest scan, begun where either motion leads to. Two apart that fit alike decide nothing.
    """
    converged = sorted((one for one in matches if one.converged), key=lambda one: -one.fit)
    if not converged or _rivals(converged):
        return "open"
    best = converged[0]
    against_wheels, against_scans = (
        _innovation2(T_map_before @ motion.T_before_now, covariance + motion.covariance, best)
        for motion in (driven, seen)
    )
    if abs(against_wheels - against_scans) < DECIDED:
        return "open"
    return "wheels" if against_wheels > against_scans else "scans"


def believing_neither(driven: F64, sigmas: F64, step: ScanStep) -> tuple[JointStep, ScanStep]:
    """The joint motion, and that of the scans, when nobody knows who is wrong: both are as uncertain as they are apart.

    `driven` (4, 4) with `sigmas` (6,) is the motion of wheels and gyro.
    """
    off = log_se3(T_inverse(driven) @ step.T_before_now)
    unsure = step._replace(covariance=step.covariance + np.diag(off**2))
    joint = joint_step(driven, sigmas, step)
    return replace(joint, driven_sigmas=np.hypot(joint.driven_sigmas, off)), unsure


def _rivals(converged: list[RegistrationResult]) -> bool:
    best = converged[0]
    alike = [one for one in converged[1:] if one.fit > best.fit - LIKE_FIT]
    off = [log_se3(T_inverse(best.T_map_vehicle) @ one.T_map_vehicle) for one in alike]
    return any(np.hypot(*o[3:5]) > APART_M or abs(o[2]) > APART_RAD for o in off)


def _innovation2(T_predicted: F64, covariance: F64, match: RegistrationResult) -> float:
    """Squared innovation of heading and place."""
    off = log_se3(T_inverse(T_predicted) @ match.T_map_vehicle)[LEVEL]
    return float(off @ np.linalg.solve((covariance + match.covariance)[np.ix_(LEVEL, LEVEL)], off))
