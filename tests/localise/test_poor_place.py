"""A corridor constrains nothing lengthwise: it is said, the pose is dead reckoned along it, and its sigma grows."""

import numpy as np
from test_localiser_bad_input import PARAMETERS, S
from yard import GROUND_M, NOISE_M, corridor, local_map_of, match_map_of, offset, pose, seen_from

from gnd.schemas.drive import MotionSample, Scan
from gnd.vehicle_agent.localise import Localiser
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import register

SPEED_MPS = 10.0


def true_pose(t_ns):
    return pose(-30.0 + SPEED_MPS * t_ns / S, 0.0, 0.0)


def driven(wheel_scale, seconds=4.0):
    """Estimates of a drive along a corridor, with wheels that tell too much, on a noisy map."""
    rng = np.random.default_rng(0)
    walls = corridor(rng)
    localiser = Localiser(local_map_of(walls + rng.normal(0.0, NOISE_M, walls.shape)), np.eye(4), PARAMETERS)
    localiser.start_at(0, true_pose(0), trusted=True)
    few, told = walls[::4], []
    for k in range(round(seconds * 50)):
        t_ns = k * S // 50
        if k % 5 == 0:
            points = seen_from(rng, few, true_pose(t_ns), 2500).astype(np.float32)
            list(localiser.take_scan(Scan(t_ns, points, np.zeros(len(points), np.uint32))))
        localiser.push_motion(MotionSample(t_ns, SPEED_MPS * wheel_scale, 0.0))
        if localiser.online is not None:
            told.append(localiser.online)
    return told


def test_a_corridor_is_named_and_the_way_along_it_is_that_of_the_wheels():
    told = driven(wheel_scale=1.01)
    last = told[-1]
    assert "longitudinal" in last.degenerate
    assert "lateral" not in last.degenerate
    assert (last.health, last.cause) == ("degraded", "poor_place")
    error = np.linalg.inv(true_pose(last.t_ns)) @ last.T_map_vehicle
    assert abs(error[1, 3]) < 0.03
    assert 0.3 < error[0, 3] < 0.5  # 1 % of the way: nothing was learnt, nothing invented
    sigmas = [e.sigma_m for e in told]
    assert sigmas[-1] > 1.5 * sigmas[10]
    assert sigmas[-1] > 0.15


def test_a_registration_moves_nothing_along_a_corridor():
    rng = np.random.default_rng(0)
    walls = corridor(rng)
    T = pose(0.0, 0.0, 0.0)
    m = match_map_of(local_map_of(walls + rng.normal(0.0, NOISE_M, walls.shape)))
    start = pose(0.3, 0.1, 0.5)
    result = register(seen_from(rng, walls, T, 2500), start, m, RegistrationParameters(), "near")
    assert offset(pose(0.3, 0.0, 0.0), result.T_map_vehicle)[0] < 0.03
    assert result.sigma_m[0] > 1.0
    assert result.sigma_m[1] < 0.05
    assert abs(result.T_map_vehicle[2, 3] - GROUND_M) < 0.03
