"""Submaps: scans laid together as wheels and gyro say, and the points and wheels of them."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, transform
from vehicle_agent.localise.odometry import MotionBuffer
from vehicle_agent.localise.refine_parameters import RefineParameters
from vehicle_agent.localise.registration import WHEELS_M
from vehicle_agent.localise.submap import SubmapScan, ToldByScans, local_poses, make_submap, thinned

S = 1_000_000_000
EVERY_NS = S // 10
NO_POINTS = np.zeros((0, 3), np.float32)


def attitude(yaw_rad, pitch_rad=0.0, roll_rad=0.0):
    return exp_so3([0, 0, yaw_rad]) @ exp_so3([0, pitch_rad, 0]) @ exp_so3([roll_rad, 0, 0])


def motion_of(speed_mps, yaw_rate_radps, seconds=20):
    motion = MotionBuffer()
    for k in range(50 * seconds + 1):
        motion.push(k * S // 50, speed_mps, yaw_rate_radps)
    return motion


def scans_at(poses, way_m, points=None):
    points = [NO_POINTS] * len(poses) if points is None else points
    return [SubmapScan(n, n * EVERY_NS, float(way_m[n]), points[n].astype(np.float32), T) for n, T in enumerate(poses)]


def circle(n, speed_mps, yaw_rate_radps, start):
    """(n, 4, 4) true poses every 0.1 s on an arc, from `start`."""
    poses = []
    for k in range(n):
        t = k * EVERY_NS / S
        turn, radius = yaw_rate_radps * t, speed_mps / yaw_rate_radps
        arc = [radius * np.sin(turn), radius * (1.0 - np.cos(turn)), 0.0]
        poses.append(start @ T_from_R_t(attitude(turn), arc))
    return np.stack(poses)


def straight(n=41, step_m=1.0, points=None):
    """Scans of a straight drive, its motion, and the poses."""
    poses = [T_from_R_t(np.eye(3), [step_m * k, 0.0, 0.0]) for k in range(n)]
    return scans_at(poses, step_m * np.arange(n), points), motion_of(step_m / 0.1, 0.0)


# --- poses ---------------------------------------------------------------------------------------------------------


def test_planar_motion_is_that_of_the_odometry_whatever_the_online_poses_say():
    rng = np.random.default_rng(0)
    start = T_from_R_t(attitude(0.7), [30.0, -12.0, 4.0])
    true = circle(60, 8.0, 0.4, start)
    online = true.copy()
    online[1:, :2, 3] += rng.normal(0.0, 0.5, (59, 2))
    for T in online[1:]:
        T[:3, :3] = T[:3, :3] @ attitude(rng.normal(0.0, 0.05))
    T_local = local_poses(scans_at(online, 0.8 * np.arange(60)), motion_of(8.0, 0.4))
    np.testing.assert_allclose(T_local[:, :3, :3], true[:, :3, :3], atol=1e-9)
    np.testing.assert_allclose(T_local[:, :2, 3], true[:, :2, 3] - true[0, :2, 3], atol=1e-9)


def test_height_roll_and_pitch_are_those_of_the_single_scans():
    """Up a slope of 6 degrees, leaning to a side: way goes along the slope, height comes from the scans."""
    pitch, roll, n = -np.radians(6.0), np.radians(2.0), 30
    R = attitude(0.5, pitch, roll)
    poses = [T_from_R_t(R, np.array([3.0, 4.0, 1.0]) + 0.9 * k * R[:, 0]) for k in range(n)]
    T_local = local_poses(scans_at(poses, 0.9 * np.arange(n)), motion_of(9.0, 0.0))
    expected = np.stack(poses)
    expected[:, :2, 3] -= [3.0, 4.0]
    np.testing.assert_allclose(T_local, expected, atol=1e-9)


angle = st.floats(-np.pi, np.pi)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(angle, st.floats(-1.4, 1.4), angle, st.floats(-50, 50)), min_size=2, max_size=6))
def test_any_attitude_of_a_standing_vehicle_comes_back_but_for_its_heading(values):
    poses = [T_from_R_t(attitude(yaw, pitch, roll), [9.0, 9.0, z]) for yaw, pitch, roll, z in values]
    T_local = local_poses(scans_at(poses, np.zeros(len(poses))), motion_of(0.0, 0.0, seconds=1))
    first_yaw = values[0][0]
    for T, (_, pitch, roll, z) in zip(T_local, values, strict=True):
        np.testing.assert_allclose(T[:3, :3], attitude(first_yaw, pitch, roll), atol=1e-7)
        np.testing.assert_allclose(T[:3, 3], [0.0, 0.0, z], atol=1e-9)


def test_one_scan_alone_is_its_own_origin():
    T = T_from_R_t(attitude(1.0, 0.1, 0.2), [5.0, 6.0, 7.0])
    only = local_poses(scans_at([T], [0.0]), MotionBuffer())
    np.testing.assert_allclose(only, T_from_R_t(T[:3, :3], [0.0, 0.0, 7.0])[None], atol=1e-12)


@pytest.mark.parametrize("turn", [True, False])
@pytest.mark.parametrize("way", [True, False])
def test_what_scans_tell_better_stands_instead_of_wheels_and_gyro(turn, way):
    """Wheels 5 % too slow and a gyro that is off; scans tell the true turn, way or both, and only that."""
    true = circle(40, 8.0, 0.4, T_from_R_t(attitude(0.7), [3.0, 2.0, 1.0]))
    scans, motion = scans_at(true, 0.8 * np.arange(40)), motion_of(7.6, 0.43)
    steps = [T_inverse(a) @ b for a, b in pairwise(true)]
    told = [ToldByScans(T[:3, :3] if turn else None, T[:3, 3] if way else None) for T in steps]
    scans[1:] = [replace(scan, told=one) for scan, one in zip(scans[1:], told, strict=True)]
    expected = np.stack(_mixed(true, motion, turn, way))
    expected[:, :2, 3] -= true[0, :2, 3]
    np.testing.assert_allclose(local_poses(scans, motion), expected, atol=1e-9)


def _mixed(true, motion, turn, way):
    """The chain of the true turns or ways, and for the rest those of the odometry."""
    chain = [true[0]]
    for n, (a, b) in enumerate(pairwise(true)):
        seen, driven = T_inverse(a) @ b, motion.delta(n * EVERY_NS, (n + 1) * EVERY_NS)
        chain.append(chain[-1] @ T_from_R_t((seen if turn else driven)[:3, :3], (seen if way else driven)[:3, 3]))
    return chain


def test_for_learning_what_the_odometry_is_wrong_by_scans_do_not_speak():
    poses = circle(20, 8.0, 0.4, np.eye(4))
    scans, motion = scans_at(poses, 0.8 * np.arange(20)), motion_of(8.0, 0.4)
    told = [replace(scan, told=ToldByScans(np.eye(3), np.zeros(3))) for scan in scans]
    np.testing.assert_array_equal(local_poses(told, motion, driven_only=True), local_poses(scans, motion))
    standing = local_poses(told, motion)
    np.testing.assert_allclose(standing[:, :2, 3], 0.0, atol=1e-12)


# --- submaps -------------------------------------------------------------------------------------------------------


def marked(n):
    """One point each, at a height of its own, so that a submap shows which scans it holds."""
    return [np.array([[0.0, 0.0, float(k)]]) for k in range(n)]


def held(submap):
    return [round(z) for z in submap.points_m[:, 2]]


@pytest.mark.parametrize("anchor", [0, 3, 20, 40])
def test_a_submap_holds_the_scans_within_reach_where_they_were(anchor):
    scans, motion = straight(points=marked(41))
    par = RefineParameters(half_m=6.0, half_s=100.0)
    submap = make_submap(scans, local_poses(scans, motion), anchor, par)
    within = list(range(max(anchor - 6, 0), min(anchor + 6, 40) + 1))
    assert held(submap) == within
    np.testing.assert_allclose(submap.points_m[:, 0], np.array(within) - anchor, atol=1e-6)


def test_a_submap_holds_nothing_that_is_too_old_or_too_late():
    scans, motion = straight(points=marked(41))
    submap = make_submap(scans, local_poses(scans, motion), 20, RefineParameters(half_m=100.0, half_s=0.5))
    assert held(submap) == list(range(15, 26))


@pytest.mark.parametrize("max_scans", [2, 3, 10, 41])
def test_many_scans_are_thinned_and_the_anchor_stays(max_scans):
    scans, motion = straight(points=marked(41))
    par = RefineParameters(half_m=100.0, half_s=100.0, max_scans=max_scans)
    scans_held = held(make_submap(scans, local_poses(scans, motion), 7, par))
    assert 7 in scans_held
    assert len(scans_held) <= max_scans
    assert len(scans_held) >= max_scans - 1
    assert scans_held[0] == 0


def test_a_standing_vehicle_makes_a_submap_of_its_own_place():
    rng = np.random.default_rng(1)
    room = rng.uniform(-20, 20, (300, 3))
    T = T_from_R_t(attitude(0.3, 0.01), [1.0, 2.0, 3.0])
    points = [rng.permutation(room)[:150] for _ in range(50)]
    scans = scans_at([T] * 50, np.zeros(50), points)
    submap = make_submap(scans, local_poses(scans, motion_of(0.0, 0.0)), 25, RefineParameters())
    np.testing.assert_allclose(submap.wheels_m, WHEELS_M, atol=1e-9)
    assert 250 < len(submap.points_m) <= 300  # each place once, however often it was seen
    nearest = np.linalg.norm(submap.points_m[:, None] - room, axis=2).min(axis=1)
    assert nearest.max() < 1e-5


def test_wheels_are_put_down_along_the_way():
    scans, motion = straight()
    par = RefineParameters(half_m=6.0, half_s=100.0, wheel_every_m=3.0)
    wheels = make_submap(scans, local_poses(scans, motion), 20, par).wheels_m.reshape(-1, 4, 3)
    np.testing.assert_allclose(wheels, [WHEELS_M + np.array([way, 0, 0]) for way in (-6, -3, 0, 3, 6)], atol=1e-9)


def test_a_place_seen_from_many_scans_of_a_bent_way_lies_in_one_spot():
    """Up a bend: every scan sees the same posts, from elsewhere and otherwise tilted."""
    rng = np.random.default_rng(2)
    posts = rng.uniform([-30, -30, 0], [30, 30, 5], (40, 3))
    poses = circle(30, 8.0, 0.3, T_from_R_t(attitude(0.2), [0.0, 0.0, 1.0]))
    points = [transform(T_inverse(T), posts) for T in poses]
    scans = scans_at(poses, 0.8 * np.arange(30), points)
    par = RefineParameters(half_m=100.0, half_s=100.0, leaf_m=1e-3)
    submap = make_submap(scans, local_poses(scans, motion_of(8.0, 0.3)), 15, par)
    true = transform(T_inverse(poses[15]), posts)
    off = np.linalg.norm(submap.points_m[:, None] - true, axis=2).min(axis=1)
    assert off.max() < 1e-5


# --- thinning ------------------------------------------------------------------------------------------------------

cloud = st.lists(st.tuples(*[st.floats(-100, 100, width=32)] * 3), min_size=1, max_size=80)


@given(cloud, st.sampled_from([0.25, 1.0, 7.5]), st.integers(1, 60))
def test_thinned_keeps_the_first_of_each_cube_and_at_most_n(points, leaf_m, n):
    points = np.array(points, np.float64)
    kept = thinned(points, leaf_m, n)
    first = {}  # the plain twin
    for row, point in enumerate(points):
        first.setdefault(tuple(int(c) for c in np.floor(point / leaf_m)), row)
    expected = points[sorted(first.values())]
    assert len(kept) == min(n, len(expected))
    rows = [int(np.flatnonzero((expected == p).all(axis=1))[0]) for p in kept]
    assert rows == sorted(set(rows))  # in their order, none twice
    if len(expected) <= n:
        np.testing.assert_array_equal(kept, expected)


def test_what_is_left_is_spread_evenly():
    points = np.column_stack([np.arange(1000.0), np.zeros(1000), np.zeros(1000)])
    kept = thinned(points, 0.25, 101)
    assert set(np.diff(kept[:, 0])) <= {9.0, 10.0}
    assert (kept[0, 0], kept[-1, 0]) == (0.0, 999.0)
