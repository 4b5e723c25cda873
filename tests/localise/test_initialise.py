"""The first pose: any heading, a position wrong by metres; and honesty where two answers fit."""

from dataclasses import replace

import numpy as np
import pytest
from yard import GROUND_M, local_map_of, match_map_of, offset, pose, rectangle, seen_from

from gnd.vehicle_agent.localise.initialise import (
    AROUND_POSITION,
    HIGHEST_GROUND_M,
    HIT,
    NEXT_TO,
    _field,
    ground_below,
    initialise,
)


@pytest.mark.parametrize("seed", range(8))
def test_any_heading_is_found_from_a_position_metres_off(yard_map, yard_points, seed):
    rng = np.random.default_rng(seed)
    T = pose(rng.uniform(-12, 12), rng.uniform(-6, 6), rng.uniform(0, 360), roll_deg=0.5, pitch_deg=-0.5)
    away = rng.uniform(0, 2 * np.pi)
    p_gnss = T[:3, 3] + [4.0 * np.cos(away), 4.0 * np.sin(away), 6.0]  # the height is not looked at
    found = initialise(seen_from(rng, yard_points, T, 2500), p_gnss, 2.5, match_map_of(yard_map))
    assert found is not None
    assert found.found
    off_m, off_deg = offset(T, found.registration.T_map_vehicle)
    assert off_m < 0.02
    assert off_deg < 0.05
    assert found.runner_up_fit < 0.8 * found.fit


def test_a_room_that_looks_the_same_from_both_ends_is_called_ambiguous():
    rng = np.random.default_rng(0)
    wall = lambda x, y, dx, dy: rectangle(rng, (x, y, GROUND_M), (dx, dy, 0), (0, 0, 4), 60)  # noqa: E731
    ground = rectangle(rng, (-15, -8, GROUND_M), (30, 0, 0), (0, 16, 0), 60)
    room = np.concatenate(
        [ground, wall(-15, -8, 30, 0), wall(-15, 8, 30, 0), wall(-15, -8, 0, 16), wall(15, -8, 0, 16)]
    )
    T = pose(0.0, 0.0, 0.0)
    found = initialise(seen_from(rng, room, T, 2500), T[:3, 3], 1.0, match_map_of(local_map_of(room)))
    assert found is not None
    assert found.fit > 0.8
    assert found.runner_up_fit > 0.95 * found.fit
    assert not found.found


def test_where_there_is_no_map_there_is_no_answer(yard_map, yard_points):
    T, rng = pose(0.0, 0.0, 0.0), np.random.default_rng(0)
    points = seen_from(rng, yard_points, T, 2500)
    assert initialise(points, np.array([400.0, 0.0, 0.0]), 2.5, match_map_of(yard_map)) is None


def test_a_place_that_is_not_in_the_map_is_not_found(yard_map):
    """Points of somewhere else may fit a little; they must not pass for the yard."""
    rng = np.random.default_rng(3)
    elsewhere = rng.uniform([-30, -30, -2], [30, 30, 6], (2500, 3))
    found = initialise(elsewhere, np.array([0.0, 0.0, GROUND_M]), 2.5, match_map_of(yard_map))
    assert found is None or not found.found


def test_the_number_of_hypotheses_grows_with_the_circle(yard_map, yard_points):
    T, rng = pose(0.0, 0.0, 0.0), np.random.default_rng(0)
    points, m = seen_from(rng, yard_points, T, 2500), match_map_of(yard_map)
    near, far = (initialise(points, T[:3, 3], sigma, m, replace(AROUND_POSITION, n_refined=4)) for sigma in (0.5, 2.0))
    assert near is not None
    assert far is not None
    assert far.hypotheses > 6 * near.hypotheses


def test_the_field_that_is_scored_equals_its_plain_twin():
    index = np.random.default_rng(2).choice(np.array([-2, -1, 7], np.int32), (9, 8, 7), p=[0.2, 0.6, 0.2])
    occupied, plain = np.pad(index >= 0, 1), np.zeros(index.shape, np.uint8)
    for axis in range(3):
        for side in (-1, 1):
            plain[np.roll(occupied, side, axis)[1:-1, 1:-1, 1:-1]] = NEXT_TO
    plain[index >= 0] = HIT
    np.testing.assert_array_equal(_field(index), plain)


def plain_ground_below(points_m):
    near = points_m[np.hypot(points_m[:, 0], points_m[:, 1]) < 15.0, 2]
    if not len(near):
        return 0.0
    low = near[near <= np.quantile(near, 0.6)]
    counts, edges = np.histogram(low, bins=max(1, int(np.ptp(low) / 0.2)))
    k = int(np.argmax(counts))
    found = float(np.median(low[(low >= edges[k]) & (low <= edges[k + 1])]))
    return found if found < HIGHEST_GROUND_M else 0.0


def test_the_ground_below_equals_its_plain_twin():
    rng = np.random.default_rng(0)
    for turn in range(500):
        points = rng.normal(0.0, [9.0, 9.0, 1.0], (int(rng.integers(0, 300)), 3))
        if turn % 2:
            points[:, 2] = np.round(points[:, 2], 1)  # many at one height, and on the edges between two
        if turn % 3:
            points[: len(points) // 2, 2] = -1.7
        assert ground_below(points) == plain_ground_below(points)
