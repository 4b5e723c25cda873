"""Several poses followed at once: symmetric places are decided by driving on, and nothing is guessed before."""

import numpy as np
import pytest
from yard import GROUND_M, local_map_of, match_map_of, offset, pose, rectangle, seen_from

from gnd.gnd_map.se3 import T_inverse, transform
from gnd.vehicle_agent.localise.first_pose import FirstPose, SearchPlace
from gnd.vehicle_agent.localise.hypotheses import PoseHypotheses
from gnd.vehicle_agent.localise.initialise import AROUND_POSITION, Around, probabilities, search
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.parameters import LocaliserParameters, RegistrationParameters
from gnd.vehicle_agent.localise.scan_pool import ScanPool

STEP_M = 1.0


def alley(rng, with_shed=True):
    """Two rows of the same buttresses, the same from both ends, until a shed comes at 22 m."""
    wall = lambda x, y, dx, dy: rectangle(rng, (x, y, GROUND_M), (dx, dy, 0), (0, 0, 4), 60)  # noqa: E731
    parts = [
        rectangle(rng, (-60, -8, GROUND_M), (120, 0, 0), (0, 16, 0), 60),
        wall(-60, -8.3, 120, 0),
        wall(-60, 8.3, 120, 0),
    ]
    for x in np.arange(-55.4, 56.0, 12.0):
        parts += [wall(x, -8.3, 0, 2.2), wall(-x, 6.1, 0, 2.2)]
    if with_shed:
        parts += [wall(22.4, 2.3, 0, 4), wall(22.4, 2.3, 5, 0)]
    return np.concatenate(parts)


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(4)
    points = alley(rng)
    return points, MatchMapCache(local_map_of(points), 0.04)


def drive_on(scene, first_x_m, last_x_m, reach_m=12.0):
    """Search from (first_x_m, 0) on and drive along x; (x where an answer came, its error) or None."""
    points, maps = scene
    first, rng = FirstPose(LocaliserParameters()), np.random.default_rng(1)
    for k, x in enumerate(np.arange(first_x_m, last_x_m, STEP_M)):
        T = pose(x, 0.0, 0.0)
        moved = pose(STEP_M if k else 0.0, 0.0, 0.0, z=0.0)
        place = SearchPlace(T[:3, 3] + [1.0, -0.8, 0.0], 2.5, 4.0)
        seen = seen_from(rng, points, T, 2500, reach_m=reach_m)
        answer = first.see(k * 200_000_000, seen, moved, place, maps)
        if answer is not None:
            return x, offset(T, answer.registration.T_map_vehicle), answer, first
    return None, None, None, first


def test_a_symmetric_alley_is_decided_by_driving_on(scene):
    x, off, answer, _ = drive_on(scene, 0.0, 30.0)
    assert x is not None
    assert x >= 9.0  # the shed must be in sight: all before looks the same from both ends
    assert off[0] < 0.1
    assert off[1] < 0.5
    assert answer.probability > 0.99


def test_while_nothing_decides_it_says_ambiguous(scene):
    x, _, _, first = drive_on(scene, -6.0, 4.0)
    assert x is None
    assert first.cause == "ambiguous"
    assert len(first.hypotheses) >= 2
    assert first.hypotheses.probability < 0.99


def test_standing_still_adds_no_evidence(scene):
    points, maps = scene
    first, rng, T = FirstPose(LocaliserParameters()), np.random.default_rng(1), pose(0.0, 0.0, 0.0)
    for k in range(8):
        seen = seen_from(rng, points, T, 2500, reach_m=12.0)
        assert first.see(k * 200_000_000, seen, np.eye(4), SearchPlace(T[:3, 3], 2.5, 4.0), maps) is None
    assert max(one.views for one in first.hypotheses._held) < 1.5


def test_without_a_position_nothing_is_searched(scene):
    points, maps = scene
    first = FirstPose(LocaliserParameters())
    assert first.see(0, seen_from(np.random.default_rng(0), points, pose(0, 0, 0), 2500), np.eye(4), None, maps) is None
    assert first.cause == "no_position"
    assert len(first.hypotheses) == 0


def test_candidates_of_a_search_are_distinct_and_sorted(yard_map, yard_points):
    T, rng, par = pose(3.0, -2.0, 140.0), np.random.default_rng(2), AROUND_POSITION
    m, points = match_map_of(yard_map), seen_from(np.random.default_rng(2), yard_points, T, 2500)
    found, n = search(points, Around(T[:3, 3] + rng.uniform(-2, 2, 3), 6.0), m, par, RegistrationParameters())
    assert n > 5000
    fits = [one.fit for one in found]
    assert fits == sorted(fits, reverse=True)
    assert offset(T, found[0].registration.T_map_vehicle)[0] < 0.02
    poses = [one.registration.T_map_vehicle for one in found]
    apart = [offset(a, b) for i, a in enumerate(poses) for b in poses[:i]]
    assert all(metres >= par.same_m or degrees >= par.same_deg for metres, degrees in apart)


def test_headings_can_be_limited(yard_map, yard_points):
    T = pose(3.0, -2.0, 140.0)
    m, points = match_map_of(yard_map), seen_from(np.random.default_rng(2), yard_points, T, 2500)
    around = Around(T[:3, 3], 4.0, np.radians(137.0), np.radians(12.0))
    found, n = search(points, around, m, AROUND_POSITION, RegistrationParameters())
    assert n < 600
    assert offset(T, found[0].registration.T_map_vehicle)[0] < 0.02


def test_poses_that_run_into_each_other_become_one(yard_map, yard_points):
    T, par = pose(3.0, -2.0, 140.0), AROUND_POSITION
    m, points = match_map_of(yard_map), seen_from(np.random.default_rng(2), yard_points, T, 2500)
    found, _ = search(points, Around(T[:3, 3], 4.0), m, par, RegistrationParameters())
    hypotheses = PoseHypotheses(RegistrationParameters())
    hypotheses.add(found)
    hypotheses.add(found)
    assert len(hypotheses) <= len(found)
    hypotheses.drop_near(T)
    assert all(offset(T, one.T_map_vehicle)[0] > 0.3 for one in hypotheses._held)


def test_probabilities_follow_fits_views_and_what_is_said_against():
    one = probabilities(np.array([0.7, 0.6]), 1.0)
    two = probabilities(np.array([0.7, 0.6]), 2.0)
    assert one[0] < two[0] < 1.0
    assert one.sum() < 1.0
    assert probabilities(np.array([0.7, 0.6]), 1.0, np.array([20.0, 0.0]))[0] < 0.01
    assert probabilities(np.array([0.1, 0.1]), 1.0).sum() < 0.01  # rather none of them


def test_a_pool_shows_the_last_scans_where_they_were_seen(yard_points):
    rng, pool = np.random.default_rng(3), ScanPool(every_m=1.0, reach_m=4.0)
    poses = [pose(x, 0.3 * x, 4.0 * x) for x in np.arange(0.0, 9.0, 1.0)]
    before = poses[0]
    for T in poses:
        pool.push(seen_from(rng, yard_points, T, 800), T_inverse(before) @ T)
        before = T
    points = pool.points_m
    assert 800 + 3 * 400 <= len(points) <= 800 + 4 * 400
    on_ground = transform(poses[-1], points)[:, 2]
    assert np.abs(on_ground[np.abs(on_ground - GROUND_M) < 0.3] - GROUND_M).mean() < 0.05
    assert (pool.standing_m[:, 2] > 0.3).all()


def test_a_standing_pool_is_the_newest_scan(yard_points):
    rng, pool, T = np.random.default_rng(3), ScanPool(), pose(0.0, 0.0, 0.0)
    for _ in range(5):
        pool.push(seen_from(rng, yard_points, T, 800), np.eye(4))
    assert pool.stands
    assert len(pool.points_m) == 800
