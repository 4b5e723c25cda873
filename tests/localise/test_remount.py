"""The mount that is used: the header's, put right where the ground or the course says that it is certainly wrong."""

import numpy as np
import pytest

from gnd.gnd_map.se3 import T_inverse, exp_so3, log_so3
from gnd.schemas.drive import MountSigma
from gnd.vehicle_agent.localise.calibration import MotionTeacher
from gnd.vehicle_agent.localise.first_course import FirstCourse
from gnd.vehicle_agent.localise.mount import MountResidual
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.registration import WHEELS_M
from gnd.vehicle_agent.localise.remount import (
    TRUSTED,
    TRUSTED_RAD,
    Mounting,
    left_over,
    left_sigma,
    lever_covariance,
    tilted,
)
from gnd.vehicle_agent.localise.scan_odometry import ScanStep

S = 1_000_000_000
DEG = np.radians(1.0)


def header(height_m=1.9, x_m=1.2):
    T = np.eye(4)
    T[:3, 3] = x_m, 0.0, height_m
    return T


def road(true, seed=0):
    """(N, 3) float64 a road and walls as a LiDAR with this mount sees them, its own frame."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-25, 25, 6000), rng.uniform(-6, 6, 6000), rng.normal(0, 0.01, 6000)])
    walls = np.column_stack([rng.uniform(-25, 25, 2000), rng.choice([-7.0, 9.0], 2000), rng.uniform(0, 6, 2000)])
    T_lidar_vehicle = T_inverse(true)
    return np.concatenate([ground, walls]) @ T_lidar_vehicle[:3, :3].T + T_lidar_vehicle[:3, 3]


def seen(told, true, scans=8, sigma=TRUSTED):
    """A mounting that was told one mount and has seen scans of another."""
    mounting = Mounting(told, sigma)
    for k in range(scans):
        mounting.see(k * S, road(true, k) @ mounting.T_used[:3, :3].T + mounting.T_used[:3, 3])
    return mounting


def test_a_header_that_is_right_is_kept():
    mounting = seen(header(), header())
    assert mounting.put_right == ()
    assert np.array_equal(mounting.T_vehicle_lidar(), header())
    assert np.array_equal(mounting.T_used_vehicle(), np.eye(4))
    assert not mounting.unsettled


def test_a_header_that_is_off_by_less_than_is_certain_is_kept():
    assert seen(header(), tilted(header(), np.array([0.06, 0.0, 0.25 * DEG]))).put_right == ()


@pytest.mark.parametrize(
    ("off", "named"),
    [((0.4, 0.0, 0.0), "height"), ((0.0, 1.5 * DEG, 0.0), "roll"), ((0.0, 0.0, -1.0 * DEG), "pitch")],
)
def test_a_header_that_is_certainly_wrong_is_put_right(off, named):
    true = tilted(header(), np.array(off))
    mounting = seen(header(), true)
    assert mounting.put_right == (named,)
    assert mounting.T_vehicle_lidar() == pytest.approx(true, abs=0.02)


def test_the_lidar_stays_where_it_was_matched_and_the_vehicle_turns_about_it():
    mounting, yaw_rad = seen(header(), tilted(header(), np.array([0.0, 0.0, 1.0 * DEG]))), 0.8 * DEG
    T_map_used = header(x_m=40.0)
    T_map_vehicle = T_map_used @ mounting.T_used_vehicle(yaw_rad)
    assert T_map_vehicle @ mounting.T_vehicle_lidar(yaw_rad) == pytest.approx(T_map_used @ mounting.T_used, abs=1e-12)
    shift = mounting.T_used_vehicle(yaw_rad)[:3, 3]
    assert shift[:2] == pytest.approx([1.9 * DEG, 1.2 * yaw_rad], rel=0.1)  # height and lever arm times the angles


def test_wheels_are_where_the_vehicle_is_and_not_where_the_header_has_them():
    mounting = seen(header(height_m=0.0), header(), scans=3)
    assert mounting.wheels_m[:, 2] == pytest.approx(-1.9, abs=0.05)
    T_now_before = mounting.remount()
    assert T_now_before[2, 3] == pytest.approx(1.9, abs=0.05)
    assert mounting.wheels_m == pytest.approx(WHEELS_M)
    assert mounting.unsettled
    mounting = seen(header(height_m=0.0), header())
    assert mounting.torn
    mounting.remount()
    assert not mounting.torn
    assert not mounting.unsettled


def test_what_is_held_of_the_mount_is_of_its_newest_look():
    asked, never = Mounting(header(height_m=0.0)), Mounting(header(height_m=0.0))
    for k in range(6):
        for mounting in (asked, never):
            mounting.see(k * S, road(header(), k) @ mounting.T_used[:3, :3].T + mounting.T_used[:3, 3])
        assert len(asked.wheels_m) == len(asked.T_used_vehicle(0.1 * k))  # held from here on
    assert asked.off.any()
    assert np.array_equal(asked.wheels_m, never.wheels_m)
    assert np.array_equal(asked.T_used_vehicle(0.1), never.T_used_vehicle(0.1))


def test_a_first_pose_waits_for_the_ground_only_where_the_header_cannot_be_right():
    assert not seen(header(), header(), scans=1).waits
    assert seen(header(height_m=0.0), header(), scans=1).waits
    assert not seen(header(height_m=0.0), header(), scans=3).waits
    assert seen(header(), header(), scans=1, sigma=MountSigma(*[np.inf] * 4)).waits
    blind = Mounting(header(height_m=0.0))
    blind.see(0, np.random.default_rng(0).uniform([-20, -20, 1], [20, 20, 3], (4000, 3)))
    assert not blind.waits  # nothing to wait for


def test_what_an_angle_is_off_by_is_shared_between_header_and_measurement():
    assert left_over(0.0, np.inf, 0.0, 2.0) == (0.0, 2.0)
    mean, sigma = left_over(1.0, 2.0, 0.0, 2.0)
    assert (mean, sigma) == pytest.approx((0.5, np.sqrt(2.0)))
    assert left_over(1.0, 0.1, 0.9, 2.0) == pytest.approx((0.1, 0.1))


def test_the_lever_arms_covariance_is_that_of_drawn_mounts():
    sigma, T = np.array([0.5, 0.8, 1.0]) * DEG, header(height_m=1.9, x_m=3.6)
    rng = np.random.default_rng(1)
    off = []
    for _ in range(4000):
        true = T.copy()
        true[:3, :3] = exp_so3(sigma * rng.standard_normal(3)) @ T[:3, :3]
        T_told_true = T @ T_inverse(true)
        off.append(np.concatenate([log_so3(T_told_true[:3, :3]), T_told_true[:3, 3]]))
    assert lever_covariance(T[:3, 3], sigma**2) == pytest.approx(np.cov(np.array(off).T), abs=2.5e-4)


# --- which way it drives, from the first metres -----------------------------------------------------------------------


def step(course_rad, forward_m=0.9, yaw_rad=0.0, across_m=0.005):
    """A step of a vehicle whose axes lie so to its course."""
    T = np.eye(4)
    T[:3, :3] = exp_so3([0.0, 0.0, yaw_rad])
    T[:2, 3] = forward_m, forward_m * np.tan(course_rad + 0.5 * yaw_rad)
    return ScanStep(T, np.diag([1e-3, 1e-3, 2e-4, 0.01, across_m, 0.01]) ** 2)


def teacher_after(steps):
    teacher = MotionTeacher(MotionBuffer(), Mounting(header()))
    for k, one in enumerate(steps):
        teacher.see_step(k * S, (k + 1) * S, one.T_before_now, one)
    return teacher


@pytest.mark.parametrize("forward_m", [0.9, -0.9])
@pytest.mark.parametrize("yaw_rad", [0.0, 0.03])
def test_the_course_of_the_first_steps_has_its_sign(forward_m, yaw_rad):
    first = FirstCourse()
    for _ in range(4):
        first.see(step(DEG, forward_m, yaw_rad))
    assert first.course_rad == pytest.approx(DEG, rel=0.05)
    assert (first.sigma_rad > 0.5 * DEG) == bool(yaw_rad)  # an origin ahead of the axle moves sideways in a turn


def test_no_pose_is_good_before_the_course_was_seen():
    assert teacher_after([]).doubted("good", "none", trimmed=True) == ("degraded", "mount")
    assert teacher_after([]).doubted("lost", "gap", trimmed=True) == ("lost", "gap")
    assert teacher_after([step(0.0)] * 3).doubted("good", "none", trimmed=True) == ("good", "none")


def test_a_mount_that_drives_askew_is_not_called_good():
    assert teacher_after([step(DEG)] * 6).doubted("good", "none", trimmed=True) == ("degraded", "mount")


def test_a_mount_that_is_known_well_need_not_be_seen():
    mounting = Mounting(header(), MountSigma(0.01, 1e-3, 1e-3, 1e-3))
    teacher = MotionTeacher(MotionBuffer(), mounting)
    assert teacher.doubted("good", "none", trimmed=True) == ("good", "none")


def test_the_sigma_of_the_heading_holds_what_the_mount_may_be_turned_by():
    unseen, known, askew = (teacher_after(steps) for steps in ([], [step(0.0)] * 20, [step(DEG)] * 6))
    assert unseen.yaw_sigma_rad(0.0, 1e-4) == pytest.approx(np.sqrt(0.05) * DEG, rel=0.2)
    assert known.yaw_sigma_rad(0.0, 1e-4) < 0.02 * DEG
    assert askew.yaw_sigma_rad(0.0, 1e-4) > 0.8 * DEG


def test_a_header_that_says_how_well_it_is_known_is_believed():
    assert left_sigma(0.0, np.inf, 0.0, 0.2 * DEG) == pytest.approx(0.2 * DEG)
    assert left_sigma(0.3 * DEG, 0.1 * DEG, 0.0, TRUSTED_RAD) < left_sigma(0.6 * DEG, 0.1 * DEG, 0.0, TRUSTED_RAD)


def test_where_no_course_can_be_seen_the_header_is_believed_after_some_way():
    assert teacher_after([step(0.0, across_m=0.05)] * 4).doubted("good", "none", trimmed=True) == ("degraded", "mount")
    assert teacher_after([step(0.0, across_m=0.05)] * 6).doubted("good", "none", trimmed=True) == ("good", "none")
    assert teacher_after([step(2 * DEG, across_m=0.02)] * 6).doubted("good", "none", trimmed=True)[1] == "mount"


def test_an_unsettled_mount_is_said():
    teacher = teacher_after([step(0.0)] * 6)
    teacher.mount.watch.residual = MountResidual(0.5, 0.02, scans=3)
    assert teacher.doubted("good", "none", trimmed=True) == ("degraded", "mount")


def test_a_course_is_not_known_better_than_a_car_drives_straight():
    """KITTI 00: 0.5° after 12 m was claimed to 0.1°."""
    teacher = teacher_after([step(0.0, 1.0)] * 12)
    assert teacher.calibration.course_sigma_rad > np.radians(0.14)
