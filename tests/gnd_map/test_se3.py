"""Rotations and poses against scipy, and their round trips at the awkward angles."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from gnd.gnd_map.errors import MotionError, ShapeError
from gnd.gnd_map.se3 import (
    R_from_quaternion_xyzw,
    T_from_R_t,
    T_inverse,
    exp_so3,
    interpolate_poses,
    log_so3,
    quaternion_xyzw_from_R,
    transform,
)

vectors = st.tuples(*[st.floats(-3.0, 3.0)] * 3)


def random_poses(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return T_from_R_t(exp_so3(rng.normal(size=(n, 3))), rng.normal(scale=100.0, size=(n, 3)))


@given(vectors)
@example((0.0, 0.0, 0.0))
@example((1e-12, 0.0, -1e-12))
@example((np.pi, 0.0, 0.0))
def test_exp_is_scipys_rotation_vector(vector: tuple[float, float, float]) -> None:
    v = np.array(vector)
    np.testing.assert_allclose(exp_so3(v), Rotation.from_rotvec(v).as_matrix(), atol=1e-14)


@given(vectors)
@example((0.0, 0.0, 0.0))
@example((1e-9, 0.0, 0.0))
@example((0.0, np.pi - 1e-9, 0.0))
@example((0.0, 0.0, np.pi))
def test_log_leads_back(vector: tuple[float, float, float]) -> None:
    R = Rotation.from_rotvec(np.array(vector)).as_matrix()
    w = log_so3(R)
    assert np.linalg.norm(w) <= np.pi + 1e-12
    np.testing.assert_allclose(exp_so3(w), R, atol=1e-14)


def test_quaternions_are_scipys() -> None:
    rotations = Rotation.random(500, random_state=3)
    q = quaternion_xyzw_from_R(rotations.as_matrix())
    np.testing.assert_allclose(q, rotations.as_quat(canonical=True), atol=1e-14)
    np.testing.assert_allclose(R_from_quaternion_xyzw(2.0 * q), rotations.as_matrix(), atol=1e-14)


def test_inverse_undoes() -> None:
    T = random_poses(50, 1)
    np.testing.assert_allclose(T_inverse(T) @ T, np.tile(np.eye(4), (50, 1, 1)), atol=1e-12)
    points = np.random.default_rng(2).normal(size=(7, 3))
    np.testing.assert_allclose(transform(T_inverse(T[0]), transform(T[0], points)), points, atol=1e-12)


def test_interpolation_is_scipys_slerp_and_linear() -> None:
    t_ns = np.array([0, 100, 250, 1000], dtype=np.int64)
    T = random_poses(4, 5)
    query = np.array([0, 1, 99, 100, 180, 999, 1000])
    found = interpolate_poses(t_ns, T, query)
    slerp = Slerp(t_ns, Rotation.from_matrix(T[:, :3, :3]))
    np.testing.assert_allclose(found[:, :3, :3], slerp(query).as_matrix(), atol=1e-12)
    for axis in range(3):
        np.testing.assert_allclose(found[:, axis, 3], np.interp(query, t_ns, T[:, axis, 3]), atol=1e-10)


def test_interpolation_keeps_nanoseconds_of_today() -> None:
    start = 1_790_000_000_123_456_789
    t_ns = start + np.array([0, 1_000_000], dtype=np.int64)
    T = T_from_R_t(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0, 0], [1.0, 0, 0]]))
    assert interpolate_poses(t_ns, T, [start + 1])[0, 0, 3] == pytest.approx(1e-6, rel=1e-12)


def test_motion_continues_within_the_tolerance_only() -> None:
    t_ns = np.array([0, 1_000_000_000], dtype=np.int64)
    T = T_from_R_t(exp_so3(np.array([[0.0, 0, 0], [0, 0, 0.2]])), np.array([[0.0, 0, 0], [10.0, 0, 0]]))
    after = interpolate_poses(t_ns, T, [1_500_000_000], tolerance_ns=600_000_000)[0]
    np.testing.assert_allclose(after, T_from_R_t(exp_so3([0.0, 0, 0.3]), [15.0, 0, 0]), atol=1e-12)
    with pytest.raises(MotionError, match=r"0.500 s outside.*0.100 s are allowed"):
        interpolate_poses(t_ns, T, [1_500_000_000], tolerance_ns=100_000_000)
    with pytest.raises(MotionError, match="outside"):
        interpolate_poses(t_ns, T, [-1])


def test_one_pose_stands_for_its_time() -> None:
    T = random_poses(1, 8)
    np.testing.assert_array_equal(interpolate_poses(np.array([5]), T, [5, 5]), np.repeat(T, 2, axis=0))
    assert interpolate_poses(np.array([5]), T, np.empty(0, np.int64)).shape == (0, 4, 4)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(MotionError, match="no poses"):
        interpolate_poses(np.empty(0, np.int64), np.empty((0, 4, 4)), [0])
    with pytest.raises(ShapeError, match="T: expected shape"):
        interpolate_poses(np.array([0, 1]), random_poses(3, 0), [0])
    with pytest.raises(ShapeError, match="length"):
        R_from_quaternion_xyzw([0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("angle_rad", [0.0, 1e-13, 1e-9, 1e-4, 0.3, 1.5, 3.0, np.pi - 1e-9, np.pi])
def test_one_rotation_is_what_many_are(angle_rad: float) -> None:
    """One and many take different ways, with the same result."""
    axes = np.random.default_rng(4).normal(size=(20, 3))
    vectors = angle_rad * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    many = exp_so3(vectors)
    one = np.stack([exp_so3(v) for v in vectors])
    np.testing.assert_allclose(one, many, rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.stack([log_so3(R) for R in many]), log_so3(many), rtol=0, atol=1e-14)
    q = np.stack([quaternion_xyzw_from_R(R) for R in many])
    np.testing.assert_allclose(q, quaternion_xyzw_from_R(many), rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.stack([R_from_quaternion_xyzw(one) for one in q]), many, rtol=0, atol=1e-15)
