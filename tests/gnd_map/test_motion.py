"""Deskewing: a static world seen from a moving vehicle comes back as it stands."""

import numpy as np
import pytest

from gnd.gnd_map.errors import MotionError, ShapeError
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, interpolate_poses, transform

START_NS = 1_790_000_000_000_000_000
FAR_AWAY_M = np.array([4000.0, 3000.0, 30.0])
MOUNT = T_from_R_t(exp_so3(np.array([0.01, -0.02, 1.2])), np.array([1.2, 0.1, 1.8]))


def curve(speed_mps: float = 15.0, yaw_rate_radps: float = 0.5, step_ns: int = 5_000_000) -> Trajectory:
    """A vehicle on a circle, with some pitching; the pose in a frame 5 km from its origin."""
    t_ns = START_NS + np.arange(-4, 45) * step_ns
    t_s = (t_ns - START_NS) * 1e-9
    turn = np.stack([np.zeros_like(t_s), 0.02 * np.sin(20.0 * t_s), yaw_rate_radps * t_s], axis=1)
    radius = speed_mps / yaw_rate_radps
    place = np.stack([radius * np.sin(turn[:, 2]), radius * (1 - np.cos(turn[:, 2])), 0 * t_s], axis=1)
    return Trajectory(t_ns, T_from_R_t(exp_so3(turn), place + FAR_AWAY_M))


def sweep(n: int = 3_000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Static points of the map, their times, and how the LiDAR sees them at these times."""
    rng = np.random.default_rng(3)
    p_map = rng.uniform(-60.0, 60.0, (n, 3)) + FAR_AWAY_M
    offset = np.sort(rng.integers(0, 100_000_000, n)).astype(np.uint32)
    poses = curve().at(START_NS + offset.astype(np.int64)) @ MOUNT
    seen = np.einsum("nij,nj->ni", T_inverse(poses)[:, :3, :3], p_map) + T_inverse(poses)[:, :3, 3]
    return p_map, offset, seen


@pytest.mark.parametrize("after_ns", [0, 50_000_000, 100_000_000])
def test_static_points_come_back_where_they_are(after_ns: int) -> None:
    p_map, offset, seen = sweep()
    reference_ns = START_NS + after_ns
    p_vehicle = deskew(seen, offset, START_NS, curve(), MOUNT, reference_ns)
    np.testing.assert_allclose(transform(curve().at(reference_ns), p_vehicle), p_map, rtol=0, atol=1e-4)


def test_the_kernel_is_the_plain_pose_of_every_point() -> None:
    _, offset, seen = sweep(500)
    poses = curve()
    reference = T_inverse(poses.at(START_NS))
    each = reference @ interpolate_poses(poses.t_ns, poses.T_dst_vehicle, START_NS + offset.astype(np.int64)) @ MOUNT
    plain = np.einsum("nij,nj->ni", each[:, :3, :3], seen) + each[:, :3, 3]
    np.testing.assert_allclose(deskew(seen, offset, START_NS, poses, MOUNT, START_NS), plain, rtol=0, atol=1e-4)


def test_without_deskewing_the_world_would_bend() -> None:
    p_map, _, seen = sweep()
    rigid = transform(curve().at(START_NS) @ MOUNT, seen)
    assert np.abs(rigid - p_map).max() > 1.0


def test_a_standing_vehicle_sees_a_rigid_world() -> None:
    still = Trajectory(curve().t_ns, np.tile(np.eye(4), (len(curve()), 1, 1)))
    points = np.random.default_rng(1).normal(size=(100, 3)).astype(np.float32)
    offset = np.arange(100) * 1_000_000
    np.testing.assert_allclose(
        deskew(points, offset, START_NS, still, MOUNT, START_NS), transform(MOUNT, points), atol=1e-12
    )


def test_an_empty_sweep_stays_empty() -> None:
    assert deskew(np.empty((0, 3)), np.empty(0, np.uint32), START_NS, curve(), MOUNT, START_NS).shape == (0, 3)


def test_a_sweep_beyond_the_trajectory_is_refused() -> None:
    _, offset, seen = sweep(50)
    with pytest.raises(MotionError, match="outside the poses"):
        deskew(seen, offset, START_NS + 1_000_000_000, curve(), MOUNT, START_NS)


def test_bad_sweeps_are_refused() -> None:
    _, offset, seen = sweep(50)
    with pytest.raises(ShapeError, match="t_offset_ns"):
        deskew(seen, offset[:-1], START_NS, curve(), MOUNT, START_NS)
    seen[7, 1] = np.nan
    with pytest.raises(ShapeError, match="1 of 150 values are not finite"):
        deskew(seen, offset, START_NS, curve(), MOUNT, START_NS)


def test_a_trajectory_answers_one_time_or_many() -> None:
    poses = curve()
    assert poses.at(START_NS).shape == (4, 4)
    assert poses.at([START_NS, START_NS + 7]).shape == (2, 4, 4)


def test_a_trajectory_must_run_forward() -> None:
    with pytest.raises(MotionError, match="pose 2 of 3"):
        Trajectory(np.array([0, 5, 5]), np.tile(np.eye(4), (3, 1, 1)))


@pytest.mark.parametrize("turn_rad", [0.0, 1e-12, 1e-6, 0.4, 2.0, 3.0, np.pi - 1e-7])
def test_poses_of_a_trajectory_are_those_of_the_plain_interpolation(turn_rad: float) -> None:
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(12, 3))
    steps = exp_so3(turn_rad * axes / np.linalg.norm(axes, axis=1, keepdims=True))
    R = [exp_so3(rng.normal(size=3))]
    for step in steps[1:]:
        R.append(R[-1] @ step)
    t_ns = START_NS + np.cumsum(rng.integers(1, 30_000_000, len(R)))
    path = Trajectory(t_ns, T_from_R_t(np.stack(R), rng.normal(scale=1e3, size=(len(R), 3))))
    query = np.concatenate([t_ns, rng.integers(t_ns[0] - 10**7, t_ns[-1] + 10**7, 200)])
    plain = interpolate_poses(t_ns, path.T_dst_vehicle, query, tolerance_ns=10**8)
    np.testing.assert_allclose(path.at(query), plain, atol=1e-9)
    np.testing.assert_allclose(path.at(int(query[-1])), plain[-1], atol=1e-9)
    one = Trajectory(t_ns[:1], path.T_dst_vehicle[:1])
    np.testing.assert_array_equal(one.at(t_ns[0] + np.arange(2)), np.repeat(one.T_dst_vehicle, 2, axis=0))
