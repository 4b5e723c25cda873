"""The whole localiser on a drive whose wheels and gyro are stamped by another clock, and on one with a wrong header."""

import numpy as np
import pytest
from clock_drives import ClockDrive, brisk_drive, driven

from gnd.gnd_map.se3 import T_inverse, exp_so3, log_so3
from gnd.vehicle_agent.localise import localisation_error

SEED = 1207  # of no street on which anything was tuned


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> ClockDrive:
    return brisk_drive(SEED, "VLP-16", 130, tmp_path_factory.mktemp("clock"))


@pytest.mark.slow
@pytest.mark.parametrize("offset_ms", [-50, -20, 0, 10, 50])
def test_a_clock_that_is_off_is_found_and_does_no_harm(recorded, offset_ms):
    """Before: 0.4 to 1.2 m at ±50 ms, every pose called good."""
    run = driven(recorded, lambda _: offset_ms * 1e-3)
    calibration = run.localiser.calibration
    assert calibration.time_offset_s == pytest.approx(offset_ms * 1e-3, abs=5e-3)
    assert calibration.time_offset_sigma_s < 5e-3
    assert calibration.clock_doubt == "none"
    for poses, most_m in ((run.refined, 0.02), (run.online, 0.05)):
        error = localisation_error(poses, recorded.reference)
        assert error.longitudinal_p95_m < most_m
        assert error.lateral_p95_m < 0.03
        assert error.heading_p95_deg < 0.08
    assert sum(pose.health != "good" for pose in run.refined) <= 0.03 * len(run.refined)


@pytest.mark.slow
@pytest.mark.parametrize("offset_s", [lambda _: 0.15, lambda t: 0.006 * t], ids=["150 ms", "6 ms a second"])
def test_a_clock_that_is_none_of_this_vehicle_is_said(recorded, offset_s):
    run = driven(recorded, offset_s)
    late = [pose for pose in run.online if pose.t_ns - run.online[0].t_ns > 10e9]
    said = [pose for pose in late if (pose.health, pose.cause) == ("degraded", "clock")]
    assert len(said) > 0.9 * len(late) > 0


def turned_header(recorded, height_m=None, **angles_deg):
    """The header's mount with another height, or turned about an axis of the LiDAR."""
    header = recorded.header.T_vehicle_lidar.copy()
    axis = np.radians([angles_deg.get(name, 0.0) for name in ("roll", "pitch", "yaw")])
    header[:3, :3] = header[:3, :3] @ exp_so3(axis)
    header[2, 3] = header[2, 3] if height_m is None else height_m
    return header


def wrong_and_good(poses, reference):
    """How many poses are off by more than 0.44 m or 0.5° and called good."""
    good = [pose for pose in poses if pose.health == "good"]
    error = T_inverse(reference.at(np.array([p.t_ns for p in good]))) @ np.stack([p.T_map_vehicle for p in good])
    turned = np.degrees(np.abs(np.arctan2(error[:, 1, 0], error[:, 0, 0])))
    return int(((np.hypot(error[:, 0, 3], error[:, 1, 3]) > 0.44) | (turned > 0.5)).sum())


@pytest.mark.slow
def test_a_header_that_puts_the_lidar_on_the_ground_is_put_right_before_the_first_pose(recorded):
    """Before: poses 1.9 m too low, every one of them degraded."""
    run = driven(recorded, lambda _: 0.0, turned_header(recorded, height_m=0.0))
    calibration, told_m = run.localiser.calibration, recorded.header.T_vehicle_lidar[2, 3]
    assert calibration.mount_doubtful == ("height",)
    assert calibration.mount.height_m == pytest.approx(told_m, abs=0.05)
    assert calibration.mount_used[2, 3] == pytest.approx(told_m, abs=0.05)
    assert (run.online[0].health, run.online[0].cause) == ("degraded", "mount")
    assert sum(pose.health != "good" for pose in run.refined) <= 0.03 * len(run.refined)
    for poses in (run.refined, run.online):
        T_true = recorded.reference.at(np.array([pose.t_ns for pose in poses]))
        height = np.array([pose.T_map_vehicle[2, 3] for pose in poses]) - T_true[:, 2, 3]
        assert np.abs(height).max() < 0.08
        assert localisation_error(poses, recorded.reference).longitudinal_p95_m < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("angles_deg", [{"yaw": 1.0}, {"pitch": -1.0}, {"roll": 1.2}, {"pitch": 4.0}], ids=str)
def test_a_turned_mount_is_found_and_put_right_about_the_lidar(recorded, angles_deg):
    """Before: 2 to 4 cm off by the lever arm, and online headings 1° off that were called good."""
    header = turned_header(recorded, **angles_deg)
    run = driven(recorded, lambda _: 0.0, header)
    calibration = run.localiser.calibration
    assert calibration.mount_doubtful == tuple(angles_deg)
    off = log_so3(calibration.mount_used[:3, :3] @ recorded.header.T_vehicle_lidar[:3, :3].T)
    assert np.degrees(np.linalg.norm(off)) < 0.25
    assert wrong_and_good(run.online, recorded.reference) == wrong_and_good(run.refined, recorded.reference) == 0
    error = localisation_error(run.refined, recorded.reference)
    assert max(error.longitudinal_p95_m, error.lateral_p95_m) < 0.02
    assert error.heading_p95_deg < 0.1
