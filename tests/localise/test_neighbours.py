"""A fence of equal posts fits at every post: the match says so. A yard fits once."""

import numpy as np
from yard import local_map_of, match_map_of, pose, rectangle, seen_from

from gnd.vehicle_agent.localise.neighbours import FAR_M, NEAR_M, WEAK_M, hedged
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import register

PAR = RegistrationParameters()


def ladder(rng, every_m):
    """A road between two even walls, and pilasters on them every so many metres."""
    surfaces = [
        rectangle(rng, [-40.0, -8.0, 0.0], [80.0, 0.0, 0.0], [0.0, 16.0, 0.0], 60.0),
        rectangle(rng, [-40.0, -8.0, 0.0], [80.0, 0.0, 0.0], [0.0, 0.0, 4.0], 60.0),
        rectangle(rng, [-40.0, 8.0, 0.0], [80.0, 0.0, 0.0], [0.0, 0.0, 4.0], 60.0),
    ]
    surfaces += [
        rectangle(rng, [x, side, 0.0], [0.0, -0.6 * np.sign(side), 0.0], [0.0, 0.0, 4.0], 150.0)
        for x in np.arange(-38.0, 38.0, every_m)
        for side in (-8.0, 8.0)
    ]
    return np.concatenate(surfaces)


def test_a_match_on_the_wrong_rung_holds_the_right_one_in_its_covariance():
    rng = np.random.default_rng(3)
    places, every_m = ladder(rng, 0.8), 0.8
    m = match_map_of(local_map_of(places + rng.normal(0.0, 0.02, places.shape)))
    points = seen_from(rng, places, pose(0.3, 0.0, 0.0), 6000)
    wrong = register(points, pose(0.3 + every_m, 0.0, 0.0), m, PAR, "near")
    off_m = abs(wrong.T_map_vehicle[0, 3] - 0.3)
    assert 0.6 < off_m < 1.0
    assert wrong.sigma_m[0] < 0.05  # sure of it
    known, contested = hedged(points, wrong, m, PAR, FAR_M, 0.0)
    assert contested
    assert known.sigma_m[0] > 0.8 * off_m


def test_a_match_that_is_the_only_one_stays_as_sure_as_it_was(yard_points, yard_map):
    rng = np.random.default_rng(4)
    T = pose(2.0, -3.0, 20.0)
    m = match_map_of(yard_map)
    points = seen_from(rng, yard_points, T, 6000)
    right = register(points, T, m, PAR, "near")
    for starts_m, least_sigma_m in ((NEAR_M, WEAK_M), (FAR_M, 0.0)):
        known, contested = hedged(points, right, m, PAR, starts_m, least_sigma_m)
        assert not contested
        assert np.array_equal(known.covariance, right.covariance)
