"""Movers in a sweep: each shot meets them where they are at its own instant."""

from dataclasses import replace
from math import cos, pi, sin

import numpy as np
import pytest
from plain_caster import plain_range

from gnd.fleet_sim import parts
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.lidar import Lidar, column_poses
from gnd.fleet_sim.movers import Mover, Movers
from gnd.fleet_sim.people import person
from gnd.fleet_sim.ray_kernels import state_at
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.sensors import HDL64E, SCALA, VLP16, LidarModel
from gnd.fleet_sim.shapes import Ball, Block, Post, Shape
from gnd.gnd_map.se3 import exp_so3

STEP_S = 0.02
TIMES = np.arange(-1.0, 1.0, STEP_S)
GROUND: list[Shape] = [Block(0.0, 0.0, 150.0, 150.0, -1.0, 0.0)]
WALL: list[Shape] = [*GROUND, Block(12.0, 0.0, 0.2, 30.0, 0.0, 6.0)]


def track(x: np.ndarray, y: np.ndarray, yaw: np.ndarray | float = 0.0, stride: np.ndarray | float = 0.0) -> np.ndarray:
    zero = np.zeros_like(TIMES)
    return np.stack([x + zero, y + zero, zero, yaw + zero, stride + zero], axis=1)


def car(x: np.ndarray, y: np.ndarray, yaw: np.ndarray | float = 0.0) -> Mover:
    shapes = parts.car(0.0, 0.0, 0.0, 0.0, 5)
    return Mover(shapes, (0.0,) * len(shapes), track(x, y, yaw))


def walker(x: np.ndarray, y: np.ndarray, yaw: float) -> Mover:
    return Mover(*person(3), track(x, y, yaw, 0.25 * np.sin(9.0 * TIMES)))


def crowd(*movers: Mover, reach_m: float = 200.0) -> Movers:
    return Movers(movers, float(TIMES[0]), STEP_S, reach_m)


def lively() -> Movers:
    """A car that turns, one that comes near, somebody who walks close by, somebody far away."""
    return crowd(
        car(9.0 + 0.0 * TIMES, 15.0 - 14.0 * TIMES, -pi / 2 + 0.8 * TIMES),
        car(30.0 - 25.0 * TIMES, np.full_like(TIMES, -3.0), pi),
        walker(2.0 + 1.5 * TIMES, 2.5 + 0.0 * TIMES, 0.3),
        walker(-40.0 + 0.0 * TIMES, 20.0 - 1.5 * TIMES, -pi / 2),
    )


def driving(t_s: np.ndarray) -> np.ndarray:
    """A sensor that drives, turns and leans."""
    T = np.tile(np.eye(4), (len(t_s), 1, 1))
    T[:, :3, :3] = exp_so3(np.outer(t_s, [0.1, 0.2, 0.7]) + np.array([0.02, -0.03, 0.1]))
    T[:, :3, 3] = np.outer(t_s, [9.0, 0.3, 0.0]) + np.array([0.0, 0.0, 1.2])
    return T


def standing(t_s: np.ndarray) -> np.ndarray:
    T = np.tile(np.eye(4), (len(t_s), 1, 1))
    T[:, 2, 3] = 1.2
    return T


def shape_at(shape: Shape, swing: float, state: np.ndarray) -> Shape:
    """The primitive of a mover as it stands in the street at one instant."""
    x, y, z, yaw, stride = state.tolist()
    ahead, left = shape.x_m + swing * stride, shape.y_m
    here = {"x_m": x + cos(yaw) * ahead - sin(yaw) * left, "y_m": y + sin(yaw) * ahead + cos(yaw) * left}
    match shape:
        case Block():
            up = {"bottom_m": shape.bottom_m + z, "top_m": shape.top_m + z, "yaw_rad": shape.yaw_rad + yaw}
            return replace(shape, **here, **up)
        case Post():
            return replace(shape, **here, bottom_m=shape.bottom_m + z, top_m=shape.top_m + z)
        case Ball():
            return replace(shape, **here, z_m=shape.z_m + z)


def plain_hit(movers: Movers, t_s: float, o: np.ndarray, d: np.ndarray, range_m: float) -> float:
    states = movers.at(np.array([t_s]))[:, 0]
    shapes = [
        shape_at(shape, swing, state)
        for mover, state in zip(movers.movers, states, strict=True)
        for shape, swing in zip(mover.shapes, mover.swing, strict=True)
    ]
    return plain_range(shapes, o, d, range_m)


@pytest.mark.parametrize("model", [VLP16, HDL64E, SCALA], ids=lambda m: m.name)
def test_shots_meet_movers_where_a_plain_caster_meets_them_at_that_instant(model: LidarModel) -> None:
    movers, scene, start_s = lively(), Scene.build(GROUND), 0.3
    T = column_poses(model, start_s, driving)
    without = Lidar(model).hits(scene, T)
    hits = Lidar(model).hits(scene, T, movers, start_s)
    on_mover = hits.primitive >= len(scene.packed)
    rng = np.random.default_rng(0)
    met, other = np.argwhere(on_mover), np.argwhere(~on_mover)
    sample = np.concatenate([rng.permutation(met)[:150], rng.permutation(other)[:250], _beside(on_mover, rng)])
    assert len(met) > 100
    t_s, directions = start_s + model.shot_times_ns() * 1e-9, model.directions()
    for column, beam in sample:
        pose = T[column] + model.shares[beam] * (T[column + 1] - T[column])
        d = pose[:3, :3] @ directions[column, beam]
        mover_m = plain_hit(movers, t_s[column, beam], pose[:3, 3], d, model.range_max_m)
        assert hits.range_m[column, beam] == pytest.approx(min(mover_m, without.range_m[column, beam]), rel=1e-9)
    np.testing.assert_array_equal(hits.primitive[~on_mover], without.primitive[~on_mover])
    np.testing.assert_array_equal(hits.range_m[~on_mover], without.range_m[~on_mover])


def _beside(on_mover: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Shots that just missed a mover: neighbours in their column or of their beam."""
    near = np.zeros_like(on_mover)
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        near |= np.roll(on_mover, step, axis)
    return np.asarray(rng.permutation(np.argwhere(near & ~on_mover))[:100])


def test_points_lie_on_the_car_of_their_own_instant_and_not_of_another() -> None:
    """A car crosses ahead at 14 m/s: over the 100 ms of a sweep it goes 1.4 m."""
    speed = 14.0
    movers = crowd(car(np.full_like(TIMES, 15.0), speed * TIMES, pi / 2))
    hits = Lidar(VLP16).hits(Scene.build(GROUND), column_poses(VLP16, -0.05, standing), movers, -0.05)
    on_car = hits.primitive >= 1
    y = (VLP16.directions()[on_car] * hits.range_m[on_car][:, None])[:, 1]
    t_s = -0.05 + VLP16.shot_times_ns()[on_car] * 1e-9
    half = movers.movers[0].shapes[0].half_x_m  # type: ignore[union-attr]
    assert on_car.sum() > 100
    assert np.all(np.abs(y - speed * t_s) < half + 1e-9), "within the car at the time of the shot"
    assert y.max() > half - 0.3
    assert y.min() < 0.3 - half
    for late_s in (-0.4, 0.4):
        aside = Lidar(VLP16).hits(Scene.build(GROUND), column_poses(VLP16, -0.05, standing), movers, -0.05 + late_s)
        assert not np.any((aside.primitive >= 1) & on_car & (np.abs(VLP16.directions()[..., 1]) < 0.05))


def test_a_mover_hides_what_is_behind_it_and_is_hidden_by_what_is_before() -> None:
    scene = Scene.build(WALL)
    T = column_poses(VLP16, 0.0, standing)
    free = Lidar(VLP16).hits(scene, T)
    before, behind = (crowd(car(np.full_like(TIMES, x), 0.0 * TIMES)) for x in (7.0, 16.0))
    hidden = Lidar(VLP16).hits(scene, T, behind, 0.0)
    np.testing.assert_array_equal(hidden.range_m, free.range_m)
    hits = Lidar(VLP16).hits(scene, T, before, 0.0)
    nearer = hits.range_m < free.range_m
    assert 100 < nearer.sum() == (hits.primitive >= len(scene.packed)).sum()
    assert np.all(free.primitive[nearer] >= 0), "it stands before wall and ground"
    assert np.all((hits.incidence > 0) & (hits.incidence <= 1.0 + 1e-12))


def test_states_are_those_of_the_plain_interpolation_and_hold_at_the_ends() -> None:
    movers = lively()
    t_s = np.array([-5.0, -1.0, -0.999, 0.0, 0.3333, 0.97, 0.98, 7.0])
    plain = movers.at(t_s)
    for mover in range(4):
        fast = [state_at(movers._crowd, mover, t) for t in t_s]
        np.testing.assert_allclose(np.array(fast), plain[mover], atol=1e-12)


def test_who_is_under_way() -> None:
    stops = np.where(TIMES < 0.3, 3.0 * TIMES, 0.9)
    movers = crowd(car(stops, 0.0 * TIMES), walker(1.0 * TIMES, 5.0 + 0.0 * TIMES, 0.0))
    cars = len(movers.movers[0].shapes)
    np.testing.assert_array_equal(movers.under_way(0.2), np.ones(len(movers.packed), bool))
    np.testing.assert_array_equal(movers.under_way(0.6), np.arange(len(movers.packed)) >= cars)


def test_movers_out_of_reach_are_not_there() -> None:
    one = car(np.full_like(TIMES, 20.0), 0.0 * TIMES)
    T = column_poses(VLP16, 0.0, standing)
    for reach_m, there in ((25.0, True), (19.0, False)):
        hits = Lidar(VLP16).hits(Scene.build(GROUND), T, crowd(one, reach_m=reach_m), 0.0)
        assert bool((hits.primitive >= 1).any()) is there


def test_a_person_has_legs_that_swing_against_each_other() -> None:
    shapes, swing = person(1)
    assert max(s.bounds()[4] for s in shapes) == pytest.approx(1.72, abs=0.2)
    assert min(s.bottom_m for s in shapes if isinstance(s, Post)) == 0.0
    assert sum(swing) == 0.0
    assert sorted(swing)[-1] == 1.0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Mover((), (), track(TIMES, TIMES)), "0 primitives"),
        (lambda: Mover((Ball(0, 0, 1, 1),), (0.0, 1.0), track(TIMES, TIMES)), "2 swings"),
        (lambda: Mover((Ball(0, 0, 1, 1),), (0.0,), np.zeros((4, 3))), r"\(4, 3\)"),
        (lambda: Mover((Ball(0, 0, 1, 1),), (0.0,), track(TIMES * np.nan, TIMES)), "100 numbers are not"),
        (lambda: Movers([], 0.0, STEP_S, 10.0), "one length"),
        (lambda: crowd(car(TIMES, TIMES), Mover((Ball(0, 0, 1, 1),), (0.0,), np.zeros((3, 5)))), r"\[3, 100\] samples"),
    ],
)
def test_impossible_movers_are_refused(make: object, words: str) -> None:
    with pytest.raises(DriveSimError, match=words):
        make()  # type: ignore[operator]
