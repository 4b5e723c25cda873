"""After a slip of the wheels a stretch stays certain only where scans saw the whole of it, and the map agrees."""

import numpy as np
import pytest
from test_refine import EVERY_NS, SHORT, SPEED_MPS, S, circle, samples
from yard import moved, seen_from

from gnd.gnd_map.se3 import T_inverse
from gnd.vehicle_agent.localise.calibration import MotionTeacher
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.refine import Refiner
from gnd.vehicle_agent.localise.scan_odometry import ScanStep

SLIP = 45  # the scan before which the wheels begin to spin
SEEN = np.diag([1e-4, 1e-4, 2e-4, 0.006, 0.006, 0.006]) ** 2
COASTED = np.diag([2e-3] * 3 + [0.03] * 3) ** 2


def right(T_before_now):
    return ScanStep(T_before_now, SEEN)


def none(_T_before_now):
    return None


def going_on(T_before_now):
    return ScanStep(T_before_now, COASTED)


def too_far(T_before_now):
    T = T_before_now.copy()
    T[0, 3] += 0.1
    return ScanStep(T, SEEN)


def certain_after(yard_map, surfaces, told, slip_mps):
    """Whether the stretch was certain before, and with each scan since a slip of 0.2 s while scans tell `told`."""
    motion = MotionBuffer()
    refiner = Refiner(
        SHORT,
        RegistrationParameters(),
        MatchMapCache(yard_map, 0.04),
        motion,
        MotionTeacher(motion),
    )
    said = []
    for k in range(SLIP + 14):
        slips = SLIP < k <= SLIP + 2
        for sample in samples(circle, k):
            speed_mps = sample.speed_mps + slip_mps * slips
            motion.push(sample.t_ns, speed_mps, sample.yaw_rate_radps)
        rng, T = np.random.default_rng(k), circle(k * EVERY_NS)
        step = T_inverse(circle((k - 1) * EVERY_NS)) @ T
        seen = told(step) if SLIP < k <= SLIP + 6 else right(step)
        points = seen_from(rng, surfaces[k % 7 :: 7], T, 1500)
        refiner.push(k, k * EVERY_NS, points, moved(rng, T, 0.05, 0.3), step, seen)
        said.append(refiner.certain)
    assert said[SLIP]
    return said[SLIP + 1 :]


def test_a_slip_that_scans_saw_whole_takes_no_certainty(yard_map, yard_points):
    assert all(certain_after(yard_map, yard_points, right, slip_mps=0.8 * SPEED_MPS))


@pytest.mark.parametrize("told", [none, going_on, too_far], ids=["unseen", "coasted", "against the map"])
def test_a_slip_that_scans_did_not_see_or_saw_wrongly_takes_certainty(yard_map, yard_points, told):
    assert not all(certain_after(yard_map, yard_points, told, slip_mps=0.8 * SPEED_MPS))


def test_without_a_slip_nothing_is_asked(yard_map, yard_points):
    assert all(certain_after(yard_map, yard_points, none, slip_mps=0.0))


def test_steps_beside_a_slip_do_not_reach_the_clock():
    motion = MotionBuffer()
    clock = MotionTeacher(motion).clock
    for k in range(20):
        clock.see(k * S // 10, (k + 1) * S // 10, right(np.eye(4)))
    clock.see_slip(2 * S)
    assert max(step.last_ns for step in clock._steps) <= 2 * S - 300_000_000
