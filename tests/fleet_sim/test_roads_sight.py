"""What hides what on a road, against lines of sight walked step by step."""

import numpy as np
import pytest

from gnd.fleet_sim.roads.curve import of_curvature
from gnd.fleet_sim.roads.route import Route, placed
from gnd.fleet_sim.roads.sight import CAMERA, LIDAR, PlacedBoxes, hidden, occluder_ranges, placed_boxes, polar
from gnd.fleet_sim.roads.traffic import Boxes
from gnd.gnd_map.geodesy import LocalFrame


def scattered(rng: np.random.Generator, looks: int, boxes: int) -> PlacedBoxes:
    """Boxes of all sizes anywhere around the looks, two or three a look."""
    return PlacedBoxes(
        look=np.repeat(np.arange(looks), boxes),
        box=np.tile(np.arange(boxes), looks),
        xy_m=rng.uniform(-40.0, 80.0, (looks * boxes, 2)),
        heading_rad=rng.uniform(-4.0, 4.0, looks * boxes),
        half_m=rng.uniform(0.8, 9.0, (looks * boxes, 2)),
        height_m=rng.uniform(1.0, 5.0, looks * boxes),
    )


def inside(points: np.ndarray, box: PlacedBoxes, index: int) -> np.ndarray:
    """Which points (K, 3) lie in a box."""
    c, s = np.cos(box.heading_rad[index]), np.sin(box.heading_rad[index])
    local = (points[:, :2] - box.xy_m[index]) @ np.array([[c, -s], [s, c]])
    return (np.abs(local) <= box.half_m[index]).all(axis=1) & (points[:, 2] < box.height_m[index])


def test_lines_of_sight_are_blocked_where_steps_along_them_meet_a_box() -> None:
    rng = np.random.default_rng(1)
    looks, features, eye_m = 60, 12, 1.3
    poses = np.column_stack([rng.uniform(-5, 5, (looks, 2)), rng.uniform(-3, 3, looks)])
    xy, height = rng.uniform(-10.0, 80.0, (features, 2)), rng.uniform(0.5, 7.0, features)
    boxes = scattered(rng, looks, 3)
    found = hidden(poses, xy, height, np.ones((looks, features), dtype=bool), boxes, eye_m)
    share = np.linspace(0.0, 1.0, 4001)[:, None]
    doubtful, blocked = 0, 0
    for look in range(looks):
        for k in range(features):
            start, end = np.append(poses[look, :2], eye_m), np.append(xy[k], height[k])
            walk = start + share * (end - start)
            steps = sum(int(inside(walk, boxes, b).sum()) for b in np.flatnonzero(boxes.look == look))
            blocked += steps > 0
            if found[look, k] != (steps > 0):
                doubtful += 1
                assert steps <= 2, "only where a corner is touched"
    assert 50 < blocked < 600
    assert doubtful <= 3


def test_what_is_not_in_view_is_not_hidden() -> None:
    rng = np.random.default_rng(2)
    boxes = scattered(rng, 5, 3)
    view = np.zeros((5, 4), dtype=bool)
    assert not hidden(np.zeros((5, 3)), rng.uniform(0, 80, (4, 2)), np.full(4, 2.0), view, boxes, 1.3).any()


@pytest.mark.parametrize("view", [CAMERA, LIDAR])
def test_occluder_ranges_are_where_rays_enter_tall_boxes(view: object) -> None:
    assert view in (CAMERA, LIDAR)
    sensor = CAMERA if view is CAMERA else LIDAR
    rng = np.random.default_rng(3)
    poses = np.column_stack([rng.uniform(-5, 5, (8, 2)), rng.uniform(-3, 3, 8)])
    boxes = scattered(rng, 8, 2)
    found = occluder_ranges(sensor, poses, boxes)
    reach = np.linspace(0.0, sensor.range_m, 8001)
    for look in range(8):
        for k in range(0, found.shape[1], 7):
            angle = poses[look, 2] + sensor.azimuths_rad()[k]
            walk = np.column_stack([poses[look, :2] + reach[:, None] * [np.cos(angle), np.sin(angle)], np.zeros(8001)])
            tall = [b for b in np.flatnonzero(boxes.look == look) if boxes.height_m[b] > 2.0]
            met = np.any([inside(walk, boxes, b) for b in tall], axis=0) if tall else np.zeros(8001, dtype=bool)
            if met.sum() > 2:
                assert found[look, k] == pytest.approx(reach[met.argmax()], abs=0.02)
            elif not met.any():
                assert np.isinf(found[look, k]) or found[look, k] > sensor.range_m - 0.05


def test_only_boxes_that_are_near_are_placed() -> None:
    line = of_curvature([(2000.0, 0.0)], 0.0)
    features = placed(line, [(500.0, -9.0, "warning", 2.5, "normal")], np.random.default_rng(0))
    route = Route(
        "straight", 0, LocalFrame(0.8, 0.1, 0.0), line, (-5.25, -1.75), (-7.0, 0.0), features, "signs", (25, 33)
    )
    boxes = Boxes(np.array([100.0, 900.0]), np.array([20.0, 20.0]), np.array([0, 1]), np.tile([16.5, 2.5, 4.0], (2, 1)))
    t_s = np.array([0.0, 10.0, 40.0])
    poses = np.array([[50.0, -1.75, 0.0], [250.0, -1.75, 0.0], [1650.0, -1.75, 0.0]])
    found = placed_boxes(route, boxes, t_s, poses)
    assert found.look.tolist() == [0, 1, 2]
    assert found.box.tolist() == [0, 0, 1]
    assert found.xy_m == pytest.approx(np.array([[100.0, -5.25], [300.0, -5.25], [1700.0, -1.75]]))


def test_polar_places_are_seen_from_the_vehicle() -> None:
    range_m, bearing = polar(np.array([[1.0, 2.0, np.pi / 2]]), np.array([[1.0, 12.0], [11.0, 2.0], [1.0, -3.0]]))
    assert range_m == pytest.approx(np.array([[10.0, 10.0, 5.0]]))
    assert np.abs(bearing) == pytest.approx(np.array([[0.0, np.pi / 2, np.pi]]))
