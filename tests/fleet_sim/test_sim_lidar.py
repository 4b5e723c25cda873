import numpy as np
import pytest
from plain_caster import plain_returns

from gnd.fleet_sim.errors import SceneError
from gnd.fleet_sim.lidar import Lidar, Sweep, column_poses
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.sensors import MODELS, VLP16, LidarModel
from gnd.fleet_sim.shapes import Ball, Block, Post, Shape
from gnd.gnd_map.se3 import exp_so3

# A room: floor, four walls, a column, a ball; the sensor stands in its middle.
ROOM: list[Shape] = [
    Block(0.0, 0.0, 40.0, 40.0, -1.0, 0.0),
    Block(15.0, 0.0, 0.5, 20.0, 0.0, 12.0),
    Block(-15.0, 0.0, 0.5, 20.0, 0.0, 12.0),
    Block(0.0, 15.0, 20.0, 0.5, 0.0, 12.0),
    Block(0.0, -15.0, 20.0, 0.5, 0.0, 12.0),
    Post(6.0, 4.0, 0.5, 0.0, 5.0),
    Ball(-5.0, -6.0, 1.5, 1.0),
]


def at(x: float, y: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def standing(model: LidarModel, T: np.ndarray) -> np.ndarray:
    return np.tile(T, (model.columns + 1, 1, 1))


@pytest.mark.parametrize("name", MODELS)
def test_a_standing_sensor_sees_the_room_as_plain_casting_does(name: str) -> None:
    model = MODELS[name]
    T, scene = at(0.5, -1.0, 1.9), Scene.build(ROOM)
    hits = Lidar(model).hits(scene, standing(model, T))
    ranges, index = scene.cast(T[:3, 3], model.directions().reshape(-1, 3), model.range_max_m)
    np.testing.assert_allclose(hits.range_m.ravel(), ranges, rtol=1e-12)
    np.testing.assert_array_equal(hits.primitive.ravel(), index)


@pytest.mark.parametrize("name", MODELS)
def test_returns_are_those_of_the_plain_twin_to_the_bit(name: str) -> None:
    """In a room that fades: dark things at the end of what the sensor sees, and too near ones."""
    shapes = [*ROOM, Block(1.3, -1.0, 0.1, 0.3, 1.0, 2.5), Block(-60.0, 0.0, 1.0, 90.0, 0.0, 30.0, reflectivity=0.03)]
    shapes = [one for one in shapes if one != ROOM[2]]
    scene, lidar = Scene.build(shapes), Lidar(MODELS[name])
    poses = standing(lidar.model, at(0.5, -1.0, 1.9))
    sweep, rng = lidar.sweep(scene, poses, np.random.default_rng(4)), np.random.default_rng(4)
    shape = lidar.model.shot_times_ns().shape
    drawn = rng.standard_normal(shape), rng.random(shape)
    twin = plain_returns(lidar, lidar.hits(scene, poses), scene.packed, drawn)
    found = sweep.points_lidar_m, sweep.t_offset_ns, sweep.ring, sweep.primitive
    assert 0.05 * drawn[0].size < len(sweep.ring) < drawn[0].size
    for ours, plain in zip(found, twin, strict=True):
        np.testing.assert_array_equal(ours, plain)


def test_incidence_is_the_cosine_to_the_surface_normal() -> None:
    """Against normals found by tilting rays: the range's derivative gives the surface's direction."""
    scene, T = Scene.build(ROOM), at(0.5, -1.0, 1.9)
    hits = Lidar(VLP16).hits(scene, standing(VLP16, T))
    d = VLP16.directions()
    ahead = np.cross(d, [0.0, 0.0, 1.0])
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    points = []
    for offset in (np.zeros_like(d), 1e-5 * ahead, 1e-5 * np.cross(ahead, d)):
        tilted = (d + offset) / np.linalg.norm(d + offset, axis=-1, keepdims=True)
        ranges, index = scene.cast(T[:3, 3], tilted.reshape(-1, 3), 100.0)
        points.append((tilted.reshape(-1, 3) * ranges[:, None], index))
    same = (points[0][1] >= 0) & (points[0][1] == points[1][1]) & (points[0][1] == points[2][1])
    normal = np.cross(points[1][0][same] - points[0][0][same], points[2][0][same] - points[0][0][same])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    cosine = np.abs(np.einsum("ni,ni->n", normal, d.reshape(-1, 3)[same]))
    off = np.abs(cosine - hits.incidence.ravel()[same])
    assert np.quantile(off, 0.99) < 1e-3, "only rays at an edge, whose tilted neighbours meet another face, may differ"


@pytest.mark.parametrize("name", MODELS)
def test_every_point_carries_the_motion_at_its_own_time(name: str) -> None:
    """Put back with the true pose at its own time, each point lies on the wall; with one pose for all it does not."""
    scene = Scene.build(ROOM)
    model = MODELS[name]

    def pose_at(t_s: np.ndarray) -> np.ndarray:
        T = np.tile(at(-2.0, 0.0, 1.9), (len(t_s), 1, 1))
        T[:, 0, 3] += 15.0 * t_s
        T[:, :3, :3] = exp_so3(np.outer(t_s, [0.0, 0.0, 0.6]))
        return T

    hits = Lidar(model).hits(scene, column_poses(model, 0.0, pose_at))
    on_wall = hits.primitive == 1
    points, t_s = model.directions()[on_wall] * hits.range_m[on_wall][:, None], model.shot_times_ns()[on_wall] * 1e-9
    true, frozen = pose_at(t_s), pose_at(np.zeros(1))[0]
    x = np.einsum("ni,ni->n", true[:, 0, :3], points) + true[:, 0, 3]
    assert on_wall.sum() > 100
    np.testing.assert_allclose(x, 14.5, atol=1e-6)
    assert np.abs(points @ frozen[0, :3] + frozen[0, 3] - 14.5).max() > 0.1


@pytest.mark.parametrize("name", MODELS)
def test_noise_rings_and_times_are_those_of_the_model(name: str) -> None:
    model, scene, T = MODELS[name], Scene.build(ROOM), standing(MODELS[name], at(0.5, -1.0, 1.9))
    lidar, rng = Lidar(model), np.random.default_rng(0)
    hits, sweeps = lidar.hits(scene, T), [lidar.sweep(scene, T, rng) for _ in range(4)]
    for sweep in sweeps:
        assert np.all(np.diff(sweep.t_offset_ns.astype(np.int64)) >= 0), "points keep the order of firing"
        assert sweep.t_offset_ns.max() < model.period_ns
    sweep = sweeps[0]
    shot = _shots(sweep, model)
    np.testing.assert_array_equal(model.shot_times_ns().ravel()[shot], sweep.t_offset_ns)
    elevation = np.arcsin(sweep.points_lidar_m[:, 2] / np.linalg.norm(sweep.points_lidar_m, axis=1))
    np.testing.assert_allclose(np.sin(elevation), model.directions().reshape(-1, 3)[shot, 2], atol=3e-3)
    off = np.concatenate([_ranges(s) - hits.range_m.ravel()[_shots(s, model)] for s in sweeps])
    rounded = np.hypot(model.range_sigma_m, model.range_step_m / np.sqrt(12))
    assert off.std() == pytest.approx(rounded, rel=0.04)
    assert abs(off.mean()) < 2e-3


@pytest.mark.parametrize("name", MODELS)
def test_returns_of_a_bright_near_wall_are_lost_at_the_share_of_the_model(name: str) -> None:
    model = MODELS[name]
    scene, T = Scene.build([Block(0.0, 0.0, 40.0, 40.0, -1.0, 0.0), *ROOM[1:5]]), at(0.0, 0.0, 3.0)
    lidar = Lidar(model)
    hits, sweep = (
        lidar.hits(scene, standing(model, T)),
        lidar.sweep(scene, standing(model, T), np.random.default_rng(1)),
    )
    on_wall = (hits.primitive > 0).ravel()
    seen = np.zeros(on_wall.size, bool)
    seen[_shots(sweep, model)] = True
    lost = 1.0 - seen[on_wall].mean()
    assert lost == pytest.approx(model.loss, abs=5 * np.sqrt(model.loss / on_wall.sum()))


def _ranges(sweep: Sweep) -> np.ndarray:
    return np.linalg.norm(sweep.points_lidar_m.astype(float), axis=1)


def _shots(sweep: Sweep, model: LidarModel) -> np.ndarray:
    """Index of the shot of each point: its cycle and its beam, which its ring names."""
    beam = np.argsort(model.rings)[sweep.ring]
    return sweep.t_offset_ns.astype(int) // model.cycle_ns * model.beams + beam


def test_a_share_of_bright_returns_is_lost_and_dark_grazing_ones_more() -> None:
    scene, T = Scene.build([Block(0.0, 0.0, 150.0, 150.0, -1.0, 0.0, reflectivity=0.15), *ROOM[1:5]]), at(0.0, 0.0, 1.9)
    lidar, rng = Lidar(VLP16), np.random.default_rng(0)
    hits = lidar.hits(scene, standing(VLP16, T))
    sweeps = [lidar.sweep(scene, standing(VLP16, T), rng) for _ in range(4)]
    walls = int((hits.primitive > 0).sum())
    on_walls = [np.abs(s.points_lidar_m[:, :2]).max(axis=1) > 14.3 for s in sweeps]
    assert np.mean([w.sum() for w in on_walls]) / walls == pytest.approx(0.99, abs=0.005)
    open_scene = Scene.build([Block(0.0, 0.0, 150.0, 150.0, -1.0, 0.0, reflectivity=0.15)])
    far = lidar.sweep(open_scene, standing(VLP16, T), rng)
    met = lidar.hits(open_scene, standing(VLP16, T)).range_m
    ranges = np.linalg.norm(far.points_lidar_m, axis=1)
    assert np.isfinite(met).sum() > len(ranges), "asphalt seen at a grazing angle gives no echo"
    assert 15.0 < ranges.max() < 60.0


def test_returns_outside_the_range_are_not_given() -> None:
    near = Scene.build([Block(0.0, 0.0, 9.0, 9.0, -1.0, 0.0), Post(0.8, 0.0, 0.1, 0.0, 5.0)])
    sweep = Lidar(VLP16).sweep(near, standing(VLP16, at(0.0, 0.0, 1.9)), np.random.default_rng(0))
    assert np.linalg.norm(sweep.points_lidar_m, axis=1).min() > 0.99 * VLP16.range_min_m


def test_a_wrong_number_of_poses_is_refused() -> None:
    with pytest.raises(SceneError, match=r"VLP-16 needs poses"):
        Lidar(VLP16).hits(Scene.build(ROOM), np.tile(np.eye(4), (10, 1, 1)))
