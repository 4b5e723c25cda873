"""Height and tilt from the road under the wheels, for sensors that do not see them."""

import numpy as np
import pytest
from yard import GROUND_M, local_map_of, match_map_of, pose, yard

from gnd.fleet_sim.sensors import MODELS
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.vehicle_agent.localise.graph import SmoothedPose
from gnd.vehicle_agent.localise.level import SIGMA_M, SIGMA_RAD, on_the_road, sees_tilt
from gnd.vehicle_agent.localise.parameters import RegistrationParameters


@pytest.fixture(scope="module")
def match_map():
    return match_map_of(local_map_of(yard(np.random.default_rng(1))))


def smoothed(T):
    root = np.random.default_rng(3).normal(size=(6, 6)) * 0.01
    return SmoothedPose(7, 1_000, T, root @ root.T)


def fan(elevations_rad, rng):
    """(N, 3) points of layers at these elevations, LiDAR frame."""
    azimuth, elevation = rng.uniform(-1.2, 1.2, 4000), rng.choice(elevations_rad, 4000)
    ray = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return rng.uniform(5.0, 60.0, (4000, 1)) * np.stack(ray, axis=1)


@pytest.mark.parametrize("name", sorted(MODELS))
def test_of_the_six_sensors_only_the_scala_does_not_see_its_tilt(name):
    points = fan(MODELS[name].elevations_rad, np.random.default_rng(2))
    assert sees_tilt(points) == (name != "Scala")
    assert sees_tilt(np.rint(points / 0.004).astype(np.int16)) == (name != "Scala")  # as scans are held


def test_no_points_are_no_reason_to_ask_the_wheels():
    assert sees_tilt(np.empty((0, 3), np.float32))
    assert sees_tilt(np.zeros((4, 3), np.float32))


@pytest.mark.parametrize(("roll_deg", "pitch_deg", "dz_m"), [(0.0, 1.0, 0.03), (0.8, -1.5, -0.1), (-1.0, 0.5, 0.15)])
def test_a_tilted_pose_is_put_on_the_road_and_stays_where_it_was(match_map, roll_deg, pitch_deg, dz_m):
    before = smoothed(pose(-3.0, 2.0, 25.0, roll_deg, pitch_deg, GROUND_M + dz_m))
    after = on_the_road(before, match_map, RegistrationParameters())
    error = T_inverse(pose(-3.0, 2.0, 25.0)) @ after.T_map_vehicle
    tilt_deg = np.degrees(log_so3(error[:3, :3]))
    assert np.abs(tilt_deg[:2]).max() < 0.3
    assert abs(error[2, 3]) < 0.02
    assert np.hypot(*error[:2, 3]) < 0.02
    assert abs(tilt_deg[2]) < 0.05
    assert (after.number, after.t_ns) == (before.number, before.t_ns)


def test_the_covariance_is_that_of_the_wheels_where_they_decide(match_map):
    before = smoothed(pose(-3.0, 2.0, 25.0, pitch_deg=1.0))
    after = on_the_road(before, match_map, RegistrationParameters())
    decided, kept = [0, 1, 5], [2, 3, 4]
    np.testing.assert_allclose(after.covariance[np.ix_(decided, decided)], np.diag([SIGMA_RAD**2] * 2 + [SIGMA_M**2]))
    np.testing.assert_array_equal(after.covariance[np.ix_(kept, kept)], before.covariance[np.ix_(kept, kept)])
    assert not after.covariance[np.ix_(decided, kept)].any()
    assert np.linalg.eigvalsh(after.covariance)[0] > 0.0


def test_where_the_map_has_no_ground_the_pose_stays(match_map):
    before = smoothed(pose(500.0, 0.0, 0.0, pitch_deg=1.0))
    assert on_the_road(before, match_map, RegistrationParameters()) is before
