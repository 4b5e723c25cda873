"""Errors along, across and about the reference's heading."""

import numpy as np
import pytest

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.localise import PoseEstimate, localisation_error

S = 1_000_000_000


def pose(t_s, x, y, yaw_deg):
    return T_from_R_t(exp_so3([0.0, 0.0, np.radians(yaw_deg)]), [x, y, 0.0])


REFERENCE = Trajectory(np.array([0, 10 * S]), np.stack([pose(0, 0, 0, 90), pose(10, 0, 100, 90)]))


def estimate(t_s, T):
    return PoseEstimate(int(t_s * S), T, 0.01, 0.001, 1.0, "good")


def test_errors_are_split_along_the_heading():
    """Driving north: east is to the right, so 0.2 m too far east is a lateral error."""
    error = localisation_error([estimate(2.5, pose(2.5, 0.2, 25.5, 91.5))], REFERENCE)
    assert error.longitudinal_max_m == pytest.approx(0.5, abs=1e-9)
    assert error.lateral_max_m == pytest.approx(0.2, abs=1e-9)
    assert error.heading_max_deg == pytest.approx(1.5, abs=1e-9)


def test_p95_leaves_out_the_worst_twentieth():
    rows = [estimate(k / 20, pose(0, 0.0, k / 2, 90)) for k in range(1, 191)]
    rows += [estimate(9.6 + k / 100, pose(0, 3.0, 96 + k / 10, 90)) for k in range(1, 6)]
    error = localisation_error(rows, REFERENCE)
    assert error.n == 195
    assert error.lateral_p95_m == pytest.approx(0.0, abs=1e-9)
    assert error.lateral_max_m == pytest.approx(3.0)


def test_estimates_outside_the_reference_are_left_out():
    inside, after = estimate(1.0, pose(1, 0, 10, 90)), estimate(11.0, pose(0, 9, 9, 9))
    assert localisation_error([inside, after], REFERENCE).n == 1


def test_no_estimate_within_the_reference_is_an_error():
    with pytest.raises(LocaliseError, match="between 0 and 10000000000 ns"):
        localisation_error([estimate(11.0, np.eye(4))], REFERENCE)
