"""The plain twin of the loop of `stretch.solve_stretch`: one knot and one step at a time."""

import numpy as np

from gnd.gnd_map.se3 import T_inverse, exp_so3
from gnd.vehicle_agent.localise.registration import linearised
from gnd.vehicle_agent.localise.stretch import (
    N_SHARED,
    SMALL_M,
    SMALL_RAD,
    STOP_M,
    STOP_RAD,
    _Steps,
    _system,
    log_se3,
)


def solve(knots, steps, belief, match_map, registration, scales, max_iterations=8):
    """Move the poses of the knots; gives the shared parameters and the information matrix at the end."""
    shared, measured = belief.shared.copy(), _Steps.of(steps)
    for scale in scales:
        for _ in range(max_iterations):
            match(knots, match_map, registration, scale)
            A, g = _system(knots, measured, belief, shared, registration)
            step = -np.linalg.solve(A, g)
            move(knots, step)
            shared += step[-N_SHARED:]
            if small(step[:-N_SHARED].reshape(-1, 6), STOP_M, STOP_RAD):
                break
    match(knots, match_map, registration, scales[-1])
    return shared, _system(knots, measured, belief, shared, registration).A


def match(knots, match_map, par, scale):
    """Match the knots with the map that have moved since, or were matched with another scale."""
    for knot in knots:
        if knot.match is not None and knot.match.scale == scale:
            moved = log_se3(T_inverse(knot.match.T_map_vehicle) @ knot.T_map_vehicle)
            if small(moved[None], SMALL_M, SMALL_RAD):
                continue
        knot.match = linearised(knot.points_m, knot.T_map_vehicle, match_map, par, scale, knot.wheels_m)


def move(knots, step):
    for knot, by in zip(knots, step[:-N_SHARED].reshape(-1, 6), strict=True):
        R, T = knot.T_map_vehicle[:3, :3], knot.T_map_vehicle.copy()
        T[:3, :3], T[:3, 3] = R @ exp_so3(by[:3]), T[:3, 3] + R @ by[3:]
        knot.T_map_vehicle = T


def small(motion, m, rad):
    return np.abs(motion[:, 3:]).max(initial=0.0) < m and np.abs(motion[:, :3]).max(initial=0.0) < rad
