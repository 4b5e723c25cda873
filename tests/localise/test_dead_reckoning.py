"""Wheel speed and yaw rate integrated, and what the map teaches about them."""

import numpy as np
import pytest

from gnd.gnd_map.se3 import T_inverse
from gnd.vehicle_agent.localise.calibration import MotionTeacher
from gnd.vehicle_agent.localise.odometry import MotionBuffer

S = 1_000_000_000


def driven(speed, yaw_rate, seconds=10.0, hz=50):
    buffer = MotionBuffer()
    for k in range(int(seconds * hz) + 1):
        assert buffer.push(k * S // hz, speed, yaw_rate)
    return buffer


def arc(speed, yaw_rate, seconds):
    """(4, 4) closed form of driving a circle."""
    yaw = yaw_rate * seconds
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    radius = speed / yaw_rate
    T[:2, 3] = radius * np.sin(yaw), radius * (1 - np.cos(yaw))
    return T


@pytest.mark.parametrize("yaw_rate", [0.4, -0.05, 1e-9])
def test_a_circle_is_driven_exactly(yaw_rate):
    delta = driven(8.0, yaw_rate).delta(S, 5 * S)
    np.testing.assert_allclose(delta, arc(8.0, yaw_rate, 4.0), atol=1e-6)


def test_there_and_back_is_nowhere():
    buffer = driven(8.0, 0.3)
    np.testing.assert_allclose(buffer.delta(2 * S, 5 * S) @ buffer.delta(5 * S, 2 * S), np.eye(4), atol=1e-12)


def test_parts_make_the_whole():
    buffer = driven(8.0, 0.3)
    parts = buffer.delta(S, 2 * S + 7_000_001) @ buffer.delta(2 * S + 7_000_001, 4 * S)
    np.testing.assert_allclose(parts, buffer.delta(S, 4 * S), atol=1e-9)


def test_acceleration_counts_half():
    buffer = MotionBuffer()
    buffer.push(0, 0.0, 0.0)
    buffer.push(2 * S, 4.0, 0.0)
    assert buffer.delta(0, 2 * S)[0, 3] == pytest.approx(4.0)


def test_beyond_the_samples_the_nearest_one_is_continued():
    buffer = driven(5.0, 0.0, seconds=1.0)
    assert buffer.delta(0, 3 * S)[0, 3] == pytest.approx(15.0)
    assert buffer.delta(-S, 0)[0, 3] == pytest.approx(5.0)


def test_without_samples_the_vehicle_stands():
    np.testing.assert_array_equal(MotionBuffer().delta(0, S), np.eye(4))


@pytest.mark.parametrize("bad", [(S, 1.0, 0.0), (S - 5, 1.0, 0.0), (2 * S, np.nan, 0.0), (2 * S, 1.0, np.inf)])
def test_samples_out_of_order_or_not_finite_are_not_kept(bad):
    buffer = MotionBuffer()
    buffer.push(S, 1.0, 0.0)
    assert not buffer.push(*bad)
    assert len(buffer) == 1


def test_old_samples_are_forgotten():
    buffer = driven(5.0, 0.0, seconds=100.0)
    assert len(buffer) <= 91 * 50
    assert buffer.delta(99 * S, 100 * S)[0, 3] == pytest.approx(5.0)


def test_poses_of_a_sweep_start_at_the_identity():
    trajectory = driven(8.0, 0.3).trajectory(S + 3_000_000, S + 100_000_000)
    np.testing.assert_array_equal(trajectory.T_dst_vehicle[0], np.eye(4))
    assert (int(trajectory.t_ns[0]), int(trajectory.t_ns[-1])) == (S + 3_000_000, S + 100_000_000)


def test_wheel_scale_gyro_bias_and_course_are_learnt():
    """The wheel shows 1.5 % too little, the gyro 0.2 °/s too much, the sensor looks 1 ° to the right of the course."""
    rng = np.random.default_rng(0)
    speed, yaw_rate, course = 9.0, 0.05, np.tan(np.radians(1.0))
    buffer = driven(speed / 1.015, yaw_rate + np.radians(0.2), seconds=30.0)
    teacher = MotionTeacher(buffer)
    unsure = teacher.sigmas(buffer.delta(0, S // 10), 0.1)
    truth = MotionBuffer()
    truth.course[:] = course, 0.0
    for k in range(30 * 50 + 1):
        truth.push(k * S // 50, speed, yaw_rate)
    for k in range(300):
        T = truth.delta(0, k * S // 10)
        T[:3, 3] += rng.normal(0, 0.01, 3)
        teacher.learn(k * S // 10, T, np.diag([1e-7] * 3 + [1e-4] * 3))
    assert buffer.speed_scale == pytest.approx(1.015, abs=0.002)
    assert np.degrees(buffer.yaw_bias_radps) == pytest.approx(0.2, abs=0.03)
    assert buffer.course[0] == pytest.approx(course, abs=0.002)
    assert (teacher.sigmas(buffer.delta(0, S // 10), 0.1)[[2, 3, 4]] < 0.8 * unsure[[2, 3, 4]]).all()


def test_odometry_that_jumps_is_trusted_less():
    buffer = driven(9.0, 0.0)
    teacher = MotionTeacher(buffer)
    before = teacher.sigmas(buffer.delta(0, S // 10), 0.1)
    rng = np.random.default_rng(0)
    for k in range(60):
        T = buffer.delta(0, k * S // 10)
        T[0, 3] += rng.normal(0, 0.2)
        teacher.learn(k * S // 10, T, np.diag([1e-7] * 3 + [1e-4] * 3))
    after = teacher.sigmas(buffer.delta(0, S // 10), 0.1)
    assert after[3] > 0.15 > 3 * before[3]
    assert after[4] < 0.05


def test_a_gap_starts_a_new_stretch():
    buffer = driven(9.0, 0.0, seconds=20.0)
    teacher = MotionTeacher(buffer)
    far = np.eye(4)
    far[0, 3] = 500.0
    teacher.learn(0, np.eye(4), np.eye(6) * 1e-4)
    teacher.learn(10 * S, far, np.eye(6) * 1e-4)
    teacher.forget()
    teacher.learn(11 * S, T_inverse(far), np.eye(6) * 1e-4)
    assert buffer.speed_scale == 1.0


def test_wheels_that_change_speed_faster_than_a_car_can_have_slipped():
    buffer = MotionBuffer()
    for k in range(200):
        slipping = 100 <= k < 120
        buffer.push(k * 20_000_000, 9.0 * (1.3 if slipping else 1.0), 0.0)
    assert not buffer.slipped(0, 1_900_000_000)
    assert buffer.slipped(2_000_000_000, 2_600_000_000)
    assert buffer.slipped(3_000_000_000, 3_100_000_000)  # what was driven meanwhile is still not known
    assert not buffer.slipped(3_800_000_000, 3_900_000_000)


def test_every_slip_of_the_last_stretch_is_remembered():
    """Before, the newest one alone: what the wheels told between older ones counted as exact again."""
    buffer, slips_s = MotionBuffer(), (2.0, 6.0, 9.0)
    for k in range(600):
        buffer.push(k * 20_000_000, 0.0 if k / 50 in slips_s else 10.0, 0.0)
    for at_s in slips_s:
        assert buffer.slipped(round(at_s * 1e9), round((at_s + 0.5) * 1e9))
    assert not buffer.slipped(4_000_000_000, 5_500_000_000)
    for k in range(600, 12_000):
        buffer.push(k * 20_000_000, 10.0, 0.0)
    assert not buffer.slipped(0, 10_000_000_000)  # as long as samples, no longer
