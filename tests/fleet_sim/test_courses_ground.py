"""Roads that climb: the ground lies on the profile, what stands on it stands on it, wheels touch it."""

import numpy as np
import pytest

from gnd.fleet_sim.courses.motion import CourseMotion
from gnd.fleet_sim.courses.path import Path, lane, smoothed
from gnd.fleet_sim.courses.places import place_of
from gnd.fleet_sim.courses.ride import Ride, cruise, halting, lively
from gnd.fleet_sim.courses.terrain import LEVEL, TerrainGround, TerrainProfile
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.raycast import Scene
from gnd.gnd_map.se3 import T_inverse, log_so3

STILL = (0.0,) * 9


@pytest.fixture(scope="module")
def hill():
    return place_of("hill", 3)


@pytest.fixture(scope="module")
def hill_scene(hill):
    return Scene.build(hill.world.shapes("after"), hill.world.A_street_map)


def heights(scene, world, places):
    """Street-frame heights of the ground under places (K, 2), by rays from far above."""
    eye = np.column_stack([places, np.full(len(places), 60.0)])
    down = np.tile([0.0, 0.0, -1.0], (len(places), 1))
    drop, _ = scene.cast(world.map_of_street(eye), down, 200.0)
    return 60.0 - drop


def test_a_profile_climbs_as_steeply_as_it_says():
    profile = TerrainProfile((-40.0, 30.0), (0.0, 0.08, -0.06), ease_m=10.0)
    x = np.linspace(-120.0, 120.0, 481)
    slope = np.gradient(profile.height_m(x), x)
    assert slope[x < -51] == pytest.approx(0.0, abs=1e-6)
    assert slope[(x > -29) & (x < 19)] == pytest.approx(0.08, abs=1e-6)
    assert slope[x > 41] == pytest.approx(-0.06, abs=1e-6)
    assert profile.height_m(np.zeros(1))[0] == pytest.approx(0.0, abs=1e-9)


def test_changes_of_grade_that_overlap_are_refused():
    with pytest.raises(DriveSimError, match="overlap"):
        TerrainProfile((0.0, 5.0), (0.0, 0.08, 0.0), ease_m=10.0)
    with pytest.raises(DriveSimError, match="need 3 grades"):
        TerrainProfile((0.0, 50.0), (0.0, 0.08))


def test_rays_from_above_find_the_ground_on_the_profile(hill, hill_scene):
    x = np.linspace(-hill.world.half_length_m + 5.0, hill.world.half_length_m - 5.0, 300)
    places = np.column_stack([x, np.full(len(x), 1.0)])
    found = heights(hill_scene, hill.world, places)
    assert found == pytest.approx(hill.ground.height_m(places), abs=0.004)
    assert np.ptp(found) > 3.0


def test_the_hill_is_eight_percent_steep_in_the_map(hill):
    x = np.linspace(-60.0, 60.0, 241)
    ground = hill.ground.height_m(np.column_stack([x, np.zeros(len(x))]))
    z_map_m = hill.world.map_of_street(np.column_stack([x, np.zeros(len(x)), ground]))[:, 2]
    slope = np.gradient(z_map_m, x)
    assert slope.max() == pytest.approx(0.08, abs=0.001)
    assert slope.min() == pytest.approx(-0.06, abs=0.001)


def test_wheels_touch_the_ground_and_the_vehicle_pitches_with_it(hill, hill_scene):
    motion = CourseMotion(hill.world, hill.ground, hill.lane, cruise(np.random.default_rng(0), 9.0, 140.0), STILL)
    t_s = np.linspace(0.0, motion.ride.duration_s, 100)
    T = motion.T_map_vehicle(t_s)
    above = hill.world.street_of_map(T[:, :3, 3])
    assert above[:, 2] == pytest.approx(heights(hill_scene, hill.world, above[:, :2]), abs=0.03)
    climb = np.degrees(np.arcsin(T[:, 2, 0]))
    assert climb.max() == pytest.approx(np.degrees(np.arctan(0.08)), abs=0.5)
    assert climb.min() == pytest.approx(-np.degrees(np.arctan(0.06)), abs=0.5)


def test_houses_and_posts_reach_into_the_ground_of_a_hill(hill):
    for o in hill.world.in_state("after"):
        if o.kind in ("lamp", "tree", "building", "sign"):
            feet = [(s.x_m, s.y_m, s.bottom_m) for s in o.shapes if hasattr(s, "bottom_m")]
            lowest = min(bottom for _, _, bottom in feet)
            x = np.array([place for shape in o.shapes for place in (shape.bounds()[0], shape.bounds()[2])])
            assert lowest < hill.ground.profile.height_m(x).min() + 0.05, o.name


def test_wheel_speed_and_yaw_rate_describe_the_motion():
    place = place_of("roundabout", 2)
    motion = CourseMotion(place.world, place.ground, place.lane, cruise(np.random.default_rng(1), 6.0, 110.0), STILL)
    t_s = np.arange(0.0, motion.ride.duration_s, 0.002)
    speed, yaw_rate = motion.speed_and_yaw_rate(t_s)
    way = motion.ride.way_m(t_s)
    assert np.sum(speed) * 0.002 == pytest.approx(way[-1], rel=2e-3)
    turn = log_so3(T_inverse(motion.T_map_vehicle(t_s[:-1])) @ motion.T_map_vehicle(t_s[1:]))[:, 2].sum()
    assert np.sum(yaw_rate) * 0.002 == pytest.approx(turn, abs=0.01)
    in_ring = (np.abs(np.linalg.norm(place.lane.at(way)[0], axis=1) - 12.7) < 0.4) & (way > 40.0) & (way < 70.0)
    assert in_ring.sum() > 500
    assert np.median(np.abs(yaw_rate[in_ring])) == pytest.approx(np.median(speed[in_ring]) / 12.7, rel=0.1)


def test_a_path_goes_on_straight_beyond_its_ends():
    path = Path(np.column_stack([np.arange(0.0, 20.0), np.zeros(20)]))
    place, ahead = path.at(np.array([-5.0, 30.0]))
    assert place == pytest.approx(np.array([[-5.0, 0.0], [30.0, 0.0]]))
    assert ahead == pytest.approx(np.array([[1.0, 0.0], [1.0, 0.0]]))
    assert path.beside(np.array([4.0]), 2.0) == pytest.approx(np.array([[4.0, 2.0]]))


@pytest.mark.parametrize("points", [np.zeros((3, 2)), np.zeros((5, 2)), np.full((5, 2), np.nan), np.zeros((5, 3))])
def test_points_that_make_no_path_are_refused(points):
    with pytest.raises(DriveSimError):
        Path(points)


def test_bends_are_rounded_and_the_lane_sways_a_little():
    bend = smoothed(np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 40.0]]), 5.0)
    _, ahead = bend.at(np.arange(0.0, bend.length_m, 0.5))
    turn = np.diff(np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])))
    assert turn.sum() == pytest.approx(np.pi / 2, abs=0.05)
    assert turn.max() < 0.13  # no tighter than about 4 m
    place, _ = lane(0.0, 100.0, -1.75, np.random.default_rng(0)).at(np.arange(100.0))
    assert 0.02 < np.abs(place[:, 1] + 1.75).max() < 0.25


def test_rides_cover_their_way_and_halting_ones_stand():
    rng = np.random.default_rng(4)
    ride = cruise(rng, 9.0, 120.0)
    assert ride.way_m(np.array([0.0, ride.duration_s])) == pytest.approx([0.0, 120.0], abs=0.2)
    wild = lively(rng, 9.0, 120.0)
    speed = np.gradient(wild.way_m(t := np.arange(0.0, wild.duration_s, 0.02)), t)
    assert speed.min() < 5.5 < 8.0 < speed.max()
    assert wild.way_m(np.array([wild.duration_s]))[0] == pytest.approx(120.0, abs=0.2)
    stops = halting(rng, 8.0, 25.0, (4.0, 5.0), (4.0, 6.0))
    speed = np.gradient(stops.way_m(t := np.arange(0.0, 25.0, 0.02)), t)
    assert 0.1 < np.mean(speed < 0.1) < 0.6
    assert speed.max() > 4.0


def test_a_ride_backwards_or_too_short_is_refused():
    with pytest.raises(DriveSimError, match="no ride"):
        Ride(np.full(500, -1.0), 2.0)
    with pytest.raises(DriveSimError, match="no ride"):
        Ride(np.full(150, 1.0), 10.0)


def test_level_ground_is_level():
    ground = TerrainGround(LEVEL, 0.02)
    places = np.array([[-500.0, 0.0], [0.0, 2.0], [300.0, -4.0]])
    assert ground.height_m(places) == pytest.approx([0.0, -0.04, -0.08], abs=1e-9)
    assert ground.gradient(places)[:, 0] == pytest.approx(0.0)
