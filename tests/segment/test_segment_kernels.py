"""The kernels of segmentation against their plain twins, and the belief against Dempster's rule vote by vote."""

import numpy as np
import plain_segment as plain
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gnd.gnd_map.se3 import exp_so3
from gnd.vehicle_agent.segment.ground_kernels import GroundGrid, ground_heights, lowest_heights, remember_ground
from gnd.vehicle_agent.segment.image_kernels import BINS, Optics, RangeJudge, draw_image, layer_gap, vote
from gnd.vehicle_agent.segment.scene import WEIGHTS, belief, hash_table
from gnd.vehicle_agent.segment.voxel_kernels import (
    GROUND,
    LOW,
    MOST_REACH,
    OUTSIDE,
    components,
    components_of,
    find_objects,
    moving_points,
)

GRID = GroundGrid(-20.0, -20.0, 1.0, 40, 40)
LEVEL = np.array([0.0, 0.0, -1.9, 0.0, 0.0, 1.0])  # the road under the vehicle and its normal
R_TURNED = exp_so3(np.array([0.02, -0.01, 0.7])).T


def cloud(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points on a cluttered ring around a sensor that moves, float32."""
    rng = np.random.default_rng(seed)
    turn, r = np.sort(rng.uniform(0, 2 * np.pi, n)), rng.choice([6.0, 9.0, 15.0], n) + rng.normal(0, 0.1, n)
    tan = rng.choice(np.arange(-8, 9) * 0.035, n)
    origins = np.stack([turn / 10, 0 * turn, 0 * turn], axis=1)
    points = origins + np.stack([r * np.cos(turn), r * np.sin(turn), r * tan], axis=1)
    return points.astype(np.float32), origins.astype(np.float32)


def test_lowest_heights_are_the_second_lowest_points() -> None:
    points, _ = cloud(4000)
    for near_m in (0.0, 8.0):
        np.testing.assert_array_equal(lowest_heights(points, GRID, near_m), plain.lowest(points, GRID, near_m))


def test_ground_is_remembered_under_what_drives_over_it() -> None:
    memory = np.full((4, 4), np.inf, np.float32)
    flat, car = np.zeros((4, 4), np.float32), np.full((4, 4), 0.5, np.float32)
    remember_ground(memory, flat, 0.15)
    for _ in range(5):
        remember_ground(memory, car, 0.15)
    assert memory.max() < 0.05
    for _ in range(6):
        remember_ground(memory, flat - 1.0, 0.15)
    assert memory.max() < -0.9


def test_ground_is_carried_on_a_few_metres_and_pits_are_left_out() -> None:
    memory = np.full((40, 40), -1.9, np.float32)
    memory[10:13, 10:13] = -0.5  # something stands there
    memory[30, 30] = -4.0  # an echo
    memory[20:, :5] = np.inf  # not seen
    found = ground_heights(memory, GRID, 0.15, LEVEL, 0.05, 0.0)
    assert found[11, 11] == pytest.approx(-1.9 + 0.15 * 2)
    assert found[30, 30] == pytest.approx(-1.9, abs=0.3)
    assert found[39, 0] == pytest.approx(-1.9 + 0.05 * 19.5 * np.sqrt(2), abs=0.01)
    assert found[20, 20] == pytest.approx(-1.9)


def test_nearer_than_any_ray_reaches_the_ground_the_road_is_taken_for_level() -> None:
    car = np.full((40, 40), -1.2, np.float32)  # the lowest that was ever seen
    found = ground_heights(car, GRID, 0.15, LEVEL, 0.03, 12.0)
    assert found[20, 29] == pytest.approx(-1.9 + 0.01 * np.hypot(0.5, 9.5), abs=1e-4)
    assert found[20, 39] == pytest.approx(-1.9 + 0.03 * np.hypot(0.5, 19.5), abs=1e-4)


def test_a_hill_before_the_vehicle_is_ground_up_to_the_slope_allowed() -> None:
    x = np.arange(40) - 19.5
    memory = np.repeat((-1.9 + 0.04 * np.maximum(x, 0.0))[:, None], 40, axis=1).astype(np.float32)
    np.testing.assert_allclose(ground_heights(memory, GRID, 0.15, LEVEL, 0.04, 0.0), memory, atol=0.01)


def test_objects_are_the_voxels_above_the_ground() -> None:
    points, origins = cloud(3000)
    ground = np.full((40, 40), -0.3, np.float32)
    voxel_of, first, index = find_objects(
        points, origins, ground, GRID, 0.25, 0.1, 0.3, 2.0, 14.0, *hash_table(len(points))
    )
    r = np.linalg.norm(points - origins, axis=1)
    inside = (r >= 2.0) & (r <= 14.0) & (np.abs(points[:, :2]) < 20.0).all(axis=1)
    np.testing.assert_array_equal(voxel_of == OUTSIDE, ~inside)
    height = points[:, 2] - np.float32(-0.3)
    np.testing.assert_array_equal(voxel_of == GROUND, inside & (height < 0.1))
    np.testing.assert_array_equal(voxel_of == LOW, inside & (height >= 0.1) & (height < 0.25))
    at = np.floor(points / np.float64(0.3)).astype(int)
    objects = voxel_of >= 0
    np.testing.assert_array_equal(index[voxel_of[objects]], at[objects])
    assert len(index) == len(np.unique(at[objects], axis=0))
    np.testing.assert_array_equal(voxel_of[first], np.arange(len(first)))


def test_range_images_hold_the_nearest_range_of_each_cell() -> None:
    points, origins = cloud(5000)
    voxel_of = np.where(points[:, 2] < -0.5, GROUND, 0).astype(np.int32)
    optics = Optics(1200, 90, -0.3, 0.007)
    image, places = draw_image(points, origins, voxel_of, R_TURNED, optics, 0.5)
    wrong = image != plain.image(points, origins, voxel_of, R_TURNED, optics)
    assert wrong.mean() < 1e-4  # a ray within rounding of a cell's border
    b = (np.arctan2(*(R_TURNED @ (points - origins).T)[1::-1]) / (2 * np.pi) % 1.0 * BINS).astype(int)
    for k in (3, 50, 120):
        np.testing.assert_allclose(places[k], origins[b == k].mean(axis=0), atol=0.02)


def test_where_start_and_end_of_a_sweep_meet_no_place_is_known() -> None:
    points, origins = cloud(5000)
    origins = origins * np.float32(5.0)  # 3 m a sweep
    points = points + origins * np.float32(0.8)
    R = exp_so3(np.array([0.0, 0.0, 0.05]))  # the seam lies within a bin
    _, places = draw_image(points, origins, np.zeros(5000, np.int32), R, Optics(1200, 90, -0.3, 0.007), 0.5)
    known = ~np.isnan(places[:, 0])
    assert known.sum() >= BINS - 4
    assert not known[int(0.05 / (2 * np.pi) * BINS)]


@pytest.mark.parametrize("gap_tan", [0.0, 0.042])
def test_votes_agree_with_the_plain_twin(gap_tan: float) -> None:
    points, origins = cloud(4000)
    voxel_of = np.where(points[:, 2] < -1.2, GROUND, 0).astype(np.int32)
    optics, judge = Optics(1200, 90, -0.3, 0.007), RangeJudge(0.15, 0.3, 0.45, 0.01, gap_tan, 255)
    image, places = draw_image(points, origins, voxel_of, R_TURNED, optics, 0.5)
    asked = (cloud(1500, seed=1)[0] + np.random.default_rng(2).normal(0, 0.3, (1500, 3))).astype(np.float32)
    offset = np.array([0.3, -0.2, 0.05])
    passed, met = np.zeros(1500, np.uint8), np.zeros(1500, np.uint8)
    vote(asked, offset, image, places, R_TURNED, optics, judge, 3, passed, met)
    said = [plain.opinion(p + offset, image, places, R_TURNED, optics, judge) for p in asked.astype(np.float64)]
    expected = np.array([[s == "passed", 3 * (s == "met")] for s in said])
    assert expected[:, 0].sum() > 30
    assert (expected[:, 1] > 0).sum() > 300
    assert (np.stack([passed, met], axis=1) != expected).any(axis=1).mean() < 2e-3  # within rounding of a border


def test_points_that_surely_stand_are_asked_no_more() -> None:
    points, origins = cloud(2000)
    optics = Optics(1200, 90, -0.3, 0.007)
    image, places = draw_image(points, origins, np.zeros(2000, np.int32), np.eye(3), optics, 0.5)
    passed, met = np.zeros(2000, np.uint8), np.full(2000, 12, np.uint8)
    passed[:1000] = 1
    vote(
        points,
        np.zeros(3),
        image,
        places,
        np.eye(3),
        optics,
        RangeJudge(0.15, 0.3, 0.45, 0.01, 0.0, 12),
        4,
        passed,
        met,
    )
    assert (met[1000:] == 12).all()
    assert (met[:1000] == 16).mean() > 0.9


@pytest.mark.parametrize("reach", [1, 4])
def test_components_against_scipy(reach: int) -> None:
    rng = np.random.default_rng(reach)
    index = np.unique(rng.integers(0, 14, (350, 3)), axis=0).astype(np.int32)
    rng.shuffle(index)
    up = rng.integers(1, reach + 1, len(index)).astype(np.uint8)
    chosen = rng.random(len(index)) < 0.6
    kept = np.flatnonzero(chosen)
    a, b = np.array(plain.joined(index[kept], up[kept])).T
    n, expected = connected_components(
        coo_array((np.ones(len(a)), (a, b)), shape=(len(kept), len(kept))), directed=False
    )
    found = components(index, up, chosen, *hash_table(len(index)))
    assert (found[~chosen] == -1).all()
    assert n > 3
    assert len(np.unique(found[kept])) == n == len(np.unique(np.stack([found[kept], expected]), axis=1).T)


def test_low_points_go_with_what_stands_above_them() -> None:
    points = np.array([[0.1, 0.1, 0.5], [0.1, 0.1, 0.2], [0.1, 0.1, -0.2], [0.1, 0.1, -0.8], [2.0, 0, 0.2]], np.float32)
    voxel_of, index = np.array([0, LOW, GROUND, LOW, LOW], np.int32), np.array([[0, 0, 1]], np.int32)
    found = moving_points(points, voxel_of, index, np.array([True]), 0.3, *hash_table(1))
    np.testing.assert_array_equal(found, [True, True, False, False, False])


def test_the_usual_gap_between_layers_is_read_from_the_image() -> None:
    image = np.zeros((100, 80), np.uint16)
    image[:, 4::6] = 500
    image[::9] = 0
    assert layer_gap(image, 0.8) == 6
    assert layer_gap(np.zeros((5, 5), np.uint16), 0.8) == 1


@example(passed=8, met=30, moving=0.9375, static=0.94921875)  # nearly all of both votes is conflict
@given(passed=st.integers(0, 12), met=st.integers(0, 40), moving=st.floats(0.05, 0.95), static=st.floats(0.05, 0.95))
def test_belief_is_what_dempsters_rule_gives_vote_by_vote(passed: int, met: int, moving: float, static: float) -> None:
    m, s, unknown = 0.0, 0.0, 1.0
    votes = [(moving, 0.0)] * passed + [(0.0, 1 - (1 - static) ** (1 / WEIGHTS))] * met
    for to_moving, to_static in votes:  # joint masses of two bodies of evidence, the conflict shared out
        rest = 1 - to_moving - to_static
        joint = (
            m * (to_moving + rest) + unknown * to_moving,
            s * (to_static + rest) + unknown * to_static,
            unknown * rest,
        )
        m, s, unknown = (x / sum(joint) for x in joint)
    found = belief(np.array([passed], np.uint8), np.array([met], np.uint8), moving, static)
    np.testing.assert_allclose([x[0] for x in found], [m, s], atol=1e-9)


@given(
    st.integers(0, 10_000), st.integers(1, 300), st.sampled_from([2, 4, 9, 30]), st.floats(0.0, 1.0)
)  # fmt: skip
@example(7, 300, 4, 0.02)
def test_components_with_a_seed_are_those_of_all_voxels(seed: int, count: int, wide: int, share: float) -> None:
    """Against the components of all voxels: the same ones, numbered by their first seeds; the others have no number."""
    rng = np.random.default_rng(seed)
    index = np.unique(rng.integers(-wide, wide, (count, 3)) * [1, 1, 3], axis=0).astype(np.int32)
    index = rng.permutation(index)
    reach = rng.integers(1, MOST_REACH + 1, len(index)).astype(np.uint8)
    seeds = rng.random(len(index)) < share
    whole = components(index, reach, np.ones(len(index), np.bool_), *hash_table(len(index)))
    number = {label: n for n, label in enumerate(dict.fromkeys(whole[seeds].tolist()))}
    label, waiting = np.full((2, len(index)), 77, np.int32)
    components_of(index, reach, seeds, *hash_table(len(index)), label, waiting)
    assert label.tolist() == [number.get(one, -1) for one in whole.tolist()]
