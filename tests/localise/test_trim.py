"""What the heading is turned by, and which sensors prove a pose scan by scan."""

import numpy as np
import pytest

from gnd.vehicle_agent.localise.calibration import MAX_TRIM_RAD, MotionTeacher
from gnd.vehicle_agent.localise.health import HEALTH_GNSS_COUNT, HealthMonitor
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.parameters import HealthParameters

SURE = 1e-5


def teacher_told(left, sigma=SURE, way_m=1000.0):
    teacher, way = MotionTeacher(MotionBuffer()), np.eye(4)
    way[0, 3] = way_m
    teacher.see_step(0, 1, way, None)
    teacher.correct(np.array([0.0, 0.0, -left, 0.0]), np.array([np.inf, np.inf, sigma, sigma]))
    return teacher


def test_the_heading_is_not_turned_before_the_course_is_known():
    assert MotionTeacher(MotionBuffer()).trim_rad == 0.0
    assert teacher_told(5e-4, sigma=5e-3).trim_rad == 0.0


@pytest.mark.parametrize("course_rad", [-9e-4, 3e-4])
def test_the_heading_is_turned_to_where_the_axle_drives(course_rad):
    assert teacher_told(-course_rad).trim_rad == pytest.approx(course_rad)


def test_a_mount_that_is_told_only_roughly_is_left_alone():
    assert teacher_told(2 * MAX_TRIM_RAD).trim_rad == 0.0


@pytest.mark.parametrize("course_rad", [-0.018, 0.009])
def test_a_header_that_is_certainly_wrong_is_put_right(course_rad):
    assert teacher_told(-course_rad).trim_rad == pytest.approx(course_rad)


def test_a_header_that_is_likely_wrong_makes_the_heading_doubtful_until_it_is_known():
    assert teacher_told(0.012, sigma=4e-3).yaw_in_doubt
    assert teacher_told(0.012, sigma=4e-3).cause == "mount"
    assert teacher_told(0.012, sigma=4e-3).trim_rad == 0.0
    assert not teacher_told(0.012, sigma=5e-4).yaw_in_doubt
    assert not teacher_told(0.008, sigma=3e-3).yaw_in_doubt


def fitting(scans_prove):
    monitor = HealthMonitor(HealthParameters(), 0)
    monitor.scans_prove = scans_prove
    monitor.see_match(0.95, 0.95, np.empty((0, 6)))
    return monitor


def test_a_few_layers_prove_a_pose_by_submaps_only():
    assert fitting(scans_prove=True).judge(0) == ("good", "none")
    monitor = fitting(scans_prove=False)
    assert monitor.judge(0) == ("degraded", "unconfirmed")
    monitor.certain = True
    assert monitor.judge(0)[0] == "good"


def test_submaps_that_leave_no_doubt_overrule_a_rival_but_not_gnss():
    monitor = fitting(scans_prove=True)
    monitor.beaten = monitor.contested = True
    assert monitor.judge(0)[0] == "lost"
    monitor.certain = True
    assert monitor.judge(0)[0] == "good"
    for _ in range(HEALTH_GNSS_COUNT):
        monitor.see_fix(np.array([60.0, 0.0]), 2.5)
    assert monitor.judge(0) == ("lost", "wrong_pose")
