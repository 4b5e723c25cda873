"""A vehicle that is set on the map's ground by its wheels."""

import numpy as np
import pytest
from yard import local_map_of, match_map_of, rectangle

from gnd.gnd_map.se3 import T_from_R_t, exp_so3, transform
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import WHEELS_M, settle

SLOPE_E, SLOPE_N = 0.05, -0.03
HEIGHT_M = 0.4


def ground_m(x, y):
    return HEIGHT_M + SLOPE_E * x + SLOPE_N * y


@pytest.fixture(scope="module")
def hillside():
    """The map of a sloping plane, 30 x 30 m."""
    rng = np.random.default_rng(4)
    points = rectangle(rng, (-15, -15, ground_m(-15, -15)), (30, 0, 30 * SLOPE_E), (0, 30, 30 * SLOPE_N), 150.0)
    return match_map_of(local_map_of(points + rng.normal(0.0, 0.01, points.shape)))


def on_the_slope(x, y, yaw_rad):
    """(4, 4) upright to the plane, the x axis above the heading."""
    up = np.array([-SLOPE_E, -SLOPE_N, 1.0])
    up /= np.linalg.norm(up)
    ahead = np.array([np.cos(yaw_rad), np.sin(yaw_rad), SLOPE_E * np.cos(yaw_rad) + SLOPE_N * np.sin(yaw_rad)])
    ahead /= np.linalg.norm(ahead)
    return T_from_R_t(np.column_stack([ahead, np.cross(up, ahead), up]), [x, y, ground_m(x, y)])


def map_sigmas(found):
    """(6,) of turns about, and motions along, the map's axes."""
    turn = np.kron(np.eye(2), found.T_map_vehicle[:3, :3])
    return np.sqrt(np.diag(turn @ found.covariance @ turn.T))


def heading(T):
    return np.arctan2(T[1, 0], T[0, 0])


@pytest.mark.parametrize("yaw_deg", [0.0, 70.0, 200.0])
@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(2.0, 0.0), (0.0, -2.0), (1.4, 1.4)])
def test_a_pose_that_is_high_and_tilted_is_put_on_the_ground(hillside, yaw_deg, roll_deg, pitch_deg):
    T = on_the_slope(2.3, -1.7, np.radians(yaw_deg))
    start = T @ T_from_R_t(exp_so3(np.radians([roll_deg, pitch_deg, 0.0])), np.zeros(3))
    start[2, 3] += 0.2
    found = settle(start, hillside).T_map_vehicle
    wheels = transform(found, WHEELS_M)
    np.testing.assert_allclose(wheels[:, 2], ground_m(wheels[:, 0], wheels[:, 1]), atol=0.01)
    assert np.degrees(np.arccos(found[:3, 2] @ T[:3, 2])) < 0.3  # upright to the slope
    np.testing.assert_allclose(found[:2, 3], start[:2, 3], atol=1e-9)
    turned = (heading(found) - heading(start) + np.pi) % (2 * np.pi) - np.pi
    assert np.degrees(abs(turned)) < 0.15  # of second order: a tilt of 2 degrees on a slope of 3


def test_what_is_not_moved_is_not_known(hillside):
    found = settle(on_the_slope(0.0, 0.0, 0.5), hillside)
    turn_east, turn_north, turn_up, east, north, up = map_sigmas(found)
    assert min(east, north) > 5.0
    assert turn_up > 0.5
    assert up < 0.03
    assert max(turn_east, turn_north) < np.radians(2.0)


def test_points_of_many_places_settle_as_wheels_do(hillside):
    T = on_the_slope(-3.0, 2.0, 1.0)
    along = np.concatenate([WHEELS_M + np.array([way, 0.0, 0.0]) for way in (-6.0, -3.0, 0.0, 3.0)])
    start = T.copy()
    start[2, 3] -= 0.15
    found = settle(start, hillside, RegistrationParameters(), along)
    assert found.T_map_vehicle[2, 3] == pytest.approx(T[2, 3], abs=0.01)
    assert map_sigmas(found)[5] < map_sigmas(settle(start, hillside))[5]


@pytest.mark.parametrize(("x", "z_off", "on_ground"), [(100.0, 0.0, 0), (0.0, 6.0, 0), (-17.0, 0.0, 2)])
def test_where_the_map_knows_no_ground_the_error_says_so(hillside, x, z_off, on_ground):
    T = on_the_slope(x, 0.0, 0.0)
    T[2, 3] += z_off
    with pytest.raises(RegistrationError, match=rf"{on_ground} of 4 wheels stand on ground .* 3 must"):
        settle(T, hillside)
