"""The fast ray caster against a plain twin: every ray against every primitive, each formulated another way."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plain_caster import plain_range

from gnd.fleet_sim.errors import SceneError
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.shapes import Ball, Block, Post, Shape


def random_shapes(rng: np.random.Generator, count: int) -> list[Shape]:
    found: list[Shape] = [Block(0.0, 0.0, 40.0, 40.0, -2.0, -0.5, rise_y=0.02)]
    for _ in range(count):
        x, y, z = rng.uniform(-30, 30), rng.uniform(-30, 30), rng.uniform(-1, 3)
        kind = rng.integers(4)
        if kind < 2:
            turned = {"yaw_rad": rng.uniform(-4, 4), "rise_x": rng.uniform(-0.4, 0.4)} if kind else {}
            size = rng.uniform(0.05, 3, 3)
            found.append(Block(x, y, size[0], size[1], z, z + size[2], rise_y=0.1 * kind, **turned))
        elif kind == 2:
            found.append(Post(x, y, rng.uniform(0.03, 1), z, z + rng.uniform(0.1, 5)))
        else:
            found.append(Ball(x, y, z, rng.uniform(0.1, 1.5)))
    return found


def random_rays(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    directions = rng.normal(size=(count, 3)) * [1, 1, 0.3]
    origins = np.column_stack([rng.uniform(-33, 33, (count, 2)), rng.uniform(0.0, 4.0, count)])
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize(("seed", "cell_m"), [(0, 2.0), (1, 0.7), (2, 5.0)])
def test_the_grid_walk_meets_what_every_ray_against_every_primitive_meets(seed: int, cell_m: float) -> None:
    rng = np.random.default_rng(seed)
    shapes = random_shapes(rng, 50)
    origins, directions = random_rays(rng, 1200)
    ranges, index = Scene.build(shapes, cell_m=cell_m).cast(origins, directions, 45.0)
    expected = np.array([plain_range(shapes, o, d, 45.0) for o, d in zip(origins, directions, strict=True)])
    np.testing.assert_allclose(ranges, expected, rtol=1e-9)
    assert 0.25 < np.isfinite(expected).mean() < 0.9, "both hits and misses are needed for this test to say anything"
    np.testing.assert_array_equal(index >= 0, np.isfinite(expected))
    for i in np.flatnonzero(index >= 0)[:100]:
        assert plain_range([shapes[index[i]]], origins[i], directions[i], 45.0) == pytest.approx(ranges[i])


def test_ranges_are_metres_of_the_map_frame_in_a_turned_and_sheared_scene() -> None:
    rng = np.random.default_rng(5)
    shapes = random_shapes(rng, 40)
    turn, shear = (
        np.array([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1.0]]),
        np.array([[1, 0, 0], [0, 1, 0], [-0.05, 0, 1.0]]),
    )
    A = shear @ turn
    starts, directions = random_rays(rng, 500)
    origins = starts @ np.linalg.inv(A).T
    ranges, _ = Scene.build(shapes, A).cast(origins, directions, 60.0)
    expected = [plain_range(shapes, A @ o, A @ d, 60.0) for o, d in zip(origins, directions, strict=True)]
    np.testing.assert_allclose(ranges, expected, rtol=1e-9)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]),
    st.floats(-9.0, 9.0),
    st.floats(0.2, 1.8),
)
def test_rays_along_the_axes_meet_a_box_exactly(direction: tuple[float, float], aside: float, height: float) -> None:
    """Degenerate rays first: along an axis, along cell borders, along the box's own faces."""
    scene = Scene.build([Block(0.0, 0.0, 3.0, 3.0, 0.0, 2.0)], margin_m=20.0)
    d = np.array([*direction, 0.0])
    o = -10.0 * d + aside * np.array([-d[1], d[0], 0.0]) + [0.0, 0.0, height]
    ranges, index = scene.cast(o[None, :], d[None, :], 50.0)
    if abs(aside) < 3.0 - 1e-9:
        assert ranges[0] == pytest.approx(7.0, abs=1e-9)
        assert index[0] == 0
    elif abs(aside) > 3.0 + 1e-9:
        assert math.isinf(ranges[0])


def test_a_vertical_ray_meets_the_ground_below() -> None:
    scene = Scene.build([Block(0.0, 0.0, 10.0, 10.0, -1.0, 0.0)])
    ranges, _ = scene.cast(np.array([1.0, 2.0, 3.0]), np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]), 50.0)
    assert ranges[0] == pytest.approx(3.0)
    assert math.isinf(ranges[1])


def test_a_hit_beyond_the_range_is_a_miss() -> None:
    scene = Scene.build([Block(20.0, 0.0, 1.0, 1.0, 0.0, 2.0)], margin_m=25.0)
    origin, ahead = np.array([0.0, 0.0, 1.0]), np.array([[1.0, 0.0, 0.0]])
    assert math.isinf(scene.cast(origin, ahead, 18.9)[0][0])
    assert scene.cast(origin, ahead, 19.1)[0][0] == pytest.approx(19.0)


def test_an_origin_outside_the_scene_is_refused_with_numbers() -> None:
    scene = Scene.build([Block(0.0, 0.0, 1.0, 1.0, 0.0, 2.0)])
    with pytest.raises(SceneError, match=r"77\.0.*the scene spans"):
        scene.cast(np.array([77.0, 0.0, 0.0]), np.array([[1.0, 0.0, 0.0]]), 10.0)


def test_a_scene_without_primitives_and_flat_directions_are_refused() -> None:
    with pytest.raises(SceneError, match="at least one"):
        Scene.build([])
    with pytest.raises(SceneError, match=r"\(N, 3\)"):
        Scene.build([Ball(0, 0, 0, 1)]).cast(np.zeros(3), np.zeros((4, 2)), 1.0)
