"""The whole localiser on a drive whose wheels and gyro are stamped by another clock, and on one with a wrong header."""

import pytest

from benchmarks.clock import Recorded, brisk_drive, driven
from vehicle_agent.localise import localisation_error

SEED = 1207  # of no street on which anything was tuned


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
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


@pytest.mark.slow
def test_a_header_that_puts_the_lidar_on_the_ground_is_said_at_once(recorded):
    header = recorded.T_vehicle_lidar.copy()
    header[2, 3] = 0.0
    run = driven(recorded, lambda _: 0.0, header)
    assert run.localiser.calibration.mount_doubtful == ("height",)
    assert run.localiser.calibration.mount.height_m == pytest.approx(recorded.T_vehicle_lidar[2, 3], abs=0.05)
    late = [pose for pose in run.online if pose.t_ns - recorded.items[0].t_ns > 3e9]
    assert not any(pose.health == "good" for pose in [*late, *list(run.refined)[20:]])
