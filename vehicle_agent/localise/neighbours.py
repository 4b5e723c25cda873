"""Where little stands, a scan fits the map at several places in a row: the neighbouring minima of a match are tried.

The Hessian at one minimum knows nothing of the next one, half a voxel or two along the weakest horizontal direction.
Where two fit alike, that direction is known no better than they lie apart.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import WHEELS_M, RegistrationResult, register
from gnd.vehicle_agent.localise.stretch import log_se3

WEAK_M: Final = 0.05
"""One sigma of the weakest horizontal direction from which on its neighbours are tried beside a tracked pose."""
UNSURE_M: Final = 0.03
"""The same of a first pose from which on it must agree with the scans to come."""
NEAR_M: Final = (0.4,)
FAR_M: Final = (0.4, 0.8)
"""Starts along that direction, either way: beside a tracked pose, and beside one that was found by search."""
LIKE_FIT: Final = 0.03
"""A neighbour that fits worse than the match by more is none."""
APART_SIGMAS: Final = 2.0
"""A neighbour nearer than this is the same minimum."""


def hedged(
    points_m: F64,
    result: RegistrationResult,
    match_map: MatchMap,
    parameters: RegistrationParameters,
    starts_m: tuple[float, ...] = NEAR_M,
    least_sigma_m: float = WEAK_M,
    wheels_m: F64 = WHEELS_M,
) -> tuple[RegistrationResult, bool]:
    """The match with a covariance that holds its neighbouring minima too, and whether there are any.

    Args:
        points_m: (N, 3) of the scan, vehicle frame.
        result: the match.
        match_map: that it was made with.
        parameters: that it was made with.
        starts_m: how far off the neighbours are begun.
        least_sigma_m: a match whose weakest direction is known better has none.
        wheels_m: (W, 3) that it was made with.
    """
    sigma_m, weak = weakest(result)
    if sigma_m < least_sigma_m or not result.converged or len(result.degenerate):
        return result, False
    found = [
        off
        for start_m in starts_m
        for sign in (-1.0, 1.0)
        if (off := _neighbour(points_m, result, sign * start_m * weak, match_map, parameters, wheels_m)) is not None
        and float(np.hypot(*off[3:5])) > APART_SIGMAS * sigma_m
    ]
    if not found:
        return result, False
    far = max(found, key=lambda off: float(np.hypot(*off[3:5])))
    return replace(result, covariance=result.covariance + np.outer(far, far)), True


def weakest(result: RegistrationResult) -> tuple[float, F64]:
    """One sigma [m], and the direction (2,) in the vehicle frame, of the weakest horizontal one."""
    values, vectors = np.linalg.eigh(result.covariance[3:5, 3:5])
    return float(np.sqrt(values[1])), np.asarray(vectors[:, 1])


def _neighbour(
    points_m: F64,
    result: RegistrationResult,
    shift_m: F64,
    match_map: MatchMap,
    parameters: RegistrationParameters,
    wheels_m: F64,
) -> F64 | None:
    """(6,) from the match to where it ends when begun shifted by (2,) m; None if that does not fit as well."""
    T = result.T_map_vehicle.copy()
    T[:3, 3] += T[:3, :2] @ shift_m
    try:
        other = register(points_m, T, match_map, parameters, "near", wheels_m)
    except RegistrationError:
        return None
    if not other.converged or other.fit < result.fit - LIKE_FIT:
        return None
    return log_se3(T_inverse(result.T_map_vehicle) @ other.T_map_vehicle)
