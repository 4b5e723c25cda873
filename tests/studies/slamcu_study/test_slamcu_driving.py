"""Drives of the SLAMCU study with poses from elsewhere, and the errors of poses."""

import numpy as np
import pytest

from gnd.fleet_sim.roads.drive import drive_route
from gnd.fleet_sim.roads.motorway import motorway
from studies.slamcu_study.driving import driven_by, pose_errors, sign_truth, verdicts_of
from studies.slamcu_study.scores import drive_summary


@pytest.mark.slow
def test_with_the_lidars_poses_signs_settle_and_are_right() -> None:
    """Features settle by time and way: without them one place stands for several, and is far too certain."""
    route = motorway(11, 5000.0)
    drive = drive_route(route, 1)
    lidar = drive_summary(verdicts_of(drive, driven_by(drive, "lidar", 1, no_tick)), sign_truth(route))
    assert lidar["pose_rmse"]["longitudinal_m"] < 0.1
    assert lidar["accuracy"]["overall"] == 100.0
    assert lidar["position_error_m"]["mean"] < 0.4
    assert lidar["position_error_m"]["nees"]["mean"] < lidar["position_error_m"]["nees"]["band_high"]


def no_tick(*_: int) -> None:
    """Nobody wants to know how far it is."""


def test_errors_of_poses_are_along_and_across_their_heading() -> None:
    facing_north = np.array([[0.0, 0.0, np.pi / 2]])
    errors = pose_errors(facing_north + np.array([1.0, 2.0, 6.3]), facing_north)
    np.testing.assert_allclose(errors, [[2.0, -1.0, 6.3 - 2 * np.pi]])
