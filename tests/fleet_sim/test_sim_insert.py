"""Insertion by construction: a scan with an object put in equals a scan of a scene that has it."""

import numpy as np
import pytest

from gnd.fleet_sim.errors import SimError
from gnd.fleet_sim.insert import Inserter
from gnd.fleet_sim.lidar import Lidar
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.sensors import VLP16
from gnd.fleet_sim.shapes import Block, Post, Shape
from gnd.gnd_map.se3 import exp_so3

ROOM: list[Shape] = [
    Block(0.0, 0.0, 40.0, 40.0, -1.0, 0.0),
    Block(15.0, 0.0, 0.5, 20.0, 0.0, 12.0),
    Block(-15.0, 0.0, 0.5, 20.0, 0.0, 12.0),
    Block(0.0, 15.0, 20.0, 0.5, 0.0, 12.0),
    Block(0.0, -15.0, 20.0, 0.5, 0.0, 12.0),
]
OBJECTS: list[Shape] = [Block(6.0, 2.0, 1.0, 0.4, 0.0, 1.8, 0.3), Post(-5.0, -4.0, 0.35, 0.0, 3.0)]


def moving_poses() -> np.ndarray:
    t = np.linspace(0.0, 0.1, VLP16.columns + 1)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3] = exp_so3(np.outer(t, [0.05, -0.1, 0.5]))
    T[:, :3, 3] = np.array([0.4, -0.2, 1.9]) + np.outer(t, [9.0, 0.5, 0.0])
    return T


def points_and_poses(shapes: list[Shape]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noise-free points of a sweep, the exact pose of each, and the primitive that it lies on."""
    poses = moving_poses()
    hits = Lidar(VLP16).hits(Scene.build(shapes), poses)
    share = VLP16.shares
    T = poses[:-1, None] + share[None, :, None, None] * (poses[1:] - poses[:-1])[:, None]
    seen = hits.primitive >= 0
    points = VLP16.directions()[seen] * hits.range_m[seen][:, None]
    return points.astype(np.float32), T[seen], hits.primitive[seen]


def test_inserted_points_are_those_of_a_scene_with_the_object() -> None:
    without, poses, _ = points_and_poses(ROOM)
    with_objects, _, primitive = points_and_poses(ROOM + OBJECTS)
    assert len(without) == len(with_objects), "every beam of the closed room returns"
    inserted = Inserter(OBJECTS).insert(without, poses)
    np.testing.assert_array_equal(inserted.hit, primitive >= len(ROOM))
    np.testing.assert_allclose(inserted.points_lidar_m, with_objects, atol=2e-5)
    assert inserted.hit.sum() > 300


def test_points_that_miss_the_object_keep_their_bits() -> None:
    points, poses, _ = points_and_poses(ROOM)
    inserted = Inserter(OBJECTS).insert(points, poses)
    np.testing.assert_array_equal(inserted.points_lidar_m[~inserted.hit], points[~inserted.hit])


def test_nothing_is_left_behind_the_object() -> None:
    """Rays to the points of the new scan meet no part of the object before their end."""
    points, poses, _ = points_and_poses(ROOM)
    inserted = Inserter(OBJECTS).insert(points, poses)
    again = Inserter(OBJECTS).insert((inserted.points_lidar_m * 0.9999).astype(np.float32), poses)
    assert not again.hit.any()


def test_a_point_before_the_object_stays() -> None:
    point = np.array([[4.0, 1.3, -1.0]], np.float32)
    T = np.eye(4)
    T[2, 3] = 1.9
    assert not Inserter(OBJECTS).insert(point, T).hit[0]
    assert Inserter(OBJECTS).insert(point * 2, T).hit[0]


def test_moved_points_carry_range_noise_when_asked() -> None:
    points, poses, _ = points_and_poses(ROOM)
    clean = Inserter(OBJECTS).insert(points, poses)
    noisy = Inserter(OBJECTS).insert(points, poses, np.random.default_rng(0), 0.02)
    a, b = (np.linalg.norm(s.points_lidar_m[s.hit].astype(float), axis=1) for s in (clean, noisy))
    assert (b - a).std() == pytest.approx(0.02, rel=0.15)


def test_a_sensor_far_away_sees_nothing_and_odd_arrays_are_refused() -> None:
    T = np.eye(4)
    T[0, 3] = 5000.0
    assert not Inserter(OBJECTS).insert(np.array([[-4996.0, 0.0, 1.0]], np.float32), T).hit.any()
    assert len(Inserter(OBJECTS).insert(np.empty((0, 3), np.float32), T).hit) == 0
    with pytest.raises(SimError, match="poses"):
        Inserter(OBJECTS).insert(np.zeros((5, 3), np.float32), np.zeros((4, 4, 4)))
